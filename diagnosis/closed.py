"""How large a gap is and how much of it is closed, as numbers with intervals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Estimate:
    """A number with its 95 % interval."""

    mean: float
    ci95: tuple[float, float]


@dataclass(frozen=True)
class JointClosed:
    """Error of one joint over 5 s free runs before, after and at the floor, rad or m, and what of it is closed.

    Attributes:
        before: Of the simulator as it was.
        after: With the selected effects.
        floor: `None` without any.
        share: `1 - after / before`.
        closed: `(before - after) / (before - floor)`; `None` without a floor below `before`.
    """

    before: float
    after: float
    floor: float | None
    share: float
    closed: float | None


@dataclass(frozen=True)
class Gap:
    """Free-running error over 5 s on parts of the field recordings that were not fitted to, all joints together.

    Attributes:
        before: Of the simulator as it was.
        after: With the selected effects.
        floor: What it would be without any effect: the simulator's on left-out reference
            recordings; without a reference that of a flexible model on field recordings that it was
            not fitted to; `None` where neither is known.
        closed: `(before - after) / (before - floor)`; `None` where there is no gap to close.
        unit: `rad` or `m`; `travel` on a machine with joints of both kinds, whose errors are taken
            over their travel.
        floor_of: `reference`, `flexible model`, or empty.
        joints: The same joint by joint.
    """

    before: float
    after: float
    floor: float | None
    closed: Estimate | None
    unit: str = "rad"
    floor_of: str = "reference"
    joints: Mapping[str, JointClosed] = field(default_factory=dict)

    @property
    def key(self) -> str:
        """Name of the errors in `diagnosis.json`."""
        return f"rmse_{self.unit}"
