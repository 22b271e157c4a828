// Icons of the parts that a joint moves, on a grid of 24 x 24: the arm from the side, the part in question thick.
const ARM = [[3, 21], [6, 6], [14, 4], [20, 10], [20, 21]];  // foot, first, second and third arm, tool
const SEGMENT = { arm_1: 0, arm_2: 1, arm_3: 2, tool: 3, boom: 0, stick: 1, bucket: 3 };
const SLEW = "M4,12 A8,5 0 1 1 12,17 M12,17 l4,-3 M12,17 l4,3.5";
const NS = "http://www.w3.org/2000/svg";
const line = points => `M${points.map(point => point.join(",")).join(" L")}`;

// Draws the icon of a part into a group; nothing for a part that has none.
export function drawIcon(group, part) {
  group.replaceChildren();
  const put = (kind, d) => {
    const path = document.createElementNS(NS, "path");
    path.setAttribute("class", kind);
    path.setAttribute("d", d);
    group.append(path);
  };
  if (part === "slew") put("thick", SLEW);
  else if (part in SEGMENT) {
    put("thin", line(ARM));
    put("thick", line(ARM.slice(SEGMENT[part], SEGMENT[part] + 2)));
  }
}
