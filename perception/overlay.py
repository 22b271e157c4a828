"""What was seen, drawn into the picture: the block's outline, rims found and refused, axes, uncertainty."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np

from brokk_rl.contracts.vision import Ellipse, FrameDetections, HolePose
from brokk_rl.errors import ConfigError, StorageError
from brokk_rl.signals import Frame
from brokk_rl.spec import spec

BLOCK, FOUND, REFUSED, AXIS, DOUBT = (
    (255, 180, 60),
    (60, 220, 60),
    (60, 60, 235),
    (255, 220, 40),
    (220, 120, 255),
)
"""Colours, blue first."""


@spec
class OverlayDrawing:
    """Draws what was seen into the picture.

    Attributes:
        width_px: Width of the picture that is written, at most that of the frame.
        axis_m: Length of the arrow along a hole's axis.
        num_sigma: Size of the drawn uncertainty of a centre, in standard deviations.
    """

    width_px: int
    axis_m: float
    num_sigma: float

    def check(self) -> None:
        if self.width_px < 64 or self.axis_m <= 0:
            raise ConfigError(
                f"overlay: expected width_px >= 64 and axis_m > 0, got {self.width_px} and {self.axis_m}"
            )

    def write(self, path: Path, frame: Frame, sighting: FrameDetections) -> None:
        """Writes the picture in one step; see `brokk_rl.contracts.vision.Overlay`."""
        done, data = cv2.imencode(".png", self.draw(frame, sighting))
        part = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            part.write_bytes(data.tobytes() if done else b"")
            part.replace(path)
        except OSError as error:
            raise StorageError(
                f"cannot write {path}: {error.strerror or error}; nothing was left behind"
            ) from error
        finally:
            part.unlink(missing_ok=True)

    def draw(self, frame: Frame, sighting: FrameDetections) -> np.ndarray:
        """Returns the picture, `(h, w, 3)` uint8, blue first."""
        height, width = frame.color.shape[:2]
        scale = min(1.0, self.width_px / width)
        size = (round(width * scale), round(height * scale))
        picture = cv2.cvtColor(
            cv2.resize(frame.color, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2BGR
        )
        if sighting.masks is not None:
            mask = cv2.resize(
                (sighting.masks.block > 0.5).astype(np.uint8), size, interpolation=cv2.INTER_NEAREST
            )
            cv2.drawContours(
                picture,
                cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)[0],
                -1,
                BLOCK,
                1,
                cv2.LINE_AA,
            )
        refused = [one.ellipse for one in sighting.rejected if one.ellipse is not None]
        for ellipse in sighting.ellipses:
            _draw_ellipse(picture, ellipse, scale, REFUSED if ellipse in refused else FOUND)
        for one in sighting.rejected:
            if one.ellipse is not None:
                below = (
                    np.array([one.ellipse.x - one.ellipse.a, one.ellipse.y + one.ellipse.a]) * scale
                )
                _write_text(picture, one.reason.split(",")[0], below + np.array([0, 14]), REFUSED)
        for hole in sighting.holes:
            self._hole(picture, hole, frame, scale)
        return picture

    def _hole(self, picture: np.ndarray, hole: HolePose, frame: Frame, scale: float) -> None:
        """Draws the axis as an arrow, the uncertainty of the centre as an ellipse, and the distance in words."""
        turn, shift = np.eye(3), np.zeros(3)
        if hole.frame == "base" and frame.base_from_camera is not None:
            turn = frame.base_from_camera[:3, :3].T
            shift = -turn @ frame.base_from_camera[:3, 3]
        center, axis = turn @ hole.center_m + shift, turn @ hole.axis
        cov = turn @ hole.cov_m2 @ turn.T
        start, end = (
            _project_point(frame.camera_matrix, point) * scale
            for point in (center, center + self.axis_m * axis)
        )
        cv2.arrowedLine(
            picture, _round_point(start), _round_point(end), AXIS, 2, cv2.LINE_AA, tipLength=0.2
        )
        x, y, z = center
        slope = frame.camera_matrix[:2, :2] @ np.array(
            [[1 / z, 0, -x / z**2], [0, 1 / z, -y / z**2]]
        )
        values, vectors = np.linalg.eigh(slope @ cov @ slope.T)
        axes = np.maximum(self.num_sigma * np.sqrt(np.maximum(values, 0.0)) * scale, 1.0)
        angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
        cv2.ellipse(
            picture,
            _round_point(start),
            _round_point(axes[::-1]),
            angle,
            0,
            360,
            DOUBT,
            1,
            cv2.LINE_AA,
        )
        std = 1000 * np.sqrt(np.trace(hole.cov_m2))
        text = f"{np.linalg.norm(center):.2f} m, +-{std:.1f} mm, r {1000 * hole.radius_m:.1f} mm"
        _write_text(picture, text, np.minimum(start, end) + np.array([8, -12]), FOUND)


def _draw_ellipse(
    picture: np.ndarray, ellipse: Ellipse, scale: float, color: tuple[int, int, int]
) -> None:
    place = _round_point(np.array([ellipse.x, ellipse.y]) * scale * 16)
    axes = _round_point(np.array([ellipse.a, ellipse.b]) * scale * 16)
    cv2.ellipse(
        picture, place, axes, float(np.degrees(ellipse.theta_rad)), 0, 360, color, 1, cv2.LINE_AA, 4
    )


def _write_text(
    picture: np.ndarray, text: str, place: np.ndarray, color: tuple[int, int, int]
) -> None:
    """Writes words that can be read on any ground."""
    for ink, width in (((0, 0, 0), 3), (color, 1)):
        cv2.putText(
            picture,
            text,
            _round_point(place),
            cv2.FONT_HERSHEY_SIMPLEX,
            0.45,
            ink,
            width,
            cv2.LINE_AA,
        )


def _project_point(camera_matrix: np.ndarray, point: np.ndarray) -> np.ndarray:
    seen = camera_matrix @ point
    return seen[:2] / seen[2]


def _round_point(values: np.ndarray) -> tuple[int, int]:
    limited = np.clip(np.rint(values), -30000, 30000).astype(int)
    return int(limited[0]), int(limited[1])
