// The controls beside the view.

import { Islands } from "./islands.js";
import { listenForKeys } from "./keys.js";
import { chosenOptions } from "./options.js";
import { Status } from "./status.js";

const $ = (id) => document.getElementById(id);

export class Panel {
  constructor(page) {
    this.page = page;
    this.status = new Status(page);
    this.islands = new Islands((message) => page.send(message));
    this.unsaved = false;
    const { view } = page;
    const send = (message) => page.send(message);

    for (const input of document.querySelectorAll("input[name=tool]")) {
      input.addEventListener("change", () => this.tool(input.value));
    }
    for (const input of document.querySelectorAll("input[name=colouring]")) {
      input.addEventListener("change", () => this.colour(input.value));
    }
    for (const id of ["edges", "seams", "grid"]) $(id).addEventListener("change", () => view.set({ [id]: $(id).checked }));
    $("shape").addEventListener("change", () => ($("letter").hidden = $("shape").value !== "letter"));
    $("letter").addEventListener("input", (event) => event.isComposing || this.#letter());
    $("outline").addEventListener("submit", (event) => {
      event.preventDefault();
      const shape = $("shape").value;
      if (shape === "letter" && !this.#letter()) this.status.note("Type a letter first.");
      else if (shape) send({ do: "outline", to: shape === "letter" ? `letter:${this.#letter()}` : shape });
    });
    for (const id of ["undo", "redo", "flatten", "save", "stop", "turn", "repair"]) $(id).addEventListener("click", () => send({ do: id }));
    $("unwrap").addEventListener("click", () => this.unwrap());
    const place = (message) => () => send({ do: "place", to: [0, 0], ...message });
    $("smaller").addEventListener("click", place({ scale: 0.9 }));
    $("larger").addEventListener("click", place({ scale: 1 / 0.9 }));
    $("mirror").addEventListener("click", place({ mirror: true }));
    $("snap").addEventListener("change", () => $("snap").checked && place({})());
    $("weld").addEventListener("click", () => send({ do: "weld", ...this.#size() }));
    for (const button of document.querySelectorAll(".view")) {
      button.addEventListener("click", () => view.lookFrom(button.dataset.view));
    }
    $("pack").addEventListener("click", () => send({ do: "pack", ...this.#size() }));
    $("glb").addEventListener("click", () => send({ do: "save", format: "glb" }));
    $("select-all").addEventListener("click", () => send({ do: "select", islands: [] }));
    $("polish").addEventListener("click", () => send({ do: "polish", energy: $("polish-energy").value, slide: $("slide").checked }));
    $("by-angle").addEventListener("click", () => send({ do: "corners" }));
    $("fit").addEventListener("click", () => view.fit());
    $("png").addEventListener("click", () => page.savePicture());
    $("play").addEventListener("click", () => page.film.play(view));
    $("film").addEventListener("click", () => page.saveFilm());
    $("help").addEventListener("click", () => $("keys").showModal());
    $("note-close").addEventListener("click", () => this.status.forget());
    for (const id of ["open", "svg", "image"]) {
      $(id).addEventListener("change", () => {
        if ($(id).files.length) page.takeAll([...$(id).files]);
        $(id).value = "";
      });
    }
    for (const button of document.querySelectorAll(".copy")) {
      button.addEventListener("click", () => navigator.clipboard.writeText($(button.dataset.of).textContent));
    }
    this.#drops();
    listenForKeys(this);
    window.addEventListener("beforeunload", (event) => {
      if (this.unsaved) event.preventDefault();
    });
  }

  #drops() {
    for (const kind of ["dragover", "drop"]) {
      document.addEventListener(kind, (event) => {
        event.preventDefault();
        if (kind === "drop" && event.dataTransfer.files.length) this.page.takeAll([...event.dataTransfer.files]);
      });
    }
  }

  /** Shorten the field of the letter to one character, which may have two code units, and return it. */
  #letter() {
    return ($("letter").value = [...$("letter").value.trim().normalize("NFC")][0] ?? "");
  }

  #size() {
    const padding = $("padding").value;
    // An empty field means the default.
    return { resolution: Number($("resolution").value), ...(padding && { padding: Number(padding) }) };
  }

  unwrap() {
    const which = { keep_seams: $("keep-seams").checked, selected: $("only-selected").checked };
    this.page.send({ do: "unwrap", options: chosenOptions(), ...which, ...this.#size() });
  }

  /** Choose a tool by its name. */
  tool(name) {
    const { view } = this.page;
    document.querySelector(`input[name=tool][value=${name}]`).checked = true;
    view.hands.tool = name;
    view.scene.seamStart = -1;
    $("corner-row").hidden = name !== "corner";
    if (name !== "draw") view.scene.sketch = [];
    view.set({});
    this.status.tool = name;
    this.status.hint();
  }

  /** Choose a colouring by its name. */
  colour(name) {
    document.querySelector(`input[name=colouring][value=${name}]`).checked = true;
    this.page.view.set({ colouring: name });
    $("legend").hidden = name !== "stretch";
    if (name === "image" && !this.pictured) $("image").click();
  }

  /** Show that there is an image on the surface, or none. */
  image(picture) {
    this.pictured = Boolean(picture);
    if (picture) this.colour("image");
    else if (this.page.view.look.colouring === "image") this.colour("checker");
  }

  surface(header) {
    $("name").textContent = `${header.name} — ${header.triangles.toLocaleString("en")} ${header.triangles === 1 ? "triangle" : "triangles"}`;
    $("name").title = header.defects.length ? `Repaired for mapping: ${header.defects.join(", ")}` : "";
    this.status.surface();
  }

  /** Show the certificate and the numbers of the displayed map. */
  map(header, moved, rate) {
    this.status.map(header, moved, rate);
    this.islands.select(header.selected);
    if (header.state !== "settled") return;
    this.unsaved = header.unsaved;
    this.islands.show(header);
    this.#outline(header.outline);
    $("stop").disabled = true;
    $("undo").disabled = !header.undo;
    $("redo").disabled = !header.redo;
    $("repair-row").hidden = !header.mapped || header.injective;
    $("outward").hidden = !header.inward;
    $("outward-words").textContent = header.inward === 1 ? "A closed part of the model faces inward." : `${header.inward} closed parts of the model face inward.`;
    $("repeat").hidden = !header.command && header.mapped === false;
    $("command").textContent = header.command || "The map is the one in the file.";
    $("python").textContent = header.python || "# The map is the one in the file.";
    $("needs").textContent = this.#needs(header);
    for (const id of ["save", "glb", "pack", "polish"]) $(id).disabled = !header.mapped;
    $("play").disabled = $("film").disabled = this.page.film.maps.length < 2;
    document.body.dataset.state = "settled";
  }

  /** Select the map's outline in the menu; nothing for a custom outline. */
  #outline(word) {
    const [shape, ...letters] = (word ?? "").split("letter:");
    if (letters.length) $("letter").value = letters[0];
    $("shape").value = letters.length ? "letter" : shape;
    if ($("shape").selectedIndex < 0) $("shape").value = "";
    $("letter").hidden = !letters.length;
  }

  #needs(header) {
    const files = header.needs.length ? `They read ${header.needs.join(" and ")}, which Save OBJ writes, too. ` : "";
    return header.anew ? files : `${files}This map was computed from the previous one; a search from scratch did not find it.`;
  }
}
