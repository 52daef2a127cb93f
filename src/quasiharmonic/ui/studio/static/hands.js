// Pointer and keyboard input: rotate the surface, pan the map, drag vertices, select, pin, choose corners, seams, draw.

const GRIP = 14; // distance in CSS pixels within which a handle is grabbed
const NARROW = 7; // the same for boundary vertices of several islands
const BESIDE = 6; // distance in CSS pixels within which an island is grabbed
const SCALE = 0.9; // factor of one step of scaling
const VIEWS = { 1: "front", 3: "side", 7: "top" };
const CLICK = 4; // maximum motion of a click in CSS pixels
const ZOOM = 1.0015;
const MANY = 300_000; // corners of triangles above which the cursor does not tell of islands
// The point itself, then points around it.
const AROUND = [[0, 0], [1, 0], [0, 1], [-1, 0], [0, -1], [0.7, 0.7], [-0.7, 0.7], [0.7, -0.7], [-0.7, -0.7]];

/** Pointer and keyboard input on both panes. Without `send` vertices cannot be dragged. */
export class Hands {
  constructor(element, { scene, plane, clock, space, send, redraw, lift }) {
    Object.assign(this, { scene, plane, clock, space, send, redraw, lift });
    this.lifted = null; // how far the selected islands are dragged
    this.tool = "move";
    this.seq = 0;
    this.inFlight = false;
    this.next = null;
    this.held = -1;
    this.aimed = -1;
    this.panes = [
      this.#pane(element, "surface", "The surface. Arrow keys rotate it, plus and minus zoom."),
      this.#pane(
        element,
        "map",
        "The map. N and B select a handle, arrow keys move it, with Shift in small steps. Without a handle, arrow keys move the map.",
      ),
    ];
  }

  #pane(element, name, label) {
    const pane = document.createElement("div");
    pane.className = `qhm-pane qhm-${name}`;
    pane.tabIndex = 0;
    pane.setAttribute("role", "application");
    pane.setAttribute("aria-label", label);
    Object.assign(pane.style, { position: "absolute", touchAction: "none" });
    const listener = (kind) => (event) => this[`${name}${kind}`](event, this.#at(event, element));
    const pinch = new Pinch((factor, dx, dy, middle) => this.#pinch(name, factor, dx, dy, middle));
    pane.addEventListener("pointerdown", (event) => {
      pane.setPointerCapture(event.pointerId);
      if (pinch.down(event.pointerId, this.#at(event, element))) this.#cancel();
      else listener("Down")(event);
    });
    pane.addEventListener("pointermove", (event) => {
      if (!pinch.move(event.pointerId, this.#at(event, element))) listener("Move")(event);
    });
    for (const kind of ["pointerup", "pointercancel"]) {
      pane.addEventListener(kind, (event) => {
        if (!pinch.up(event.pointerId)) listener("Up")(event);
      });
    }
    pane.addEventListener("wheel", (event) => {
      event.preventDefault();
      listener("Wheel")(event);
    });
    pane.addEventListener("keydown", (event) => {
      if (!event.ctrlKey && !event.metaKey && !event.altKey && this[`${name}Key`](event)) event.preventDefault();
    });
    if (name === "map") {
      // A released key ends a drag by keys, not one with the pointer.
      pane.addEventListener("keyup", () => this.from || this.#letGo());
      pane.addEventListener("blur", () => this.#letGo());
    }
    element.append(pane);
    return pane;
  }

  /** Zoom and shift a pane with two fingers. */
  #pinch(name, factor, dx, dy, middle) {
    if (name === "map") {
      this.plane.zoomBy(factor, middle);
      this.plane.shiftBy(dx, dy);
      this.redraw("plane");
    } else if (this.space()) {
      this.space().zoomBy(factor);
      this.space().shiftBy(dx, dy);
      this.redraw("space");
    }
  }

  /** End a drag with one finger when a second one comes. */
  #cancel() {
    if (this.lifted) this.lift([0, 0]);
    this.from = this.last = this.lifted = null;
    this.#letGo();
  }

  #at(event, element) {
    const box = element.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  /** Set the positions of the panes. */
  place(...boxes) {
    boxes.forEach((box, i) => {
      const style = { left: `${box.x}px`, top: `${box.y}px`, width: `${box.width}px`, height: `${box.height}px` };
      Object.assign(this.panes[i].style, style);
    });
  }

  /** Reset the drag, for a new surface. */
  forget() {
    this.held = -1;
    this.aimed = -1;
    this.inFlight = false;
    this.next = null;
    this.lifted = null;
    this.seq = 0;
  }

  // --- the surface -------------------------------------------------------------------------------------------------

  surfaceDown(event, point) {
    this.from = this.last = point;
  }

  surfaceMove(event, point) {
    if (!event.buttons || !this.last || !this.space()) return;
    const [dx, dy] = [point[0] - this.last[0], point[1] - this.last[1]];
    if (event.shiftKey || event.buttons === 4) this.space().shiftBy(dx, dy);
    else this.space().turnBy(dx, dy);
    this.last = point;
    this.redraw("space");
  }

  surfaceUp(event, point) {
    const clicked = this.from && Math.hypot(point[0] - this.from[0], point[1] - this.from[1]) < CLICK;
    this.from = this.last = null;
    if (!clicked || event.type !== "pointerup" || !this.send) return;
    const { scene, tool } = this;
    const hit = this.space()?.pick(point, scene.triangles);
    if (!hit) return;
    if (tool === "pin") this.send({ do: scene.pins.includes(hit.vertex) ? "unpin" : "pin", vertex: hit.vertex });
    else if (["corner", "erase", "stitch"].includes(tool)) this.send({ do: tool, vertex: hit.vertex });
    else if (tool === "seam" || tool === "forbid") this.#seamTo(hit.vertex, tool === "forbid");
    else if (tool === "move") this.#select(scene.islandOfTriangle(hit.triangle), event.shiftKey);
  }

  /** Start a seam at a vertex, or continue it to there. */
  #seamTo(vertex, forbid) {
    const { scene } = this;
    if (scene.seamStart >= 0 && scene.seamStart !== vertex) this.send({ do: "seam", start: scene.seamStart, vertex, forbid });
    scene.seamStart = vertex;
    this.redraw();
  }

  /** Select an island; with `more` add it to the selection, or remove it. */
  #select(island, more) {
    const { selected, starts } = this.scene;
    if (starts.length < 2 || island < 0) return;
    const chosen = new Set(more ? selected : []);
    if (more && chosen.has(island)) chosen.delete(island);
    else chosen.add(island);
    this.send({ do: "select", islands: [...chosen].sort((a, b) => a - b) });
  }

  surfaceWheel(event) {
    this.space()?.zoomBy(ZOOM ** -event.deltaY);
    this.redraw("space");
  }

  surfaceKey(event) {
    const space = this.space();
    if (!space) return false;
    const turns = { ArrowLeft: [-12, 0], ArrowRight: [12, 0], ArrowUp: [0, -12], ArrowDown: [0, 12] };
    if (turns[event.key]) space.turnBy(...turns[event.key]);
    else if (event.key === "+" || event.key === "=") space.zoomBy(1.15);
    else if (event.key === "-") space.zoomBy(1 / 1.15);
    else if (event.key === "0") space.reset();
    else if (VIEWS[event.key]) space.viewFrom(VIEWS[event.key]);
    else if (event.key === "Escape") this.scene.seamStart = -1;
    else return false;
    this.redraw();
    return true;
  }

  // --- the map -----------------------------------------------------------------------------------------------------

  /** Return the vertex that can be grabbed at a point, or -1. Pins and corners precede other boundary vertices. */
  handleAt(point) {
    const { scene, plane } = this;
    if (!scene.places || !this.send) return -1;
    for (const some of [scene.pins, scene.corners, scene.boundary]) {
      // Among several islands, a drag inside of one moves it.
      const within = some === scene.boundary && scene.starts.length > 1 ? NARROW : GRIP;
      const vertex = plane.nearest(point, some, scene.places, within);
      if (vertex >= 0) return vertex;
    }
    return -1;
  }

  mapDown(event, point) {
    this.from = this.last = point;
    if (this.tool === "draw") return;
    if (event.shiftKey && event.button === 0 && this.#movesIslands()) {
      this.scene.frame = [point, point];
      return;
    }
    const vertex = event.button === 0 ? this.handleAt(point) : -1;
    this.scene.chosen = vertex;
    if (vertex >= 0) this.#grab(vertex);
    else if (event.button === 0 && this.#movesIslands()) this.#lift(this.#islandAt(point));
    this.redraw();
  }

  /** Return whether drags of the map move islands, of which there are several. */
  #movesIslands() {
    return this.tool === "move" && this.send && this.scene.places && this.scene.starts.length > 1;
  }

  /** Begin to move an island: with the others that are selected, or alone if it is not, or all are. */
  #lift(island) {
    const { scene } = this;
    if (island < 0) return;
    const chosen = scene.selected.has(island) && scene.selected.size < scene.starts.length;
    this.lifted = [0, 0];
    this.liftedIslands = chosen ? null : [island];
  }

  mapMove(event, point) {
    if (this.scene.frame && event.buttons) {
      this.scene.frame[1] = point;
      this.redraw("plane");
    } else if (this.lifted && event.buttons && this.from) {
      if (Math.hypot(point[0] - this.from[0], point[1] - this.from[1]) < CLICK) return;
      if (this.liftedIslands) this.scene.selected = new Set(this.liftedIslands);
      this.lifted = [0, 1].map((k) => ((k ? -1 : 1) * (point[k] - this.from[k])) / this.plane.pixels);
      this.lift(this.lifted);
    } else if (this.held >= 0 && event.buttons) {
      this.#moveTo(this.plane.placeOf(point));
    } else if (event.buttons && this.last) {
      this.plane.shiftBy(point[0] - this.last[0], point[1] - this.last[1]);
      this.redraw("plane");
    } else {
      const hovered = this.tool === "move" ? this.handleAt(point) : -1;
      const free = this.#movesIslands() && this.scene.triangles.length < MANY && this.#islandAt(point) >= 0 ? "move" : "default";
      this.panes[1].style.cursor = hovered >= 0 ? "grab" : this.tool === "draw" ? "crosshair" : free;
      if (hovered !== this.scene.hovered) {
        this.scene.hovered = hovered;
        this.redraw();
      }
    }
    this.last = point;
  }

  mapUp(event, point) {
    const clicked = this.from && Math.hypot(point[0] - this.from[0], point[1] - this.from[1]) < CLICK;
    const to = this.lifted;
    this.from = this.last = this.lifted = null;
    const { frame } = this.scene;
    this.scene.frame = null;
    if (frame && !clicked) {
      if (event.type === "pointerup") this.#selectWithin(frame);
      return;
    }
    if (to && !clicked && event.type === "pointerup") {
      if (this.liftedIslands) this.send({ do: "select", islands: this.liftedIslands });
      this.send({ do: "place", to });
    } else if (to && !clicked) this.lift([0, 0]);
    if (this.held >= 0) this.#letGo();
    else if (clicked && event.type === "pointerup" && this.scene.places && this.send) {
      if (this.tool === "draw") this.#drawTo(point);
      else this.#select(this.#islandAt(point), event.shiftKey);
    }
  }

  /** Return the island at a point of the map, or just beside it; else -1. */
  #islandAt(point) {
    const { scene, plane } = this;
    for (const [x, y] of AROUND) {
      const triangle = plane.pick([point[0] + BESIDE * x, point[1] + BESIDE * y], scene.places, scene.triangles);
      if (triangle >= 0) return scene.islandOfTriangle(triangle);
    }
    return -1;
  }

  /** Select the islands with a vertex in a box of the screen. */
  #selectWithin([[x, y], [right, low]]) {
    const { scene, plane } = this;
    const islands = scene.starts.map((_, k) => k).filter((k) => {
      const end = scene.starts[k + 1] ?? scene.places.length / 2;
      for (let v = scene.starts[k]; v < end; v++) {
        const [a, b] = plane.pointOf(...scene.placeOf(v));
        if ((a - x) * (a - right) <= 0 && (b - y) * (b - low) <= 0) return true;
      }
      return false;
    });
    if (islands.length) this.send({ do: "select", islands });
    this.redraw();
  }

  mapWheel(event, point) {
    this.plane.zoomBy(ZOOM ** -event.deltaY, point);
    this.redraw("plane");
  }

  mapKey(event) {
    const { scene, plane } = this;
    if (!scene.places) return false;
    const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    if (event.key === "n" || event.key === "b") this.#choose(event.key === "n" ? 1 : -1);
    else if (event.key === "Escape") {
      [scene.chosen, scene.sketch] = [-1, []];
      if (this.lifted) this.lift([0, 0]);
      this.lifted = null;
    } else if ("[]".includes(event.key) && this.send) this.send({ do: "place", to: [0, 0], scale: event.key === "[" ? SCALE : 1 / SCALE });
    else if (event.key === "m" && this.send) this.send({ do: "place", to: [0, 0], mirror: true });
    else if (event.key.toLowerCase() === "r" && this.send) this.send({ do: "place", to: [0, 0], turn: event.shiftKey ? 15 : 90 });
    else if (event.key === "Enter" && scene.sketch.length) this.closeSketch();
    else if (event.key === "Delete" && scene.pins.includes(scene.chosen)) this.send?.({ do: "unpin", vertex: scene.chosen });
    else if (event.key === "+" || event.key === "=") plane.zoomBy(1.15, this.#middle());
    else if (event.key === "-") plane.zoomBy(1 / 1.15, this.#middle());
    else if (event.key === "0" && scene.places) plane.fit(scene.places);
    else if (steps[event.key]) {
      const step = plane.extent * (event.shiftKey ? 0.002 : 0.02);
      const [dx, dy] = steps[event.key];
      if (scene.chosen >= 0 && this.send) {
        if (this.held < 0) this.#grab(scene.chosen);
        this.#moveTo(this.aim.map((c, k) => c + step * [dx, dy][k]));
      } else plane.shiftBy(-dx * 24, dy * 24);
    } else return false;
    this.redraw();
    return true;
  }

  #middle() {
    const { x, y, width, height } = this.plane.box;
    return [x + width / 2, y + height / 2];
  }

  #choose(step) {
    const { scene } = this;
    const all = [...scene.pins, ...scene.corners];
    const some = all.length ? all : scene.boundary.filter((_, i) => i % Math.ceil(scene.boundary.length / 12) === 0);
    if (!some.length || !this.send) return;
    const at = some.indexOf(scene.chosen);
    scene.chosen = some[(at < 0 ? (step > 0 ? 0 : some.length - 1) : at + step + some.length) % some.length];
  }

  #grab(vertex) {
    this.held = vertex;
    // If this vertex was released a moment ago, its map may still be under way, so keep its target.
    if (this.aimed !== vertex) this.aim = this.scene.placeOf(vertex);
    this.aimed = vertex;
    this.next = null;
    this.inFlight = false;
    this.send({ do: "grab", vertex });
  }

  // Request one map at a time, for the newest position, so that the picture lags by at most one round trip.
  #moveTo(place) {
    this.aim = place;
    this.seq += 1;
    this.clock.move(this.seq);
    this.next = { do: "drag", seq: this.seq, to: [place[0] + this.scene.origin[0], place[1] + this.scene.origin[1]] };
    this.#ask();
  }

  #ask() {
    if (this.inFlight || !this.next) return;
    this.inFlight = true;
    this.send(this.next);
    this.next = null;
  }

  /** Handle the arrival of a map, during a drag or after it; the pointer may have moved on. */
  answered(seq, after) {
    if (seq < 0) {
      if (after >= this.seq && this.held < 0) this.aimed = -1;
      return;
    }
    this.inFlight = false;
    this.#ask();
  }

  #letGo() {
    if (this.held < 0) return;
    this.held = -1;
    this.inFlight = false;
    this.#ask();
    this.inFlight = false;
    this.send({ do: "drop" });
  }

  // --- a polygon drawn by hand -------------------------------------------------------------------------------------

  #drawTo(point) {
    const { sketch } = this.scene;
    const first = sketch.length ? this.plane.pointOf(...sketch[0]) : null;
    if (first && sketch.length > 2 && Math.hypot(first[0] - point[0], first[1] - point[1]) < GRIP) this.closeSketch();
    else sketch.push(this.plane.placeOf(point));
    this.redraw();
  }

  /** Send the drawn polygon as the outline. */
  closeSketch() {
    const { sketch, origin } = this.scene;
    this.scene.sketch = [];
    if (sketch.length > 2) {
      const points = new Float64Array(sketch.flatMap((place) => [place[0] + origin[0], place[1] + origin[1]]));
      this.send?.({ do: "polygon" }, { points });
    }
    this.redraw();
  }
}

/** Two or more fingers on a pane: calls `changed(factor, dx, dy, middle)` when the first two move. */
class Pinch {
  constructor(changed) {
    this.changed = changed;
    this.fingers = new Map();
  }

  /** Return whether two or more fingers are down now. */
  down(id, point) {
    this.fingers.set(id, point);
    return this.fingers.size >= 2;
  }

  move(id, point) {
    if (!this.fingers.has(id)) return false;
    if (this.fingers.size < 2) {
      this.fingers.set(id, point);
      return false;
    }
    const before = this.#pair();
    this.fingers.set(id, point);
    const after = this.#pair();
    if (before.length > 0) {
      this.changed(after.length / before.length, after.middle[0] - before.middle[0], after.middle[1] - before.middle[1], after.middle);
    }
    return true;
  }

  /** Return whether two or more fingers were down. */
  up(id) {
    const two = this.fingers.size >= 2;
    this.fingers.delete(id);
    return two;
  }

  #pair() {
    const [a, b] = [...this.fingers.values()];
    return { middle: [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2], length: Math.hypot(a[0] - b[0], a[1] - b[1]) };
  }
}
