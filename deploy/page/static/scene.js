// The 3D scene, in a worker with a canvas and a WebSocket of its own: machine, boreholes, path, and the point cloud.
import { add, lookAlong, lookAt, multiply, perspective } from "./matrices.js";
import { Painter } from "./painter.js";
import { Shapes, boreholes, camera, ground, machine, path, tip } from "./shapes.js";
import { Socket } from "./socket.js";

const FOV = 0.7, NEAR = 0.1, FAR = 40, REPORT_MS = 1000;
const APART_MS = 15;  // no faster than a screen, nor than the state comes; what is left belongs to the levers
const view = { at: [1.7, 0, 0.7], distance: 6.2, azimuth: -1.05, height: 0.42 };
const floor = new Shapes();
ground(floor);
const BEHIND_M = 0.6;  // distance from the tip of somebody who looks along the tool
let along = false, night = false;
let painter = null, setup = null, state = null, changed = true, drawn = 0, since = performance.now();
let frames = 0, undrawn = null, latest = 0;

function start({ canvas, geometry, points, size }) {
  setup = { canvas, geometry, points };
  resize(size);
  try { painter = new Painter(canvas); } catch { postMessage({ failed: true }); return; }
  painter.shade(night);
  new Socket("/frames", { binary: true, opened: () => { frames = 0; }, heard: take });
  requestAnimationFrame(tick);
}

function resize(size) {
  [setup.canvas.width, setup.canvas.height] = size.map(length => Math.max(1, length));
  changed = true;
}

// A frame: depth to the graphics card as it is, colour to the card and to the page.
async function take(data, socket) {
  const began = performance.now(), number = ++frames;
  const length = new DataView(data).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
  const { width, height, depth_bytes } = header;
  const count = width * height, depth = new Uint16Array(count);
  const deflated = new Blob([new Uint8Array(data, 4 + length, depth_bytes)]).stream();
  const bytes = new Uint8Array(await new Response(deflated.pipeThrough(new DecompressionStream("deflate"))).arrayBuffer());
  for (let row = 0; row < count; row += width) for (let i = row, unit = 0; i < row + width; i++) {
    const outwards = bytes[i] | bytes[count + i] << 8;
    depth[i] = unit += (outwards >> 1) ^ -(outwards & 1);  // modulo 2^16
  }
  const jpeg = new Blob([new Uint8Array(data, 4 + length + depth_bytes)], { type: "image/jpeg" });
  const picture = await createImageBitmap(jpeg);
  painter.cloud(header, depth, picture, setup.points);
  postMessage({ picture, lens: header }, [picture]);
  undrawn = { number, socket, began };
  changed = true;
}

function tick() {
  requestAnimationFrame(tick);
  const now = performance.now();
  if (now - since >= REPORT_MS) report(now);
  if (!changed || now - latest < APART_MS) return;
  [changed, latest] = [false, now];
  const shapes = new Shapes(), tool = along && setup.geometry && state?.q ? lookAlong(setup.geometry, state.q) : null;
  if (state) {
    if (tool) tip(shapes, tool);
    else if (setup.geometry && state.q) machine(shapes, setup.geometry, state.q);
    boreholes(shapes, state.targets);
    path(shapes, state.path_in_base_m);
    if (state.view && painter.header?.placed && !tool) camera(shapes, painter.header);
  }
  const { width, height: tall } = setup.canvas;
  painter.draw(multiply(perspective(FOV, width / tall, NEAR, FAR), tool ? lookAt(add(tool.at, tool.ahead, -BEHIND_M), tool.at, tool.up) : orbit()), floor, shapes);
  drawn += 1;
  if (undrawn) {
    undrawn.socket.send(String(undrawn.number));
    postMessage({ measured: { frames: undrawn.number, frame_ms: performance.now() - undrawn.began, points: painter.points } });
    undrawn = null;
  }
}

function orbit() {
  const { at, distance, azimuth, height } = view;
  return lookAt([at[0] + distance * Math.cos(height) * Math.cos(azimuth), at[1] + distance * Math.cos(height) * Math.sin(azimuth), at[2] + distance * Math.sin(height)], at);
}

function report(now) {
  postMessage({ measured: { fps: 1000 * drawn / (now - since) } });
  [drawn, since] = [0, now];
}

const acts = {
  start,
  size: resize,
  state: shown => { state = shown; changed = true; },
  along: on => { along = on; changed = true; },
  night: on => { night = on; painter?.shade(night); changed = true; },
  turn: ([x, y]) => {
    view.azimuth -= x * 0.006;
    view.height = Math.min(1.5, Math.max(-0.1, view.height + y * 0.006));
    changed = true;
  },
  zoom: factor => { view.distance = Math.min(15, Math.max(0.8, view.distance * factor)); changed = true; },
};
onmessage = ({ data }) => { for (const [name, value] of Object.entries(data)) acts[name]?.(value); };
