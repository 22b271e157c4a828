"""Frames of the camera as Foxglove's own messages, which Foxglove and Rerun draw, and back.

Source: the message schemas of https://docs.foxglove.dev/docs/sdk/schemas.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from foxglove_schemas_protobuf import (
    CameraCalibration_pb2,
    CompressedImage_pb2,
    FrameTransform_pb2,
    PackedElementField_pb2,
    PointCloud_pb2,
    Quaternion_pb2,
    Vector3_pb2,
)

from brokk_rl.signals import Frame
from deploy.picture import decode_jpeg, encode_jpeg
from deploy.recorder.topics import CAMERA_POSE, CLOUD, LENS, PICTURE

BASE_FRAME, CAMERA_FRAME = "base", "camera"
JPEG_QUALITY = 80
"""Chosen by hand: no loss that a person sees."""
MOST_POINTS = 6000
"""Points of a cloud at most: 96 kB a picture before compression. Chosen by hand."""
SHADES = ("red", "green", "blue", "alpha")
CLOUD_TYPE = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), *((name, "u1") for name in SHADES)]
)
"""A point of a cloud."""


def encode_frame(frame: Frame) -> Iterator[tuple[str, Any]]:
    """Yield topic and message for picture, calibration, pose where it is known, and points."""
    height, width = frame.color.shape[:2]
    jpeg = encode_jpeg(frame.color, JPEG_QUALITY)
    image = CompressedImage_pb2.CompressedImage(frame_id=CAMERA_FRAME, format="jpeg", data=jpeg)
    yield PICTURE, image
    matrix = frame.camera_matrix
    yield (
        LENS,
        CameraCalibration_pb2.CameraCalibration(
            frame_id=CAMERA_FRAME,
            width=width,
            height=height,
            K=matrix.ravel().tolist(),
            R=np.eye(3).ravel().tolist(),
            P=np.column_stack([matrix, np.zeros(3)]).ravel().tolist(),
        ),
    )
    if frame.base_from_camera is not None:
        yield CAMERA_POSE, _build_transform(frame.base_from_camera)
    yield CLOUD, _build_cloud(frame)


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


def _build_cloud(frame: Frame) -> PointCloud_pb2.PointCloud:
    """Return points in the camera's frame with their colours.

    Every second pixel of a row and column is taken, or third, …, until `MOST_POINTS` is kept.
    """
    height, width = frame.depth_m.shape
    step = max(1, math.ceil(math.sqrt(height * width / MOST_POINTS)))
    rows, columns = np.mgrid[0:height:step, 0:width:step]
    depth_m = frame.depth_m[::step, ::step]
    known = np.isfinite(depth_m)
    z, matrix = depth_m[known].astype(float), frame.camera_matrix
    data = np.full(len(z), 255, CLOUD_TYPE)
    data["x"] = (columns[known] - matrix[0, 2]) / matrix[0, 0] * z
    data["y"] = (rows[known] - matrix[1, 2]) / matrix[1, 1] * z
    data["z"] = z
    color = frame.color[::step, ::step][known]
    data["red"], data["green"], data["blue"] = color.T
    cloud = PointCloud_pb2.PointCloud(
        frame_id=CAMERA_FRAME, point_stride=CLOUD_TYPE.itemsize, data=data.tobytes()
    )
    cloud.pose.orientation.w = 1.0
    kinds = PackedElementField_pb2.PackedElementField
    offset = 0
    for name in ("x", "y", "z", *SHADES):
        kind = kinds.UINT8 if name in SHADES else kinds.FLOAT32
        cloud.fields.add(name=name, offset=offset, type=kind)
        offset += CLOUD_TYPE[name].itemsize
    return cloud


def _build_transform(base_from_camera: np.ndarray) -> FrameTransform_pb2.FrameTransform:
    x, y, z, w = _to_quaternion(base_from_camera[:3, :3])
    place_m = base_from_camera[:3, 3]
    return FrameTransform_pb2.FrameTransform(
        parent_frame_id=BASE_FRAME,
        child_frame_id=CAMERA_FRAME,
        translation=Vector3_pb2.Vector3(x=place_m[0], y=place_m[1], z=place_m[2]),
        rotation=Quaternion_pb2.Quaternion(x=x, y=y, z=z, w=w),
    )


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
