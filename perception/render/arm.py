"""The machine's arm before the block, pushed so far over a rim that it hides a given part of it."""

from __future__ import annotations

import numpy as np

from perception.render.concrete import frame_of
from perception.render.rig import Rig
from perception.render.solids import Box, Cylinder, Pose, Solid
from perception.render.texture import Material

_CLEAR = 1.6
"""Where the arm hides nothing it stays away from the rim's centre by this factor of the rim's size
at least."""
_BISECTIONS = 14


def arm_over(
    rim: np.ndarray, rig: Rig, hidden: float, generator: np.random.Generator
) -> list[Solid]:
    """Returns boom, hose and chisel, coming from a random side, that hide the part `hidden` of the rim, `(P, 3)`, from the left."""
    middle = rim.mean(0)
    ray = middle / np.linalg.norm(middle)
    angle = generator.uniform(-np.pi, np.pi)
    sideways = frame_of(ray, float(angle))[:, 0]
    nearness = float(generator.uniform(0.45, 0.8))
    parts = _parts(nearness * middle, ray, sideways, generator)

    def covered(push: float) -> float:
        shut = np.zeros(len(rim), bool)
        for solid in _moved(parts, -push * sideways):
            shut |= solid.hit(np.zeros(3), rim.astype(np.float32)).t < 1.0
        return float(shut.mean())

    size = float(np.linalg.norm(rim - middle, axis=1).max()) * nearness
    if hidden <= 0:
        low = -_CLEAR * size
        return _moved(parts, -(low - generator.uniform(0.0, 3.0) * size) * sideways)
    low, high = -2.0 * size, 2.0 * size
    for _ in range(_BISECTIONS):
        middle_push = (low + high) / 2
        low, high = (middle_push, high) if covered(middle_push) < hidden else (low, middle_push)
    return _moved(parts, -high * sideways)


def _parts(
    start: np.ndarray, ray: np.ndarray, sideways: np.ndarray, generator: np.random.Generator
) -> list[Solid]:
    """Returns the arm with its edge along the line of sight through `start`; it lies on the side that `sideways` points to."""
    along = np.cross(ray, sideways)
    wide = float(generator.uniform(0.06, 0.16))
    thick = float(generator.uniform(0.05, 0.12))
    yellow = np.clip(
        np.array([0.75, 0.45, 0.08]) * generator.uniform(0.3, 1.2)
        + 0.05 * generator.standard_normal(3),
        0.02,
        0.9,
    )
    paint = Material(
        (float(yellow[0]), float(yellow[1]), float(yellow[2])),
        0.08,
        0.002,
        int(generator.integers(4)),
    )
    grey = float(generator.uniform(0.03, 0.3))
    steel = Material((grey, grey, grey), 0.15, 0.001, int(generator.integers(4)))
    length = float(generator.uniform(0.6, 1.5))
    pose = np.stack([sideways, along, np.cross(sideways, along)], 1)
    if generator.random() < 0.5:
        boom: Solid = Box(
            "arm", Pose(pose, start + wide * sideways), np.array([wide, length, thick]), (paint,)
        )
    else:
        turn = np.stack([sideways, np.cross(along, sideways), along], 1)
        boom = Cylinder("arm", Pose(turn, start + wide * sideways), wide, length, (paint,))
    hose_turn = np.stack([sideways, np.cross(along, sideways), along], 1)
    hose = Cylinder(
        "arm", Pose(hose_turn, start + 2.3 * wide * sideways + 0.08 * ray), 0.025, length, (steel,)
    )
    chisel_axis = 0.8 * ray + 0.6 * along
    chisel_place = start + 3.2 * wide * sideways + 0.1 * along
    chisel = Cylinder("arm", Pose(frame_of(chisel_axis, 0.0), chisel_place), 0.04, 0.25, (steel,))
    return [boom, hose, chisel]


def _moved(parts: list[Solid], shift_m: np.ndarray) -> list[Solid]:
    """Returns the arm elsewhere."""
    found: list[Solid] = []
    for part in parts:
        pose = Pose(part.pose.rotation, part.pose.center_m + shift_m)  # type: ignore[attr-defined]
        if isinstance(part, Box):
            found.append(Box(part.role, pose, part.half_m, part.materials))
        elif isinstance(part, Cylinder):
            found.append(
                Cylinder(part.role, pose, part.radius_m, part.half_length_m, part.materials)
            )
    return found
