import { LinePainter } from "./lines.js";

// Shaders for a surface and its map. Both panes share the vertex buffers, so a new map needs only one upload.

const VERTEX = `#version 300 es
uniform bool flat_pane;
uniform mat4 turn;
uniform vec4 window;
in vec3 position;
in vec2 place;
out vec3 at;
out vec2 uv;
void main() {
  at = position;
  uv = place;
  gl_Position = flat_pane ? vec4(place * window.xy + window.zw, 0.0, 1.0) : turn * vec4(position, 1.0);
}`;

// Surface positions and map positions are linear on a triangle, so their screen derivatives give the Jacobian.
// No data per triangle are computed or sent when the map moves.
const FRAGMENT = `#version 300 es
precision highp float;
uniform bool flat_pane;
uniform int colouring;
uniform vec3 toward;
uniform float scale;
uniform float reach;
uniform float squares;
uniform float dim;
uniform vec4 flat_colour;
uniform vec2 origin;
uniform sampler2D image;
in vec3 at;
in vec2 uv;
out vec4 colour;

vec3 ramp(float t) {
  vec3 c0 = vec3(0.99, 0.97, 0.80), c1 = vec3(0.66, 0.86, 0.66), c2 = vec3(0.21, 0.65, 0.67);
  vec3 c3 = vec3(0.19, 0.39, 0.63), c4 = vec3(0.22, 0.10, 0.36);
  float s = clamp(t, 0.0, 1.0) * 4.0;
  return s < 1.0 ? mix(c0, c1, s) : s < 2.0 ? mix(c1, c2, s - 1.0) : s < 3.0 ? mix(c2, c3, s - 2.0) : mix(c3, c4, s - 3.0);
}

vec3 checker() {
  // Averaged over the pixel, or fine squares would flicker.
  vec2 w = max(fwidth(uv * squares), 1e-6);
  vec2 p = uv * squares;
  vec2 i = 2.0 * (abs(fract((p - 0.5 * w) * 0.5) - 0.5) - abs(fract((p + 0.5 * w) * 0.5) - 0.5)) / w;
  return mix(vec3(0.36, 0.53, 0.80), vec3(0.96, 0.96, 0.93), 0.5 - 0.5 * i.x * i.y);
}

float stretch() {
  vec3 a = dFdx(at), b = dFdy(at);
  vec2 u = dFdx(uv), v = dFdy(uv);
  float l = max(length(a), 1e-20);
  vec3 e = a / l;
  float s = dot(b, e), h = max(length(b - s * e), 1e-20);
  vec2 j1 = u / l, j2 = (v - s * j1) / h;
  float p = length(vec2(j1.x + j2.y, j1.y - j2.x)), q = length(vec2(j1.x - j2.y, j1.y + j2.x));
  float larger = 0.5 * (p + q) * scale, smaller = 0.5 * abs(p - q) * scale;
  return max(larger, 1.0 / max(smaller, 1e-20));
}

void main() {
  if (colouring == 2) {
    colour = flat_colour;
    return;
  }
  vec3 normal = normalize(cross(dFdx(at), dFdy(at)));
  float facing = dot(normal, toward);
  float light = flat_pane ? 0.9 + 0.1 * facing : 0.45 + 0.55 * abs(facing);
  vec3 base = vec3(0.72, 0.74, 0.78);
  if (colouring == 0) base = checker();
  if (colouring == 1) base = ramp(log2(stretch()) / reach);
  if (colouring == 3) base = texture(image, uv + origin).rgb;
  if (!flat_pane && !gl_FrontFacing) base *= 0.6;
  colour = vec4(mix(base * light, vec3(0.62, 0.64, 0.68), dim), 1.0);
}`;

/** Numbers of the colourings in the shader; "plain" is that of a surface without a map. */
const COLOURINGS = { checker: 0, stretch: 1, image: 3, plain: 4 };
const FLAT = 2;

function compiled(gl, kind, source) {
  const shader = gl.createShader(kind);
  gl.shaderSource(shader, source);
  gl.compileShader(shader);
  if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
  return shader;
}

/** Whether WebGL runs in software; antialiasing is then most of the work. */
function drawsInSoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const info = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}

/** Draws triangles and edges of one surface; throws if the browser has no WebGL 2. */
export class Painter {
  constructor(canvas) {
    this.canvas = canvas;
    /** Whether WebGL runs in software; a pane that is not redrawn then keeps its picture. */
    this.software = drawsInSoftware();
    this.gl = canvas.getContext("webgl2", { antialias: !this.software, preserveDrawingBuffer: this.software, alpha: true });
    if (!this.gl) throw new Error("this browser has no WebGL 2, which draws the surface");
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => this.#build());
    this.surface = null;
    this.#build();
  }

  #build() {
    const gl = this.gl;
    this.program = gl.createProgram();
    gl.attachShader(this.program, compiled(gl, gl.VERTEX_SHADER, VERTEX));
    gl.attachShader(this.program, compiled(gl, gl.FRAGMENT_SHADER, FRAGMENT));
    gl.bindAttribLocation(this.program, 0, "position");
    gl.bindAttribLocation(this.program, 1, "place");
    gl.linkProgram(this.program);
    if (!gl.getProgramParameter(this.program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(this.program));
    this.at = {};
    for (const name of ["flat_pane", "turn", "window", "colouring", "toward", "scale", "reach", "squares", "dim", "flat_colour", "origin", "image"]) {
      this.at[name] = gl.getUniformLocation(this.program, name);
    }
    this.buffers = {};
    for (const name of ["position", "place", "triangles", "edges", "bad", "coarse"]) this.buffers[name] = gl.createBuffer();
    this.lines = new LinePainter(gl, compiled);
    this.texture = gl.createTexture();
    if (this.picture) this.setImage(this.picture);
    if (this.surface) {
      const { positions, triangles, places, bad, seams, coarse } = this.surface;
      this.setSurface(positions, triangles);
      if (seams) this.setSeams(...seams);
      this.setPlaces(places);
      this.setBad(bad);
      this.setCoarse(coarse);
    }
  }

  /** Set positions (n × 3) and triangles (f × 3) of a surface. */
  setSurface(positions, triangles) {
    const gl = this.gl;
    this.surface = { positions, triangles, edges: null, seams: null, coarse: null, places: new Float32Array((positions.length / 3) * 2), bad: new Uint32Array(0) };
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers.position);
    gl.bufferData(gl.ARRAY_BUFFER, positions, gl.STATIC_DRAW);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.buffers.triangles);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, triangles, gl.STATIC_DRAW);
    this.setSeams(new Uint32Array(0), new Uint32Array(0), false);
  }

  /** Upload the edges when they are first drawn. */
  #edges() {
    if (this.surface.edges) return this.surface.edges;
    const { triangles } = this.surface;
    const edges = new Uint32Array(2 * triangles.length);
    let count = 0;
    for (let t = 0; t < triangles.length; t += 3) {
      for (let k = 0; k < 3; k++) {
        const [i, j] = [triangles[t + k], triangles[t + ((k + 1) % 3)]];
        // The second halfedge of an inner edge has the opposite direction; the overlay draws the boundary.
        if (i < j) [edges[count++], edges[count++]] = [i, j];
      }
    }
    this.surface.edges = edges.subarray(0, count);
    this.gl.bindBuffer(this.gl.ELEMENT_ARRAY_BUFFER, this.buffers.edges);
    this.gl.bufferData(this.gl.ELEMENT_ARRAY_BUFFER, this.surface.edges, this.gl.STATIC_DRAW);
    return this.surface.edges;
  }

  /** Set the sides of the seams (k × 2), the chain of each, and whether the user drew them. */
  setSeams(edges, chain, drawn) {
    this.surface.seams = [edges, chain, drawn];
    this.lines.setEdges(edges, chain, this.surface.positions, drawn);
    this.lines.setPlaces(this.surface.places);
  }

  /** Set the image on the surface: an ImageBitmap with its last row first, or null. */
  setImage(picture) {
    const gl = this.gl;
    this.picture = picture;
    if (!picture) return;
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, picture);
    gl.generateMipmap(gl.TEXTURE_2D);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
  }

  /** Set the triangles (f × 3) that stand for all in coarse pictures; null if all are drawn. */
  setCoarse(triangles) {
    const gl = this.gl;
    this.surface.coarse = triangles;
    if (!triangles) return;
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.buffers.coarse);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, triangles, gl.DYNAMIC_DRAW);
  }

  /** Set the positions (n × 2) of the vertices in the map. */
  setPlaces(places) {
    const gl = this.gl;
    this.surface.places = places;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers.place);
    gl.bufferData(gl.ARRAY_BUFFER, places, gl.DYNAMIC_DRAW);
    this.lines.setPlaces(places);
  }

  /** Set the positions of some vertices, from `start` on. */
  setSomePlaces(places, start) {
    const gl = this.gl;
    this.surface.places.set(places, 2 * start);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers.place);
    gl.bufferSubData(gl.ARRAY_BUFFER, 8 * start, places);
    this.lines.setPlaces(this.surface.places);
  }

  /** Set the indices of the triangles to paint red. */
  setBad(bad) {
    const gl = this.gl;
    this.surface.bad = bad;
    const corners = new Uint32Array(bad.length * 3);
    bad.forEach((t, i) => corners.set(this.surface.triangles.subarray(3 * t, 3 * t + 3), 3 * i));
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.buffers.bad);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.DYNAMIC_DRAW);
  }

  /** Draw one pane: `box` in canvas pixels from the lower left, `look` with the uniforms. */
  pane(box, look) {
    const gl = this.gl;
    if (box.width <= 0 || box.height <= 0) return;
    gl.viewport(box.x, box.y, box.width, box.height);
    gl.scissor(box.x, box.y, box.width, box.height);
    gl.enable(gl.SCISSOR_TEST);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.useProgram(this.program);
    gl.uniform1i(this.at.flat_pane, look.flat ? 1 : 0);
    gl.uniformMatrix4fv(this.at.turn, false, look.turn);
    gl.uniform4fv(this.at.window, look.window);
    gl.uniform3fv(this.at.toward, look.toward);
    gl.uniform1f(this.at.scale, look.scale);
    gl.uniform1f(this.at.reach, look.reach);
    gl.uniform1f(this.at.squares, look.squares);
    gl.uniform2f(this.at.origin, ...look.origin);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.uniform1i(this.at.image, 0);
    this.#attribute(0, this.buffers.position, 3);
    this.#attribute(1, this.buffers.place, 2);
    gl[look.flat ? "disable" : "enable"](gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.enable(gl.POLYGON_OFFSET_FILL);
    gl.polygonOffset(1, 1);
    gl.uniform1i(this.at.colouring, COLOURINGS[look.colouring === "image" && !this.picture ? "checker" : look.colouring]);
    const { coarse } = this.surface;
    if (look.coarse && coarse) this.#draw(gl.TRIANGLES, this.buffers.coarse, coarse.length);
    else {
      // Islands that are not selected are paler, in both panes.
      for (const [first, count, chosen] of look.runs) {
        gl.uniform1f(this.at.dim, chosen ? 0 : 0.6);
        this.#draw(gl.TRIANGLES, this.buffers.triangles, count, first);
      }
      gl.uniform1f(this.at.dim, 0);
    }
    gl.disable(gl.POLYGON_OFFSET_FILL);
    gl.uniform1i(this.at.colouring, FLAT);
    if (look.edges && !(look.coarse && coarse)) {
      gl.enable(gl.BLEND);
      // Keep the canvas opaque, otherwise the page shines through.
      gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE);
      gl.uniform4f(this.at.flat_colour, 0.06, 0.12, 0.29, 0.35);
      const count = this.#edges().length;
      this.#draw(gl.LINES, this.buffers.edges, count);
      gl.disable(gl.BLEND);
    }
    gl.uniform4f(this.at.flat_colour, 0.89, 0.07, 0.17, 1);
    this.#draw(gl.TRIANGLES, this.buffers.bad, this.surface.bad.length * 3);
    if (look.seams) this.lines.draw(box, look, look.width);
  }

  /** Clear a pane: `box` in canvas pixels from the lower left. */
  clearPane(box) {
    const gl = this.gl;
    gl.scissor(box.x, box.y, box.width, box.height);
    gl.enable(gl.SCISSOR_TEST);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  }

  /** Clear the canvas. */
  clear() {
    const gl = this.gl;
    gl.disable(gl.SCISSOR_TEST);
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  }

  /** Wait until drawing is finished, for measurements. */
  finish() {
    this.gl.readPixels(0, 0, 1, 1, this.gl.RGBA, this.gl.UNSIGNED_BYTE, new Uint8Array(4));
  }

  dispose() {
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
  }

  #attribute(location, buffer, size) {
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.enableVertexAttribArray(location);
    gl.vertexAttribPointer(location, size, gl.FLOAT, false, 0, 0);
  }

  #draw(mode, buffer, count, first = 0) {
    if (!count) return;
    this.gl.bindBuffer(this.gl.ELEMENT_ARRAY_BUFFER, buffer);
    this.gl.drawElements(mode, count, this.gl.UNSIGNED_INT, 4 * first);
  }
}
