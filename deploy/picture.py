"""Pictures for the operator's page, coded by OpenCV."""

from __future__ import annotations

import cv2
import numpy as np


def encode_jpeg(color: np.ndarray, quality: int) -> bytes:
    """Returns an RGB picture, `(h, w, 3)` uint8, as JPEG of `quality`, 1 to 100."""
    done, data = cv2.imencode(
        ".jpg", cv2.cvtColor(color, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality]
    )
    assert done, "OpenCV codes any RGB picture"
    return data.tobytes()


def shrink_picture(picture: np.ndarray, width: int, height: int) -> np.ndarray:
    """Returns a picture, `(h, w)` or `(h, w, 3)`, of `width` times `height` px: colours averaged, depths picked."""
    way = cv2.INTER_AREA if picture.ndim == 3 else cv2.INTER_NEAREST
    return cv2.resize(picture, (width, height), interpolation=way)
