"""Holes and a block that a person measured in the frame of a board beside them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import yaml
from annotated_types import Interval

from brokk_rl.errors import ConfigError
from brokk_rl.spec import spec

EXAMPLE = """lengths are in m, not in mm; expected YAML such as
  std_m: 0.0005   # of the measured centres
  holes:          # in the board's frame: from its corner, x along the top, y down, z into the face
    - {name: A, center_m: [1.120, 0.310, 0.004], axis: [0, 0, -1], radius_m: 0.05}
  block: {corner_m: [-0.20, -0.15, 0.004], size_m: [1.6, 0.9, 0.6]}   # for mode=label: least x, y, z"""
USUAL = {"axis": (0.0, 0.0, -1.0), "radius_m": 0.05}
"""Axis and radius of a hole whose file gives none."""
# Larger numbers are mm. Chosen by hand: no block is longer, and no hole wider.
Coordinate = Annotated[float, Interval(ge=-20, le=20)]
Side = Annotated[float, Interval(gt=0, le=20)]
Radius = Annotated[float, Interval(gt=0, le=1)]


@spec
class MeasuredHole:
    """A hole in the board's frame: centre, axis out of the hole, radius."""

    name: str
    center_m: tuple[Coordinate, Coordinate, Coordinate]
    axis: tuple[float, float, float]
    radius_m: Radius

    def check(self) -> None:
        if not any(self.axis):
            raise ConfigError(f"hole {self.name}: axis: expected a direction, got 0")

    @property
    def outward(self) -> np.ndarray:
        """Unit vector along the axis, `(3,)`."""
        return np.array(self.axis) / np.linalg.norm(self.axis)


@spec
class MeasuredBlock:
    """Corner of a block with the least x, y and z in the board's frame, and its sides along them."""

    corner_m: tuple[Coordinate, Coordinate, Coordinate]
    size_m: tuple[Side, Side, Side]


@spec
class MeasuredScene:
    """Holes and block in the board's frame, whose z axis goes into the drilled face.

    Attributes:
        holes: At least one.
        std_m: Standard deviation of their centres.
        block: The block; `None` where it was not measured.
    """

    holes: tuple[MeasuredHole, ...]
    std_m: Radius
    block: MeasuredBlock | None

    def check(self) -> None:
        if not self.holes:
            raise ConfigError("holes: expected one or more, got none")


def read_measured(path: Path, where: str) -> MeasuredScene:
    """Read what was measured.

    Raises:
        ConfigError: the file cannot be read; the message shows the expected form.
    """
    try:
        told = {"block": None} | yaml.safe_load(path.read_text())
        holes = []
        for number, one in enumerate(told["holes"], 1):
            holes.append(USUAL | one | {"name": str(one.get("name", number))})
        return MeasuredScene(**told | {"holes": holes})
    except (OSError, yaml.YAMLError, KeyError, TypeError, AttributeError, ConfigError) as error:
        raise ConfigError(f"{where}={path}: {type(error).__name__} {error}; {EXAMPLE}") from error
