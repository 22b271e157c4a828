"""Shapes of a machine for the guard on its own computer, which has no MuJoCo: `shapes.json`.

The arm is enclosed by a few capsules a link. Undercarriage and first link keep their own shapes, as
boxes with rounded edges: a capsule is a box without width, any other shape its bounding box.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from brokk_rl.machine import Machine
from brokk_rl.session import write_json
from brokk_rl.sim.model import compile_machine

SCHEMA = 1
SHAPES = "shapes.json"
BASE = -1
"""Link number of what stands still; link `j` turns with joint `j`."""
DECIMALS = 5
"""Of lengths in m."""


def write_shapes(machine: Machine, folder: Path) -> None:
    """Write `shapes.json` of `machine` into `folder`."""
    write_json(folder / SHAPES, describe_shapes(machine))


def describe_shapes(machine: Machine) -> dict[str, Any]:
    """Return the shapes of `machine` as plain data, lengths in m.

    `arm` holds capsules of all links but the first: `link`, `begin_m`, `end_m`, `radius_m` in the
    link's frame. `body` holds boxes of undercarriage and first link: `link`, `center_m`, `rotation`
    with the box's axes as columns, `half_m`, and `radius_m` by which they are grown.
    """
    boxes = _list_boxes(machine)
    ends = [np.array([one.value for one in body.origin_m]) for body in machine.bodies[1:]]
    ends.append(machine.tip_m)
    arm = []
    for link in range(1, machine.num_joints):
        own = [box for box in boxes if box["link"] == link]
        arm += fit_capsules(own, ends[link]) if own else []
    content = {"schema": SCHEMA, "machine": machine.name, "fingerprint": machine.fingerprint()}
    content["arm"] = [_round(one) for one in arm]
    content["body"] = [_round(box) for box in boxes if box["link"] <= 0]
    return content


def fit_capsules(boxes: list[dict[str, Any]], end_m: np.ndarray) -> list[dict[str, Any]]:
    """Return one capsule, or two of less volume, that enclose the boxes of a link.

    Two are enough for a breaker's housing and its chisel. More would make the envelope tighter by
    centimetres, and slower.

    Args:
        boxes: Its shapes.
        end_m: Where the link ends, in its frame; the capsules lie along it.
    """
    along = end_m / np.linalg.norm(end_m)
    ordered = sorted(boxes, key=lambda box: float((_list_corners(box) @ along).min()))
    best = [_fit_capsule(ordered, along)]
    for cut in range(1, len(ordered)):
        pieces = [_fit_capsule(part, along) for part in (ordered[:cut], ordered[cut:])]
        if sum(map(_compute_volume, pieces)) < sum(map(_compute_volume, best)):
            best = pieces
    return best


def _list_boxes(machine: Machine) -> list[dict[str, Any]]:
    """Return all geoms but planes as rounded boxes in the frames of their links."""
    model = compile_machine(machine)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    links = {int(model.joint(name).bodyid[0]): j for j, name in enumerate(machine.joint_names)}
    kinds = mujoco.mjtGeom
    boxes = []
    for geom in range(model.ngeom):
        kind = mujoco.mjtGeom(int(model.geom_type[geom]))
        if kind == kinds.mjGEOM_PLANE:
            continue
        body = int(model.geom_bodyid[geom])
        while body and body not in links:
            body = int(model.body_parentid[body])
        turn = data.xmat[body].reshape(3, 3)
        rotation = data.geom_xmat[geom].reshape(3, 3)
        center_m, half_m, radius_m = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:], 0.0
        if kind in (kinds.mjGEOM_SPHERE, kinds.mjGEOM_CAPSULE):
            radius_m = float(model.geom_size[geom, 0])
            half_m = half_m - radius_m
        place_m = data.geom_xpos[geom] + rotation @ center_m - data.xpos[body]
        box = {"link": links.get(body, BASE), "center_m": turn.T @ place_m}
        box |= {"rotation": turn.T @ rotation, "half_m": half_m.clip(0.0), "radius_m": radius_m}
        boxes.append(box)
    return boxes


def _list_corners(box: dict[str, Any]) -> np.ndarray:
    """Return the corners of a box before its growth, in the frame of the link, `(8, 3)`."""
    signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), -1).reshape(8, 3)
    return box["center_m"] + (signs * box["half_m"]) @ box["rotation"].T


def _fit_capsule(boxes: list[dict[str, Any]], along: np.ndarray) -> dict[str, Any]:
    """Return the capsule along `along` that encloses the boxes, its axis in their middle."""
    points = np.concatenate([_list_corners(box) for box in boxes])
    radius_m = np.repeat([box["radius_m"] for box in boxes], 8)
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
    begin_m, end_m = middle + first * along, middle + last * along
    return {"link": boxes[0]["link"], "begin_m": begin_m, "end_m": end_m, "radius_m": whole_m}


def _compute_volume(capsule: dict[str, Any]) -> float:
    length_m = float(np.linalg.norm(capsule["end_m"] - capsule["begin_m"]))
    return math.pi * capsule["radius_m"] ** 2 * (length_m + 4.0 / 3.0 * capsule["radius_m"])


def _round(shape: dict[str, Any]) -> dict[str, Any]:
    """Return a shape as plain data; radii are rounded up."""
    plain = {}
    for name, value in shape.items():
        plain[name] = value if name == "link" else np.round(value, DECIMALS).tolist()
    steps = 10.0**DECIMALS
    plain["radius_m"] = math.ceil(shape["radius_m"] * steps) / steps
    return plain
