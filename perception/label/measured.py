"""Holes and a block that a person measured in the frame of a board beside them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from brokk_rl.errors import ConfigError

EXAMPLE = """expected YAML such as
  std_m: 0.0005   # of the measured centres
  holes:          # in the board's frame: from its corner, x along the top, y down, z into the face
    - {name: A, center_m: [1.120, 0.310, 0.004], axis: [0, 0, -1], radius_m: 0.05}
  block: {corner_m: [-0.20, -0.15, 0.004], size_m: [1.6, 0.9, 0.6]}   # for mode=label: least x, y, z"""


@dataclass(frozen=True)
class MeasuredHole:
    """A hole in the board's frame: centre, axis out of the hole, radius, m."""

    name: str
    center_m: np.ndarray
    axis: np.ndarray
    radius_m: float


@dataclass(frozen=True)
class MeasuredScene:
    """Holes and block in the board's frame, whose z axis goes into the drilled face.

    Attributes:
        holes: At least one.
        std_m: Standard deviation of their centres.
        block_m: Least and largest x, y and z of the block, `(2, 3)`; `None` where it was not
            measured.
    """

    holes: tuple[MeasuredHole, ...]
    std_m: float
    block_m: np.ndarray | None


def read_measured(path: Path, where: str) -> MeasuredScene:
    """Read what was measured.

    Raises:
        ConfigError: the file cannot be read; the message shows the expected form.
    """
    try:
        told = yaml.safe_load(path.read_text())
        holes = []
        for number, one in enumerate(told["holes"], 1):
            holes.append(_read_hole(number, one))
        std_m = float(told["std_m"])
        if not holes or not math.isfinite(std_m):
            raise ValueError("no holes")
        block_m = None
        if "block" in told:
            corner_m, size_m = (
                np.asarray(told["block"][name], float) for name in ("corner_m", "size_m")
            )
            if corner_m.shape != (3,) or size_m.shape != (3,) or not (size_m > 0).all():
                raise ValueError(
                    "block: corner_m and size_m need three numbers each, sizes above 0"
                )
            block_m = np.stack([corner_m, corner_m + size_m])
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise ConfigError(f"{where}={path}: {type(error).__name__} {error}; {EXAMPLE}") from error
    return MeasuredScene(tuple(holes), std_m, block_m)


def _read_hole(number: int, told: dict[str, Any]) -> MeasuredHole:
    center_m = np.asarray(told["center_m"], float)
    axis = np.asarray(told.get("axis", (0.0, 0.0, -1.0)), float)
    if center_m.shape != (3,) or axis.shape != (3,) or not np.linalg.norm(axis) > 0:
        raise ValueError(f"hole {number}: center_m and axis need three numbers each")
    name = str(told.get("name", number))
    return MeasuredHole(
        name, center_m, axis / np.linalg.norm(axis), float(told.get("radius_m", 0.05))
    )
