"""Ellipse proposals of Edge Drawing from OpenCV's contrib modules, judged like those of arcs."""

from __future__ import annotations

from typing import Annotated

import cv2
import numpy as np
from annotated_types import Ge

from brokk_rl.errors import ConfigError
from brokk_rl.spec import Index, spec
from perception.ellipse.detector import ArcDetector, ContourArcs


@spec
class EdgeDrawing:
    """Arcs, and the proposals of Edge Drawing; needs OpenCV with contrib modules.

    Edge Drawing (EDCircles, Akinlar and Topal 2013) snaps small ellipses to circles, so its
    proposals are fitted again and judged like all candidates.

    Attributes:
        arcs: Search for arcs, and judgement of all ellipses.
        gradient: Gradient from which a pixel is an edge, grey levels.
        anchor: Least difference of an anchor from its neighbours, grey levels.
        sigma_px: Blur; below 1 the released library writes into its input (opencv_contrib issue
            4203).
    """

    arcs: ContourArcs
    gradient: Index
    anchor: Index
    sigma_px: Annotated[float, Ge(1)]

    def build(self) -> ArcDetector:
        """Return a detector.

        Raises:
            ConfigError: this OpenCV has no Edge Drawing.
        """
        extra = getattr(cv2, "ximgproc", None)
        if extra is None or not hasattr(extra, "createEdgeDrawing"):
            raise ConfigError(
                f"perception/ellipse=edge_drawing: OpenCV {cv2.__version__} has no contrib modules; "
                "install opencv-contrib-python-headless in place of opencv-python-headless, or "
                "choose perception/ellipse=contour_arcs"
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
    """Return the ellipses `(C, 5)` of Edge Drawing's answer `(C, 1, 6)`.

    Its columns: centre, radius of a circle, semi-axes, direction in degrees.
    """
    if found is None or not len(found):
        return np.empty((0, 5))
    x, y, radius, one, two, degrees = np.asarray(found, float).reshape(-1, 6).T
    swapped = two > one
    major, minor = np.where(swapped, two, one) + radius, np.where(swapped, one, two) + radius
    return np.column_stack(
        [x, y, major, minor, (np.radians(degrees) + np.where(swapped, np.pi / 2, 0.0)) % np.pi]
    )
