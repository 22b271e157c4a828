"""Overlay of the detections: outline of the block, rims found and refused, axes, uncertainty."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from annotated_types import Ge

from brokk_rl.contracts.vision import Ellipse, FrameDetections, HolePose
from brokk_rl.signals import Frame
from brokk_rl.spec import Positive, spec
from perception import dataset
from perception.camera import express_in_camera

# Colours in OpenCV's order, blue first.
BLOCK = (255, 180, 60)
FOUND = (60, 220, 60)
REFUSED = (60, 60, 235)
AXIS = (255, 220, 40)
UNCERTAINTY = (220, 120, 255)
SUBPIXEL_BITS = 4
"""Fraction bits of coordinates that OpenCV draws with: ellipses to 1/16 px."""
LARGEST_COORDINATE = 30_000
"""Beyond it OpenCV's 16-bit drawing coordinates overflow, px."""


@spec
class OverlayDrawing:
    """Draw detections into their picture.

    Attributes:
        width_px: Width of the written picture, at most that of the frame.
        axis_m: Length of the arrow along a hole's axis.
        num_sigma: Size of the drawn uncertainty of a centre, in standard deviations.
    """

    width_px: Annotated[int, Ge(64)]
    axis_m: Positive
    num_sigma: float

    def write(self, path: Path, frame: Frame, detections: FrameDetections) -> None:
        """Write the picture in one step."""
        dataset.write_picture(path, self.draw(frame, detections))

    def draw(self, frame: Frame, detections: FrameDetections) -> np.ndarray:
        """Return the picture, `(h, w, 3)` uint8, blue first."""
        height, width = frame.color.shape[:2]
        scale = min(1.0, self.width_px / width)
        size = (round(width * scale), round(height * scale))
        small = cv2.resize(frame.color, size, interpolation=cv2.INTER_AREA)
        picture = cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
        if detections.masks is not None:
            block = (detections.masks.block > 0.5).astype(np.uint8)
            mask = cv2.resize(block, size, interpolation=cv2.INTER_NEAREST)
            outlines = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)[0]
            cv2.drawContours(picture, outlines, -1, BLOCK, 1, cv2.LINE_AA)
        refused = [one.ellipse for one in detections.rejected if one.ellipse is not None]
        for ellipse in detections.ellipses:
            _draw_ellipse(picture, ellipse, scale, REFUSED if ellipse in refused else FOUND)
        for one in detections.rejected:
            if one.ellipse is not None:
                corner = np.array([one.ellipse.x - one.ellipse.a, one.ellipse.y + one.ellipse.a])
                below = corner * scale + np.array([0, 14])
                _write_text(picture, one.reason.split(",")[0], below, REFUSED)
        for hole in detections.holes:
            self._draw_hole(picture, hole, frame, scale)
        return picture

    def _draw_hole(self, picture: np.ndarray, hole: HolePose, frame: Frame, scale: float) -> None:
        """Draw the axis as an arrow, the centre's uncertainty as an ellipse, the distance as text.

        A hole behind the camera, or in a base frame that the camera does not know, is left out.
        """
        place = express_in_camera(hole, frame)
        if place is None:
            return
        center, axis, rotation = place
        tip = center + self.axis_m * axis
        if min(center[2], tip[2]) <= 0:
            return
        cov = rotation @ hole.cov_m2 @ rotation.T
        start = _project_point(frame.camera_matrix, center) * scale
        end = _project_point(frame.camera_matrix, tip) * scale
        cv2.arrowedLine(
            picture, _round_point(start), _round_point(end), AXIS, 2, cv2.LINE_AA, tipLength=0.2
        )
        # First-order propagation of the covariance through the projection.
        x, y, z = center
        slope = frame.camera_matrix[:2, :2] @ np.array(
            [[1 / z, 0, -x / z**2], [0, 1 / z, -y / z**2]]
        )
        values, vectors = np.linalg.eigh(slope @ cov @ slope.T)
        axes = np.maximum(self.num_sigma * np.sqrt(np.maximum(values, 0.0)) * scale, 1.0)
        angle_deg = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
        place, size = _round_point(start), _round_point(axes[::-1])
        cv2.ellipse(picture, place, size, angle_deg, 0, 360, UNCERTAINTY, 1, cv2.LINE_AA)
        std_mm = 1000 * np.sqrt(np.trace(hole.cov_m2))
        distance_m = np.linalg.norm(center)
        text = f"{distance_m:.2f} m, +-{std_mm:.1f} mm, r {1000 * hole.radius_m:.1f} mm"
        _write_text(picture, text, np.minimum(start, end) + np.array([8, -12]), FOUND)


def _draw_ellipse(
    picture: np.ndarray, ellipse: Ellipse, scale: float, color: tuple[int, int, int]
) -> None:
    factor = scale * 2**SUBPIXEL_BITS
    place = _round_point(np.array([ellipse.x, ellipse.y]) * factor)
    axes = _round_point(np.array([ellipse.a, ellipse.b]) * factor)
    angle_deg = float(np.degrees(ellipse.theta_rad))
    cv2.ellipse(picture, place, axes, angle_deg, 0, 360, color, 1, cv2.LINE_AA, SUBPIXEL_BITS)


def _write_text(
    picture: np.ndarray, text: str, place: np.ndarray, color: tuple[int, int, int]
) -> None:
    """Write text with a dark edge, legible on any background."""
    at, font = _round_point(place), cv2.FONT_HERSHEY_SIMPLEX
    for ink, width in (((0, 0, 0), 3), (color, 1)):
        cv2.putText(picture, text, at, font, 0.45, ink, width, cv2.LINE_AA)


def _project_point(camera_matrix: np.ndarray, point: np.ndarray) -> np.ndarray:
    seen = camera_matrix @ point
    return seen[:2] / seen[2]


def _round_point(values: np.ndarray) -> tuple[int, int]:
    limited = np.clip(np.rint(values), -LARGEST_COORDINATE, LARGEST_COORDINATE).astype(int)
    return int(limited[0]), int(limited[1])
