// What stands in the scene as boxes and cylinders: each a matrix that places a unit body (z from -1 to 1), and a colour.
import { add, chain, cross, frame, norm, rim, scaled, sub, unit } from "./matrices.js";

const PAINT = [0.96, 0.65, 0.05], DARK = [0.16, 0.17, 0.18], STEEL = [0.42, 0.43, 0.45], LINE = [0.55, 0.6, 0.66];
const CHOSEN = [0, 0.55, 0.2], OTHER = [0.05, 0.3, 0.85], PATH = [0.82, 0, 0.45];
const THICK_M = [0.20, 0.13, 0.11, 0.095, 0.12];
const VIEW = [0.1, 0.6, 0.75], VIEW_M = 0.7;  // how far the edges of a camera's view are drawn
const DASH_M = 0.09, CHISEL_M = 0.034, CHISEL_PART = 0.4;

export class Shapes {
  constructor() { this.boxes = []; this.cylinders = []; }

  box(x, y, z, at, color) { this.boxes.push(...frame(x, y, z, at), ...color); }

  plain(center, half, color) { this.box([half[0], 0, 0], [0, half[1], 0], [0, 0, half[2]], center, color); }

  rod(a, b, radius, color) {
    const way = sub(b, a), z = unit(way), x = unit(cross(Math.abs(z[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0], z));
    this.cylinders.push(...frame(scaled(x, radius), scaled(cross(z, x), radius), scaled(way, 0.5), scaled(add(a, b), 0.5)), ...color);
  }

  beam(a, b, side, wide, high, color) {  // a box from a to b whose width lies along side
    const way = sub(b, a), up = unit(cross(way, side));
    this.box(scaled(way, 0.5), scaled(unit(side), wide), scaled(up, high), scaled(add(a, b), 0.5), color);
  }
}

export function ground(shapes) {
  for (let i = -4; i <= 6; i++) shapes.plain([1, i - 1, 0], [5, 0.005, 0.002], LINE);
  for (let i = -4; i <= 6; i++) shapes.plain([i, 0, 0], [0.005, 5, 0.002], LINE);
}

export function machine(shapes, geometry, q) {
  const { links, tip } = chain(geometry, q);
  const foot = links[0].origin[2];
  if (foot > 0.3) {  // something that stands on tracks
    shapes.plain([0, 0, 0.62 * foot], [0.46, 0.18, 0.2 * foot], DARK);
    for (const side of [-1, 1]) {
      shapes.plain([0, 0.29 * side, 0.28 * foot], [0.55, 0.1, 0.28 * foot], DARK);
      for (const end of [-1, 1]) {
        const knee = [0.92 * end, 0.62 * side, 0.4];
        shapes.rod([0.44 * end, 0.14 * side, 0.44], knee, 0.05, PAINT);
        shapes.rod(knee, [1.0 * end, 0.7 * side, 0.05], 0.04, STEEL);
        shapes.rod([1.0 * end, 0.7 * side, 0.06], [1.0 * end, 0.7 * side, 0], 0.13, STEEL);
      }
    }
  }
  links.forEach((link, j) => {
    const end = links[j + 1]?.origin ?? tip, thick = THICK_M[Math.min(j, THICK_M.length - 1)];
    if (norm(sub(end, link.at)) < 1e-6) return;
    if (j === 0 && links.length > 1) {
      const [x, y, z] = link.axes;
      shapes.box(scaled(x, 0.32), scaled(y, 0.29), scaled(z, 0.17), add(add(link.at, x, -0.24), z, 0.24), PAINT);
      shapes.box(scaled(x, 0.36), scaled(y, 0.28), scaled(z, 0.035), add(link.at, z, 0.02), DARK);
      shapes.beam(link.at, end, y, 0.15, 0.1, DARK);
    } else if (j === links.length - 1) {
      const front = add(link.at, sub(end, link.at), 1 - CHISEL_PART);
      shapes.beam(link.at, front, link.axes[1], 0.1, thick, DARK);
      shapes.rod(front, end, CHISEL_M, STEEL);
    } else shapes.beam(link.at, end, link.axes[1], 0.7 * thick, thick, PAINT);
    if (j) shapes.rod(add(link.at, link.axis, -0.15), add(link.at, link.axis, 0.15), 0.06, STEEL);
  });
}

export function tip(shapes, { at, ahead }) {  // what is seen of the chisel by somebody who looks along it
  shapes.rod(add(at, ahead, -0.02), at, CHISEL_M, STEEL);
}

export function boreholes(shapes, targets) {
  for (const target of targets) {
    const color = target.chosen ? CHOSEN : OTHER, wide = target.chosen ? 0.014 : 0.008, points = rim(target);
    for (let i = 1; i < points.length; i++) shapes.rod(points[i - 1], points[i], wide, color);
    if (target.chosen) shapes.rod(target.center_in_base_m, add(target.center_in_base_m, target.axis_in_base, 0.3), 0.008, color);
  }
}

export function camera(shapes, { base_from_camera: m, width, height, focal_px, center_px }) {  // its body, and the edges of its view
  const at = [m[3], m[7], m[11]], ray = (u, v) => {
    const [x, y] = [(u - center_px[0]) / focal_px[0], (v - center_px[1]) / focal_px[1]];
    return [0, 1, 2].map(i => m[4 * i] * x + m[4 * i + 1] * y + m[4 * i + 2]);
  };
  const ends = [[0, 0], [width, 0], [width, height], [0, height]].map(([u, v]) => add(at, ray(u, v), VIEW_M));
  shapes.beam(add(at, ray(...center_px), -0.05), add(at, ray(...center_px), 0.03), [m[0], m[4], m[8]], 0.09, 0.03, DARK);
  ends.forEach((end, i) => { shapes.rod(at, end, 0.006, VIEW); shapes.rod(end, ends[(i + 1) % 4], 0.006, VIEW); });
}

export function path(shapes, points) {
  for (let i = 1; i < points.length; i++) {
    const way = sub(points[i], points[i - 1]), parts = Math.max(1, Math.round(norm(way) / DASH_M));
    for (let k = 0; k < parts; k++) shapes.rod(add(points[i - 1], way, k / parts), add(points[i - 1], way, (k + 0.6) / parts), 0.014, PATH);
  }
}

