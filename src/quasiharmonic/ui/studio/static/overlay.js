// Overlay of the panes: outline, handles, obstructions, and the polygon being drawn.

import { drawScale } from "./grid.js";

export const INK = "#0f1f4a";
export const RED = "#c01030";
const HANDLE = "#b35900";
const PIN = "#7a1fa2";
const PAPER = "#ffffff";
// Maximum number of rings around triangles that are too small to see; more would hide the picture.
const MAX_RINGS = 200;
// Maximum number of tests of a handle against a triangle while the surface moves.
const MAX_TESTS = 3e6;

/**
 * Draw on a 2D canvas whose unit is the CSS pixel. `scene` is the scene of `createView`; `style` has the colours of the
 * page; `moving` says that a picture must be quick.
 */
export function drawOverlay(context, scene, space, plane, { moving = false, style }) {
  const ink = style.getPropertyValue("--ink").trim() || INK;
  context.lineJoin = "round";
  if (scene.places) {
    context.save();
    clip(context, plane.box);
    outline(context, scene, plane, style);
    badTriangles(context, scene, plane);
    const point = (v) => plane.pointOf(...scene.placeOf(v));
    obstructions(context, scene, point);
    handles(context, scene, point, { numbered: true });
    if (scene.sketch.length) sketch(context, scene, plane);
    if (scene.frame) frame(context, scene.frame, style);
    drawScale(context, plane.box, plane.pixels, ink);
    context.restore();
  }
  context.save();
  clip(context, space.box);
  obstructions(context, scene, (v) => space.project(v));
  const shown = [...scene.corners, ...scene.pins, ...(scene.chosen >= 0 ? [scene.chosen] : [])];
  const tests = (shown.length * scene.triangles.length) / 3;
  const hidden = shown.length && (!moving || tests < MAX_TESTS) ? space.hidden(shown, scene.triangles) : null;
  handles(context, scene, (v) => space.project(v), { faint: (v) => (hidden?.has(v) ? 0.25 : 1) });
  if (scene.seamStart >= 0) disc(context, space.project(scene.seamStart), 6, RED);
  drawScale(context, space.box, space.pixels, ink);
  context.restore();
}

function clip(context, box) {
  context.beginPath();
  context.rect(box.x, box.y, box.width, box.height);
  context.clip();
}

function path(context, loop, point) {
  loop.forEach((vertex, i) => context[i ? "lineTo" : "moveTo"](...point(vertex, i)));
  context.closePath();
}

function outline(context, scene, plane, style) {
  const point = (v) => plane.pointOf(...scene.placeOf(v));
  // Where all islands are selected, the outlines show the colours of the seams.
  const several = scene.selected.size < scene.starts.length;
  for (const chosen of [false, true]) {
    context.lineWidth = chosen && several ? 3 : 1;
    context.strokeStyle = style.getPropertyValue(chosen && several ? "--accent" : "--ink").trim() || INK;
    context.beginPath();
    scene.loops.forEach((loop, i) => {
      if (scene.selected.has(scene.owners[i]) === chosen) path(context, loop, point);
    });
    context.stroke();
  }
  if (!scene.asked) return;
  // The target of the boundary, while there is no certified map for it.
  context.strokeStyle = RED;
  context.setLineDash([6, 4]);
  context.beginPath();
  let start = 0;
  for (const loop of scene.loops) {
    const target = scene.asked.subarray(2 * start, 2 * (start += loop.length));
    // Boundaries that are at their target have none to show.
    if (misses(loop, target, scene.places)) path(context, loop, (_, i) => plane.pointOf(target[2 * i], target[2 * i + 1]));
  }
  context.stroke();
  context.setLineDash([]);
}

function misses(loop, target, places) {
  return loop.some((vertex, i) => target[2 * i] !== places[2 * vertex] || target[2 * i + 1] !== places[2 * vertex + 1]);
}

function badTriangles(context, scene, plane) {
  context.strokeStyle = RED;
  context.lineWidth = 2;
  for (const t of scene.bad.subarray(0, MAX_RINGS)) {
    const corners = [0, 1, 2].map((k) => scene.placeOf(scene.triangles[3 * t + k]));
    const middle = plane.pointOf(...[0, 1].map((k) => (corners[0][k] + corners[1][k] + corners[2][k]) / 3));
    context.beginPath();
    context.arc(...middle, 7, 0, 2 * Math.PI);
    context.stroke();
  }
}

function obstructions(context, scene, point) {
  const shown = scene.obstruction;
  if (!shown) return;
  context.strokeStyle = RED;
  context.fillStyle = RED;
  context.lineWidth = 4;
  context.beginPath();
  for (const [i, j] of shown.edges) {
    context.moveTo(...point(i));
    context.lineTo(...point(j));
  }
  context.stroke();
  context.lineWidth = 2.5;
  for (const t of shown.triangles) {
    context.beginPath();
    path(context, [0, 1, 2].map((k) => scene.triangles[3 * t + k]), point);
    context.stroke();
  }
  for (const vertex of shown.vertices) {
    context.beginPath();
    context.arc(...point(vertex), 8, 0, 2 * Math.PI);
    context.stroke();
  }
}

function handles(context, scene, point, { numbered = false, faint = () => 1 }) {
  context.font = "600 12px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "middle";
  for (const [vertices, draw, colour] of [[scene.corners, square, HANDLE], [scene.pins, disc, PIN]]) {
    for (const vertex of vertices) {
      context.globalAlpha = faint(vertex);
      draw(context, point(vertex), vertex === scene.chosen ? 8 : 6, colour);
    }
  }
  if (numbered) scene.corners.forEach((vertex, i) => label(context, point(vertex), scene.numbers[i]));
  const marked = scene.chosen >= 0 ? scene.chosen : scene.hovered;
  if (marked >= 0) {
    context.globalAlpha = faint(marked);
    context.strokeStyle = scene.chosen >= 0 ? HANDLE : INK;
    context.lineWidth = 2.5;
    context.beginPath();
    context.arc(...point(marked), 10, 0, 2 * Math.PI);
    context.stroke();
  }
  context.globalAlpha = 1;
}

function square(context, [x, y], half, colour) {
  context.fillStyle = colour;
  context.strokeStyle = PAPER;
  context.lineWidth = 2;
  context.beginPath();
  context.rect(x - half, y - half, 2 * half, 2 * half);
  context.fill();
  context.stroke();
}

function disc(context, [x, y], radius, colour) {
  context.fillStyle = colour;
  context.strokeStyle = PAPER;
  context.lineWidth = 2;
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fill();
  context.stroke();
}

function label(context, [x, y], text) {
  context.lineWidth = 3;
  context.strokeStyle = PAPER;
  context.fillStyle = INK;
  context.strokeText(text, x + 15, y - 13);
  context.fillText(text, x + 15, y - 13);
}

function frame(context, [[x, y], [right, low]], style) {
  context.strokeStyle = style.getPropertyValue("--accent").trim() || INK;
  context.lineWidth = 1;
  context.setLineDash([4, 3]);
  context.strokeRect(x, y, right - x, low - y);
  context.setLineDash([]);
}

function sketch(context, scene, plane) {
  context.strokeStyle = HANDLE;
  context.fillStyle = HANDLE;
  context.lineWidth = 2;
  context.beginPath();
  scene.sketch.forEach((place, i) => context[i ? "lineTo" : "moveTo"](...plane.pointOf(...place)));
  context.stroke();
  for (const place of scene.sketch) {
    context.beginPath();
    context.arc(...plane.pointOf(...place), 4, 0, 2 * Math.PI);
    context.fill();
  }
}
