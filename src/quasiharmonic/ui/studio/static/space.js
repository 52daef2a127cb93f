// View of the surface: rotation, projection, and picking of vertices.

/** Return the largest distance of some points (n × 3) from a centre. */
function farthest(positions, [x, y, z]) {
  let most = 0;
  for (let i = 0; i < positions.length; i += 3) {
    most = Math.max(most, (positions[i] - x) ** 2 + (positions[i + 1] - y) ** 2 + (positions[i + 2] - z) ** 2);
  }
  return Math.sqrt(most);
}

/** An orthographic view of points (n × 3) that supports rotation, pan and zoom. Angles in radians. */
export class SpaceView {
  constructor(positions) {
    const low = [Infinity, Infinity, Infinity];
    const high = [-Infinity, -Infinity, -Infinity];
    for (let i = 0; i < positions.length; i++) {
      low[i % 3] = Math.min(low[i % 3], positions[i]);
      high[i % 3] = Math.max(high[i % 3], positions[i]);
    }
    this.positions = positions;
    this.centre = low.map((value, k) => (value + high[k]) / 2);
    this.radius = farthest(positions, this.centre) || 1;
    this.box = { x: 0, y: 0, width: 1, height: 1 };
    this.reset();
  }

  reset() {
    this.yaw = 0;
    this.pitch = 0;
    this.zoom = 1;
    this.shift = [0, 0];
  }

  /** Take over the direction of another view. */
  turnLike(other) {
    [this.yaw, this.pitch, this.zoom] = [other.yaw, other.pitch, other.zoom];
    this.shift = [...other.shift];
  }

  /** Set the direction of view: "front", "side" or "top". */
  viewFrom(name) {
    this.yaw = name === "side" ? -Math.PI / 2 : 0;
    this.pitch = name === "top" ? Math.PI / 2 : 0;
  }

  /** Rotate by a pointer motion in CSS pixels. */
  turnBy(dx, dy) {
    this.yaw += dx * 0.01;
    this.pitch = Math.max(-Math.PI / 2, Math.min(Math.PI / 2, this.pitch + dy * 0.01));
  }

  shiftBy(dx, dy) {
    this.shift[0] += dx;
    this.shift[1] += dy;
  }

  zoomBy(factor) {
    this.zoom = Math.max(0.1, Math.min(200, this.zoom * factor));
  }

  /** CSS pixels per unit of length. */
  get pixels() {
    return (0.46 * Math.min(this.box.width, this.box.height) * this.zoom) / this.radius;
  }

  /** Rows of the rotation: right, up, and toward the eye. */
  get axes() {
    const [cy, sy, cp, sp] = [Math.cos(this.yaw), Math.sin(this.yaw), Math.cos(this.pitch), Math.sin(this.pitch)];
    return [
      [cy, 0, sy],
      [sp * sy, cp, -sp * cy],
      [-cp * sy, sp, cp * cy],
    ];
  }

  /** The matrix for the painter, in column-major order. */
  get matrix() {
    const axes = this.axes;
    const sx = (2 * this.pixels) / this.box.width;
    const sy = (2 * this.pixels) / this.box.height;
    // At every zoom the whole surface lies between the clipping planes.
    const sz = -0.5 / this.radius;
    const rows = [axes[0].map((a) => a * sx), axes[1].map((a) => a * sy), axes[2].map((a) => a * sz)];
    const shift = rows.map((row) => -row.reduce((sum, a, k) => sum + a * this.centre[k], 0));
    shift[0] += (2 * this.shift[0]) / this.box.width;
    shift[1] -= (2 * this.shift[1]) / this.box.height;
    return new Float32Array([0, 1, 2, 3].flatMap((c) => (c < 3 ? [rows[0][c], rows[1][c], rows[2][c], 0] : [...shift, 1])));
  }

  /** Return the point of the screen of a vertex, in CSS pixels from the upper left of the whole view. */
  project(vertex) {
    const axes = this.axes;
    const d = [0, 1, 2].map((k) => this.positions[3 * vertex + k] - this.centre[k]);
    const [x, y] = axes.map((axis) => axis[0] * d[0] + axis[1] * d[1] + axis[2] * d[2]);
    return [
      this.box.x + this.box.width / 2 + x * this.pixels + this.shift[0],
      this.box.y + this.box.height / 2 - y * this.pixels + this.shift[1],
    ];
  }

  /** Return the vertices of a list that triangles in front of them hide; the last answer is kept for the same direction. */
  hidden(vertices, triangles) {
    const key = `${this.yaw},${this.pitch},${vertices.join()}`;
    if (this.hiddenKey !== key) {
      this.hiddenKey = key;
      const flat = this.#flatten(0, 0);
      this.hiddenVertices = new Set(vertices.filter((vertex) => this.#isHidden(vertex, triangles, flat)));
    }
    return this.hiddenVertices;
  }

  #isHidden(vertex, triangles, flat) {
    const [x, y, z] = flat.subarray(3 * vertex, 3 * vertex + 3);
    const margin = 1e-3 * this.radius;
    for (let t = 0; t < triangles.length; t += 3) {
      const [i, j, k] = [3 * triangles[t], 3 * triangles[t + 1], 3 * triangles[t + 2]];
      if (Math.max(flat[i + 2], flat[j + 2], flat[k + 2]) < z + margin) continue;
      const [ax, ay, bx, by] = [flat[i] - x, flat[i + 1] - y, flat[j] - x, flat[j + 1] - y];
      const [cx, cy] = [flat[k] - x, flat[k + 1] - y];
      const [a, b, c] = [bx * cy - cx * by, cx * ay - ax * cy, ax * by - bx * ay];
      if ((a < 0 || b < 0 || c < 0) && (a > 0 || b > 0 || c > 0)) continue;
      const whole = a + b + c;
      if (whole && (a * flat[i + 2] + b * flat[j + 2] + c * flat[k + 2]) / whole > z + margin) return true;
    }
    return false;
  }

  /** Return the coordinates of all vertices along right, up and the direction toward the eye, less (x, y). */
  #flatten(x, y) {
    const [right, up, eye] = this.axes;
    const n = this.positions.length / 3;
    const flat = new Float64Array(3 * n);
    for (let i = 0; i < n; i++) {
      const a = this.positions[3 * i] - this.centre[0];
      const b = this.positions[3 * i + 1] - this.centre[1];
      const c = this.positions[3 * i + 2] - this.centre[2];
      flat[3 * i] = right[0] * a + right[1] * b + right[2] * c - x;
      flat[3 * i + 1] = up[0] * a + up[1] * b + up[2] * c - y;
      flat[3 * i + 2] = eye[0] * a + eye[1] * b + eye[2] * c;
    }
    return flat;
  }

  /** Return the nearest triangle under a point of the screen and its vertex nearest to that point, or null. */
  pick(point, triangles) {
    const x = (point[0] - this.box.x - this.box.width / 2 - this.shift[0]) / this.pixels;
    const y = -(point[1] - this.box.y - this.box.height / 2 - this.shift[1]) / this.pixels;
    const flat = this.#flatten(x, y);
    let nearest = -Infinity;
    let found = null;
    for (let t = 0; t < triangles.length; t += 3) {
      const [i, j, k] = [3 * triangles[t], 3 * triangles[t + 1], 3 * triangles[t + 2]];
      const a = flat[j] * flat[k + 1] - flat[k] * flat[j + 1];
      const b = flat[k] * flat[i + 1] - flat[i] * flat[k + 1];
      const c = flat[i] * flat[j + 1] - flat[j] * flat[i + 1];
      if ((a < 0 || b < 0 || c < 0) && (a > 0 || b > 0 || c > 0)) continue;
      const whole = a + b + c;
      if (whole === 0) continue;
      const depth = (a * flat[i + 2] + b * flat[j + 2] + c * flat[k + 2]) / whole;
      if (depth > nearest) {
        nearest = depth;
        const nearer = (p, q) => (Math.hypot(flat[p], flat[p + 1]) <= Math.hypot(flat[q], flat[q + 1]) ? p : q);
        found = { triangle: t / 3, vertex: [j, k].reduce(nearer, i) / 3 };
      }
    }
    return found;
  }
}
