"""Holes and a block that a person measured in the frame of a board beside them."""

from __future__ import annotations

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


FARTHEST_M, LARGEST_M = 20.0, 1.0
"""Largest coordinate, and largest radius or deviation: larger numbers are mm. Chosen by hand: no block
is longer, and no hole wider."""


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
            usual = {"name": number, "axis": (0, 0, -1), "radius_m": 0.05}
            holes.append(_read_hole(f"hole {number}", usual | one))
        std_m = _read_length("holes", told, "std_m")
        if not holes:
            raise ValueError("no holes")
        block_m = None
        if "block" in told:
            corner_m = _read_vector("block", told["block"], "corner_m")
            size_m = _read_vector("block", told["block"], "size_m")
            if not (size_m > 0).all():
                raise ValueError(f"block: size_m: expected more than 0, got {size_m.tolist()}")
            block_m = np.stack([corner_m, corner_m + size_m])
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise ConfigError(f"{where}={path}: {type(error).__name__} {error}; {EXAMPLE}") from error
    return MeasuredScene(tuple(holes), std_m, block_m)


def _read_hole(part: str, told: dict[str, Any]) -> MeasuredHole:
    axis = _read_vector(part, told, "axis")
    if not axis.any():
        raise ValueError(f"{part}: axis: expected a direction, got 0")
    axis = axis / np.linalg.norm(axis)
    center_m, radius_m = _read_vector(part, told, "center_m"), _read_length(part, told, "radius_m")
    return MeasuredHole(str(told["name"]), center_m, axis, radius_m)


def _read_vector(part: str, told: dict[str, Any], name: str) -> np.ndarray:
    vector = np.asarray(told[name], float)
    if vector.shape != (3,) or not (np.abs(vector) <= FARTHEST_M).all():
        raise ValueError(
            f"{part}: {name}: expected three numbers of up to {FARTHEST_M:g} m, got {told[name]}; are they in mm?"
        )
    return vector


def _read_length(part: str, told: dict[str, Any], name: str) -> float:
    length_m = float(told[name])
    if not 0 < length_m <= LARGEST_M:
        raise ValueError(
            f"{part}: {name}: expected more than 0 and up to {LARGEST_M:g} m, got {told[name]}; is it in mm?"
        )
    return length_m
