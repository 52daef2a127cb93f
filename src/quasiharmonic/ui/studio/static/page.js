// The page: the socket to the worker, the view, and the controls.

import { Film } from "./film.js";
import { decodeFrame, encodeFrame } from "./frames.js";
import { showOptions } from "./options.js";
import { Panel } from "./panel.js";
import { createView } from "./view.js";

const $ = (id) => document.getElementById(id);
// Names of models, images and drawings, in the order in which they are opened if several are dropped.
const KINDS = [/\.(obj|off|ply|glb|stl)$/i, /\.(png|jpe?g)$/i, /\.svg$/i];
const RATE_OVER = 1000; // window in milliseconds for the rate of maps

class Page {
  constructor() {
    this.mostBytes = Infinity;
    this.arrivals = [];
    this.film = new Film();
    this.view = createView($("view"), {
      send: (message, arrays) => this.send(message, arrays),
      measured: new URLSearchParams(location.search).has("measured"),
      pictured: (picture) => this.panel.image(picture),
    });
    this.panel = new Panel(this);
    this.connect();
  }

  connect() {
    const address = new URL("socket", location.href);
    address.protocol = "ws:";
    address.search = `session=${sessionName()}`;
    this.socket = new WebSocket(address);
    this.socket.binaryType = "arraybuffer";
    this.socket.onmessage = (event) => this.receive(decodeFrame(event.data));
    this.socket.onclose = (event) => {
      this.view.hands.forget();
      const { status } = this.panel;
      if (event.code === 1009) status.note("That file is too large. The page restarts.");
      else if (event.code === 1013) status.refused(event.reason);
      else if (event.code === 4001) status.elsewhere();
      else if (event.code === 1006 || event.code === 1001) status.disconnected();
      if (event.code !== 1009 && event.code !== 1011) return;
      status.restarting();
      setTimeout(() => this.connect(), 1500);
    };
  }

  send(message, arrays) {
    // What is drawn by hand follows the options of Unwrap, and what is moved those of the islands.
    if (["seam", "erase"].includes(message.do)) message.symmetry = $("unwrap-symmetry").value;
    if (message.do === "place" && $("snap").checked) message.resolution = Number($("resolution").value);
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(encodeFrame(message, arrays));
    else if (!["gone", "restarting"].includes(document.body.dataset.state)) this.panel.status.disconnected();
  }

  receive(frame) {
    const { header, arrays } = frame;
    if (header.kind === "hello") {
      this.mostBytes = header.most_bytes;
      if (!$("unwrap-options").childElementCount) showOptions(header);
    }
    else if (header.kind === "note") this.panel.status.note(header.text);
    else if (header.kind === "busy") this.panel.status.busy(header.what);
    else if (header.kind === "progress") this.panel.status.progress(header);
    else if (header.kind === "saved") this.panel.unsaved = false;
    else if (header.kind === "file") {
      this.panel.status.forget();
      this.download(header.name, new Blob([arrays.content]));
    }
    else this.view.receive(frame);
    if (header.kind === "surface") {
      this.film.clear();
      this.panel.surface(header);
    } else if (header.kind === "map") {
      if (arrays.places) {
        // A film contains only certified maps.
        if (header.injective) this.film.add(header.start === undefined ? arrays.places : this.view.scene.places.slice());
        this.count();
      }
      this.panel.map(header, Boolean(arrays.places), this.arrivals.length);
    } else if (header.kind === "obstructions") {
      this.panel.status.obstructions(header.obstructions);
    }
  }

  count() {
    const now = performance.now();
    this.arrivals.push(now);
    while (this.arrivals[0] < now - RATE_OVER) this.arrivals.shift();
  }

  /** Take files that the user opened or dropped together: a model first, then an image for it. */
  async takeAll(files) {
    const rank = (file) => KINDS.findIndex((suffixes) => suffixes.test(file.name));
    const chosen = KINDS.map((_, kind) => files.find((file) => rank(file) === kind)).filter(Boolean);
    for (const file of chosen.length ? chosen : files.slice(0, 1)) await this.take(file);
  }

  /** Upload a file of the user: a model, an image for it, or a drawing of an outline. */
  async take(file) {
    if (file.size > this.mostBytes) {
      const mega = (bytes) => `${Math.ceil(bytes / 2 ** 20).toLocaleString("en")} MB`;
      this.panel.status.note(`${file.name} has ${mega(file.size)}, more than ${mega(this.mostBytes)}: map it with the command qhm map.`);
      return;
    }
    const content = new Uint8Array(await file.arrayBuffer());
    const suffix = file.name.toLowerCase().split(".").pop();
    const what = { svg: "drawing", png: "image", jpg: "image", jpeg: "image" }[suffix] ?? "load";
    if (what !== "drawing") this.panel.status.forget();
    this.send({ do: what, name: file.name.slice(-200) }, { content });
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
    else this.panel.status.note("This browser cannot record films.");
  }
}

/** Return the name of this tab's session, with which it continues after a reload. */
function sessionName() {
  let name = sessionStorage.getItem("qhm-session");
  if (!name) {
    name = Array.from(crypto.getRandomValues(new Uint8Array(16)), (byte) => byte.toString(16).padStart(2, "0")).join("");
    sessionStorage.setItem("qhm-session", name);
  }
  return name;
}

window.studio = new Page();
