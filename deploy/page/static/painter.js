// WebGL 2: lit boxes and cylinders in one call each, and a point cloud that the card makes from depth and colour.
// What stands still (ground, cloud) is drawn only when it or the view changes, into a layer of its own with its depths, and the
// machine over that: 50,000 points cost a processor without a graphics card 30 ms, the layer a few.
import { multiply } from "./matrices.js";

const SOLID = `#version 300 es
in vec3 corner; in vec3 facing; in vec4 m0; in vec4 m1; in vec4 m2; in vec4 m3; in vec3 color;
uniform mat4 view; out vec3 shade;
void main() {
  mat4 place = mat4(m0, m1, m2, m3);
  vec3 up = normalize(m0.xyz / dot(m0, m0) * facing.x + m1.xyz / dot(m1, m1) * facing.y + m2.xyz / dot(m2, m2) * facing.z);
  shade = color * (0.55 + 0.35 * max(0.0, dot(up, vec3(0.35, -0.5, 0.79))) + 0.1 * up.z);
  gl_Position = view * place * vec4(corner, 1.0);
}`;
const FLAT = `#version 300 es
precision mediump float; in vec3 shade; out vec4 seen;
void main() { seen = vec4(shade, 1.0); }`;
const POINTS = `#version 300 es
precision highp usampler2D;
uniform usampler2D depth; uniform sampler2D picture; uniform mat4 view;
uniform vec4 lens; uniform ivec4 grid; uniform vec2 unit; out vec3 shade;
void main() {
  ivec2 at = ivec2(gl_VertexID % grid.z, gl_VertexID / grid.z) * grid.w;
  float z = float(texelFetch(depth, at, 0).r) * unit.x;
  gl_Position = z > 0.0 ? view * vec4((vec2(at) - lens.zw) / lens.xy * z, z, 1.0) : vec4(2.0, 2.0, 2.0, 1.0);
  gl_PointSize = clamp(unit.y * z / gl_Position.w, 1.0, 6.0);
  shade = texelFetch(picture, at, 0).rgb;
}`;
const WHOLE = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID % 2, gl_VertexID / 2) * 4.0 - 1.0, 0.0, 1.0); }`;
const LAYER = `#version 300 es
precision highp float; uniform highp sampler2D color; uniform highp sampler2D depth; out vec4 seen;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  seen = texelFetch(color, at, 0);
  gl_FragDepth = texelFetch(depth, at, 0).r;
}`;
const STRIDE = 19;  // floats of an instance: matrix and colour

export class Painter {
  constructor(canvas) {
    const gl = this.gl = canvas.getContext("webgl2", { antialias: false, alpha: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("no WebGL 2");
    this.canvas = canvas;
    this.points = 0;
    this.solid = program(gl, SOLID, FLAT);
    this.cloudy = program(gl, POINTS, FLAT);
    this.empty = gl.createVertexArray();
    this.box = body(gl, this.solid, boxCorners());
    this.cylinder = body(gl, this.solid, cylinderCorners(10));
    this.depth = texture(gl);
    this.picture = texture(gl);
    this.behind = program(gl, WHOLE, LAYER);
    this.still = { buffer: gl.createFramebuffer(), color: texture(gl), depth: texture(gl), width: 0, height: 0 };
    this.stale = true;
    gl.enable(gl.DEPTH_TEST);
  }

  // Sets the colour of the sky, for day or night.
  shade(night) {
    this.gl.clearColor(...(night ? [0.06, 0.07, 0.09] : [0.87, 0.91, 0.94]), 1);
    this.stale = true;
  }

  cloud(header, depth, picture, limit) {
    const gl = this.gl, { width, height } = header;
    const every = Math.ceil(Math.sqrt(width * height / limit));
    const columns = Math.ceil(width / every);
    this.points = columns * Math.ceil(height / every);
    this.stale = true;
    this.header = { ...header, every, columns, pose: new Float32Array(16).map((_, i) => header.base_from_camera[4 * (i % 4) + Math.floor(i / 4)]) };
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 2);
    gl.bindTexture(gl.TEXTURE_2D, this.depth);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.R16UI, width, height, 0, gl.RED_INTEGER, gl.UNSIGNED_SHORT, depth);
    gl.bindTexture(gl.TEXTURE_2D, this.picture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, gl.RGB, gl.UNSIGNED_BYTE, picture);
  }

  draw(view, floor, shapes) {
    const gl = this.gl, { width, height } = this.canvas;
    if (sized(gl, this.still, width, height)) this.stale = true;
    if (this.view?.some((value, i) => value !== view[i]) ?? true) this.stale = true;
    this.view = view;
    gl.viewport(0, 0, width, height);
    if (this.stale) {
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.still.buffer);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      this.solids(view, floor);
      if (this.header?.placed) this.drawCloud(view);
      this.stale = false;
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.useProgram(this.behind);
    gl.bindVertexArray(this.empty);
    this.textures(this.behind, { color: this.still.color, depth: this.still.depth });
    gl.depthFunc(gl.ALWAYS);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.depthFunc(gl.LESS);
    this.solids(view, shapes);
  }

  textures(made, named) {
    const gl = this.gl;
    Object.entries(named).forEach(([name, kind], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, kind);
      gl.uniform1i(gl.getUniformLocation(made, name), unit);
    });
    gl.activeTexture(gl.TEXTURE0);
  }

  solids(view, shapes) {
    const gl = this.gl;
    gl.useProgram(this.solid);
    gl.uniformMatrix4fv(gl.getUniformLocation(this.solid, "view"), false, view);
    this.bodies(this.box, shapes.boxes);
    this.bodies(this.cylinder, shapes.cylinders);
  }

  drawCloud(view) {
    const gl = this.gl, { width: w, height: h, every, columns, pose, focal_px, center_px, m_per_unit } = this.header;
    const at = name => gl.getUniformLocation(this.cloudy, name);
    gl.useProgram(this.cloudy);
    gl.bindVertexArray(this.empty);
    this.textures(this.cloudy, { depth: this.depth, picture: this.picture });
    gl.uniformMatrix4fv(at("view"), false, multiply(view, pose));
    gl.uniform4f(at("lens"), ...focal_px, ...center_px);
    gl.uniform4i(at("grid"), w, h, columns, every);
    gl.uniform2f(at("unit"), m_per_unit, 1.5 * every * this.canvas.height / focal_px[1]);  // a point covers about what its pixel saw
    gl.drawArrays(gl.POINTS, 0, this.points);
  }

  bodies({ array, instances, count }, data) {
    const gl = this.gl;
    if (!data.length) return;
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, instances);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(data), gl.STREAM_DRAW);
    gl.drawArraysInstanced(gl.TRIANGLES, 0, count, data.length / STRIDE);
  }
}

function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
  }
  gl.linkProgram(made);
  return made;
}

function sized(gl, made, width, height) {
  if (made.width === width && made.height === height) return false;
  Object.assign(made, { width, height });
  gl.bindFramebuffer(gl.FRAMEBUFFER, made.buffer);
  gl.bindTexture(gl.TEXTURE_2D, made.color);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, width, height, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, made.color, 0);
  gl.bindTexture(gl.TEXTURE_2D, made.depth);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.DEPTH_COMPONENT24, width, height, 0, gl.DEPTH_COMPONENT, gl.UNSIGNED_INT, null);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, made.depth, 0);
  return true;
}

function texture(gl) {
  const made = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, made);
  for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
  return made;
}

function body(gl, made, corners) {
  const array = gl.createVertexArray(), mesh = gl.createBuffer(), instances = gl.createBuffer();
  gl.bindVertexArray(array);
  const attribute = (name, size, stride, offset, each) => {
    const at = gl.getAttribLocation(made, name);
    gl.enableVertexAttribArray(at);
    gl.vertexAttribPointer(at, size, gl.FLOAT, false, 4 * stride, 4 * offset);
    gl.vertexAttribDivisor(at, each);
  };
  gl.bindBuffer(gl.ARRAY_BUFFER, mesh);
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(corners), gl.STATIC_DRAW);
  attribute("corner", 3, 6, 0, 0);
  attribute("facing", 3, 6, 3, 0);
  gl.bindBuffer(gl.ARRAY_BUFFER, instances);
  for (let i = 0; i < 4; i++) attribute(`m${i}`, 4, STRIDE, 4 * i, 1);
  attribute("color", 3, STRIDE, 16, 1);
  return { array, instances, count: corners.length / 6 };
}

function boxCorners() {
  const out = [];
  for (let i = 0; i < 3; i++) for (const side of [-1, 1]) {
    const facing = [0, 0, 0], u = (i + 1) % 3, v = (i + 2) % 3;
    facing[i] = side;
    for (const [a, b] of [[-1, -1], [1, -1], [1, 1], [-1, -1], [1, 1], [-1, 1]]) {
      const corner = [0, 0, 0];
      corner[i] = side; corner[u] = a; corner[v] = b;
      out.push(...corner, ...facing);
    }
  }
  return out;
}

function cylinderCorners(parts) {
  const out = [];
  for (let k = 0; k < parts; k++) {
    const [a, b] = [k, k + 1].map(i => [Math.cos(2 * Math.PI * i / parts), Math.sin(2 * Math.PI * i / parts)]);
    const side = (p, z) => [...p, z, ...p, 0];
    out.push(...side(a, -1), ...side(b, -1), ...side(b, 1), ...side(a, -1), ...side(b, 1), ...side(a, 1));
    for (const z of [-1, 1]) out.push(...a, z, 0, 0, z, ...b, z, 0, 0, z, 0, 0, z, 0, 0, z);
  }
  return out;
}
