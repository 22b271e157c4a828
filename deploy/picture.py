"""Pictures for the operator's page, coded by OpenCV."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from brokk_rl.signals import Frame


def encode_jpeg(color: np.ndarray, quality: int) -> bytes:
    """Return an RGB picture, `(h, w, 3)` uint8, as JPEG of `quality`, 1 to 100."""
    encoded, data = cv2.imencode(
        ".jpg", cv2.cvtColor(color, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality]
    )
    assert encoded, "OpenCV encodes any RGB picture"
    return data.tobytes()


def decode_jpeg(data: bytes) -> np.ndarray:
    """Return the RGB picture, `(h, w, 3)` uint8, of a JPEG.

    Raises:
        ValueError: it is none.
    """
    found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    if found is None:
        raise ValueError("expected a JPEG")
    return cv2.cvtColor(found, cv2.COLOR_BGR2RGB)


def shrink_frame(frame: Frame, width: int) -> Frame:
    """Return a frame shrunk to `width` px, and its camera with it; a narrower one as it is.

    Colours are averaged; depths are picked, since a mean over an edge is no depth.
    """
    full_height, full_width = frame.color.shape[:2]
    if width >= full_width:
        return frame
    size = width, full_height * width // full_width
    # The half pixel that the grid moves by is a millimetre at 4 m.
    part = width / full_width
    return replace(
        frame,
        color=cv2.resize(frame.color, size, interpolation=cv2.INTER_AREA),
        depth_m=cv2.resize(frame.depth_m, size, interpolation=cv2.INTER_NEAREST),
        camera_matrix=frame.camera_matrix * np.array([[part], [part], [1.0]]),
    )
