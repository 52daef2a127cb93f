// The controls beside the view, and their status texts.

const $ = (id) => document.getElementById(id);

const HINTS = {
  move: "",
  pin: "Click a vertex on the surface to pin it, then drag it in the map with Move. Click it again to remove the pin.",
  corner: "Click on the surface: the nearest boundary vertex is assigned to the outline's next corner.",
  draw: "Click the corners of a polygon in the map. To close it, click the first corner again or press Enter.",
};
const NUMBER = new Intl.NumberFormat("en", { maximumSignificantDigits: 4 });
const shown = (value) => {
  if (value === null || value === undefined) return "∞";
  return Math.abs(value) < 1e6 ? NUMBER.format(value) : value.toExponential(2);
};

export class Panel {
  constructor(page) {
    this.page = page;
    this.dragged = false;
    const { view } = page;
    const send = (message) => page.send(message);

    for (const input of document.querySelectorAll("input[name=tool]")) {
      input.addEventListener("change", () => this.tool(input.value));
    }
    for (const input of document.querySelectorAll("input[name=colouring]")) {
      input.addEventListener("change", () => {
        view.set({ colouring: input.value });
        $("legend").hidden = input.value !== "stretch";
      });
    }
    $("edges").addEventListener("change", () => view.set({ edges: $("edges").checked }));
    $("shape").addEventListener("change", () => ($("letter").hidden = $("shape").value !== "letter"));
    $("outline").addEventListener("submit", (event) => {
      event.preventDefault();
      const shape = $("shape").value;
      if (shape) send({ do: "outline", to: shape === "letter" ? `letter:${$("letter").value.trim()}` : shape });
    });
    for (const id of ["undo", "redo", "flatten", "save", "stop"]) $(id).addEventListener("click", () => send({ do: id }));
    $("polish").addEventListener("click", () => send({ do: "polish", energy: $("polish-energy").value, slide: $("slide").checked }));
    $("by-angle").addEventListener("click", () => send({ do: "corners" }));
    $("fit").addEventListener("click", () => view.fit());
    $("png").addEventListener("click", () => page.savePicture());
    $("play").addEventListener("click", () => page.film.play(view));
    $("film").addEventListener("click", () => page.saveFilm());
    for (const id of ["open", "svg"]) {
      $(id).addEventListener("change", () => {
        if ($(id).files.length) page.take($(id).files[0]);
        $(id).value = "";
      });
    }
    for (const button of document.querySelectorAll(".copy")) {
      button.addEventListener("click", () => navigator.clipboard.writeText($(button.dataset.of).textContent));
    }
    this.#drops();
    document.addEventListener("keydown", (event) => {
      if (!(event.ctrlKey || event.metaKey) || event.target.closest("input, select")) return;
      const key = event.key.toLowerCase();
      if (key === "z") send({ do: event.shiftKey ? "redo" : "undo" });
      else if (key === "y") send({ do: "redo" });
      else if (key === "s") send({ do: "save" });
      else return;
      event.preventDefault();
    });
  }

  #drops() {
    for (const kind of ["dragover", "drop"]) {
      document.addEventListener(kind, (event) => {
        event.preventDefault();
        if (kind === "drop" && event.dataTransfer.files.length) this.page.take(event.dataTransfer.files[0]);
      });
    }
  }

  tool(name) {
    this.page.view.hands.tool = name;
    $("tool-hint").textContent = HINTS[name];
    $("corner-row").hidden = name !== "corner";
    if (name !== "draw") this.page.view.scene.sketch = [];
    this.page.view.set({});
  }

  surface(header) {
    $("name").textContent = `${header.name} — ${header.triangles.toLocaleString("en")} triangles`;
    $("hint").hidden = this.dragged;
  }

  /** Show the certificate and the numbers of the displayed map. */
  map(header, moved, rate) {
    if (header.seq > 2 && !this.dragged) {
      this.dragged = true;
      $("hint").hidden = true;
    }
    if (!moved) {
      this.#verdict("open", "…", "No injective map yet", "Release the pointer to search for one, or undo.");
      return;
    }
    if (!header.injective) this.#verdict("bad", "✗", "Not injective", header.verdict);
    else if (!header.reached) {
      this.#verdict("open", "…", "Target not reached", "The map is certified, but its boundary has not reached the dashed target.");
    } else if (header.bijective) this.#verdict("good", "✓", "Certified: no inverted triangle, no overlap", header.verdict);
    else this.#verdict("open", "✓", "Certified: no inverted triangle, but it overlaps itself", header.verdict);
    $("flips").textContent = header.flips;
    $("worst").textContent = header.worst === null ? "∞" : `${shown(header.worst)} ×`;
    $("energy").textContent = shown(header.energy);
    if (header.state === "following") $("rate").textContent = rate;
    if (header.state !== "settled") return;
    this.#outline(header.outline);
    $("stop").disabled = true;
    $("undo").disabled = !header.undo;
    $("redo").disabled = !header.redo;
    $("command").textContent = header.command;
    $("python").textContent = header.python;
    $("needs").textContent = this.#needs(header);
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
    const files = header.needs.length ? `They read ${header.needs.join(" and ")}; Save OBJ writes what they read. ` : "";
    return header.anew ? files : `${files}This map was computed from the previous one; a search from scratch did not find it.`;
  }

  #verdict(kind, sign, title, words) {
    $("verdict").className = kind;
    $("sign").textContent = sign;
    if ($("title").textContent !== title) $("title").textContent = title;
    $("words").textContent = words;
  }

  obstructions(all) {
    $("why").hidden = !all.length;
    $("obstructions").replaceChildren(
      ...all.map((one) => {
        const item = document.createElement("li");
        const button = document.createElement("button");
        button.textContent = `${one.message} ${one.advice}`;
        button.title = `Show the place. Consequence: ${one.forbids}.`;
        button.addEventListener("click", () => this.page.view.point(one));
        item.append(button);
        return item;
      }),
    );
  }

  busy(what) {
    document.body.dataset.state = "busy";
    $("stop").disabled = false;
    this.#verdict("open", "…", `Working: ${what}`, "");
    $("note").hidden = true;
  }

  progress(header) {
    $("words").textContent = header.flips ? `${header.flips} triangles still inverted` : `energy ${shown(header.energy)}`;
  }

  note(text) {
    $("note").textContent = text;
    $("note").hidden = false;
    clearTimeout(this.hiding);
    this.hiding = setTimeout(() => ($("note").hidden = true), 12_000);
  }

  disconnected() {
    this.#gone("Disconnected", "The server has stopped. Restart it, then reload the page.");
  }

  /** Report that the server has too many open pages. */
  refused(why) {
    this.#gone("Not opened", `${why}. Close another page, then reload this one.`);
  }

  #gone(title, words) {
    document.body.dataset.state = "gone";
    this.#verdict("bad", "✗", title, words);
  }
}
