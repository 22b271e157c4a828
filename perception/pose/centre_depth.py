"""Pose by the paper's method, depth at the ellipse's centre; the baseline of the benchmarks."""

from __future__ import annotations

import numpy as np

from brokk_rl.contracts.vision import Ellipse, HolePose, Masks, Rejection
from brokk_rl.signals import Frame
from brokk_rl.spec import spec
from perception.ellipse import conic
from perception.pose.plane_conic import as_row


@spec
class CentreDepth:
    """Pose by the paper's method: depth at the ellipse's centre, normals around it compared.

    Attributes:
        radius_m: Reported radius; it is not measured.
        window_px: Side of the window of the median depth at the centre; 1 for the pixel itself.
        ring_px: Distance from the rim at which local normals are taken.
        normal_rad: Largest angle between a local normal and their mean.
        std_m: Claimed standard deviation of each coordinate.
    """

    radius_m: float
    window_px: int
    ring_px: float
    normal_rad: float
    std_m: float

    def build(self) -> CentreDepthEstimator:
        """Return an estimator."""
        return CentreDepthEstimator(self)


class CentreDepthEstimator:
    """The paper's estimator: depth at the centre and the normals around, with the settings `CentreDepth`."""

    NUM_NORMALS = 8

    def __init__(self, settings: CentreDepth) -> None:
        self.settings = settings

    def estimate(self, frame: Frame, masks: Masks, ellipse: Ellipse) -> HolePose | Rejection:
        """Return the point at the ellipse's centre with the mean normal; see `PoseEstimator`."""
        s = self.settings
        half = s.window_px // 2
        u, v = round(ellipse.x), round(ellipse.y)
        # The slice ends at the border by itself; its start must not be negative.
        window = frame.depth_m[max(v - half, 0) : v + half + 1, max(u - half, 0) : u + half + 1]
        if not np.isfinite(window).any():
            return Rejection("pose", "known depth at the centre", 0.0, 1.0, ellipse)
        ray = np.linalg.solve(frame.camera_matrix, np.array([ellipse.x, ellipse.y, 1.0]))
        normals = self._normals(frame, as_row(ellipse))
        if len(normals) < 3:
            return Rejection(
                "pose", "local normals around the rim", float(len(normals)), 3.0, ellipse
            )
        # The bound guards normals that cancel.
        mean = normals.mean(0) / max(float(np.linalg.norm(normals.mean(0))), 1e-9)
        # The median: one wrong normal must not refuse the hole.
        worst = float(np.median(np.arccos(np.clip(normals @ mean, -1, 1))))
        if worst > s.normal_rad:
            return Rejection(
                "pose", "angle between local normals, rad", worst, s.normal_rad, ellipse
            )
        across = np.eye(3) - np.outer(mean, mean)
        return HolePose(
            center_m=ray * float(np.nanmedian(window)),
            axis=mean,
            radius_m=s.radius_m,
            cov_m2=np.eye(3) * s.std_m**2,
            # The mean of K normals is more exact than each by their number.
            axis_cov_rad2=across * worst**2 / len(normals),
            frame="camera",
            score=ellipse.score,
            t_s=frame.t_s,
        )

    def _normals(self, frame: Frame, row: np.ndarray) -> np.ndarray:
        """Return unit normals of the depth beside the rim, `(K, 3)`, by finite differences."""
        wide = row + np.array([0, 0, self.settings.ring_px, self.settings.ring_px, 0])
        places = conic.sample_ellipses(
            wide[None], np.arange(self.NUM_NORMALS) * 2 * np.pi / self.NUM_NORMALS
        )[0][0]
        step = max(2, round(self.settings.ring_px / 2))
        height, width = frame.depth_m.shape
        inverse = np.linalg.inv(frame.camera_matrix)
        found = []
        for x, y in np.rint(places).astype(int):
            if not (step <= x < width - step and step <= y < height - step):
                continue
            corners = [(x + step, y), (x - step, y), (x, y + step), (x, y - step)]
            points = [frame.depth_m[v, u] * (inverse @ np.array([u, v, 1.0])) for u, v in corners]
            normal = np.cross(points[0] - points[1], points[2] - points[3])
            length = float(np.linalg.norm(normal))
            if np.isfinite(length) and length > 0:
                found.append(normal / length * -np.sign(normal @ points[0]))
        return np.array(found).reshape(-1, 3)
