"""Ellipses from Edge Drawing, which OpenCV's contrib modules have: beside those of the arcs, judged by the same support."""

from __future__ import annotations

import cv2
import numpy as np

from brokk_rl.errors import ConfigError
from brokk_rl.spec import spec
from perception.ellipse.detector import ArcDetector, ContourArcs


@spec
class EdgeDrawing:
    """Arcs, and what OpenCV's Edge Drawing (EDCircles, Akinlar and Topal 2013) proposes as well; needs OpenCV with contrib modules.

    Edge Drawing snaps small ellipses to circles, so what it proposes is fitted again and judged
    like everything else.

    Attributes:
        arcs: How arcs are found, and how all ellipses are judged.
        gradient: Gradient from which a pixel is an edge.
        anchor: By how much an anchor stands out from its neighbours.
        sigma_px: Blur; below 1 the released library writes into the picture that it was given
            (opencv_contrib issue 4203).
    """

    arcs: ContourArcs
    gradient: int
    anchor: int
    sigma_px: float

    def check(self) -> None:
        if self.sigma_px < 1.0 or min(self.gradient, self.anchor) < 0:
            raise ConfigError(
                "perception/ellipse=edge_drawing: expected sigma_px of 1 or more, gradient and anchor of 0 or more, got "
                f"{self.sigma_px}, {self.gradient} and {self.anchor}"
            )

    def build(self) -> ArcDetector:
        """Returns a detector.

        Raises:
            ConfigError: this OpenCV has no Edge Drawing.
        """
        extra = getattr(cv2, "ximgproc", None)
        if extra is None or not hasattr(extra, "createEdgeDrawing"):
            raise ConfigError(
                f"perception/ellipse=edge_drawing: OpenCV {cv2.__version__} is without contrib modules; put "
                "opencv-contrib-python-headless in place of opencv-python-headless, or take perception/ellipse=contour_arcs"
            )
        drawing, parameters = extra.createEdgeDrawing(), extra.EdgeDrawing.Params()
        parameters.GradientThresholdValue, parameters.AnchorThresholdValue = (
            self.gradient,
            self.anchor,
        )
        parameters.Sigma = self.sigma_px
        drawing.setParams(parameters)

        def propose(gray: np.ndarray) -> np.ndarray:
            drawing.detectEdges(gray.copy())
            return convert_detections(drawing.detectEllipses())

        return ArcDetector(self.arcs, propose)


def convert_detections(found: np.ndarray | None) -> np.ndarray:
    """Returns ellipses `(C, 5)` of what Edge Drawing answers, `(C, 1, 6)`: centre, radius of a circle, semi-axes, degrees."""
    if found is None or not len(found):
        return np.empty((0, 5))
    x, y, radius, one, two, degrees = np.asarray(found, float).reshape(-1, 6).T
    swapped = two > one
    major, minor = np.where(swapped, two, one) + radius, np.where(swapped, one, two) + radius
    return np.column_stack(
        [x, y, major, minor, (np.radians(degrees) + np.where(swapped, np.pi / 2, 0.0)) % np.pi]
    )
