"""Topics for viewers: the session as Foxglove's own messages.

Foxglove and Rerun draw these without further work: frames of the links, shapes of the machine,
boreholes and tool path, pictures, point clouds, and events in words. Everything here follows from
other topics of the same capture and from the camera; nothing else reads it but the page's replay.

Shapes and path are point clouds, since Rerun knows no scenes of Foxglove's.

Source: the message schemas of https://docs.foxglove.dev/docs/sdk/schemas.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from foxglove_schemas_protobuf import (
    CameraCalibration_pb2,
    CompressedImage_pb2,
    FrameTransform_pb2,
    FrameTransforms_pb2,
    Log_pb2,
    PackedElementField_pb2,
    PointCloud_pb2,
    Pose_pb2,
    Quaternion_pb2,
    Vector3_pb2,
)
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message

from brokk_rl.kinematics import compute_tool_kinematics, rotate_about_axis
from brokk_rl.machine import Machine
from brokk_rl.signals import Frame
from deploy.checks.shapes import MachineShapes
from deploy.kernel.guard import GuardState
from deploy.page.scene import plan_approach
from deploy.picture import decode_jpeg, encode_jpeg
from deploy.recorder.topics import CAMERA_POSE, CLOUD, LENS, PICTURE
from deploy.runtime.operator_state import AdviceStatus
from deploy.runtime.target import NEAR_M

SHAPES, TASK = "scene/machine", "scene/task"
LINKS, LOG = "tf", "log"
"""Topics."""
BASE_FRAME, TIP_FRAME, CAMERA_FRAME = "base", "tip", "camera"
PERIOD_S, TASK_PERIOD_S = 0.05, 0.2
"""Least time between two messages of links and of the task. Chosen by hand: smooth to look at."""
JPEG_QUALITY = 80
"""Chosen by hand: no loss that a person sees."""
MOST_POINTS = 6000
"""Points of a cloud at most: 96 kB a picture before compression. Chosen by hand."""
RING_POINTS, LINE_POINTS = 48, 40
"""Points of a rim, and of a line."""
AXIS_M = 0.3
"""Length at which the axis of a borehole is drawn."""
STEEL, PAINT = (0.25, 0.25, 0.27, 1.0), (0.93, 0.62, 0.05, 1.0)
GREEN, BLUE, PINK = (0.1, 0.75, 0.3, 1.0), (0.25, 0.5, 1.0, 1.0), (0.95, 0.2, 0.6, 1.0)
SHADES = ("red", "green", "blue", "alpha")
CLOUD_TYPE = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), *((name, "u1") for name in SHADES)]
)
"""A point of a cloud."""
LEVELS = Log_pb2.Log
SEED, SURFACE_POINTS = 7, 150
"""Seed and number of the points on a shape's surface: dense enough to see it, chosen by hand."""
WriteMessage = Callable[[str, float, str, bytes, bytes], None]
Color = tuple[float, float, float, float]
Line = tuple[np.ndarray, Color]
"""Points `(K, 3)` in the base frame, and colour."""


class SceneTopics:
    """Writes the topics for viewers of one capture.

    Args:
        machine: The machine.
        shapes: Of the machine; `None`: none are drawn.
        write: Takes topic, monotonic time, name and data of the schema, and the message.
        offset_ns: Wall-clock time minus monotonic time.
    """

    def __init__(
        self, machine: Machine, shapes: MachineShapes | None, write: WriteMessage, offset_ns: int
    ) -> None:
        self._machine, self._write_message, self._offset_ns = machine, write, offset_ns
        self._q = np.full(machine.num_joints, np.nan)
        self._index = {f"Position_{name}": j for j, name in enumerate(machine.joint_names)}
        self._links_s = self._task_s = -math.inf
        self._holes: list[dict[str, Any]] = []
        self._target_m: np.ndarray | None = None
        self._shapes = shapes
        self._schemas: dict[str, bytes] = {}

    def add(self, topic: str, t_s: float, values: dict[str, Any]) -> None:
        """Take a message of another topic: of the bus, or a decision."""
        if topic == "holes":
            self._holes = values.get("holes", [])
        elif topic == "advice":
            valid = values.get("reason") == AdviceStatus.VALID.value
            target_m = values.get("target_in_base_m") if valid else None
            self._target_m = None if target_m is None else np.array(target_m)
            self._write_task(t_s)
        elif (event := describe_event(topic, values)) is not None:
            level, text = event
            message = Log_pb2.Log(level=level, message=text, name=topic)
            self._write(LOG, t_s, message)
        elif any(name in self._index for name in values):
            for name, j in self._index.items():
                self._q[j] = values.get(name, self._q[j])
            self._write_links(t_s)

    def add_frame(self, frame: Frame) -> None:
        """Take a frame of the camera."""
        height, width = frame.color.shape[:2]
        jpeg = encode_jpeg(frame.color, JPEG_QUALITY)
        picture = CompressedImage_pb2.CompressedImage(
            frame_id=CAMERA_FRAME, format="jpeg", data=jpeg
        )
        self._write(PICTURE, frame.t_s, picture)
        matrix = frame.camera_matrix
        lens = CameraCalibration_pb2.CameraCalibration(
            frame_id=CAMERA_FRAME,
            width=width,
            height=height,
            K=matrix.ravel().tolist(),
            R=np.eye(3).ravel().tolist(),
            P=np.column_stack([matrix, np.zeros(3)]).ravel().tolist(),
        )
        self._write(LENS, frame.t_s, lens)
        if frame.base_from_camera is not None:
            pose = _build_transform(BASE_FRAME, CAMERA_FRAME, frame.base_from_camera)
            self._write(CAMERA_POSE, frame.t_s, pose)
        points_m, color = list_points(frame, MOST_POINTS)
        self._write(CLOUD, frame.t_s, _build_cloud(CAMERA_FRAME, points_m, color))

    def _write(self, topic: str, t_s: float, message: Any) -> None:
        name = message.DESCRIPTOR.full_name
        if name not in self._schemas:
            self._schemas[name] = _describe_schema(message)
        data = _stamp(message, int(t_s * 1e9) + self._offset_ns)
        self._write_message(topic, t_s, name, self._schemas[name], data)

    def _write_links(self, t_s: float) -> None:
        machine = self._machine
        if not machine.has_bodies or np.isnan(self._q).any() or t_s - self._links_s < PERIOD_S:
            return
        if self._shapes is not None and self._links_s == -math.inf:
            self._write_shapes(t_s, self._shapes)
        self._links_s = t_s
        transforms, parent = [], BASE_FRAME
        for joint, body, q in zip(machine.joints, machine.bodies, self._q, strict=True):
            pose = np.eye(4)
            pose[:3, 3] = [one.value for one in body.origin_m]
            axis = np.array(body.axis)
            if joint.kind == "slide":
                pose[:3, 3] += q * axis
            else:
                pose[:3, :3] = rotate_about_axis(axis, np.array(q))
            transforms.append(_build_transform(parent, joint.name, pose))
            parent = joint.name
        tip = np.eye(4)
        tip[:3, 3] = machine.tip_m
        transforms.append(_build_transform(parent, TIP_FRAME, tip))
        message = FrameTransforms_pb2.FrameTransforms(transforms=transforms)
        self._write(LINKS, t_s, message)

    def _write_shapes(self, t_s: float, shapes: MachineShapes) -> None:
        """Write points on the machine's shapes, in the frame of their link: once."""
        clouds: dict[str, list[np.ndarray]] = {}
        names = [*self._machine.joint_names, BASE_FRAME]
        for box in shapes.body:
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = box.rotation, box.center_m
            size = 2.0 * (box.half_m + box.radius_m)
            clouds.setdefault(names[box.link], []).append(_sample_box(pose, size))
        for capsule in shapes.arm:
            along = capsule.end_m - capsule.begin_m
            pose, width_m = _turn_z_to(along), 2.0 * capsule.radius_m
            pose[:3, 3] = (capsule.begin_m + capsule.end_m) / 2
            size = np.array([width_m, width_m, float(np.linalg.norm(along)) + width_m])
            clouds.setdefault(names[capsule.link], []).append(_sample_cylinder(pose, size))
        for frame, parts in clouds.items():
            paint = STEEL if frame in (BASE_FRAME, names[-2]) else PAINT
            cloud = _build_cloud(frame, np.concatenate(parts), np.array(paint))
            self._write(f"{SHAPES}/{frame}", t_s, cloud)

    def _write_task(self, t_s: float) -> None:
        """Write boreholes and tool path, all anew: a viewer that jumps shows the last message."""
        if t_s - self._task_s < TASK_PERIOD_S:
            return
        self._task_s = t_s
        points, colors = [np.empty((0, 3))], [np.empty((0, 4))]
        for points_m, color in self._list_lines():
            points.append(_fill_line(points_m))
            colors.append(np.tile(color, (LINE_POINTS, 1)))
        cloud = _build_cloud(BASE_FRAME, np.concatenate(points), np.concatenate(colors))
        self._write(TASK, t_s, cloud)

    def _list_lines(self) -> Iterator[Line]:
        """Yield rims and axes of the boreholes, and the way of the tool into the chosen one."""
        goal, up = self._target_m, np.array([0.0, 0.0, 1.0])
        for hole in self._holes:
            center_m, axis = np.array(hole["center_in_base_m"]), np.array(hole["axis_in_base"])
            chosen = goal is not None and float(np.linalg.norm(center_m - goal)) < NEAR_M
            color = GREEN if chosen else BLUE
            if chosen:
                goal, up = center_m, axis
            angle = np.linspace(0.0, 2.0 * np.pi, RING_POINTS + 1)[:, None]
            turn = _turn_z_to(axis)[:3, :3]
            ring_m = np.cos(angle) * turn[:, 0] + np.sin(angle) * turn[:, 1]
            yield center_m + hole["radius_m"] * ring_m, color
            yield np.stack([center_m, center_m + AXIS_M * axis]), color
        if goal is not None and self._machine.has_bodies and not np.isnan(self._q).any():
            tip_m = compute_tool_kinematics(self._machine, self._q).tip_in_base_m
            yield np.array(plan_approach(tip_m, goal, up)), PINK


def describe_event(
    topic: str, values: dict[str, Any]
) -> tuple[Log_pb2.Log.Level.ValueType, str] | None:
    """Return level and words of an event for the log; `None` where a topic is not logged."""
    if topic == "guard":
        latched = values["state"] == GuardState.LATCHED.name
        reason = values["cause"] if latched else values["trip"]
        about = f" ({values['joint']})" if values.get("joint") else ""
        return LEVELS.ERROR if latched else LEVELS.INFO, f"guard {values['state']}: {reason}{about}"
    if topic == "bus":
        return LEVELS.ERROR, f"bus down: {values['down']}"
    if topic == "wish":
        taken = "" if values["taken"] else " (not taken)"
        return LEVELS.INFO, f"operator: {values['kind']} {values['value']}".rstrip() + taken
    return None


def list_points(frame: Frame, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points `(K, 3)` of a frame in the camera's, in m, and colours `(K, 4)` in [0, 1].

    Every second pixel of a row and column is taken, or third, …, until `most` is kept.
    """
    height, width = frame.depth_m.shape
    step = max(1, math.ceil(math.sqrt(height * width / most)))
    rows, columns = np.mgrid[0:height:step, 0:width:step]
    depth_m = frame.depth_m[::step, ::step]
    known = np.isfinite(depth_m)
    z = depth_m[known].astype(float)
    matrix = frame.camera_matrix
    x = (columns[known] - matrix[0, 2]) / matrix[0, 0] * z
    y = (rows[known] - matrix[1, 2]) / matrix[1, 1] * z
    color = np.ones((len(z), 4))
    color[:, :3] = frame.color[::step, ::step][known] / 255.0
    return np.stack([x, y, z], 1), color


def decode_frame(
    picture: bytes, lens: bytes, cloud: bytes, pose: bytes | None, t_s: float
) -> Frame:
    """Return the frame that pictures, calibration, points and pose of one moment stand for.

    Depth is known only where a point was recorded.

    Raises:
        ValueError: a message cannot be decoded.
    """
    image = CompressedImage_pb2.CompressedImage.FromString(picture)
    color = decode_jpeg(image.data)
    matrix = np.array(CameraCalibration_pb2.CameraCalibration.FromString(lens).K).reshape(3, 3)
    data = np.frombuffer(PointCloud_pb2.PointCloud.FromString(cloud).data, CLOUD_TYPE)
    points_m = np.stack([data["x"], data["y"], data["z"]], 1).astype(float)
    depth_m = np.full(color.shape[:2], np.nan, np.float32)
    pixels = (points_m @ matrix.T / points_m[:, 2:])[:, :2].round().astype(int)
    inside = ((pixels >= 0) & (pixels < np.array(color.shape[1::-1]))).all(1)
    columns, rows = pixels[inside].T
    depth_m[rows, columns] = points_m[inside, 2]
    placed = None
    if pose is not None:
        message, placed = FrameTransform_pb2.FrameTransform.FromString(pose), np.eye(4)
        turn, at = message.rotation, message.translation
        placed[:3, :3] = _to_rotation(np.array([turn.x, turn.y, turn.z, turn.w]))
        placed[:3, 3] = at.x, at.y, at.z
    return Frame(color, depth_m, matrix, placed, t_s)


def _stamp(message: Any, wall_ns: int) -> bytes:
    """Return a message with its time: its own field, or one in each of its transforms."""
    for part in getattr(message, "transforms", [message]):
        part.timestamp.FromNanoseconds(wall_ns)
    return message.SerializeToString()


def _describe_schema(message: Message) -> bytes:
    """Return the schema of a message and of all that it needs."""
    found, seen = FileDescriptorSet(), set[str]()

    def add(file: Any) -> None:
        if file.name in seen:
            return
        seen.add(file.name)
        for needed in file.dependencies:
            add(needed)
        file.CopyToProto(found.file.add())

    add(message.DESCRIPTOR.file)
    return found.SerializeToString()


def _build_cloud(frame: str, points_m: np.ndarray, color: np.ndarray) -> PointCloud_pb2.PointCloud:
    """Return points `(K, 3)` with one colour `(4,)`, or one each, `(K, 4)`."""
    data = np.empty(len(points_m), CLOUD_TYPE)
    for index, name in enumerate("xyz"):
        data[name] = points_m[:, index]
    shades = np.broadcast_to(color, (len(points_m), 4))
    for index, name in enumerate(SHADES):
        data[name] = np.round(255.0 * shades[:, index])
    cloud = PointCloud_pb2.PointCloud(
        frame_id=frame, point_stride=CLOUD_TYPE.itemsize, data=data.tobytes()
    )
    cloud.pose.CopyFrom(_build_pose(np.eye(4)))
    kinds = PackedElementField_pb2.PackedElementField
    offset = 0
    for name in ("x", "y", "z", *SHADES):
        kind = kinds.UINT8 if name in SHADES else kinds.FLOAT32
        cloud.fields.add(name=name, offset=offset, type=kind)
        offset += CLOUD_TYPE[name].itemsize
    return cloud


def _build_transform(
    parent: str, child: str, pose: np.ndarray
) -> FrameTransform_pb2.FrameTransform:
    placed = _build_pose(pose)
    return FrameTransform_pb2.FrameTransform(
        parent_frame_id=parent,
        child_frame_id=child,
        translation=placed.position,
        rotation=placed.orientation,
    )


def _build_pose(pose: np.ndarray) -> Pose_pb2.Pose:
    """Return a pose `(4, 4)`."""
    x, y, z, w = _to_quaternion(pose[:3, :3])
    turn = Quaternion_pb2.Quaternion(x=x, y=y, z=z, w=w)
    return Pose_pb2.Pose(position=_build_vector(pose[:3, 3]), orientation=turn)


def _build_vector(values: Sequence[float] | np.ndarray) -> Vector3_pb2.Vector3:
    x, y, z = map(float, values)
    return Vector3_pb2.Vector3(x=x, y=y, z=z)


def _to_quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return x, y, z, w of a rotation `(3, 3)`.

    Source: Bar-Itzhack, New method for extracting the quaternion from a rotation matrix, 2000. It
    is the eigenvector of the largest eigenvalue.
    """
    r = rotation
    k = np.zeros((4, 4))
    k[:3, :3] = r + r.T - r.trace() * np.eye(3)
    k[3] = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], r.trace()
    return np.linalg.eigh(k)[1][:, -1]  # it reads the lower half alone


def _to_rotation(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation `(3, 3)` of a unit quaternion x, y, z, w."""
    x, y, z, w = quaternion
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross


def _turn_z_to(axis: np.ndarray) -> np.ndarray:
    """Return a pose `(4, 4)` at the origin whose z points along `axis`."""
    z = axis / np.linalg.norm(axis)
    x = np.cross(np.eye(3)[int(np.abs(z).argmin())], z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z], 1)
    return pose


def _fill_line(points_m: np.ndarray) -> np.ndarray:
    """Return `LINE_POINTS` points along a line `(K, 3)`, equally far apart, `(L, 3)`."""
    apart_m = np.linalg.norm(np.diff(points_m, axis=0), axis=1)
    along_m = np.concatenate([[0.0], np.cumsum(apart_m)])
    places_m = np.linspace(0.0, along_m[-1], LINE_POINTS)
    return np.stack([np.interp(places_m, along_m, points_m[:, i]) for i in range(3)], 1)


def _sample_box(pose: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return points on the surface of a box, `(SURFACE_POINTS, 3)`, in the frame of its pose."""
    chance = np.random.default_rng(SEED)
    points = chance.uniform(-0.5, 0.5, (SURFACE_POINTS, 3))
    # Faces by their areas; on a face one coordinate is at its end.
    areas = np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])
    face = chance.choice(3, SURFACE_POINTS, p=areas / areas.sum())
    points[np.arange(SURFACE_POINTS), face] = chance.choice([-0.5, 0.5], SURFACE_POINTS)
    return (points * size) @ pose[:3, :3].T + pose[:3, 3]


def _sample_cylinder(pose: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return points on the mantle of a cylinder along z, `(SURFACE_POINTS, 3)`, likewise."""
    chance = np.random.default_rng(SEED)
    angle = chance.uniform(0.0, 2.0 * np.pi, SURFACE_POINTS)
    height = chance.uniform(-0.5, 0.5, SURFACE_POINTS)
    points = np.stack([0.5 * np.cos(angle), 0.5 * np.sin(angle), height], 1)
    return (points * size) @ pose[:3, :3].T + pose[:3, 3]
