"""Contracts of perception: frame sources, finders, trackers, and what they return.

A finder is an option of `conf/perception`: a spec whose `build()` returns a `BoreholeFinder`. Its
one method is `find(frame) -> FrameDetections`. `mode=perceive` and the camera process call nothing
else; both hand the holes of each frame to one `HoleTracker`. The parts of the shipped finder
(`perception.finder`) have contracts of their own in `perception.contracts`.

Pictures are `(h, w)` or `(h, w, 3)`, RGB, uint8; pixel centres lie at whole numbers. Camera
coordinates follow the optical convention (x right, y down, z forward). Depth is z in m, `NaN` where
it is unknown, never 0 or infinite. Times `t_s` are in s, of one clock.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np

from brokk_rl.signals import Frame


@dataclass(frozen=True)
class Masks:
    """Masks of one frame: the block, and the inside of its holes.

    Attributes:
        block: Probability that a pixel shows the block, `(h, w)` float32 in [0, 1].
        hole_mask: Probability that a pixel shows the inside of a hole, `(h, w)` float32 in [0, 1];
            `None` from a segmenter that does not look for holes.
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
        score: Confidence in [0, 1].
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
class HolePose:
    """A borehole as seen in one frame, or averaged over several.

    Attributes:
        center_m: Centre of the rim, `(3,)`.
        axis: Unit axis, pointing out of the hole, `(3,)`.
        radius_m: Radius of the rim.
        cov_m2: Covariance of the centre, `(3, 3)`.
        axis_cov_rad2: Covariance of the axis, `(3, 3)`, singular along it.
        frame: Coordinates of all of it: `camera` (optical) or `base`.
        score: Confidence that it is a hole, in [0, 1].
        t_s: Time of the frame.
        shared_m2: Part of `cov_m2` that all frames share: the errors of the camera's pose and of
            the pair's disparity. Averaging over frames does not reduce it. `None` for none.
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
        """Return the pose in the base frame, in which it may be already.

        Args:
            base_from_camera: Pose of the camera, `(4, 4)`.
            camera_cov: Covariance of that pose, see `Frame`; it adds to the covariances.
        """
        if self.frame == "base":
            return self
        rotation, shift = base_from_camera[:3, :3], base_from_camera[:3, 3]
        # First order: a small motion (shift, turn) of the camera moves the centre by
        # shift - center x turn, and the axis by -axis x turn.
        center_lever = np.hstack([np.eye(3), -np.cross(np.eye(3), self.center_m)])
        axis_lever = np.hstack([np.zeros((3, 3)), -np.cross(np.eye(3), self.axis)])
        levers = {"cov_m2": center_lever, "axis_cov_rad2": axis_lever}
        levers |= {"shared_m2": center_lever, "shared_rad2": axis_lever}
        turned: dict[str, Any] = {}
        for name, lever in levers.items():
            covariance = getattr(self, name)
            if camera_cov is not None:
                of_camera = lever @ camera_cov @ lever.T
                covariance = of_camera if covariance is None else covariance + of_camera
            turned[name] = None if covariance is None else rotation @ covariance @ rotation.T
        center_m = rotation @ self.center_m + shift
        axis = rotation @ self.axis
        return replace(self, center_m=center_m, axis=axis, frame="base", **turned)


@dataclass(frozen=True)
class Rejection:
    """A refused candidate and the limit that it missed.

    Attributes:
        stage: `frame`, `segment`, `ellipse` or `pose`.
        reason: Quantity that was judged: `radius, m`, `axis ratio on the face`, …
        value: Its value, in the unit of `limit`.
        limit: Allowed value.
        ellipse: The refused ellipse, `None` where there was none.
    """

    stage: str
    reason: str
    value: float
    limit: float
    ellipse: Ellipse | None = None


@dataclass(frozen=True)
class FrameDetections:
    """Result of a finder for one frame; only `holes` is required.

    Attributes:
        holes: Holes, the surest first.
        rejected: Refused candidates, in the order of the stages.
        ellipses: Judged ellipses: one for each hole, then those that the pose stage refused.
        masks: Masks of the segmenter, `None` without one.
        ms: Duration of each stage, ms.
    """

    holes: Sequence[HolePose]
    rejected: Sequence[Rejection] = ()
    ellipses: Sequence[Ellipse] = ()
    masks: Masks | None = None
    ms: dict[str, float] = field(default_factory=dict)

    def in_base_frame(self, frame: Frame) -> FrameDetections:
        """Return the same with all holes in the base frame, as they are if the camera's pose is unknown."""
        if frame.base_from_camera is None:
            return self
        holes = [hole.moved(frame.base_from_camera, frame.camera_cov) for hole in self.holes]
        return replace(self, holes=holes)


@dataclass(frozen=True)
class TrackedHole:
    """A borehole over many frames.

    Attributes:
        name: Number that it keeps from the first frame on, counted from 1.
        pose: Its pose; the covariance of the centre takes all frames into account.
        std_m: Standard deviation of one coordinate of the centre.
        num_frames: Detections that it is made of.
        seen_s: Time of its last detection.
        confirmed: It was detected often enough to be no accident.
        stale: Its last detection is too old to act on.
    """

    name: int
    pose: HolePose
    std_m: float
    num_frames: int
    seen_s: float
    confirmed: bool
    stale: bool


@dataclass(frozen=True)
class CameraView:
    """Where a camera on a mount looks, and why.

    Attributes:
        name: Position of the mount in words.
        is_moving: It is on its way there.
        travel_s: Time until it stands there; 0 where it stays.
        seen_s: Part of the coming `horizon_s` for which the hole will be seen from there.
        seen_before_s: The same had it stayed where it was.
        horizon_s: Time ahead that is looked at.
        std_m: Expected standard deviation of one coordinate of the hole after that time.
        std_before_m: The same had it stayed.
    """

    name: str
    is_moving: bool
    travel_s: float
    seen_s: float
    seen_before_s: float
    horizon_s: float
    std_m: float
    std_before_m: float


class BoreholeFinder(Protocol):
    """Finds boreholes in frames, as `mode=perceive` and the camera process call it."""

    def find(self, frame: Frame) -> FrameDetections:
        """Return the holes of one frame, in camera coordinates or in the base frame.

        The frame is read-only. No hole is no error. The frames are those of one camera, in order: a
        finder may remember that its pair was good, and answer a frame that shows too little to tell
        by that. Otherwise the same frame gives the same answer.

        Raises:
            FrameError: the frame cannot be used; its message says why.
        """
        ...


class FinderSpec(Protocol):
    """A spec in `conf/perception`."""

    def build(self) -> BoreholeFinder:
        """Return a finder."""
        ...


class HoleTracker(Protocol):
    """Associates the holes of successive frames."""

    def update(self, holes: Sequence[HolePose], t_s: float) -> Sequence[TrackedHole]:
        """Take the holes of the frame at `t_s`, possibly none; return all known ones by name."""
        ...


class TrackerSpec(Protocol):
    """The spec in `conf/tracker.yaml`."""

    def build(self) -> HoleTracker:
        """Return a tracker that has seen nothing yet."""
        ...


class FrameSource(Protocol):
    """An open source of frames, live or from disk; a context manager."""

    @property
    def num_frames(self) -> int | None:
        """Number of frames; `None` for a live source."""
        ...

    def read_latest(self) -> Frame | None:
        """Return the newest frame not returned yet, from disk the next one; `None` at the end.

        Raises:
            FrameError: this frame cannot be used, its message says which and why; the next call
                goes on with the next frame.
        """
        ...

    def __enter__(self) -> FrameSource: ...

    def __exit__(self, *exc: Any) -> None: ...


@runtime_checkable
class AimedSource(Protocol):
    """Optional ability of a source: its camera is moved to where it sees the hole."""

    def aim(self, q: np.ndarray | None, hole: TrackedHole | None, t_s: float) -> CameraView | None:
        """Choose where to look, and go there; called before each `read_latest`.

        Args:
            q: Joint positions of the machine, `(J,)`; `None` for unknown.
            hole: The chosen hole as tracked; `None` before it was seen.
            t_s: Time of the call.

        Returns:
            The view and the reason; `None` before the positions are known.
        """
        ...


class FrameSourceSpec(Protocol):
    """A spec in `conf/perception/source`."""

    def build(self) -> FrameSource:
        """Return a source, not yet opened."""
        ...
