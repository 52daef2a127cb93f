// Fewer triangles of the same vertices, for pictures of a large model in motion.

/**
 * Return about `count` triangles that stand for all (f × 3, indices of the same vertices). Vertices of one island in one
 * cell of a grid in space, and of a grid in the map if there is one, become one of them; boundary vertices stay.
 */
export function coarsen({ positions, places, triangles, starts, boundary }, count) {
  const n = positions.length / 3;
  // Two grids together have more cells than each.
  const cells = count / (places ? 6 : 2);
  const inSpace = grid(positions, 3, Math.sqrt(area(positions, triangles) / cells));
  const inMap = places ? grid(places, 2, Math.max(...extents(places, 2)) / Math.sqrt(cells)) : () => 0;
  const kept = new Uint8Array(n);
  for (const vertex of boundary) kept[vertex] = 1;
  const chosen = new Uint32Array(n);
  for (let island = 0; island < starts.length; island++) {
    const first = new Map();
    const end = starts[island + 1] ?? n;
    for (let vertex = starts[island]; vertex < end; vertex++) {
      chosen[vertex] = vertex;
      if (kept[vertex]) continue;
      const key = inSpace(vertex) * 2 ** 22 + inMap(vertex);
      const found = first.get(key);
      if (found === undefined) first.set(key, vertex);
      else chosen[vertex] = found;
    }
  }
  const some = new Uint32Array(triangles.length);
  let length = 0;
  for (let t = 0; t < triangles.length; t += 3) {
    const [i, j, k] = [chosen[triangles[t]], chosen[triangles[t + 1]], chosen[triangles[t + 2]]];
    if (i === j || j === k || k === i) continue;
    const was = normal(positions, triangles[t], triangles[t + 1], triangles[t + 2]);
    const is = normal(positions, i, j, k);
    // A triangle that turned its back would be drawn dark.
    const turned = was[0] * is[0] + was[1] * is[1] + was[2] * is[2] < 0;
    some[length] = i;
    some[length + 1] = turned ? k : j;
    some[length + 2] = turned ? j : k;
    length += 3;
  }
  return some.slice(0, length);
}

/** Return a function from a point of some (n × width) to the number of its cell; at most 1,024 cells a side. */
function grid(points, width, size) {
  const low = lowest(points, width);
  const step = Math.max(size, ...extents(points, width).map((length) => length / 1023)) || 1;
  return (i) => {
    let cell = 0;
    for (let k = 0; k < width; k++) cell = cell * 1024 + Math.floor((points[width * i + k] - low[k]) / step);
    return cell;
  };
}

function lowest(points, width, sign = 1) {
  const low = new Array(width).fill(Infinity);
  for (let i = 0; i < points.length; i++) low[i % width] = Math.min(low[i % width], sign * points[i]);
  return low;
}

function extents(points, width) {
  const low = lowest(points, width);
  return lowest(points, width, -1).map((value, k) => -value - low[k]);
}

function area(positions, triangles) {
  let sum = 0;
  for (let t = 0; t < triangles.length; t += 3) {
    sum += Math.hypot(...normal(positions, triangles[t], triangles[t + 1], triangles[t + 2]));
  }
  return sum / 2;
}

/** Return the normal of a triangle, twice as long as its area. */
function normal(positions, i, j, m) {
  const side = (a, b, k) => positions[3 * b + k] - positions[3 * a + k];
  const [ax, ay, az] = [side(i, j, 0), side(i, j, 1), side(i, j, 2)];
  const [bx, by, bz] = [side(i, m, 0), side(i, m, 1), side(i, m, 2)];
  return [ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx];
}
