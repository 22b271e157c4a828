"""Pictures of a camera as its owner has them: its library, a video, a device, files, or a ROS log.

ROS logs are a bag of ROS 1, a bag folder of ROS 2, or an MCAP file.
"""

from __future__ import annotations

import importlib
import itertools
import re
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from brokk_rl.contracts.vision import FrameSourceSpec
from brokk_rl.errors import FrameError
from brokk_rl.spec import Positive, spec
from perception.camera import CameraModel, RawFrame
from perception.sources import validation
from perception.sources.folder import read_picture

NUMBER = re.compile(r"(\d+)(?!.*\d)")
"""The last number of a file's name: which frame it belongs to."""


@spec
class SourceCapture:
    """Frames of a camera with a library of its own: an option of `conf/perception/source`.

    Attributes:
        source: The camera, or a recording of it.
    """

    source: FrameSourceSpec

    def read(self) -> Iterator[RawFrame]:
        """Yield frames until a recording ends; a camera has no end.

        Raises:
            FrameError: the camera cannot be opened, or gives no frame in time.
        """
        with self.source.build() as source:
            for number, frame in enumerate(iter(source.read_latest, None)):
                size_px = frame.color.shape[1], frame.color.shape[0]
                lens = (frame.camera_matrix, frame.distortion, frame.baseline_m, size_px)
                pictures = (frame.color, frame.right, frame.depth_m)
                yield RawFrame(*pictures, frame.t_s, f"frame {number}", CameraModel(*lens))


@spec
class StereoVideo:
    """A video file, or a camera that OpenCV opens.

    Attributes:
        input: A file, or the number of a device: 0 is the first camera.
        layout: Where both pictures are in one: side by side as a ZED gives them, one above the
            other, or `single` for a left picture alone.
        rate_hz: Of a device, asked of it; `null` leaves it as it is.
        size_px: Width and height of a device's picture, asked of it; `null` leaves it as it is.
    """

    input: str | int
    layout: Literal["side_by_side", "above", "single"]
    rate_hz: float | None
    size_px: tuple[int, int] | None

    def read(self) -> Iterator[RawFrame]:
        """Yield frames until the video ends; a device has no end.

        Raises:
            FrameError: it cannot be opened, or cannot be cut into two pictures.
        """
        is_device = str(self.input).isdigit()
        if not is_device and not Path(str(self.input)).is_file():
            raise FrameError(
                f"capture.input={self.input}: no such file; expected a video, or the number of a "
                "camera such as 0"
            )
        video = cv2.VideoCapture(int(self.input) if is_device else str(self.input))
        if is_device and self.size_px is not None:
            video.set(cv2.CAP_PROP_FRAME_WIDTH, self.size_px[0])
            video.set(cv2.CAP_PROP_FRAME_HEIGHT, self.size_px[1])
        if is_device and self.rate_hz is not None:
            video.set(cv2.CAP_PROP_FPS, self.rate_hz)
        try:
            if not video.isOpened():
                raise FrameError(
                    f"capture.input={self.input}: OpenCV cannot open it; a camera may be in use, a "
                    "video may need another codec"
                )
            for number in itertools.count():
                there, picture = video.read()
                if not there:
                    return
                yield self._cut(f"{self.input}, frame {number}", np.asarray(picture))
        finally:
            video.release()

    def _cut(self, name: str, picture: np.ndarray) -> RawFrame:
        """Return the left and the right part of a picture, blue first, as RGB."""
        color = np.ascontiguousarray(picture[..., ::-1])
        if self.layout == "single":
            return RawFrame(color, name=name)
        axis = 1 if self.layout == "side_by_side" else 0
        if color.shape[axis] % 2:
            raise FrameError(
                f"{name}: {color.shape[1]} x {color.shape[0]} px cannot be cut into two equal "
                f"pictures {self.layout}; expected an even number, or capture.layout=single"
            )
        left, right = np.split(color, 2, axis)
        return RawFrame(np.ascontiguousarray(left), np.ascontiguousarray(right), name=name)


@spec
class ExportedPictures:
    """Files that a camera's own tools export; those of one frame have the same last number.

    Attributes:
        folder: The folder.
        color: Glob of the left or only pictures.
        right: Glob of the right ones; `null` for none.
        depth: Glob of depth pictures, 16 bits; `null` for none.
        depth_unit_m: A step of the depth picture.
    """

    folder: str
    color: str
    right: str | None
    depth: str | None
    depth_unit_m: Positive

    def read(self) -> Iterator[RawFrame]:
        """Yield frames in the order of their numbers.

        Raises:
            FrameError: there are none, one lacks a partner, or a picture cannot be read.
        """
        files = {}
        for kind, pattern in (("color", self.color), ("right", self.right), ("depth", self.depth)):
            if pattern is not None:
                files[kind] = self._list_files(kind, pattern)
        for number, path in sorted(files["color"].items()):
            parts: dict[str, np.ndarray] = {}
            for kind, some in files.items():
                if number not in some:
                    raise FrameError(
                        f"{path}: no partner numbered {number} by capture.{kind}="
                        f"{getattr(self, kind)} in {self.folder}"
                    )
                picture, where = read_picture(some[number]), str(some[number])
                if kind == "depth":
                    parts[kind] = validation.convert_png_depth(picture, where, self.depth_unit_m)
                else:
                    parts[kind] = validation.convert_color(picture, where)
            yield RawFrame(parts["color"], parts.get("right"), parts.get("depth"), name=str(path))

    def _list_files(self, kind: str, pattern: str) -> dict[int, Path]:
        """Return files by number."""
        found: dict[int, Path] = {}
        for path in sorted(Path(self.folder).glob(pattern)):
            match = NUMBER.search(path.stem)
            if match is None:
                raise FrameError(f"{path}: expected a number in its name, which says its frame")
            number = int(match.group(1))
            if number in found:
                raise FrameError(
                    f"capture.{kind}={pattern}: {found[number].name} and {path.name} have the same "
                    "number; choose a narrower pattern"
                )
            found[number] = path
        if not found:
            raise FrameError(f"capture.{kind}={pattern}: no such file in '{self.folder}'")
        return found


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
        raise FrameError(f"{topic}: encoding '{message.encoding}' is none of {', '.join(CHANNELS)}")
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
