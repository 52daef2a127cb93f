// The page: the socket to the worker, the view, and the controls.

import { Film } from "./film.js";
import { decodeFrame, encodeFrame } from "./frames.js";
import { Panel } from "./panel.js";
import { createView } from "./view.js";

const $ = (id) => document.getElementById(id);
const RATE_OVER = 1000; // window in milliseconds for the rate of maps

class Page {
  constructor() {
    this.mostBytes = Infinity;
    this.arrivals = [];
    this.film = new Film();
    this.view = createView($("view"), {
      send: (message, arrays) => this.send(message, arrays),
      measured: new URLSearchParams(location.search).has("measured"),
    });
    this.panel = new Panel(this);
    this.connect();
  }

  connect() {
    const address = new URL("socket", location.href);
    address.protocol = "ws:";
    address.search = "";
    this.socket = new WebSocket(address);
    this.socket.binaryType = "arraybuffer";
    this.socket.onmessage = (event) => this.receive(decodeFrame(event.data));
    this.socket.onclose = (event) => {
      this.view.hands.forget();
      if (event.code === 1009) this.panel.note("That file is too large. The page restarts.");
      else if (event.code === 1013) this.panel.refused(event.reason);
      else if (event.code === 1006) this.panel.disconnected();
      if (event.code === 1009 || event.code === 1011) setTimeout(() => this.connect(), 1500);
    };
  }

  send(message, arrays) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(encodeFrame(message, arrays));
    else if (document.body.dataset.state !== "gone") this.panel.disconnected();
  }

  receive(frame) {
    const { header, arrays } = frame;
    if (header.kind === "hello") this.mostBytes = header.most_bytes;
    else if (header.kind === "note") this.panel.note(header.text);
    else if (header.kind === "busy") this.panel.busy(header.what);
    else if (header.kind === "progress") this.panel.progress(header);
    else if (header.kind === "file") this.download(header.name, new Blob([arrays.content]));
    else this.view.receive(frame);
    if (header.kind === "surface") {
      this.film.clear();
      this.panel.surface(header);
    } else if (header.kind === "map") {
      if (arrays.places) {
        // A film contains only certified maps.
        if (header.injective) this.film.add(arrays.places);
        this.count();
      }
      this.panel.map(header, Boolean(arrays.places), this.arrivals.length);
    } else if (header.kind === "obstructions") {
      this.panel.obstructions(header.obstructions);
    }
  }

  count() {
    const now = performance.now();
    this.arrivals.push(now);
    while (this.arrivals[0] < now - RATE_OVER) this.arrivals.shift();
  }

  /** Upload a file of the user: a surface, or a drawing of an outline. */
  async take(file) {
    if (file.size > this.mostBytes) {
      const mega = (bytes) => `${Math.ceil(bytes / 2 ** 20).toLocaleString("en")} MB`;
      this.panel.note(`${file.name} has ${mega(file.size)}, more than ${mega(this.mostBytes)}: map it with the command qhm map.`);
      return;
    }
    const content = new Uint8Array(await file.arrayBuffer());
    const drawing = file.name.toLowerCase().endsWith(".svg");
    this.send({ do: drawing ? "drawing" : "load", name: file.name.slice(-150) }, { content });
  }

  download(name, blob) {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = name;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
  }

  savePicture() {
    this.view.picture().toBlob((blob) => this.download("map.png", blob), "image/png");
  }

  async saveFilm() {
    const blob = await this.film.record(this.view);
    if (blob) this.download("map.webm", blob);
    else this.panel.note("This browser cannot record films.");
  }
}

window.studio = new Page();
