// The scene: what the last frames say, and what the user points at.

export class Scene {
  constructor() {
    this.name = "";
    this.size = { width: 1, height: 1 };
    this.places = null;
    this.loops = [];
    this.owners = []; // island of each loop
    this.boundary = [];
    this.triangles = new Uint32Array(0);
    this.starts = [0];
    this.firstTriangles = [0];
    this.selected = new Set([0]);
    this.asked = null;
    this.bad = new Uint32Array(0);
    this.origin = [0, 0];
    this.corners = [];
    this.numbers = [];
    this.pins = [];
    this.obstruction = null;
    this.hovered = -1;
    this.chosen = -1;
    this.frame = null; // two opposite corners of the box that selects
    this.sketch = [];
    this.seamStart = -1;
  }

  /** Set the islands of a surface frame, and its boundary, loop after loop. */
  setIslands(header, boundary) {
    this.boundary = boundary;
    this.starts = header.starts;
    this.firstTriangles = header.first_triangles;
    let start = 0;
    this.loops = header.loops.map((length) => boundary.slice(start, (start += length)));
    this.owners = this.loops.map((loop) => last(this.starts, loop[0]));
    this.selected = new Set(this.starts.keys());
  }

  /** Return runs of triangles that are selected or not: first corner, number of corners, selected. */
  get runs() {
    const runs = [];
    this.starts.forEach((_, k) => {
      const first = 3 * this.firstTriangles[k];
      const end = 3 * (this.firstTriangles[k + 1] ?? this.triangles.length / 3);
      const chosen = this.selected.has(k);
      const last = runs.at(-1);
      if (last?.[2] === chosen) last[1] = end - last[0];
      else runs.push([first, end - first, chosen]);
    });
    return runs;
  }

  placeOf(vertex) {
    return [this.places[2 * vertex], this.places[2 * vertex + 1]];
  }

  islandOfTriangle(triangle) {
    return last(this.firstTriangles, triangle);
  }
}

/** Return the index of the last of some ascending numbers that is at most `value`. */
function last(ascending, value) {
  let [low, high] = [0, ascending.length - 1];
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (ascending[middle] <= value) low = middle;
    else high = middle - 1;
  }
  return low;
}
