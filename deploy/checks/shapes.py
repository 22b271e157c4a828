"""Shapes of a machine for the envelope, from the `shapes.json` that `brokk mode=export` writes.

`brokk_rl.sim.shapes` describes the file. There is no MuJoCo on the machine's computer.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

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
            ends_m = np.array(one["begin_m"], float), np.array(one["end_m"], float)
            arm.append(LinkCapsule(int(one["link"]), *ends_m, float(one["radius_m"])))
        for one in content["body"]:
            place = np.array(one["center_m"], float), np.array(one["rotation"], float)
            half_m, radius_m = np.array(one["half_m"], float), float(one["radius_m"])
            body.append(RoundedBox(int(one["link"]), *place, half_m, radius_m))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(
            f"guard.envelope.shapes: {path} cannot be read ({error}); brokk mode=export writes such a file"
        ) from error
    return MachineShapes(tuple(arm), tuple(body))
