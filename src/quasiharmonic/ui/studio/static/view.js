// View of a surface and its map. It is self-contained: pass `createView` an element and a function that sends messages,
// and pass frames to `receive`.
//
// It handles the frames "surface", "map", "seams", "image" and "obstructions", and sends {do: "grab" | "drag" | "drop" |
// "place" | "pin" | "unpin" | "corner" | "polygon" | "select" | "seam" | "erase" | "stitch"}; docs/development/page_protocol.md describes them.
// Without `send` the view is read-only.

import { coarsen } from "./coarse.js";
import { decodeFrame } from "./frames.js";
import { drawGrid } from "./grid.js";
import { Hands } from "./hands.js";
import { drawOverlay } from "./overlay.js";
import { PlaneView } from "./plane.js";
import { Painter } from "./shaders.js";
import { Scene } from "./scene.js";
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
// Of models with more triangles than MANY, coarse pictures show about FEWER.
const MANY = 100_000;
const FEWER = 30_000;
// Width of seams in CSS pixels.
const SEAM = 3;
const SMOOTH = 200; // duration of a transition to another map, in milliseconds
const TOO_SLOW = 120; // milliseconds for a full picture above which a transition would not be smooth

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
  const look = { colouring: "checker", edges: false, seams: true, grid: true, squares: 16, reach: 3 };
  let space = null;
  let scale = 1;
  let seq = -1;
  let waiting = false;
  const stale = new Set(); // panes to redraw in the next picture
  let moves = true; // whether all requests for the next picture come from motion
  let followed = 0; // maps since the surface was redrawn
  let resting = 0;
  let thinned = false; // whether the painter has the triangles for coarse pictures of this map
  let unlifted = null; // positions before islands were dragged
  let transition = null; // the transition to the current map, while it runs

  element.classList.add("qhm-view");
  const canvas = document.createElement("canvas");
  const over = document.createElement("canvas");
  const under = document.createElement("canvas");
  for (const each of [canvas, over, under]) {
    Object.assign(each.style, { position: "absolute", inset: "0", width: "100%", height: "100%" });
    each.setAttribute("aria-hidden", "true");
  }
  // An element that is not in the document yet has no computed position.
  if (["static", ""].includes(getComputedStyle(element).position)) element.style.position = "relative";
  // The grid lies behind the map.
  under.style.zIndex = "-1";
  element.style.isolation = "isolate";
  element.append(canvas, over, under);
  const painter = new Painter(canvas);
  const context = over.getContext("2d");
  const ground = under.getContext("2d");

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
    if (coarse && !thinned && scene.triangles.length > 3 * MANY) {
      painter.setCoarse(coarsen({ ...scene, positions: space.positions }, FEWER));
      thinned = true;
    }
    const shown = transition?.plane ?? plane;
    if (space) {
      const within = (box) => ({
        x: Math.round(box.x * ratio),
        y: Math.round((scene.size.height - box.y - box.height) * ratio),
        width: Math.round(box.width * ratio),
        height: Math.round(box.height * ratio),
      });
      const shared = {
        ...look,
        colouring: scene.places ? look.colouring : "plain",
        scale,
        squares: look.squares / shown.extent,
        toward: space.axes[2],
        turn: space.matrix,
        origin: scene.origin,
        width: SEAM * ratio,
        runs: scene.runs,
        coarse,
      };
      for (const [name, pane] of [["space", space], ["plane", plane]]) {
        if (!every && !stale.has(name)) continue;
        if (pane === plane && !scene.places) {
          painter.clearPane(within(pane.box));
          continue;
        }
        painter.pane(within(pane.box), { ...shared, flat: pane === plane, window: shown.window });
      }
      if (every || stale.has("space")) followed = 0;
    } else painter.clear();
    stale.clear();
    moves = true;
    for (const [some, drawing] of [[over, context], [under, ground]]) {
      fill(some, density());
      drawing.setTransform(density(), 0, 0, density(), 0, 0);
      drawing.clearRect(0, 0, scene.size.width, scene.size.height);
    }
    if (!space) return;
    const style = getComputedStyle(element);
    if (look.grid && scene.places) drawGrid(ground, scene, shown, style);
    drawOverlay(context, transition?.scene ?? scene, space, shown, { moving: coarse, style });
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
    element.classList.toggle("stacked", stacked);
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
    lift,
  });

  /** Show the selected islands moved by a vector from where the last map has them. */
  function lift(by) {
    unlifted ??= scene.places.slice();
    for (const k of scene.selected) {
      const end = 2 * (scene.starts[k + 1] ?? scene.places.length / 2);
      for (let i = 2 * scene.starts[k]; i < end; i++) scene.places[i] = unlifted[i] + by[i % 2];
    }
    painter.setPlaces(scene.places);
    redraw("plane");
    if (++followed >= SURFACE_EVERY) redraw("space");
  }

  function surface(header, arrays) {
    const { positions, triangles } = arrays;
    painter.setSurface(positions, triangles);
    const turned = space;
    space = new SpaceView(positions);
    // The same model with other seams keeps its direction.
    if (turned && scene.name === header.name) space.turnLike(turned);
    transition = null;
    thinned = false;
    Object.assign(scene, new Scene(), { size: scene.size, sizes: scene.sizes, name: header.name, triangles });
    scene.setIslands(header, Array.from(arrays.boundary));
    hands.forget();
    resize();
  }

  function map(header, arrays) {
    if (!space) return;
    finish();
    const before = { places: scene.places, origin: scene.origin, plane: plane.copy(), bad: scene.bad.length };
    scene.origin = header.origin;
    scene.asked = arrays.asked ?? null;
    scene.corners = header.corners;
    scene.numbers = header.numbers;
    scene.pins = header.pins;
    scene.selected = new Set(header.selected);
    if (arrays.places) unlifted = null;
    if (arrays.places && header.start !== undefined && scene.places) {
      scene.places.set(arrays.places, 2 * header.start);
      painter.setSomePlaces(arrays.places, header.start);
    } else if (arrays.places) {
      scene.places = arrays.places.slice();
      painter.setPlaces(scene.places);
    } else if (header.mapped === false) scene.places = null;
    if (arrays.places) {
      scene.bad = arrays.bad;
      // A map at rest differs from the one for which triangles were chosen.
      if (header.seq < 0) thinned = false;
      scale = header.scale;
      painter.setBad(arrays.bad);
      clock.maps += 1;
    }
    if (header.fit) {
      scene.chosen = -1;
      if (scene.places) plane.fit(scene.places);
    }
    if (arrays.places && header.seq < 0) begin(before);
    seq = header.seq;
    hands.answered(header.seq, header.after);
    if (transition) return;
    if (seq < 0 || header.fit) redraw();
    else {
      redraw("plane");
      if (++followed >= SURFACE_EVERY) redraw("space");
    }
  }

  /** Show an image on the surface; an empty one is none. */
  async function image(header, arrays) {
    const blob = new Blob([arrays.content], { type: header.type });
    // The first row of a picture is the highest, that of a texture the lowest.
    const picture = blob.size ? await createImageBitmap(blob, { imageOrientation: "flipY" }) : null;
    painter.setImage(picture);
    options.pictured?.(picture);
    redraw();
  }

  /**
   * Move the map and its view smoothly from where they were, unless the user prefers less motion. Only the picture moves:
   * `scene` and `plane` are already those of the new map.
   */
  function begin(before) {
    const same = before.places?.length === scene.places.length && before.places !== scene.places;
    // Inverted triangles are shown at once.
    if (!same || before.bad || scene.bad.length || (painter.software && clock.whole > TOO_SLOW)) return;
    if (matchMedia("(prefers-reduced-motion: reduce)").matches) return;
    const shift = before.origin.map((value, k) => value - scene.origin[k]);
    const from = before.places.map((value, i) => value + shift[i % 2]);
    const to = scene.places;
    before.plane.centre = before.plane.centre.map((value, k) => value + shift[k]);
    const still = plane.sameAs(before.plane) && from.every((value, i) => Math.abs(value - to[i]) < 0.5 / plane.pixels);
    if (still) return;
    const places = new Float32Array(from.length);
    const moving = Object.create(scene, { places: { value: places }, asked: { value: null } });
    const own = { plane: before.plane, scene: moving };
    const began = performance.now();
    transition = own;
    const step = () => {
      if (transition !== own) return;
      const t = Math.min((performance.now() - began) / SMOOTH, 1);
      if (t >= 1) return finish();
      const s = t * t * (3 - 2 * t);
      for (let i = 0; i < places.length; i++) places[i] = from[i] + s * (to[i] - from[i]);
      own.plane = before.plane.toward(plane, s);
      painter.setPlaces(places);
      redraw("plane");
      redraw("space");
      requestAnimationFrame(step);
    };
    step();
  }

  /** Show the current map at once. */
  function finish() {
    if (!transition) return;
    transition = null;
    painter.setPlaces(scene.places);
    redraw();
  }

  for (const kind of ["pointerdown", "wheel", "keydown"]) element.addEventListener(kind, finish, { capture: true });

  const observer = new ResizeObserver(resize);
  observer.observe(element);
  resize();

  return {
    scene,
    clock,
    hands,
    look,

    /** Handle a frame: a buffer, or the result of `decodeFrame`. */
    receive(frame) {
      const { header, arrays } = frame.header ? frame : decodeFrame(frame);
      if (header.kind === "surface") surface(header, arrays);
      else if (header.kind === "map") map(header, arrays);
      else if (header.kind === "seams" && space) {
        painter.setSeams(arrays.edges, arrays.chain, header.drawn);
        redraw();
      } else if (header.kind === "image") image(header, arrays);
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

    /**
     * Change the look: `colouring` ("checker", "stretch" or "image"), `edges`, `seams`, `grid`, `squares` across the map,
     * `reach` in doublings.
     */
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

    /** View the surface from the "front", the "side" or the "top". */
    lookFrom(name) {
      space?.viewFrom(name);
      redraw();
    },

    /** Show another map of the same surface, for example a stored one. */
    show(places, bad = new Uint32Array(0)) {
      if (places.length !== scene.places?.length) return;
      finish();
      scene.places = places;
      scene.bad = bad;
      painter.setPlaces(places);
      painter.setBad(bad);
      redraw("plane");
      redraw("space");
    },

    /** Return a canvas with the current picture on white. */
    picture() {
      finish();
      paint();
      const whole = document.createElement("canvas");
      [whole.width, whole.height] = [canvas.width, canvas.height];
      const flat = whole.getContext("2d");
      flat.fillStyle = getComputedStyle(element).getPropertyValue("--paper").trim() || "#ffffff";
      flat.fillRect(0, 0, whole.width, whole.height);
      flat.drawImage(under, 0, 0);
      flat.drawImage(canvas, 0, 0);
      flat.drawImage(over, 0, 0);
      return whole;
    },

    dispose() {
      clearTimeout(resting);
      transition = null;
      observer.disconnect();
      painter.dispose();
      element.replaceChildren();
    },
  };
}
