"""A finder that returns a configured borehole, for simulation and rehearsals."""

from __future__ import annotations

import numpy as np

from brokk_rl.contracts.vision import FrameDetections, HolePose
from brokk_rl.errors import ConfigError
from brokk_rl.signals import Frame
from brokk_rl.spec import NonNegative, Positive, spec


@spec
class TruthPerception:
    """Finder that returns the configured borehole for every frame; replaces a camera in rehearsals.

    Attributes:
        center_in_base_m: Centre of the rim.
        axis_in_base: Unit axis, pointing out of the hole.
        radius_m: Radius of the hole.
        std_m: Claimed standard deviation of each coordinate of the centre; 0 for a hole known
            exactly.
    """

    center_in_base_m: tuple[float, float, float]
    axis_in_base: tuple[float, float, float]
    radius_m: Positive
    std_m: NonNegative

    def check(self) -> None:
        if abs(float(np.linalg.norm(self.axis_in_base)) - 1.0) > 1e-6:
            raise ConfigError(f"axis_in_base: {self.axis_in_base} is not a unit vector")

    def build(self) -> TruthPerception:
        """Return the finder, which is the spec itself."""
        return self

    def find(self, frame: Frame) -> FrameDetections:
        """Return the borehole, whatever the frame shows."""
        hole = HolePose(
            center_m=np.array(self.center_in_base_m),
            axis=np.array(self.axis_in_base),
            radius_m=self.radius_m,
            cov_m2=np.eye(3) * self.std_m**2,
            axis_cov_rad2=np.zeros((3, 3)),
            frame="base",
            score=1.0,
            t_s=frame.t_s,
        )
        return FrameDetections([hole])
