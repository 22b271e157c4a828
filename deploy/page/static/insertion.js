// Tool and borehole: depth as a bar, distance and angle as numbers, and the rim as seen along the tool.
const ABOVE_M = 0.3, BELOW_M = 0.2, TALL = 240;  // what the bar spans, and its height in units of the drawing
const RANGES_M = [0.05, 0.1, 0.2, 0.5, 1, 2, 5], RADIUS = 92;  // what the view reaches, and its radius in units of the drawing
const AXIS_M = 0.3;
const NS = "http://www.w3.org/2000/svg";
const mm = metres => `${Math.round(1000 * metres)} mm`;
const height = depth_m => TALL * Math.min(1, Math.max(0, (depth_m + ABOVE_M) / (ABOVE_M + BELOW_M)));

export class InsertionView {
  constructor(section) {
    this.section = section;
    const put = (parent, name, attributes) => {
      const node = parent.appendChild(document.createElementNS(NS, name));
      for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
      return node;
    };
    const bar = section.querySelector(".depth"), view = section.querySelector(".along");
    put(bar, "rect", { class: "rock", x: 20, y: height(0), width: 40, height: TALL - height(0) });
    this.fill = put(bar, "rect", { class: "fill", x: 28, width: 24 });
    put(bar, "line", { class: "rim", x1: 8, x2: 72, y1: height(0), y2: height(0) });
    this.wanted = put(bar, "line", { class: "wanted", x1: 8, x2: 72 });
    this.tip = put(bar, "path", { class: "tip", d: "M40,0 l-14,-22 h28 Z" });
    this.rings = [0.5, 1].map(part => put(view, "circle", { class: "ring", r: RADIUS * part }));
    this.scale = put(view, "text", { class: "scale", x: 0, y: RADIUS + 13 });
    put(view, "path", { class: "cross", d: `M${-RADIUS},0 H${RADIUS} M0,${-RADIUS} V${RADIUS}` });
    this.axis = put(view, "line", { class: "axis" });
    this.rim = put(view, "ellipse", { class: "rim" });
    this.way = put(view, "line", { class: "way", x1: 0, y1: 0 });
    put(view, "circle", { class: "own", r: 6 });
    this.say = section.querySelector(".inserted");
    this.numbers = [...section.querySelectorAll("dd")];
  }

  // Draws a reading, or none; hole is the chosen one, and known whether the reading is to be relied on.
  draw(reading, hole, known, say) {
    this.section.hidden = !reading;
    if (!reading) return;
    const { depth_m, lateral_m, angle_rad, wanted_m, inserted, center_in_view_m: center, axis_in_view: axis } = reading;
    this.section.classList.toggle("stale", !known);
    this.section.classList.toggle("in", known && inserted);
    const set = (node, values) => { for (const [key, value] of Object.entries(values)) node.setAttribute(key, typeof value === "number" ? value.toFixed(2) : value); };
    set(this.tip, { transform: `translate(0 ${height(depth_m).toFixed(2)})` });
    const [from, to] = [height(Math.min(0, depth_m)), height(Math.max(0, depth_m))];
    set(this.fill, { y: from, height: to - from, class: depth_m > 0 && lateral_m <= hole.radius_m ? "fill inside" : "fill" });
    set(this.wanted, { y1: height(wanted_m), y2: height(wanted_m) });
    const out = Math.hypot(center[0], center[1]) + hole.radius_m;
    const range = RANGES_M.find(one => one >= 1.1 * out) ?? RANGES_M.at(-1), scale = RADIUS / range;
    const [x, y] = [scale * center[0], -scale * center[1]];
    // a circle seen from aside: its short half lies along the projected axis
    set(this.rim, { rx: Math.max(1, scale * hole.radius_m * Math.abs(axis[2])), ry: scale * hole.radius_m, transform: `translate(${x.toFixed(2)} ${y.toFixed(2)}) rotate(${(180 / Math.PI * Math.atan2(-axis[1], axis[0])).toFixed(2)})` });
    set(this.axis, { x1: x, y1: y, x2: x + scale * AXIS_M * axis[0], y2: y - scale * AXIS_M * axis[1] });
    set(this.way, { x2: x, y2: y });
    const texts = [mm(depth_m), mm(lateral_m), `${(180 / Math.PI * angle_rad).toFixed(1)}°`];
    texts.forEach((text, index) => { if (this.numbers[index].textContent !== text) this.numbers[index].textContent = text; });
    const said = !known ? say("too old") : inserted ? say("inserted") : lateral_m > hole.radius_m ? say("beside the hole") : say(depth_m > 0 ? "in the hole" : "over the hole");
    if (this.say.textContent !== said) this.say.textContent = said;
    const label = mm(range);
    if (this.scale.textContent !== label) this.scale.textContent = label;
  }
}
