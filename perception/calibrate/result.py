"""What a calibration says, and how it is stored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from brokk_rl import record
from brokk_rl.machine import Machine
from perception.calibrate.extrinsics import SCHEMA, plain, point_std_m


@dataclass(frozen=True)
class Judged:
    """One pose or point: its name, how far off it is (m, rad or `None`), and why it was left out, `None` if it was not."""

    name: str
    away_m: float | None
    away_rad: float | None
    left_out: str | None

    def plain(self) -> dict[str, Any]:
        """Returns it as plain data."""
        rounded = {key: None if value is None else round(value, 6) for key, value in
                   (("away_m", self.away_m), ("away_rad", self.away_rad))}  # fmt: skip
        return {"name": self.name, **rounded, "left_out": self.left_out}


def stored(
    kind: str,
    machine: Machine,
    base_from_camera: np.ndarray,
    cov: np.ndarray,
    judged: Sequence[Judged],
    distance_m: float,
    more: dict[str, Any],
) -> dict[str, Any]:
    """Returns what `calibration.yaml` says.

    Args:
        kind: `board` or `touched`.
        machine: Whose base it is.
        base_from_camera: The camera, `(4, 4)`.
        cov: Covariance of a small motion of it in its own frame, `(6, 6)`.
        judged: Poses or points.
        distance_m: How far away the camera's work is: there its uncertainty is told.
        more: What the kind has to say besides.
    """
    used = [one for one in judged if one.left_out is None]

    def rms(values: Sequence[float | None]) -> float | None:
        there = [value for value in values if value is not None]
        return round(float(np.sqrt(np.mean(np.square(there)))), 6) if there else None

    return {
        "schema": SCHEMA,
        "kind": kind,
        "created": record.format_now(),
        "machine": machine.name,
        "T_base_cam": plain(base_from_camera),
        "covariance": plain(
            cov, 15
        ),  # of a small motion of the camera in its own frame: x y z in m, then turns in rad
        "std_m": plain(np.sqrt(np.diag(cov)[:3])),
        "std_rad": plain(np.sqrt(np.diag(cov)[3:6])),
        "point_std_m": {
            "at_m": round(distance_m, 3),
            "std_m": round(point_std_m(cov, distance_m), 6),
        },
        "residual": {
            "rms_m": rms([one.away_m for one in used]),
            "rms_rad": rms([one.away_rad for one in used]),
        },
        "num_used": len(used),
        "num_left_out": len(judged) - len(used),
        **more,
        "poses": [one.plain() for one in judged],
    }
