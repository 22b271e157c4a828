"""Camera process: publishes the newest frame, and the boreholes that a finder sees in it.

It waits only for the camera, and no other process waits for it. If it dies, the last frame shown
grows old.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence
from contextlib import ExitStack
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge

from brokk_rl.contracts.vision import (
    AimedSource,
    BoreholeFinder,
    FinderSpec,
    FrameSource,
    FrameSourceSpec,
    HolePose,
    TrackedHole,
    TrackerSpec,
)
from brokk_rl.errors import FrameError
from brokk_rl.signals import Frame
from brokk_rl.spec import NonNegative, Positive, spec
from deploy.picture import shrink_frame
from deploy.runtime.process import Stop
from deploy.runtime.shared_memory import Slot
from deploy.runtime.shm_layout import HOLE, MOST_HOLES, LoopMemory, log_text
from deploy.runtime.target import NEAR_M, read_holes

log = logging.getLogger(__name__)

MESSAGE_INTERVAL_S = 10.0
"""Shortest time between two messages about frames that cannot be used."""
SMALLEST_PICTURE_PX = 256
"""Pixels below which a handed-on frame shows nothing."""


@spec
class CameraConfig:
    """A camera beside the loop, and the finder that searches its frames.

    Attributes:
        source: Source of the frames.
        finder: Finds boreholes in them; `null`: none, a person at the page can still point at one.
        tracker: Follows the boreholes over the frames.
        rate_hz: Frames a second at most.
        num_px: Pixels of a frame that are handed on; larger ones are shrunk. The finder gets them
            whole.
        stale_s: Age from which the picture is shown as old.
        record_hz: Pictures a second that are recorded; 0: none.
    """

    source: FrameSourceSpec
    finder: FinderSpec | None
    tracker: TrackerSpec
    rate_hz: Positive
    num_px: Annotated[int, Ge(SMALLEST_PICTURE_PX)]
    stale_s: Positive
    record_hz: NonNegative

    def check_frames(self) -> None:
        """Check before any process starts that stored frames are there; a live camera may come later.

        Raises:
            FrameError: there are none.
        """
        try:
            _ = self.source.build().num_frames
        except FrameError as error:
            raise FrameError(
                f"deploy.camera.source: expected frames, got none ({error}); give a folder that holds "
                "some by source.folder=<folder>"
            ) from error


def run(stop: Stop, camera: CameraConfig, memory: LoopMemory) -> None:
    """Run until asked to stop, or until the source is at its end.

    Raises:
        FrameError: there is no such camera.
    """
    finder = camera.finder.build() if camera.finder else None
    tracker, complained_s = camera.tracker.build(), -math.inf
    tracked: Sequence[TrackedHole] = ()
    with ExitStack() as stack:
        source: FrameSource = stack.enter_context(camera.source.build())
        while not stop():
            began_s = time.monotonic()
            if isinstance(source, AimedSource):
                point_camera(source, memory, tracked, began_s)
            try:
                frame = source.read_latest()
            except FrameError as error:
                if began_s - complained_s > MESSAGE_INTERVAL_S:
                    log.warning("%s", error)
                    complained_s = began_s
                time.sleep(0.5 / camera.rate_hz)
                continue
            if frame is None:
                log.warning("the camera has delivered its last frame")
                return
            now_s = time.monotonic()
            _publish_frame(memory.frame, frame, camera.num_px, now_s)
            if finder is not None and frame.base_from_camera is not None:
                tracked = tracker.update(_find_holes(finder, frame), now_s)
                write_holes(memory.holes, tracked, now_s)
                known = {"holes": _list_holes(memory.holes)}
                log_text(memory.vision_log, "holes", now_s, known)
            time.sleep(max(0.0, began_s + 1.0 / camera.rate_hz - time.monotonic()))


def point_camera(
    source: AimedSource, memory: LoopMemory, tracked: Sequence[TrackedHole], t_s: float
) -> None:
    """Let a moving camera choose its view of the chosen hole, and publish it with the reason."""
    state, target = memory.state.read(), memory.target.read()
    hole = None
    if target is not None:
        center_m = np.array(target["center_in_base_m"])
        away_m = {one.name: float(np.linalg.norm(one.pose.center_m - center_m)) for one in tracked}
        near = [one for one in tracked if away_m[one.name] <= NEAR_M]
        hole = min(near, key=lambda one: away_m[one.name], default=None)
    view = source.aim(None if state is None else np.array(state.q), hole, t_s)
    if view is None:
        return
    memory.view.write(view)
    log_text(memory.vision_log, "view", t_s, vars(view))


def _find_holes(finder: BoreholeFinder, frame: Frame) -> Sequence[HolePose]:
    """Return the boreholes of one frame in the base frame, none if it cannot be used."""
    try:
        return finder.find(frame).in_base_frame(frame).holes
    except FrameError as error:
        log.debug("%s", error)
        return []


def write_holes(slot: Slot, tracked: Sequence[TrackedHole], t_s: float) -> None:
    """Publish the known boreholes; the surest ones where there are too many for the record."""
    surest = sorted(tracked, key=lambda hole: -hole.pose.score)[:MOST_HOLES]
    record = slot.new()
    record["t_s"], record["count"] = t_s, len(surest)
    for row, hole in enumerate(sorted(surest, key=lambda hole: hole.name)):
        entry = record["holes"][row]
        entry["name"], entry["std_m"], entry["t_s"] = hole.name, hole.std_m, hole.seen_s
        entry["center_in_base_m"], entry["axis_in_base"] = hole.pose.center_m, hole.pose.axis
        entry["radius_m"], entry["score"] = hole.pose.radius_m, hole.pose.score
    slot.write(record)


def _list_holes(slot: Slot) -> list[dict[str, Any]]:
    """Return the published boreholes as plain data for the log."""
    plain = []
    for hole in read_holes(slot):
        found = {name: hole[name].tolist() for name in HOLE.names or ()}
        plain.append(found | {"seen_t_s": found.pop("t_s")})
    return plain


def _publish_frame(slot: Slot, frame: Frame, num_px: int, t_s: float) -> None:
    """Publish a frame, shrunk to the room that there is."""
    full_height, full_width = frame.color.shape[:2]
    frame = shrink_frame(frame, math.isqrt(num_px * full_width // full_height))
    height, width = frame.color.shape[:2]
    count = width * height
    record = slot.new()
    record["t_s"], record["width"], record["height"] = t_s, width, height
    record["color"][:count] = frame.color.reshape(count, 3)
    record["depth_m"][:count] = frame.depth_m.reshape(count)
    record["camera_matrix"] = frame.camera_matrix
    pose = frame.base_from_camera
    record["base_from_camera"] = math.nan if pose is None else pose
    slot.write(record)


def read_frame(record: Any) -> Frame:
    """Return the frame that a record of `shm_layout.build_frame_fields` holds."""
    width, height = int(record["width"]), int(record["height"])
    pose = np.array(record["base_from_camera"])
    return Frame(
        color=np.array(record["color"][: width * height]).reshape(height, width, 3),
        depth_m=np.array(record["depth_m"][: width * height]).reshape(height, width),
        camera_matrix=np.array(record["camera_matrix"]),
        base_from_camera=pose if np.isfinite(pose).all() else None,
        t_s=float(record["t_s"]),
    )


def read_newer_frame(slot: Slot, after_s: float) -> Frame | None:
    """Return the newest frame if it is later than `after_s`, else `None`."""
    # The time alone is read first: copying a picture that has not changed would cost milliseconds.
    taken_s = slot.peek("t_s")
    if taken_s is None or taken_s <= after_s:
        return None
    record = slot.read()
    return None if record is None else read_frame(record)
