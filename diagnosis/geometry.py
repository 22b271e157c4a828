"""Measured tool points against forward kinematics: how far off, and which single error of geometry explains it best.

Works on measured positions alone, no simulator takes part: what is off here is off whatever the
actuators do.
Axes: `S` samples, `J` joints.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch

from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine
from brokk_rl.record import Recording

COLUMNS = ("ee_x_m", "ee_y_m", "ee_z_m")
FEWEST = 100
"""Samples with a measured tool point below which nothing is said."""


@dataclass(frozen=True)
class Geometry:
    """How measured tool points differ from those of the machine's file.

    Attributes:
        rms_m: Root mean square distance, m.
        cause: The error of geometry that explains most of it, e.g. `encoder_bias q3`.
        size: Its size, in `unit`.
        unit: `rad`, `m`, or `` for a part of the whole.
        explained: Part of the mean squared distance that it explains.
        count: Samples.
    """

    rms_m: float
    cause: str
    size: float
    unit: str
    explained: float
    count: int

    def plain(self) -> dict[str, Any]:
        """Returns it as plain JSON data."""
        return asdict(self)


def geometry(recordings: Sequence[Recording], machine: Machine) -> Geometry | None:
    """Returns how far off measured tool points are, `None` where there are too few, or the machine's geometry is not known."""
    if not machine.has_bodies:
        return None
    having = [r for r in recordings if all(column in r.extra for column in COLUMNS)]
    if not having:
        return None
    seen = np.concatenate(
        [np.stack([r.extra[column] for column in COLUMNS], 1) for r in having]
    ).astype(float)
    q = np.concatenate([r.q for r in having])
    given = np.isfinite(seen).all(1)
    if given.sum() < FEWEST:
        return None
    pose, jacobian = Kinematics(machine).pose_and_jacobian(
        torch.as_tensor(q[given], dtype=torch.float32)
    )
    off = seen[given] - pose.tip_in_base_m.numpy()
    whole = float((off**2).sum())
    columns = _columns(machine, q[given], pose, jacobian.tip.numpy())
    found = [(*_fitted(column, off, whole), cause, unit) for cause, unit, column in columns]
    explained, size, cause, unit = max(found)
    return Geometry(float(np.sqrt(whole / len(off))), cause, size, unit, explained, len(off))


def _columns(
    machine: Machine, q: np.ndarray, pose: Any, tip: np.ndarray
) -> Iterator[tuple[str, str, np.ndarray]]:
    """Yields the way in which each error of unit size moves the measured tip, `(S, 3)`, relative to the computed one."""
    origins, end = (
        pose.joints_in_base_m.numpy().astype(float),
        pose.tip_in_base_m.numpy().astype(float),
    )
    points = np.concatenate([origins, end[:, None]], 1)
    for j, joint in enumerate(machine.joints):
        yield (
            f"encoder_bias {joint.name}",
            joint.unit,
            -tip[:, :, j],
        )  # the sensor says too much: the tip is less far
        yield f"encoder_scale {joint.name}", "", -tip[:, :, j] * q[:, j : j + 1]
        link = points[:, j + 1] - points[:, j]
        length = np.linalg.norm(link, axis=1, keepdims=True)
        if length.min() > 1e-6:
            yield f"link_length {joint.name}", "m", link / length
    for name, axis in (("x", (1.0, 0.0, 0.0)), ("y", (0.0, 1.0, 0.0))):
        yield f"base_tilt about {name}", "rad", np.cross(axis, end)
    for name, axis in zip("xyz", np.eye(3), strict=True):
        yield f"offset along {name}", "m", np.tile(axis, (len(end), 1))


def _fitted(column: np.ndarray, off: np.ndarray, whole: float) -> tuple[float, float]:
    """Returns the explained part of the squared distance and the size."""
    norm = max(float((column**2).sum()), np.finfo(float).tiny)
    size = float((column * off).sum()) / norm
    return size**2 * norm / max(whole, np.finfo(float).tiny), size
