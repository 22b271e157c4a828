"""Pictures of a camera in a ROS log: a bag of ROS 1, a bag folder of ROS 2, or an MCAP file."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from brokk_rl.errors import FrameError
from brokk_rl.spec import Positive, spec
from perception.camera import CameraModel, RawFrame
from perception.sources import validation

CHANNELS = {
    "rgb8": (np.uint8, 3), "bgr8": (np.uint8, 3), "rgba8": (np.uint8, 4), "bgra8": (np.uint8, 4),
    "mono8": (np.uint8, 1), "8UC1": (np.uint8, 1), "8UC3": (np.uint8, 3), "mono16": (np.uint16, 1),
    "16UC1": (np.uint16, 1), "32FC1": (np.float32, 1),
}  # fmt: skip
"""Type and channels of the encodings of `sensor_msgs/Image`."""
IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO = "sensor_msgs/msg/CameraInfo"
COMPRESSED_DEPTH_HEAD = 12
"""Bytes before the PNG of a `compressedDepth` picture."""


@spec
class RosLog:
    """Read the pictures of a ROS log; the messages of one moment are a frame.

    Attributes:
        input: `.bag`, `.mcap`, or the folder of a ROS 2 bag.
        color: Topic of the left or only picture, or a pattern of it.
        right: Topic of the right one; `null` for none.
        depth: Topic of depth, aligned to the left picture; `null` for none.
        together_s: Largest difference of the stamps of one frame.
    """

    input: str
    color: str
    right: str | None
    depth: str | None
    together_s: Positive

    def read(self) -> Iterator[RawFrame]:
        """Yield frames in the order of their time.

        Raises:
            FrameError: the log cannot be read, lacks a topic, or holds a picture of another kind.
        """
        topics: dict[str, str] = {}
        waiting: dict[str, tuple[float, np.ndarray]] = {}
        lenses: dict[str, Any] = {}
        for topic, kind, stamp_s, message in _read_messages(Path(self.input)):
            if kind == INFO:
                lenses[topic.rsplit("/", 1)[0]] = message
                continue
            role = self._find_role(topic, topics)
            if role is None or kind not in IMAGES:
                continue
            waiting[role] = stamp_s, decode_picture(message, kind, topic)
            newest_s = max(taken_s for taken_s, _ in waiting.values())
            old = [one for one, (t_s, _) in waiting.items() if newest_s - t_s > self.together_s]
            for one in old:
                del waiting[one]
            wanted = {"color"} | {one for one in ("right", "depth") if getattr(self, one)}
            if set(waiting) == wanted:
                yield self._join(waiting, topics, lenses, stamp_s)
                waiting.clear()
        for role in ("color", "right", "depth"):
            if getattr(self, role) and role not in topics:
                raise FrameError(
                    f"capture.{role}={getattr(self, role)}: no such topic of pictures in {self.input}; "
                    f"`brokk mode=import log.input={self.input}` lists what is in it"
                )

    def _find_role(self, topic: str, topics: dict[str, str]) -> str | None:
        """Return which picture of a frame a topic holds, `None` for none; keeps what it found."""
        for role in ("color", "right", "depth"):
            pattern = getattr(self, role)
            if pattern and fnmatch(topic, pattern) and topics.setdefault(role, topic) == topic:
                return role
        return None

    def _join(
        self,
        waiting: dict[str, tuple[float, np.ndarray]],
        topics: dict[str, str],
        lenses: dict[str, Any],
        stamp_s: float,
    ) -> RawFrame:
        """Return the frame of some pictures."""
        name = f"{self.input}, {stamp_s:.3f} s"
        pictures = {}
        for role in ("color", "right"):
            if role in waiting:
                pictures[role] = validation.convert_color(waiting[role][1], f"{name}, {role}")
        depth_m = None
        if "depth" in waiting:
            raw = waiting["depth"][1]
            depth_m = raw.astype(np.float32) * np.float32(0.001 if raw.dtype == np.uint16 else 1.0)
            depth_m = np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, np.float32(np.nan))
        infos = [
            lenses.get(topics[one].rsplit("/", 1)[0]) for one in ("color", "right") if one in topics
        ]
        camera = None
        if infos and infos[0] is not None:
            is_raw = "rect" not in topics["color"]
            camera = _read_lens(infos[0], infos[1] if len(infos) > 1 else None, is_raw)
        return RawFrame(pictures["color"], pictures.get("right"), depth_m, stamp_s, name, camera)


def decode_picture(message: Any, kind: str, topic: str) -> np.ndarray:
    """Return the picture of a message as OpenCV reads it, blue first.

    Raises:
        FrameError: its encoding is unknown, or it is damaged.
    """
    data = np.frombuffer(bytes(message.data), np.uint8)
    if kind == "sensor_msgs/msg/CompressedImage":
        is_depth = "compressedDepth" in message.format
        data = data[COMPRESSED_DEPTH_HEAD:] if is_depth else data
        picture = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
        if picture is None:
            raise FrameError(f"{topic}: a compressed picture ({message.format}) that is damaged")
        return np.asarray(picture)
    if message.encoding not in CHANNELS:
        raise FrameError(
            f"{topic}: encoding '{message.encoding}', expected one of {', '.join(CHANNELS)}"
        )
    dtype, channels = CHANNELS[message.encoding]
    order = ">" if message.is_bigendian else "<"
    rows = data.reshape(message.height, message.step)
    used = message.width * channels * np.dtype(dtype).itemsize
    values = np.ascontiguousarray(rows[:, :used]).view(np.dtype(dtype).newbyteorder(order))
    picture = values.astype(dtype).reshape(message.height, message.width, channels)
    if message.encoding.startswith("rgb"):
        picture = np.concatenate([picture[..., 2::-1], picture[..., 3:]], axis=2)
    return picture[..., 0] if channels == 1 else picture


def _read_lens(left: Any, right: Any | None, is_raw: bool) -> CameraModel:
    """Return the camera of `CameraInfo` messages; those of raw pictures are rectified by them."""

    def read(message: Any, *names: str) -> np.ndarray:
        name = next(name for name in names if hasattr(message, name))
        return np.asarray(getattr(message, name), float)

    projection = read(left, "p", "P").reshape(3, 4)
    matrix = read(left, "k", "K").reshape(3, 3)
    has_projection = bool(projection[0, 0] > 0)
    baseline_m = None
    if right is not None:
        other = read(right, "p", "P").reshape(3, 4)
        baseline_m = abs(float(other[0, 3] / other[0, 0])) or None
    size_px = int(left.width), int(left.height)
    if not is_raw or not has_projection:
        distortion = read(left, "d", "D") if is_raw else None
        rectified = projection[:, :3] if has_projection and not is_raw else matrix
        return CameraModel(rectified, distortion, baseline_m, size_px)
    maps = []
    for message in (left, right):
        if message is not None:
            maps.append(
                cv2.initUndistortRectifyMap(
                    read(message, "k", "K").reshape(3, 3), read(message, "d", "D"),
                    read(message, "r", "R").reshape(3, 3), read(message, "p", "P").reshape(3, 4),
                    size_px, cv2.CV_32FC1,
                )
            )  # fmt: skip
    return CameraModel(projection[:, :3], None, baseline_m, size_px, maps=tuple(maps))


def _read_messages(path: Path) -> Iterator[tuple[str, str, float, Any]]:
    """Yield topic, type, stamp in s and message of each picture and lens of a log.

    Raises:
        FrameError: it cannot be read, or a package for it is missing.
    """
    if not path.exists():
        raise FrameError(f"capture.input={path}: no such file or folder")
    try:
        reader = importlib.import_module("rosbags.highlevel").AnyReader
        stores = importlib.import_module("rosbags.typesys")
    except ImportError as error:
        raise FrameError(
            "capture=ros: the package `rosbags` is not installed; pip install 'brokk-rl[logs]'"
        ) from error
    default = stores.get_typestore(stores.Stores.ROS2_HUMBLE)
    if path.suffix == ".mcap":
        yield from _read_mcap(path, default)
        return
    try:
        with reader([path], default_typestore=default) as log:
            wanted = [one for one in log.connections if one.msgtype in (*IMAGES, INFO)]
            for connection, _, data in log.messages(wanted):
                message = log.deserialize(data, connection.msgtype)
                yield connection.topic, connection.msgtype, _read_stamp_s(message), message
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        raise FrameError(f"{path}: cannot be read as a ROS log ({error})") from error


def _read_mcap(path: Path, store: Any) -> Iterator[tuple[str, str, float, Any]]:
    """Yield the same of an MCAP file, which needs no folder around it."""
    make_reader = importlib.import_module("mcap.reader").make_reader
    with path.open("rb") as file:
        try:
            for schema, channel, message in make_reader(file).iter_messages():
                kind = "" if schema is None else schema.name
                if kind in (*IMAGES, INFO) and channel.message_encoding == "cdr":
                    found = store.deserialize_cdr(message.data, kind)
                    yield channel.topic, kind, _read_stamp_s(found), found
        except Exception as error:  # the library has no error of its own for a damaged file
            raise FrameError(f"{path}: cannot be read as MCAP ({error})") from error


def _read_stamp_s(message: Any) -> float:
    stamp = message.header.stamp
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)
