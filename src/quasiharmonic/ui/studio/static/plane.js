// View of the map: transformation from the plane to the screen, and picking of vertices.

/** A window on the plane that supports pan and zoom. */
export class PlaneView {
  constructor() {
    this.box = { x: 0, y: 0, width: 1, height: 1 };
    this.centre = [0, 0];
    this.extent = 1;
    this.pixels = 1;
    this.followed = true;
  }

  /** Return another view of the same part of the plane. */
  copy() {
    return Object.assign(new PlaneView(), this);
  }

  sameAs(other) {
    return this.pixels === other.pixels && this.centre.every((value, k) => value === other.centre[k]);
  }

  /** Return the view that is a part `s` of the way to another one, in the box of that one. */
  toward(other, s) {
    const between = other.copy();
    between.centre = this.centre.map((value, k) => value + s * (other.centre[k] - value));
    between.pixels = this.pixels * (other.pixels / this.pixels) ** s;
    between.extent = this.extent * (other.extent / this.extent) ** s;
    return between;
  }

  /** Fit the view to some positions (n × 2), with a margin. */
  fit(places) {
    let [left, right, bottom, top] = [Infinity, -Infinity, Infinity, -Infinity];
    for (let i = 0; i < places.length; i += 2) {
      left = Math.min(left, places[i]);
      right = Math.max(right, places[i]);
      bottom = Math.min(bottom, places[i + 1]);
      top = Math.max(top, places[i + 1]);
    }
    if (!(right >= left)) return;
    this.centre = [(left + right) / 2, (bottom + top) / 2];
    this.extent = Math.max(right - left, top - bottom) || 1;
    this.size = [right - left || 1, top - bottom || 1];
    this.followed = true;
    this.#refit();
  }

  #refit() {
    if (this.followed && this.size) {
      this.pixels = 0.84 * Math.min(this.box.width / this.size[0], this.box.height / this.size[1]);
    }
  }

  /** Set the box of the pane on the screen, in CSS pixels. */
  setBox(box) {
    this.box = box;
    this.#refit();
  }

  shiftBy(dx, dy) {
    this.followed = false;
    this.centre = [this.centre[0] - dx / this.pixels, this.centre[1] + dy / this.pixels];
  }

  /** Zoom around a point of the screen. */
  zoomBy(factor, point) {
    this.followed = false;
    const before = this.placeOf(point);
    this.pixels = Math.max(this.pixels * factor, 1e-6);
    const after = this.placeOf(point);
    this.centre = this.centre.map((c, k) => c + before[k] - after[k]);
  }

  /** Return the position in the plane of a point of the screen. */
  placeOf([x, y]) {
    return [
      this.centre[0] + (x - this.box.x - this.box.width / 2) / this.pixels,
      this.centre[1] - (y - this.box.y - this.box.height / 2) / this.pixels,
    ];
  }

  /** Return the point of the screen of a position in the plane. */
  pointOf(u, v) {
    return [
      this.box.x + this.box.width / 2 + (u - this.centre[0]) * this.pixels,
      this.box.y + this.box.height / 2 - (v - this.centre[1]) * this.pixels,
    ];
  }

  /** Scale and shift from positions to the pane's clip coordinates. */
  get window() {
    const sx = (2 * this.pixels) / this.box.width;
    const sy = (2 * this.pixels) / this.box.height;
    return new Float32Array([sx, sy, -sx * this.centre[0], -sy * this.centre[1]]);
  }

  /** Return the triangle that covers a point of the screen, the last one if several do; -1 if none does. */
  pick(point, places, triangles) {
    const [x, y] = this.placeOf(point);
    for (let t = triangles.length - 3; t >= 0; t -= 3) {
      const [i, j, k] = [2 * triangles[t], 2 * triangles[t + 1], 2 * triangles[t + 2]];
      const [ax, ay, bx, by] = [places[i] - x, places[i + 1] - y, places[j] - x, places[j + 1] - y];
      const [cx, cy] = [places[k] - x, places[k + 1] - y];
      const [a, b, c] = [bx * cy - cx * by, cx * ay - ax * cy, ax * by - bx * ay];
      if ((a >= 0 && b >= 0 && c >= 0) || (a <= 0 && b <= 0 && c <= 0)) return t / 3;
    }
    return -1;
  }

  /** Return a round length, 1, 2 or 5 times a power of ten, of at least so many pixels. */
  roundLength(pixels) {
    const least = pixels / this.pixels;
    const power = 10 ** Math.floor(Math.log10(least));
    return power * [1, 2, 5, 10].find((factor) => factor * power >= least);
  }

  /** Return the vertex of a list nearest to a point of the screen, within so many pixels; else -1. */
  nearest(point, vertices, places, within) {
    let best = within;
    let found = -1;
    for (const vertex of vertices) {
      const [x, y] = this.pointOf(places[2 * vertex], places[2 * vertex + 1]);
      const away = Math.hypot(x - point[0], y - point[1]);
      if (away < best) [best, found] = [away, vertex];
    }
    return found;
  }
}
