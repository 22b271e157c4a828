"""Pictures for the operator's page, coded by OpenCV."""

from __future__ import annotations

import cv2
import numpy as np


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


def shrink_picture(picture: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return a picture, `(h, w)` or `(h, w, 3)`, shrunk to `width` times `height` px.

    Colours are averaged; depths are picked, since a mean over an edge is no depth.
    """
    interpolation = cv2.INTER_AREA if picture.ndim == 3 else cv2.INTER_NEAREST
    return cv2.resize(picture, (width, height), interpolation=interpolation)
