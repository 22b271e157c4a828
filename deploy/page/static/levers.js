// Both levers seen from above: up is forward, right is right; full deflection is TRAVEL units from the middle.
import { drawIcon } from "./icons.js";

export const TRAVEL = 95;
const NS = "http://www.w3.org/2000/svg";
const DIAMOND = "M0,-24 L24,0 L0,24 L-24,0 Z";

export class LeverView {
  constructor(svg, side, setup) {
    this.svg = svg;
    this.side = side;
    this.tolerance = setup.tolerance;
    const put = (name, attributes, parent = svg, text = "") => {
      const node = document.createElementNS(NS, name);
      for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
      node.textContent = text;
      return parent.appendChild(node);
    };
    svg.replaceChildren();
    put("rect", { class: "gate", x: -TRAVEL, y: -TRAVEL, width: 2 * TRAVEL, height: 2 * TRAVEL, rx: 8 });
    put("rect", { class: "gate", x: -TRAVEL / 2, y: -TRAVEL / 2, width: TRAVEL, height: TRAVEL, rx: 4 });
    put("path", { class: "cross", d: `M${-TRAVEL},0 H${TRAVEL} M0,${-TRAVEL} V${TRAVEL}` });
    const joints = axis => setup.shared[`${side}_${axis}`];
    // the name of the joint and its icon, above the gate and along its right side
    this.names = {};
    for (const [axis, place] of [["theta", `translate(0 ${-TRAVEL - 17})`], ["psi", `translate(${TRAVEL + 17} 0) rotate(90)`]]) {
      const group = put("g", { class: "name", transform: place });
      this.names[axis] = { text: put("text", { x: 10, y: 0 }, group), icon: put("g", { class: "icon" }, group), joint: null };
    }
    this.parts = setup.parts;
    this.joints = { theta: joints("theta"), psi: joints("psi") };
    this.exclusive = setup.exclusive;
    put("text", { class: "tick", x: -TRAVEL - 16, y: -TRAVEL - 12 }, svg, "✓");
    this.stick = put("line", { class: "stick", x1: 0, y1: 0, x2: 0, y2: 0 });
    this.own = put("g", { class: "own" });
    put("circle", { class: "own", r: 14 }, this.own);
    this.way = put("line", { class: "way", x1: 0, y1: 0, x2: 0, y2: 0 });
    this.target = put("g", { class: "advised" });
    put("circle", { class: "tolerance", r: 24 + TRAVEL * this.tolerance }, this.target);
    put("path", { class: "target", d: DIAMOND }, this.target);
  }

  // own and advised: {left_theta, …} of full, or null; fresh: whether each is to be relied on; button: whether the shared axis is the exclusive joint's.
  // name: makes words of a joint.
  draw(own, advised, fresh, button, name) {
    const at = levers => [TRAVEL * levers[`${this.side}_psi`], -TRAVEL * levers[`${this.side}_theta`]];
    const place = (node, levers) => {
      node.setAttribute("visibility", levers ? "visible" : "hidden");
      if (levers) node.setAttribute("transform", `translate(${at(levers).map(value => value.toFixed(2)).join(" ")})`);
    };
    place(this.own, own);
    place(this.target, advised);
    const [x, y] = own ? at(own) : [0, 0];
    for (const [name, value] of [["x2", x], ["y2", y]]) this.stick.setAttribute(name, value.toFixed(2));
    const [a, b] = advised ? at(advised) : [x, y];
    for (const [name, value] of [["x1", x], ["y1", y], ["x2", a], ["y2", b]]) this.way.setAttribute(name, value.toFixed(2));
    const usable = own && advised && fresh.own && fresh.advised;
    this.svg.classList.toggle("together", Boolean(usable && Math.hypot(a - x, b - y) <= TRAVEL * this.tolerance));
    this.svg.classList.toggle("stale", !fresh.advised);
    this.svg.classList.toggle("ownstale", !fresh.own);
    for (const axis of ["theta", "psi"]) {
      const joints = this.joints[axis];
      const meant = joints.length > 1 ? joints.filter(name => this.exclusive.includes(name) === button) : joints;
      const text = meant.map(name).join(" "), label = this.names[axis];
      if (label.text.textContent === text) continue;
      label.text.textContent = text;
      drawIcon(label.icon, meant.length === 1 ? this.parts[meant[0]] : null);
      // the icon's 24 units, and a gap, to the left of the text's middle at 10
      label.icon.setAttribute("transform", `translate(${(-22 - label.text.getComputedTextLength() / 2).toFixed(1)} -11)`);
    }
  }
}
