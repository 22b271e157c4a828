"""What the parts of perception promise each other: sources, segmenters, ellipses, poses, targets.

Every part is an option of a config group
(`conf/perception/{source,segmenter,ellipse,pose,filter}`): a spec with `build()`, which returns
what the Protocols here describe. Pictures are `(h, w)` or `(h, w, 3)`, RGB, uint8; pixel centres
lie at whole numbers. Camera coordinates follow the optical convention (x right, y down, z forward);
depth is z, in m, `NaN` where it is unknown and never 0 or infinite. Times `t_s` are of one clock,
in s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np

from brokk_rl.signals import Borehole, Frame

if TYPE_CHECKING:
    from pathlib import Path


@dataclass(frozen=True)
class Masks:
    """Where the block and the mouths of its holes are.

    Attributes:
        block: Probability that a pixel shows the block, `(h, w)` float32 in [0, 1].
        hole_mask: Probability that a pixel shows the inside of a hole, `(h, w)` float32 in [0, 1];
            `None` where nobody has looked.
    """

    block: np.ndarray
    hole_mask: np.ndarray | None


@dataclass(frozen=True)
class Ellipse:
    """An ellipse in the picture.

    Attributes:
        x: Centre, px.
        y: Centre, px.
        a: Major semi-axis, px.
        b: Minor semi-axis, px.
        theta_rad: Direction of the major axis from +x towards +y, in [0, pi).
        rms_px: Root mean square distance of its edge points.
        coverage: Part of its circumference that has edge points, in [0, 1].
        score: How much it is one, in [0, 1].
    """

    x: float
    y: float
    a: float
    b: float
    theta_rad: float
    rms_px: float
    coverage: float
    score: float


@dataclass(frozen=True)
class SizePrior:
    """How large the ellipse that is looked for may be: its major semi-axis in px."""

    lowest_px: float
    highest_px: float


@dataclass(frozen=True)
class HolePose:
    """A borehole as seen in one frame, or in many.

    Attributes:
        center_m: Centre of the rim, `(3,)`.
        axis: Unit axis, pointing out of the hole, `(3,)`.
        radius_m: Measured radius of the rim.
        cov_m2: Covariance of the centre, `(3, 3)`.
        axis_cov_rad2: Covariance of the axis, `(3, 3)`, singular along it.
        frame: In which coordinates all of it stands: `camera` (optical) or `base`.
        score: How sure it is a hole, in [0, 1].
        t_s: When it was seen.
        shared_m2: Part of `cov_m2` that no further frame takes away, since the camera's pose is off
            by the same in all of them; `None` for none.
        shared_rad2: The same part of `axis_cov_rad2`.
    """

    center_m: np.ndarray
    axis: np.ndarray
    radius_m: float
    cov_m2: np.ndarray
    axis_cov_rad2: np.ndarray
    frame: Literal["camera", "base"]
    score: float
    t_s: float
    shared_m2: np.ndarray | None = None
    shared_rad2: np.ndarray | None = None

    def moved(self, base_from_camera: np.ndarray, camera_cov: np.ndarray | None = None) -> HolePose:
        """Returns the pose in the base frame.

        Args:
            base_from_camera: Pose of the camera, `(4, 4)`.
            camera_cov: How uncertain that is, see `Frame`; it adds to the covariances.
        """
        rotation, shift = base_from_camera[:3, :3], base_from_camera[:3, 3]
        shared_m2 = shared_rad2 = None
        cov_m2 = rotation @ self.cov_m2 @ rotation.T
        axis_cov_rad2 = rotation @ self.axis_cov_rad2 @ rotation.T
        if camera_cov is not None:
            # First order: a small motion (shift, turn) of the camera moves the centre by
            # shift - center x turn, and the axis by -axis x turn.
            center_lever = np.hstack([np.eye(3), -_build_cross_matrix(self.center_m)])
            axis_lever = np.hstack([np.zeros((3, 3)), -_build_cross_matrix(self.axis)])
            shared_m2 = rotation @ center_lever @ camera_cov @ center_lever.T @ rotation.T
            shared_rad2 = rotation @ axis_lever @ camera_cov @ axis_lever.T @ rotation.T
            cov_m2 = cov_m2 + shared_m2
            axis_cov_rad2 = axis_cov_rad2 + shared_rad2
        return HolePose(
            center_m=rotation @ self.center_m + shift,
            axis=rotation @ self.axis,
            radius_m=self.radius_m,
            cov_m2=cov_m2,
            axis_cov_rad2=axis_cov_rad2,
            frame="base",
            score=self.score,
            t_s=self.t_s,
            shared_m2=shared_m2,
            shared_rad2=shared_rad2,
        )

    def borehole(self) -> Borehole:
        """Returns it as the word that the rest of the framework knows; for a pose in the base frame."""
        return Borehole(self.center_m, self.axis, self.radius_m, self.cov_m2)


def _build_cross_matrix(vector: np.ndarray) -> np.ndarray:
    """Returns the matrix that takes the cross product with a vector from the left, `(3, 3)`."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


@dataclass(frozen=True)
class Rejection:
    """Why something was refused.

    Attributes:
        stage: `frame`, `segment`, `ellipse`, `pose` or `filter`.
        reason: What was judged, a noun: `radius`, `axis ratio`, `face normal`, …
        value: What it was, in the unit of `limit`.
        limit: What was allowed.
        ellipse: The ellipse that was refused, `None` where there was none.
    """

    stage: str
    reason: str
    value: float
    limit: float
    ellipse: Ellipse | None = None


@dataclass(frozen=True)
class Target:
    """What the filter holds to be true after several frames.

    Attributes:
        pose: The hole; its covariance counts what the frames agree on.
        num_frames: Frames that speak for it.
        age_s: Since it was last seen.
        stale: It has not been seen for so long that nobody should act on it.
    """

    pose: HolePose
    num_frames: int
    age_s: float
    stale: bool


@dataclass(frozen=True)
class FrameDetections:
    """Everything that came out of one frame.

    Attributes:
        holes: Holes, the surest first.
        rejected: All that was refused, in the order of the stages.
        ellipses: Ellipses that were judged, one for each hole and then those refused by the pose
            stage.
        masks: What the segmenter said, `None` where it was not asked.
        ms: Time of each stage in ms.
    """

    holes: Sequence[HolePose]
    rejected: Sequence[Rejection]
    ellipses: Sequence[Ellipse]
    masks: Masks | None
    ms: dict[str, float] = field(default_factory=dict)


class FrameSource(Protocol):
    """An open source of frames, live or from disk; a context manager."""

    @property
    def num_frames(self) -> int | None:
        """How many frames there are in all; `None` for a live source."""
        ...

    def read_latest(self) -> Frame | None:
        """Returns the newest frame that has not been returned yet, from disk the next one; `None` when there is none left.

        Raises:
            FrameError: this frame cannot be used, its message says which and why; the next call
                goes on with the next frame.
        """
        ...

    def __enter__(self) -> FrameSource: ...

    def __exit__(self, *exc: Any) -> None: ...


class Segmenter(Protocol):
    """Says which pixels show the block and the mouths of its holes."""

    def segment(self, frame: Frame) -> Masks:
        """Returns masks of the size of the frame."""
        ...


class EllipseDetector(Protocol):
    """Finds ellipses in a grey picture."""

    def detect(
        self, gray: np.ndarray, roi: np.ndarray | None, prior: SizePrior | None
    ) -> list[Ellipse]:
        """Returns ellipses, the best first.

        Args:
            gray: Picture, `(h, w)` uint8.
            roi: Where to look, `(h, w)` bool; `None` for everywhere.
            prior: How large they may be; `None` for any size.
        """
        ...


class PoseEstimator(Protocol):
    """Makes a hole in space of an ellipse in a picture."""

    def estimate(self, frame: Frame, masks: Masks, ellipse: Ellipse) -> HolePose | Rejection:
        """Returns the hole in camera coordinates, or why it is none. `frame` is free of lens distortion."""
        ...


class HoleTracker(Protocol):
    """Makes one target of what is seen frame after frame."""

    def update(self, poses: Sequence[HolePose], t_s: float) -> Target | None:
        """Takes the holes seen at `t_s`, none at all too; returns what is held to be true now, `None` as long as nothing is."""
        ...

    def reset(self) -> None:
        """Forgets everything."""
        ...


class Observer(Protocol):
    """A finder that shows its work: what `build` of an option of `conf/perception` returns when it looks at pictures."""

    def find(self, frame: Frame) -> Borehole | None:
        """Returns the borehole in the base frame, or `None` when there is none to be sure of."""
        ...

    def look(self, frame: Frame) -> FrameDetections:
        """Returns everything that one frame says.

        Raises:
            FrameError: nothing can be made of the frame.
        """
        ...

    def follow(self, sighting: FrameDetections, t_s: float) -> Target | None:
        """Returns what the filter holds to be true after this sighting as well."""
        ...

    def ellipses(self, frame: Frame) -> list[Ellipse]:
        """Returns the ellipses of the whole picture, the best first, of any size; needs no depth."""
        ...

    def explain(self, rejection: Rejection) -> str:
        """Returns in words what was refused, why, and what could be done."""
        ...


class Overlay(Protocol):
    """Draws what was seen into the picture in which it was seen."""

    def write(self, path: Path, frame: Frame, sighting: FrameDetections) -> None:
        """Writes a picture file.

        Raises:
            StorageError: it could not be written.
        """
        ...


class FrameSourceSpec(Protocol):
    """A spec in `conf/perception/source`."""

    def build(self) -> FrameSource:
        """Returns a source, not yet opened."""
        ...


class SegmenterSpec(Protocol):
    """A spec in `conf/perception/segmenter`."""

    def build(self) -> Segmenter:
        """Returns a segmenter."""
        ...


class EllipseDetectorSpec(Protocol):
    """A spec in `conf/perception/ellipse`."""

    def build(self) -> EllipseDetector:
        """Returns a detector."""
        ...


class PoseEstimatorSpec(Protocol):
    """A spec in `conf/perception/pose`."""

    def build(self) -> PoseEstimator:
        """Returns an estimator."""
        ...


class TrackerSpec(Protocol):
    """A spec in `conf/perception/filter`."""

    def build(self) -> HoleTracker:
        """Returns a filter without memory yet."""
        ...


class BoreholeFinder(Protocol):
    """Finds the borehole in a frame."""

    def find(self, frame: Frame) -> Borehole | None:
        """Returns the borehole in the base frame, or `None` when there is none to be sure of."""
        ...


class FinderSpec(Protocol):
    """A spec in `conf/perception`: builds a finder."""

    def build(self) -> BoreholeFinder:
        """Returns a finder."""
        ...
