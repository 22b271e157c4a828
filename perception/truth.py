"""What the simulator knows: a finder that needs no picture."""

from __future__ import annotations

import numpy as np

from brokk_rl.errors import ConfigError
from brokk_rl.signals import Borehole, Frame
from brokk_rl.spec import spec


@spec
class TruthPerception:
    """Returns a configured borehole for every frame; stands in for a camera in the simulator and in rehearsals.

    Attributes:
        center_in_base_m: Centre of the rim.
        axis_in_base: Unit axis, pointing out of the hole.
        radius_m: Radius of the hole.
        std_m: Standard deviation that is claimed for each coordinate of the centre; 0 for a hole
            known exactly.
    """

    center_in_base_m: tuple[float, float, float]
    axis_in_base: tuple[float, float, float]
    radius_m: float
    std_m: float

    def check(self) -> None:
        if abs(float(np.linalg.norm(self.axis_in_base)) - 1.0) > 1e-6:
            raise ConfigError(f"perception.axis_in_base: {self.axis_in_base} is not a unit vector")
        if self.radius_m <= 0 or self.std_m < 0:
            raise ConfigError(
                f"perception: expected radius_m > 0 and std_m >= 0, got {self.radius_m} and {self.std_m}"
            )

    def build(self) -> TruthFinder:
        """Returns a finder that always finds this borehole."""
        covariance = np.eye(3) * self.std_m**2
        return TruthFinder(
            Borehole(
                np.array(self.center_in_base_m),
                np.array(self.axis_in_base),
                self.radius_m,
                covariance,
            )
        )


class TruthFinder:
    """A finder that has the answer.

    Args:
        borehole: The borehole; whoever moves the hole sets it anew, or to `None` when there is
            none.
    """

    def __init__(self, borehole: Borehole | None) -> None:
        self.borehole = borehole

    def find(self, frame: Frame) -> Borehole | None:
        """Returns the borehole, whatever the frame shows."""
        return self.borehole
