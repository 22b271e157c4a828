"""Shapes of a machine for the envelope: read once at start from its MJCF, without MuJoCo.

The arm is enclosed by a few capsules a link. Undercarriage and first link keep their own shapes, as
boxes with rounded edges: a capsule is a box without width, a cylinder its bounding box. As in the
simulator, a link is stretched along itself where the machine's file gives it another length.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path

import numpy as np

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.registry import resolve_package_path

BASE = -1
"""Link number of what stands still; link `j` turns with joint `j`."""
SHORTEST_M = 1e-9
"""Length below which a link has no direction."""
KINDS = ("sphere", "capsule", "cylinder", "ellipsoid", "box")
"""Types of geoms that can be read."""


@dataclass(frozen=True)
class RoundedBox:
    """A box grown by a radius on all sides.

    Attributes:
        link: Link that it is fixed to, or `BASE`.
        center_m: Centre in the frame of the link, `(3,)`.
        rotation: Axes of the box in that frame, as columns, `(3, 3)`.
        half_m: Half lengths, `(3,)`.
        radius_m: Radius of the growth.
    """

    link: int
    center_m: np.ndarray
    rotation: np.ndarray
    half_m: np.ndarray
    radius_m: float

    @property
    def corners_m(self) -> np.ndarray:
        """Corners before the growth, in the frame of the link, `(8, 3)`."""
        signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), -1).reshape(8, 3)
        return self.center_m + (signs * self.half_m) @ self.rotation.T


@dataclass(frozen=True)
class LinkCapsule:
    """A capsule of the arm.

    Attributes:
        link: Link that it encloses a part of.
        begin_m: One end of its axis in the frame of the link, `(3,)`.
        end_m: The other end.
        radius_m: Its radius.
    """

    link: int
    begin_m: np.ndarray
    end_m: np.ndarray
    radius_m: float


@dataclass(frozen=True)
class MachineShapes:
    """Shapes of a machine.

    Attributes:
        arm: Capsules of all links but the first.
        body: Boxes of undercarriage, outriggers and first link.
    """

    arm: tuple[LinkCapsule, ...]
    body: tuple[RoundedBox, ...]


def read_machine_shapes(machine: Machine) -> MachineShapes | None:
    """Return the shapes of `machine`; `None` where its geometry is not known.

    Raises:
        ConfigError: the MJCF is missing, or holds a shape that cannot be read.
    """
    if machine.mjcf is None or not machine.has_bodies:
        return None
    root = _read_xml(machine)
    boxes: list[RoundedBox] = []
    for world in root.findall("worldbody"):
        _Reader(machine, root).read_body(world, BASE, np.eye(3), np.zeros(3), boxes)
    boxes = _stretch_links(boxes, machine, root)
    arm: list[LinkCapsule] = []
    ends = _list_link_ends(machine)
    for link in range(1, machine.num_joints):
        own = [box for box in boxes if box.link == link]
        if own:
            arm += fit_capsules(own, ends[link])
    return MachineShapes(tuple(arm), tuple(box for box in boxes if box.link <= 0))


def fit_capsules(boxes: list[RoundedBox], end_m: np.ndarray) -> list[LinkCapsule]:
    """Return one capsule, or two of less volume, that enclose the boxes of a link.

    Two are enough for a breaker's housing and its chisel. More would make the envelope tighter by
    centimetres, and slower.

    Args:
        boxes: Its shapes.
        end_m: Where the link ends, in its frame; the capsules lie along it.
    """
    along = end_m / max(float(np.linalg.norm(end_m)), SHORTEST_M)
    ordered = sorted(boxes, key=lambda box: float(box.corners_m.min(0) @ along))
    best = [_fit_capsule(ordered, along)]
    for cut in range(1, len(ordered)):
        pieces = [_fit_capsule(part, along) for part in (ordered[:cut], ordered[cut:])]
        if sum(map(_compute_volume, pieces)) < sum(map(_compute_volume, best)):
            best = pieces
    return best


def _fit_capsule(boxes: list[RoundedBox], along: np.ndarray) -> LinkCapsule:
    """Return the capsule along `along` that encloses the boxes, its axis in their middle."""
    points = np.concatenate([box.corners_m for box in boxes])
    radius_m = np.repeat([box.radius_m for box in boxes], 8)
    height_m = points @ along
    aside = points - height_m[:, None] * along
    lowest = (aside - radius_m[:, None]).min(0)
    highest = (aside + radius_m[:, None]).max(0)
    middle = (lowest + highest) / 2
    middle = middle - (middle @ along) * along
    off_m = np.linalg.norm(aside - middle, axis=1)
    whole_m = float((off_m + radius_m).max())
    # A ball of radius r, off the axis by d, lies inside where the axis passes within R - r of it.
    reach_m = np.sqrt(np.maximum((whole_m - radius_m) ** 2 - off_m**2, 0.0))
    first, last = sorted((float((height_m + reach_m).min()), float((height_m - reach_m).max())))
    return LinkCapsule(boxes[0].link, middle + first * along, middle + last * along, whole_m)


def _compute_volume(capsule: LinkCapsule) -> float:
    length_m = float(np.linalg.norm(capsule.end_m - capsule.begin_m))
    return math.pi * capsule.radius_m**2 * (length_m + 4.0 / 3.0 * capsule.radius_m)


def _read_xml(machine: Machine) -> ET.Element:
    assert machine.mjcf is not None
    assets = Path(str(resources.files("brokk_rl"))) / "sim" / "assets"
    path = assets / resolve_package_path(machine.mjcf)
    try:
        return ET.parse(path).getroot()
    except (OSError, ET.ParseError) as error:
        raise ConfigError(
            f"machine {machine.name}: its shapes cannot be read from {path} ({error}); mend `mjcf` "
            "in the machine's file, or switch the envelope off by guard.envelope=null"
        ) from error


def _list_link_ends(machine: Machine) -> list[np.ndarray]:
    """Return where each link ends in its own frame: the next joint, or the tip."""
    origins = [np.array([one.value for one in body.origin_m]) for body in machine.bodies[1:]]
    return [*origins, machine.tip_m]


def _stretch_links(boxes: list[RoundedBox], machine: Machine, root: ET.Element) -> list[RoundedBox]:
    """Stretch each link's boxes to the length of the machine's file, as the simulator does."""
    places = {}
    for body in root.iter("body"):
        for joint in body.findall("joint"):
            places[joint.get("name")] = _parse_numbers(body.get("pos", "0 0 0"))
    missing = [name for name in machine.joint_names if name not in places]
    if missing:
        raise ConfigError(
            f"machine {machine.name}: expected its joints in its MJCF, got none of {', '.join(missing)}; "
            "mend `mjcf` in the machine's file, or switch the envelope off by guard.envelope=null"
        )
    drawn_m = [places[name] for name in machine.joint_names[1:]]
    tip = next((site for site in root.iter("site") if site.get("name") == "tip"), None)
    drawn_m.append(machine.tip_m if tip is None else _parse_numbers(tip.get("pos", "0 0 0")))
    ends, stretched = _list_link_ends(machine), []
    for box in boxes:
        if box.link == BASE or np.linalg.norm(drawn_m[box.link]) < SHORTEST_M:
            stretched.append(box)
            continue
        drawn = drawn_m[box.link]
        along = drawn / np.linalg.norm(drawn)
        growth = float(np.linalg.norm(ends[box.link]) / np.linalg.norm(drawn)) - 1.0
        stretched.append(
            replace(
                box,
                center_m=box.center_m + growth * along * (along @ box.center_m),
                half_m=box.half_m * (1.0 + growth * (along @ box.rotation) ** 2),
            )
        )
    return stretched


class _Reader:
    """Reader of the geoms of an MJCF: default classes, places and orientations."""

    def __init__(self, machine: Machine, root: ET.Element) -> None:
        self._machine = machine
        compiler = root.find("compiler")
        angle = "degree" if compiler is None else compiler.get("angle", "degree")
        self._rad_per_unit = 1.0 if angle == "radian" else math.pi / 180.0
        self._classes: dict[str, dict[str, str]] = {}
        for default in root.findall("default"):
            self._read_defaults(default, {}, "main")

    def _read_defaults(self, node: ET.Element, above: dict[str, str], name: str) -> None:
        geom = node.find("geom")
        self._classes[name] = above | ({} if geom is None else dict(geom.attrib))
        for child in node.findall("default"):
            self._read_defaults(child, self._classes[name], child.get("class", ""))

    def read_body(
        self,
        node: ET.Element,
        link: int,
        rotation: np.ndarray,
        at_m: np.ndarray,
        found: list[RoundedBox],
        group: str = "main",
    ) -> None:
        """Add the boxes of a body and of all behind it to `found`."""
        for geom in node.findall("geom"):
            name = geom.get("class", group)
            box = self._read_geom(self._classes.get(name, {}) | geom.attrib, link)
            if box is not None:
                center_m = at_m + rotation @ box.center_m
                found.append(replace(box, center_m=center_m, rotation=rotation @ box.rotation))
        for body in node.findall("body"):
            joints = [one.get("name") for one in body.findall("joint")]
            names = self._machine.joint_names
            own = [names.index(name) for name in joints if name in names]
            inner = body.get("childclass", group)
            if own:
                # A link's frame is that of the machine's file: it begins at its joint.
                self.read_body(body, own[0], np.eye(3), np.zeros(3), found, inner)
            else:
                turn = rotation @ self._read_rotation(dict(body.attrib))
                there_m = at_m + rotation @ _parse_numbers(body.get("pos", "0 0 0"))
                self.read_body(body, link, turn, there_m, found, inner)

    def _read_geom(self, values: dict[str, str], link: int) -> RoundedBox | None:
        kind = values.get("type", "sphere")
        if kind == "plane":
            return None
        if kind not in KINDS:
            raise ConfigError(
                f"machine {self._machine.name}: expected geoms of {', '.join(KINDS)} in its MJCF for the envelope, "
                f"got {kind}; add simple shapes beside it, or switch the envelope off by guard.envelope=null"
            )
        size = _parse_numbers(values.get("size", ""))
        center_m = _parse_numbers(values.get("pos", "0 0 0"))
        if "fromto" in values:
            ends = _parse_numbers(values["fromto"]).reshape(2, 3)
            center_m, axis = ends.mean(0), ends[0] - ends[1]
            half_length_m = np.linalg.norm(axis) / 2
            # MuJoCo takes the first number alone: boxes and ellipsoids are as wide as they are deep.
            size = np.array([size[0], half_length_m])
            if kind in ("box", "ellipsoid"):
                size = np.array([size[0], size[0], half_length_m])
            rotation = _compute_rotation_to(axis)
        else:
            rotation = self._read_rotation(values)
        if kind == "box" or kind == "ellipsoid":
            half_m, radius_m = size, 0.0
        elif kind == "cylinder":
            half_m, radius_m = np.array([size[0], size[0], size[1]]), 0.0
        else:
            half_m = np.array([0.0, 0.0, size[1] if kind == "capsule" else 0.0])
            radius_m = float(size[0])
        return RoundedBox(link, center_m, rotation, half_m, radius_m)

    def _read_rotation(self, values: dict[str, str]) -> np.ndarray:
        for name in ("axisangle", "xyaxes", "zaxis"):
            if name in values:
                raise ConfigError(
                    f"machine {self._machine.name}: expected quat or euler in its MJCF for the envelope, got {name}; "
                    "write it as quat, or switch the envelope off by guard.envelope=null"
                )
        if "quat" in values:
            return _convert_quaternion(_parse_numbers(values["quat"]))
        rotation = np.eye(3)
        # MuJoCo's order: about x, then the new y, then the new z.
        angles = _parse_numbers(values.get("euler", "0 0 0")) * self._rad_per_unit
        for axis, angle in enumerate(angles):
            half = np.zeros(4)
            half[0], half[1 + axis] = math.cos(angle / 2), math.sin(angle / 2)
            rotation = rotation @ _convert_quaternion(half)
        return rotation


def _parse_numbers(text: str) -> np.ndarray:
    return np.array([float(one) for one in text.split()])


def _convert_quaternion(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation of a quaternion w, x, y, z."""
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross


def _compute_rotation_to(axis: np.ndarray) -> np.ndarray:
    """Return the shortest rotation that turns z into the direction of `axis`, as MuJoCo's."""
    x, y, z = axis
    across = math.hypot(x, y)
    half_rad = math.atan2(across, z) / 2
    turn_x, turn_y = (-y / across, x / across) if across > 0 else (1.0, 0.0)
    about = math.sin(half_rad)
    return _convert_quaternion(np.array([math.cos(half_rad), about * turn_x, about * turn_y, 0.0]))
