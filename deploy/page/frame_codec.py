"""Encoding of a frame for the page: depth in whole millimetres, and colour as JPEG.

Depth is coded by differences along each row, then deflated, which browsers undo by themselves. Small
differences are small numbers (zigzag), and low and high bytes stand apart: 211 KiB for 640 x 360 px,
where 32-bit points and colours take 3.2 MB. The page makes points of it on the graphics card. A
message is the length of a JSON header, 4 bytes little-endian, the header, the depth, and the JPEG,
which also is the camera's picture.
"""

from __future__ import annotations

import json
import struct
import zlib

import numpy as np

from brokk_rl.errors import FrameError
from brokk_rl.signals import Frame
from deploy.picture import encode_jpeg, shrink_frame

LENGTH = struct.Struct("<I")
M_PER_UNIT = 0.001
"""Of the 16-bit depths; the page reads it from the header."""
FAR = 65_535
"""Depths from here on, in units, are not known: 65 m is further than a stereo camera sees."""
LEVEL = 1
"""Of zlib: higher ones take several times as long for a few percent."""


def encode_frame(frame: Frame, width: int, quality: int) -> bytes:
    """Return the message of a frame, shrunk to `width` px where it is wider.

    Args:
        frame: Depth and colour of one size.
        width: Of the message, px.
        quality: Of the JPEG, 1 to 100.

    Raises:
        FrameError: depth and colour differ in size.
    """
    if frame.depth_m.shape != frame.color.shape[:2]:
        raise FrameError(
            f"depth is {frame.depth_m.shape}, colour {frame.color.shape}: expected one size"
        )
    frame = shrink_frame(frame, width)
    height, width = frame.depth_m.shape
    matrix = frame.camera_matrix
    pose = np.eye(4) if frame.base_from_camera is None else frame.base_from_camera
    depth = zlib.compress(encode_depth_planes(frame.depth_m).tobytes(), LEVEL)
    header = {
        "t_s": frame.t_s,
        "width": width,
        "height": height,
        "m_per_unit": M_PER_UNIT,
        "depth_bytes": len(depth),
        "focal_px": [matrix[0, 0], matrix[1, 1]],
        "center_px": [matrix[0, 2], matrix[1, 2]],
        "base_from_camera": pose.astype(float).ravel().tolist(),
        "placed": frame.base_from_camera is not None,
    }
    text = json.dumps(header).encode()
    return b"".join((LENGTH.pack(len(text)), text, depth, encode_jpeg(frame.color, quality)))


def encode_depth_planes(depth_m: np.ndarray) -> np.ndarray:
    """Return the low and high bytes, `(2, h, w)`, of depths, `(h, w)` in m.

    Depths are 16-bit millimetres (0: unknown), each as its difference to its left neighbour modulo
    2^16, counted from 0 outwards: 0, -1, 1, -2, ….
    """
    units = np.nan_to_num(depth_m / M_PER_UNIT, nan=0.0, posinf=0.0, neginf=0.0).round()
    units = np.where((units > 0) & (units < FAR), units, 0).astype("<u2")
    units[:, 1:] -= units[:, :-1].copy()
    signed = units.view("<i2")
    outwards = ((signed << 1) ^ (signed >> 15)).astype("<i2")
    return np.moveaxis(outwards.view(np.uint8).reshape(*units.shape, 2), -1, 0).copy()
