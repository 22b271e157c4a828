// 4 x 4 matrices as column-major arrays, and the chain of links: what the scene needs of linear algebra.
export const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const add = (a, b, scale = 1) => [a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2]];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const norm = a => Math.hypot(...a);
export const unit = a => { const length = norm(a) || 1; return a.map(value => value / length); };

export function multiply(a, b) {
  const out = new Float32Array(16);
  for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++) {
    let sum = 0;
    for (let k = 0; k < 4; k++) sum += a[4 * k + r] * b[4 * c + k];
    out[4 * c + r] = sum;
  }
  return out;
}

export function perspective(fov, aspect, near, far) {
  const f = 1 / Math.tan(fov / 2), d = near - far;
  return new Float32Array([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / d, -1, 0, 0, 2 * far * near / d, 0]);
}

export function lookAt(eye, at, up = [0, 0, 1]) {
  const z = unit(sub(eye, at)), x = unit(cross(up, z)), y = cross(z, x);
  return new Float32Array([x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0, -dot(x, eye), -dot(y, eye), -dot(z, eye), 1]);
}

// Columns: three axes that carry the half sizes, and the middle.
export const frame = (x, y, z, at) => [...x, 0, ...y, 0, ...z, 0, ...at, 1];
export const scaled = (a, scale) => a.map(value => value * scale);

function turned(v, axis, angle) {  // Rodrigues' formula
  const k = unit(axis), c = Math.cos(angle), s = Math.sin(angle), kv = cross(k, v), d = dot(k, v) * (1 - c);
  return [0, 1, 2].map(i => v[i] * c + kv[i] * s + k[i] * d);
}

// Returns the origin, the turned axes (x, y, z) and the joint axis of each link, and the tip, in the base frame.
export function chain(geometry, q) {
  let axes = [[1, 0, 0], [0, 1, 0], [0, 0, 1]], at = [0, 0, 0];
  const inBase = v => [0, 1, 2].map(i => axes[0][i] * v[0] + axes[1][i] * v[1] + axes[2][i] * v[2]);
  const links = geometry.links.map((link, j) => {
    at = add(at, inBase(link.origin_m));
    const axis = inBase(link.axis), origin = at;
    if (link.kind === "hinge") axes = axes.map(one => turned(one, axis, q[j]));
    else at = add(at, axis, q[j]);
    return { origin, at, axis, axes };
  });
  return { links, tip: add(at, inBase(geometry.tip_m)) };
}

// Returns tip, direction and upward direction of somebody who looks along the tool; up is forward for a tool that points down.
export function lookAlong(geometry, q) {
  const { links, tip } = chain(geometry, q), ahead = unit(sub(tip, links.at(-1).at));
  const side = Math.hypot(tip[0], tip[1]) > 0 ? [tip[1], -tip[0], 0] : [0, -1, 0];
  return { at: tip, ahead, up: cross(unit(add(side, ahead, -dot(side, ahead))), ahead) };
}

const RIM_PARTS = 32;
// Returns the points of a borehole's rim, the first one again at the end.
export function rim(hole) {
  const axis = unit(hole.axis_in_base), x = unit(cross(Math.abs(axis[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0], axis)), y = cross(axis, x);
  return Array.from({ length: RIM_PARTS + 1 }, (_, index) => {
    const angle = 2 * Math.PI * index / RIM_PARTS;
    return add(add(hole.center_in_base_m, x, hole.radius_m * Math.cos(angle)), y, hole.radius_m * Math.sin(angle));
  });
}
