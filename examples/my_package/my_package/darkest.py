"""A finder: the darkest spot of a bright face."""

import numpy as np

from brokk_rl.contracts.vision import FrameDetections, HolePose
from brokk_rl.spec import Positive, spec


@spec
class DarkestSpot:
    """Take the darkest spot of a bright face for a hole.

    Attributes:
        radius_m: Radius that is reported.
        std_m: Standard deviation that is reported, in each direction.
    """

    radius_m: Positive
    std_m: Positive

    def build(self):
        """Return the finder, which is the spec itself."""
        return self

    def find(self, frame):
        """Return the holes in a frame; see `brokk_rl.contracts.vision.BoreholeFinder`."""
        known = np.isfinite(frame.depth_m)
        gray = frame.color.mean(axis=2)
        rows, columns = np.nonzero(gray < 0.5 * np.median(gray))
        if not known.any() or len(rows) == 0:
            return FrameDetections(holes=[])
        ray = np.linalg.solve(frame.camera_matrix, [columns.mean(), rows.mean(), 1.0])
        hole = HolePose(
            center_m=np.median(frame.depth_m[known]) * ray,
            axis=np.array([0.0, 0.0, -1.0]),
            radius_m=self.radius_m,
            cov_m2=np.eye(3) * self.std_m**2,
            axis_cov_rad2=np.zeros((3, 3)),
            frame="camera",
            score=0.5,
            t_s=frame.t_s,
        )
        return FrameDetections(holes=[hole])
