"""The perception process: the camera's newest frame for page and log, and the boreholes that are seen in it.

It waits for the camera and for nobody else, and nobody waits for it: if it dies, the last frame
grows old where it is shown.
"""

from __future__ import annotations

import json
import logging
import math
import time
from contextlib import ExitStack
from typing import Any

import numpy as np

from brokk_rl.contracts.vision import FinderSpec, FrameSource, FrameSourceSpec, HolePose, Observer
from brokk_rl.errors import ConfigError, FrameError
from brokk_rl.signals import Frame
from brokk_rl.spec import spec
from deploy.picture import shrink_picture
from deploy.runtime.bus_process import TEXT
from deploy.runtime.process import Stop
from deploy.runtime.shared_memory import Slot
from deploy.runtime.shm_layout import MOST_HOLES, LoopMemory
from deploy.runtime.target import NEAR_M

log = logging.getLogger(__name__)

MEMORY = 10
"""Sightings, at most, that count against a new one: a base that was moved is noticed within
seconds."""
QUIET_S = 10.0
"""Between two messages about frames that cannot be used."""


@spec
class CameraConfig:
    """A camera beside the loop, and what is looked for in its frames.

    Attributes:
        source: Where frames come from.
        finder: Finds boreholes in them; `null`: nobody looks, a person at the page can still point
            at one.
        rate_hz: Frames a second at most.
        num_px: Pixels of a frame that are handed on; larger ones are shrunk, perception has them
            whole.
        forget_s: Time after which a borehole that is not seen any more is forgotten.
        stale_s: Age from which the picture is shown as old.
        record_hz: Pictures a second that are recorded; 0: none.
    """

    source: FrameSourceSpec
    finder: FinderSpec | None
    rate_hz: float
    num_px: int
    forget_s: float
    stale_s: float
    record_hz: float

    def check(self) -> None:
        if (
            min(self.rate_hz, self.forget_s, self.stale_s) <= 0
            or self.record_hz < 0
            or self.num_px < 256
        ):
            raise ConfigError(
                "camera: expected rate_hz, forget_s and stale_s above 0, record_hz of 0 or more, num_px of 256 or more"
            )


def run(stop: Stop, camera: CameraConfig, exchange: LoopMemory) -> None:
    """Runs until it is asked to stop, or the source is at its end.

    Raises:
        FrameError: there is no such camera.
    """
    assert exchange.frame is not None
    finder = camera.finder.build() if camera.finder else None
    known, complained_s = KnownHoles(camera.forget_s), -math.inf
    with ExitStack() as stack:
        source: FrameSource = stack.enter_context(camera.source.build())
        while not stop():
            began_s = time.monotonic()
            try:
                frame = source.read_latest()
            except FrameError as error:
                if began_s - complained_s > QUIET_S:
                    log.warning("%s", error)
                    complained_s = began_s
                time.sleep(0.5 / camera.rate_hz)
                continue
            if frame is None:
                log.warning("the camera is at its end; nothing new is seen any more")
                return
            now_s = time.monotonic()
            _publish(exchange.frame, frame, camera.num_px, now_s)
            if finder is not None and frame.base_from_camera is not None:
                known.take(_look(finder, frame), now_s)
                known.write(exchange.holes, now_s)
                text = {"topic": "holes", "t_s": now_s, "holes": known.plain()}
                exchange.vision_log.put(TEXT + json.dumps(text).encode())
            time.sleep(max(0.0, began_s + 1.0 / camera.rate_hz - time.monotonic()))


def _look(finder: Any, frame: Frame) -> list[HolePose]:
    """Returns the boreholes in the base frame that one frame shows."""
    observer: Observer = finder
    try:
        found = observer.look(frame).holes
    except FrameError as error:
        log.debug("%s", error)
        return []
    assert frame.base_from_camera is not None
    return [
        hole if hole.frame == "base" else hole.moved(frame.base_from_camera, frame.camera_cov)
        for hole in found
    ]


def _publish(slot: Slot, frame: Frame, num_px: int, t_s: float) -> None:
    """Hands a frame on, shrunk to what there is room for."""
    height, width = frame.color.shape[:2]
    part = min(1.0, math.sqrt(num_px / (width * height)))
    size = int(part * width), int(part * height)
    color, depth_m = (
        (frame.color, frame.depth_m)
        if part == 1.0
        else (shrink_picture(frame.color, *size), shrink_picture(frame.depth_m, *size))
    )
    count = size[0] * size[1]
    record = slot.new()
    record["t_s"], record["width"], record["height"] = t_s, *size
    record["color"][:count], record["depth_m"][:count] = (
        color.reshape(count, 3),
        depth_m.reshape(count),
    )
    record["camera_matrix"] = frame.camera_matrix * np.array([[part], [part], [1.0]])
    record["base_from_camera"] = (
        math.nan if frame.base_from_camera is None else frame.base_from_camera
    )
    slot.write(record)


def read_frame(record: Any) -> Frame:
    """Returns the frame that a record of `frame_fields` holds."""
    width, height = int(record["width"]), int(record["height"])
    pose = np.array(record["base_from_camera"])
    return Frame(
        color=np.array(record["color"][: width * height]).reshape(height, width, 3),
        depth_m=np.array(record["depth_m"][: width * height]).reshape(height, width),
        camera_matrix=np.array(record["camera_matrix"]),
        base_from_camera=pose if np.isfinite(pose).all() else None,
        t_s=float(record["t_s"]),
    )


class KnownHoles:
    """Boreholes over many frames, each under the name that it got when it was first seen.

    What a new frame says counts by its variance against what was known, of which no more than
    `MEMORY` sightings count. What the camera's pose is wrong by is the same in all of them: it is
    no reason to trust one frame more than another, and it stays.

    Args:
        forget_s: Time after which one that is not seen any more is forgotten.
    """

    def __init__(self, forget_s: float) -> None:
        self._forget_s, self._names = forget_s, 0
        self._holes: dict[int, dict[str, Any]] = {}

    def take(self, found: list[HolePose], now_s: float) -> None:
        """Takes in what one frame shows."""
        for pose in found:
            shared = 0.0 if pose.shared_m2 is None else float(np.trace(pose.shared_m2)) / 3
            weight = 1.0 / max(1e-8, float(np.trace(pose.cov_m2)) / 3 - shared)
            name = min(self._holes, key=lambda one: self._apart_m(one, pose), default=None)
            if name is None or self._apart_m(name, pose) > NEAR_M:
                self._names += 1
                name, before, center_m = self._names, 0.0, pose.center_m
            else:
                old = self._holes[name]
                before = min(old["weight"], MEMORY * weight)
                center_m = (before * old["center_in_base_m"] + weight * pose.center_m) / (
                    before + weight
                )
            self._holes[name] = {
                "center_in_base_m": center_m, "axis_in_base": pose.axis, "radius_m": pose.radius_m, "score": pose.score,
                "weight": before + weight, "shared_m2": shared, "t_s": now_s,
            }  # fmt: skip
        self._holes = {
            name: hole
            for name, hole in self._holes.items()
            if now_s - hole["t_s"] <= self._forget_s
        }

    def write(self, slot: Slot, now_s: float) -> None:
        """Makes what is known the newest; the surest where there are too many."""
        record = slot.new()
        surest = sorted(
            sorted(self._holes, key=lambda name: -self._holes[name]["score"])[:MOST_HOLES]
        )
        record["t_s"], record["count"] = now_s, len(surest)
        for row, name in enumerate(surest):
            for field, value in self._holes[name].items():
                if field not in ("weight", "shared_m2"):
                    record["holes"][row][field] = value
            record["holes"][row]["name"], record["holes"][row]["std_m"] = name, self._std_m(name)
        slot.write(record)

    def plain(self) -> list[dict[str, Any]]:
        """Returns what is known as plain data."""
        return [
            {"name": name, "center_in_base_m": np.round(hole["center_in_base_m"], 4).tolist(), "std_m": round(self._std_m(name), 5),
             "score": round(float(hole["score"]), 3), "seen_t_s": hole["t_s"]}
            for name, hole in self._holes.items()
        ]  # fmt: skip

    def _std_m(self, name: int) -> float:
        hole = self._holes[name]
        return math.sqrt(1.0 / hole["weight"] + hole["shared_m2"])

    def _apart_m(self, name: int, pose: HolePose) -> float:
        return float(np.linalg.norm(self._holes[name]["center_in_base_m"] - pose.center_m))
