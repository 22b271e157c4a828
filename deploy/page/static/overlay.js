// Rim, axis and tool path drawn into the camera's picture, by the lens that came with it.
import { add, dot, rim, sub } from "./matrices.js";

const AXIS_M = 0.3, NEAR_M = 0.05;
const NS = "http://www.w3.org/2000/svg";

export class Overlay {
  constructor(svg) {
    this.svg = svg;
    this.paths = {};
    for (const kind of ["path", "other", "chosen", "axis"]) {
      this.paths[kind] = svg.appendChild(document.createElementNS(NS, "path"));
      this.paths[kind].setAttribute("class", kind);
    }
    this.lens = null;
  }

  // Takes the lens of a picture: size, focal lengths, centre, and the camera's pose.
  see(lens) {
    this.lens = lens;
    this.svg.setAttribute("viewBox", `-0.5 -0.5 ${lens.width} ${lens.height}`);
    this.svg.style.aspectRatio = `${lens.width} / ${lens.height}`;
  }

  draw(shown) {
    const placed = Boolean(this.lens?.placed);
    const lines = { path: [], other: [], chosen: [], axis: [] };
    if (placed) for (const target of shown.targets) {
      lines[target.chosen ? "chosen" : "other"].push(this.trace(rim(target)));
      if (target.chosen) lines.axis.push(this.trace([target.center_in_base_m, add(target.center_in_base_m, target.axis_in_base, AXIS_M)]));
    }
    if (placed) lines.path.push(this.trace(shown.path_in_base_m));
    for (const [kind, parts] of Object.entries(lines)) this.paths[kind].setAttribute("d", parts.join(" "));
  }

  // Returns the drawing of a line in the base frame; the part behind the camera is cut off.
  trace(points) {
    const { focal_px, center_px, base_from_camera: m } = this.lens;
    const seen = points.map(point => {
      const off = sub(point, [m[3], m[7], m[11]]);
      return [0, 1, 2].map(i => dot(off, [m[i], m[4 + i], m[8 + i]]));
    });
    const pixel = ([x, y, z]) => `${(focal_px[0] * x / z + center_px[0]).toFixed(1)},${(focal_px[1] * y / z + center_px[1]).toFixed(1)}`;
    let drawn = "", open = false;
    for (let i = 1; i < seen.length; i++) {
      const [a, b] = [seen[i - 1], seen[i]];
      if (a[2] < NEAR_M && b[2] < NEAR_M) { open = false; continue; }
      const meet = () => add(a, sub(b, a), (NEAR_M - a[2]) / (b[2] - a[2]));
      if (!open || a[2] < NEAR_M) drawn += `M${pixel(a[2] < NEAR_M ? meet() : a)} `;
      drawn += `L${pixel(b[2] < NEAR_M ? meet() : b)} `;
      open = b[2] >= NEAR_M;
    }
    return drawn;
  }
}
