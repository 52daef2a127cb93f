// What the page says: the certificate with its numbers, the hint for the current state, progress, and errors.

const $ = (id) => document.getElementById(id);

const TOOL_HINTS = {
  pin: "Click a vertex on the surface to pin it; with Move, drag it in the map. Click it again to release it.",
  corner: "Click the surface near its boundary: that vertex goes to the outline's next corner.",
  seam: "Click two or more vertices on the surface: the shortest path between them becomes a seam. Escape ends it.",
  erase: "Click near a seam on the surface to remove it, up to where seams meet.",
  forbid: "Click two or more vertices on the surface: Unwrap makes no seam on the path between them (blue).",
  stitch: "Click a seam on the surface: the smaller island moves to the larger one, and both are joined there.",
  draw: "Click the corners of a polygon in the map. To close it, click the first corner again or press Enter.",
};
const PHASES = {
  clean: "Cleaning the model",
  cut: "Cutting",
  flatten: "Flattening",
  improve: "Improving",
  pack: "Packing",
  separate: "Separating overlaps",
  certify: "Verifying",
};
const NUMBER = new Intl.NumberFormat("en", { maximumSignificantDigits: 4 });
const shown = (value) => {
  if (value === null || value === undefined) return "∞";
  const size = Math.abs(value);
  return size === 0 || (size >= 1e-3 && size < 1e6) ? NUMBER.format(value) : value.toExponential(2);
};

export class Status {
  constructor(page) {
    this.page = page;
    this.tool = "move";
    this.header = null;
  }

  /** A model was opened: what was said about the previous one is over. */
  surface() {
    this.forget();
    this.header = null;
  }

  map(header, moved, rate) {
    if (header.state === "settled") {
      this.header = header;
      this.forget();
      $("progress").hidden = true;
      clearInterval(this.ticking);
      $("elapsed").textContent = "";
    }
    if (header.mapped === false) {
      this.#verdict("open", "…", "No map yet", "Press Unwrap for texture coordinates of the whole model.");
      for (const id of ["flips", "worst", "energy", "used", "rate"]) $(id).textContent = "–";
      return this.hint();
    }
    if (!moved) {
      this.#verdict("open", "…", "No map without overlap yet", "Release the pointer to search for one, or undo.");
      return;
    }
    if (header.mirrored) this.#verdict("bad", "✗", "Mirrored", "Every triangle of the map is inverted. Mirror or Repair reflects the map.");
    else if (!header.injective) this.#verdict("bad", "✗", "Not injective", header.verdict);
    else if (!header.reached) {
      this.#verdict("open", "…", "Target not reached", "The map is certified, but its boundary has not reached the dashed target.");
    } else if (header.bijective) this.#verdict("good", "✓", "Certified: no inverted triangle, no overlap", header.verdict);
    else if (header.overlapping) this.#verdict("open", "✓", "Certified: no inverted triangle, but islands overlap", `${header.verdict} Pack separates them.`);
    else this.#verdict("open", "✓", "Certified: no inverted triangle, but it overlaps itself", header.verdict);
    $("flips").textContent = header.flips;
    $("worst").textContent = header.worst === null ? "∞" : `${shown(header.worst)} ×`;
    $("energy").textContent = shown(header.energy);
    $("used").textContent = header.used === null ? "–" : `${Math.round(100 * header.used)} %`;
    $("used-of").textContent = header.packed ? "of the square" : "of its box";
    if (header.state === "following") $("rate").textContent = rate;
    this.hint();
  }

  /** Show a hint for the current tool and state. */
  hint() {
    const { header, tool } = this;
    let text = TOOL_HINTS[tool] ?? "";
    if (!text && header) {
      if (header.mapped === false) text = "Press Unwrap to cut the model and map it. Drag the surface to rotate it.";
      else if (header.drawn) text = "The seams have changed: press Flatten or Unwrap to cut the surface along them.";
      else if (header.pins.length) text = "Drag a purple pin or any point of the outline in the map.";
      else if (header.corners.length) text = "Drag an orange corner, or any point of the outline, in the map. Drag the surface to rotate it.";
      else if (header.selected.length < header.count) text = "Drag a selected island to move it; R rotates, [ and ] scale it. Drag a point of its outline to bend it.";
      else if (header.count > 1) text = "Drag an island to move it, or any point of an outline to bend it. Click to select, with Shift several; Shift and drag a box.";
      else text = "The boundary is free: drag any point of the outline, or pin a vertex and drag the pin.";
    }
    $("hint").textContent = text;
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
        if (one.undo) {
          const undo = document.createElement("button");
          undo.textContent = "Undo the drag";
          undo.className = "primary";
          undo.addEventListener("click", () => this.page.send({ do: "undo" }));
          item.append(undo);
        }
        return item;
      }),
    );
  }

  busy(what) {
    document.body.dataset.state = "busy";
    $("stop").disabled = false;
    this.#verdict("open", "…", `Working: ${what}`, "");
    this.forget();
    const began = performance.now();
    clearInterval(this.ticking);
    this.ticking = setInterval(() => ($("elapsed").textContent = `${Math.round((performance.now() - began) / 1000)} s`), 500);
    $("progress").hidden = false;
    $("progress").removeAttribute("value");
  }

  progress(header) {
    if (header.phase) {
      const phase = PHASES[header.phase] ?? header.phase;
      $("words").textContent = header.total > 1 ? `${phase}: ${header.done} of ${header.total}` : phase;
      if (header.total > 1) [$("progress").max, $("progress").value] = [header.total, header.done];
      else $("progress").removeAttribute("value");
    } else $("words").textContent = header.flips ? `${header.flips} triangles still inverted` : `energy ${shown(header.energy)}`;
  }

  /** Show an error, until it is closed, or the next action starts a computation, changes the state or sends files. */
  note(text) {
    // A message that begins with a word, and not with a name, is a sentence.
    $("note-text").textContent = text.replace(/^[a-z]+(?=[ ,])/, (word) => word[0].toUpperCase() + word.slice(1));
    $("note").hidden = false;
  }

  /** Hide the error. */
  forget() {
    $("note").hidden = true;
  }

  disconnected() {
    this.#gone("Disconnected", "The server has stopped. Restart it, then reload the page.");
  }

  /** Report that the worker ended; a new one continues its session. */
  restarting() {
    document.body.dataset.state = "restarting";
    this.#verdict("open", "…", "Restarting", "The computation ended unexpectedly. The session continues with its last map.");
  }

  /** Report that the session continues in another tab. */
  elsewhere() {
    this.#gone("Opened elsewhere", "This session continues in another tab. Reload this page to continue here.");
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
