"""Shapes of a machine for the envelope, from the `shapes.json` that `brokk mode=export` writes.

`brokk_rl.sim.shapes` describes the file. There is no MuJoCo on the machine's computer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.plain_files import read_json

SCHEMA, MOST_BYTES = 1, 1 << 22
"""Version of the file, and the size beyond which it is none."""
BASE = -1
"""Link number of what stands still; link `j` turns with joint `j`."""
NEEDED = ("joints", "limits", "geometry")
"""Parts of the machine's fingerprint on which shapes depend."""


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


def read_machine_shapes(path: Path, machine: Machine) -> MachineShapes | None:
    """Return the shapes in a file; `None` where they are those of another machine.

    Raises:
        ConfigError: the file is missing, or no such file.
    """
    try:
        content = read_json(path, MOST_BYTES)
        if content["schema"] != SCHEMA:
            raise ValueError(f"expected schema {SCHEMA}, got {content['schema']}")
        own = machine.fingerprint()
        if any(content["fingerprint"].get(part) != own[part] for part in NEEDED):
            return None
        arm, body = [], []
        for one in content["arm"]:
            ends_m = _read_numbers(one, "begin_m", 3), _read_numbers(one, "end_m", 3)
            arm.append(LinkCapsule(_read_link(one, machine), *ends_m, _read_radius(one)))
        for one in content["body"]:
            place = _read_numbers(one, "center_m", 3), _read_numbers(one, "rotation", 3, 3)
            half_m = _read_numbers(one, "half_m", 3)
            body.append(RoundedBox(_read_link(one, machine), *place, half_m, _read_radius(one)))
        # Without capsules nothing would ever be near an obstacle.
        if not arm:
            raise ValueError("expected capsules of the arm, got none")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(
            f"guard.envelope.shapes: {path} cannot be read ({error}); brokk mode=export writes such a file"
        ) from error
    return MachineShapes(tuple(arm), tuple(body))


def _read_numbers(part: Mapping[str, Any], name: str, *shape: int) -> np.ndarray:
    """Return numbers of a shape's entry; one that is not finite would pass every comparison."""
    numbers = np.array(part[name], float)
    if numbers.shape != shape or not np.isfinite(numbers).all():
        raise ValueError(f"expected finite numbers {shape} in {name}, got {part[name]}")
    return numbers


def _read_radius(part: Mapping[str, Any]) -> float:
    radius_m = float(_read_numbers(part, "radius_m"))
    if radius_m < 0.0:
        raise ValueError(f"expected a radius_m of 0 or more, got {radius_m:g}")
    return radius_m


def _read_link(part: Mapping[str, Any], machine: Machine) -> int:
    link = part["link"]
    if link not in range(BASE, machine.num_joints):
        raise ValueError(f"expected a link from {BASE} to {machine.num_joints - 1}, got {link}")
    return link
