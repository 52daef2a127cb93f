// View of a surface and its map. It is self-contained: pass `createView` an element and a function that sends messages,
// and pass frames to `receive`.
//
// It handles the frames "surface", "map" and "obstructions", and sends {do: "grab" | "drag" | "drop" | "pin" | "unpin" |
// "corner" | "polygon"}; docs/development/page_protocol.md describes them. Without `send` the view is read-only.

import { decodeFrame } from "./frames.js";
import { Hands } from "./hands.js";
import { drawOverlay } from "./overlay.js";
import { PlaneView } from "./plane.js";
import { Painter } from "./shaders.js";
import { SpaceView } from "./space.js";

const STACKED_BELOW = 640; // CSS pixels of width
const NOTHING = { vertices: [], edges: [], triangles: [] };
// Settings for software rendering. If a full picture takes longer than QUICK ms, moving panes are drawn with COARSER times
// fewer pixels per side. The surface is redrawn with every SURFACE_EVERY-th map. After REST ms without motion everything
// is redrawn at full resolution.
const COARSER = 3;
const QUICK = 12;
const SURFACE_EVERY = 4;
const REST = 150;

/** The scene according to the last frames; see `drawOverlay`. */
class Scene {
  constructor() {
    this.size = { width: 1, height: 1 };
    this.places = null;
    this.loops = [];
    this.boundary = [];
    this.triangles = new Uint32Array(0);
    this.asked = null;
    this.bad = new Uint32Array(0);
    this.origin = [0, 0];
    this.corners = [];
    this.numbers = [];
    this.pins = [];
    this.obstruction = null;
    this.hovered = -1;
    this.chosen = -1;
    this.sketch = [];
  }

  placeOf(vertex) {
    return [this.places[2 * vertex], this.places[2 * vertex + 1]];
  }
}

/** Latencies: milliseconds from a pointer motion to the picture of its map, for the last thousand. */
class Clock {
  constructor() {
    this.moved = new Map();
    this.latencies = [];
    this.frames = 0;
    this.maps = 0;
    this.whole = 0; // milliseconds for the last full picture
  }

  move(seq) {
    this.moved.set(seq, performance.now());
  }

  drawn(seq) {
    this.frames += 1;
    const began = this.moved.get(seq);
    if (began === undefined) return;
    this.latencies.push(performance.now() - began);
    if (this.latencies.length > 1000) this.latencies.shift();
    for (const key of this.moved.keys()) if (key <= seq) this.moved.delete(key);
  }
}

/**
 * Create the view of a surface and its map in an element.
 *
 * `options.send(message, arrays)` sends the user's actions. `options.measured` waits until every picture is finished, so that
 * `clock` includes asynchronous drawing.
 */
export function createView(element, options = {}) {
  const scene = new Scene();
  const plane = new PlaneView();
  const clock = new Clock();
  const look = { colouring: "checker", edges: false, squares: 16, reach: 3 };
  let space = null;
  let scale = 1;
  let seq = -1;
  let waiting = false;
  const stale = new Set(); // panes to redraw in the next picture
  let moves = true; // whether all requests for the next picture come from motion
  let followed = 0; // maps since the surface was redrawn
  let resting = 0;

  element.classList.add("qhm-view");
  const canvas = document.createElement("canvas");
  const over = document.createElement("canvas");
  for (const each of [canvas, over]) {
    Object.assign(each.style, { position: "absolute", inset: "0", width: "100%", height: "100%" });
    each.setAttribute("aria-hidden", "true");
  }
  if (getComputedStyle(element).position === "static") element.style.position = "relative";
  element.append(canvas, over);
  const painter = new Painter(canvas);
  const context = over.getContext("2d");

  /** Request a picture: a full one, or one of a pane in motion, "space" or "plane". */
  function redraw(moving = null) {
    for (const pane of moving ? [moving] : ["space", "plane"]) stale.add(pane);
    moves &&= moving !== null;
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(draw);
  }

  function draw() {
    // Inverted triangles are drawn at full resolution in both panes.
    const coarse = moves && stale.size > 0 && !scene.bad.length && painter.software && clock.whole > QUICK;
    const began = performance.now();
    waiting = false;
    paint(coarse);
    if (options.measured || (painter.software && !coarse)) painter.finish();
    if (!coarse) clock.whole = performance.now() - began;
    clock.drawn(seq);
    clearTimeout(resting);
    if (coarse) resting = setTimeout(rest, REST);
  }

  function rest() {
    // A drag that waits for a map is still in motion.
    if (hands.inFlight) resting = setTimeout(rest, REST);
    else redraw();
  }

  /** Draw the stale panes coarsely, or all panes. */
  function paint(coarse = false) {
    const ratio = density() / (coarse ? COARSER : 1);
    const resized = fill(canvas, ratio);
    const every = resized || !coarse;
    if (space && scene.places) {
      const within = (box) => ({
        x: Math.round(box.x * ratio),
        y: Math.round((scene.size.height - box.y - box.height) * ratio),
        width: Math.round(box.width * ratio),
        height: Math.round(box.height * ratio),
      });
      const shared = { ...look, scale, squares: look.squares / plane.extent, toward: space.axes[2], turn: space.matrix };
      for (const [name, pane] of [["space", space], ["plane", plane]]) {
        if (!every && !stale.has(name)) continue;
        painter.pane(within(pane.box), { ...shared, flat: pane === plane, window: plane.window });
      }
      if (every || stale.has("space")) followed = 0;
    } else painter.clear();
    stale.clear();
    moves = true;
    fill(over, density());
    context.setTransform(density(), 0, 0, density(), 0, 0);
    if (space) drawOverlay(context, scene, space, plane);
  }

  function density() {
    return Math.min(window.devicePixelRatio || 1, 2);
  }

  /** Set the canvas size for a pixel ratio; return whether the size changed, which clears the canvas. */
  function fill(some, ratio) {
    const [width, height] = [scene.size.width, scene.size.height].map((length) => Math.max(1, Math.round(length * ratio)));
    if (some.width === width && some.height === height) return false;
    Object.assign(some, { width, height });
    return true;
  }

  function resize() {
    const width = Math.max(1, element.clientWidth);
    const height = Math.max(1, element.clientHeight);
    scene.size = { width, height };
    const stacked = width < STACKED_BELOW;
    const half = stacked ? { width, height: height / 2 } : { width: width / 2, height };
    if (space) space.box = { x: 0, y: 0, ...half };
    plane.setBox(stacked ? { x: 0, y: height / 2, ...half } : { x: width / 2, y: 0, ...half });
    hands.place(space ? space.box : { x: 0, y: 0, ...half }, plane.box);
    redraw();
  }

  const hands = new Hands(element, {
    scene,
    plane,
    clock,
    space: () => space,
    send: options.send,
    redraw,
  });

  function surface(header, arrays) {
    const positions = arrays.positions;
    const triangles = arrays.triangles;
    const edges = [];
    for (let t = 0; t < triangles.length; t += 3) {
      for (let k = 0; k < 3; k++) {
        const [i, j] = [triangles[t + k], triangles[t + ((k + 1) % 3)]];
        // The second halfedge of an inner edge has the opposite direction; the overlay draws the boundary.
        if (i < j) edges.push(i, j);
      }
    }
    painter.setSurface(positions, triangles, new Uint32Array(edges));
    space = new SpaceView(positions);
    Object.assign(scene, new Scene(), { size: scene.size, triangles, boundary: Array.from(arrays.boundary) });
    let start = 0;
    scene.loops = header.loops.map((length) => scene.boundary.slice(start, (start += length)));
    hands.forget();
    resize();
  }

  function map(header, arrays) {
    if (!space) return;
    scene.origin = header.origin;
    scene.asked = arrays.asked ?? null;
    scene.corners = header.corners;
    scene.numbers = header.numbers;
    scene.pins = header.pins;
    if (arrays.places) {
      scene.places = arrays.places;
      scene.bad = arrays.bad;
      scale = header.scale;
      painter.setPlaces(arrays.places);
      painter.setBad(arrays.bad);
      clock.maps += 1;
    }
    if (header.fit) {
      scene.chosen = -1;
      plane.fit(scene.places);
    }
    seq = header.seq;
    hands.answered(header.seq, header.after);
    if (seq < 0 || header.fit) redraw();
    else {
      redraw("plane");
      if (++followed >= SURFACE_EVERY) redraw("space");
    }
  }

  const observer = new ResizeObserver(resize);
  observer.observe(element);
  resize();

  return {
    scene,
    clock,
    hands,

    /** Handle a frame: a buffer, or the result of `decodeFrame`. */
    receive(frame) {
      const { header, arrays } = frame.header ? frame : decodeFrame(frame);
      if (header.kind === "surface") surface(header, arrays);
      else if (header.kind === "map") map(header, arrays);
      else if (header.kind === "obstructions") {
        scene.obstruction = header.obstructions.length ? header.obstructions[0] : null;
        redraw();
      }
    },

    /** Mark one obstruction, or none. */
    point(obstruction) {
      scene.obstruction = obstruction ?? NOTHING;
      redraw();
    },

    /** Change the look: `colouring` ("checker" or "stretch"), `edges`, `squares` across the map, `reach` in doublings. */
    set(changes) {
      Object.assign(look, changes);
      redraw();
    },

    /** Fit the views to surface and map. */
    fit() {
      if (scene.places) plane.fit(scene.places);
      space?.reset();
      redraw();
    },

    /** Show another map of the same surface, for example a stored one. */
    show(places, bad = new Uint32Array(0)) {
      scene.places = places;
      scene.bad = bad;
      painter.setPlaces(places);
      painter.setBad(bad);
      redraw("plane");
      redraw("space");
    },

    /** Return a canvas with the current picture on white. */
    picture() {
      paint();
      const whole = document.createElement("canvas");
      [whole.width, whole.height] = [canvas.width, canvas.height];
      const flat = whole.getContext("2d");
      flat.fillStyle = "#ffffff";
      flat.fillRect(0, 0, whole.width, whole.height);
      flat.drawImage(canvas, 0, 0);
      flat.drawImage(over, 0, 0);
      return whole;
    },

    dispose() {
      clearTimeout(resting);
      observer.disconnect();
      painter.dispose();
      element.replaceChildren();
    },
  };
}
