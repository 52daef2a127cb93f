// Draws thick lines along edges of the surface in both panes: seams, with one colour for both sides.

const VERTEX = `#version 300 es
uniform bool flat_pane;
uniform mat4 turn;
uniform vec4 window;
uniform vec2 pixel; // width of the line in clip coordinates of the pane
in vec3 from_position;
in vec3 to_position;
in vec2 from_place;
in vec2 to_place;
in vec3 tint;
in vec2 corner;
out vec3 shade;
vec4 project(vec3 at, vec2 uv) {
  return flat_pane ? vec4(uv * window.xy + window.zw, 0.0, 1.0) : turn * vec4(at, 1.0);
}
void main() {
  vec4 a = project(from_position, from_place), b = project(to_position, to_place);
  vec2 along = (b.xy - a.xy) / pixel;
  along = length(along) > 1e-6 ? normalize(along) : vec2(1.0, 0.0);
  vec4 at = corner.x < 0.0 ? a : b;
  // The ends are extended by half the width, so that lines of a chain join.
  at.xy += (vec2(-along.y, along.x) * corner.y + along * corner.x) * 0.5 * pixel;
  if (!flat_pane) at.z -= 0.004;
  shade = tint;
  gl_Position = at;
}`;

const FRAGMENT = `#version 300 es
precision highp float;
in vec3 shade;
out vec4 colour;
void main() {
  colour = vec4(shade, 1.0);
}`;

/** Colours of chains, in turn. */
export const CHAINS = ["#d6336c", "#e8590c", "#2b8a3e", "#862e9c", "#0b7285", "#c92a2a", "#5f3dc4", "#846300"];
const DRAWN = "#ff2d95";
// Edges that must not become seams, and the number of their chain.
const FORBIDDEN = 0xffffffff;
const KEPT = "#1c7ed6";

const rgb = (colour) => [1, 3, 5].map((k) => parseInt(colour.slice(k, k + 2), 16) / 255);

/** The lines of one surface. `compile(kind, source)` compiles a shader. */
export class LinePainter {
  constructor(gl, compile) {
    this.gl = gl;
    this.count = 0;
    this.edges = new Uint32Array(0);
    this.program = gl.createProgram();
    gl.attachShader(this.program, compile(gl, gl.VERTEX_SHADER, VERTEX));
    gl.attachShader(this.program, compile(gl, gl.FRAGMENT_SHADER, FRAGMENT));
    gl.linkProgram(this.program);
    if (!gl.getProgramParameter(this.program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(this.program));
    this.at = {};
    for (const name of ["flat_pane", "turn", "window", "pixel"]) this.at[name] = gl.getUniformLocation(this.program, name);
    this.buffers = {};
    for (const name of ["positions", "places", "tint", "corner"]) this.buffers[name] = gl.createBuffer();
    this.array = gl.createVertexArray();
    gl.bindVertexArray(this.array);
    this.#attribute("corner", "corner", 2, 8, 0, 0);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, -1, 1, 1, -1, 1, 1]), gl.STATIC_DRAW);
    this.#attribute("from_position", "positions", 3, 24, 0, 1);
    this.#attribute("to_position", "positions", 3, 24, 12, 1);
    this.#attribute("from_place", "places", 2, 16, 0, 1);
    this.#attribute("to_place", "places", 2, 16, 8, 1);
    this.#attribute("tint", "tint", 3, 12, 0, 1);
    gl.bindVertexArray(null);
  }

  #attribute(name, buffer, size, stride, offset, divisor) {
    const gl = this.gl;
    const location = gl.getAttribLocation(this.program, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers[buffer]);
    gl.enableVertexAttribArray(location);
    gl.vertexAttribPointer(location, size, gl.FLOAT, false, stride, offset);
    gl.vertexAttribDivisor(location, divisor);
  }

  /** Set the edges (k × 2), the chain of each edge, and the positions (n × 3) of the surface. */
  setEdges(edges, chain, positions, drawn) {
    const gl = this.gl;
    this.edges = edges;
    this.count = chain.length;
    const at = new Float32Array(6 * this.count);
    const tint = new Float32Array(3 * this.count);
    edges.forEach((vertex, i) => at.set(positions.subarray(3 * vertex, 3 * vertex + 3), 3 * i));
    const colours = (drawn ? [DRAWN] : CHAINS).map(rgb);
    chain.forEach((k, i) => tint.set(k === FORBIDDEN ? rgb(KEPT) : colours[k % colours.length], 3 * i));
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers.positions);
    gl.bufferData(gl.ARRAY_BUFFER, at, gl.STATIC_DRAW);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers.tint);
    gl.bufferData(gl.ARRAY_BUFFER, tint, gl.STATIC_DRAW);
    this.setPlaces(null);
  }

  /** Set the positions (n × 2) of the vertices in the map; null if there is no map. */
  setPlaces(places) {
    const gl = this.gl;
    const at = new Float32Array(4 * this.count);
    if (places) this.edges.forEach((vertex, i) => at.set(places.subarray(2 * vertex, 2 * vertex + 2), 2 * i));
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers.places);
    gl.bufferData(gl.ARRAY_BUFFER, at, gl.DYNAMIC_DRAW);
  }

  /** Draw the lines in the pane of the viewport: `box` in canvas pixels, `look` as for the triangles, `width` in pixels. */
  draw(box, look, width) {
    if (!this.count) return;
    const gl = this.gl;
    gl.useProgram(this.program);
    gl.uniform1i(this.at.flat_pane, look.flat ? 1 : 0);
    gl.uniformMatrix4fv(this.at.turn, false, look.turn);
    gl.uniform4fv(this.at.window, look.window);
    gl.uniform2f(this.at.pixel, (2 * width) / box.width, (2 * width) / box.height);
    gl.bindVertexArray(this.array);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.count);
    gl.bindVertexArray(null);
  }
}
