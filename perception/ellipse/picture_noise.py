"""Noise of a picture, estimated from the picture itself."""

from __future__ import annotations

import cv2
import numpy as np


def estimate_noise(gray: np.ndarray) -> float:
    """Return the standard deviation of a picture's noise, grey levels (Immerkær 1996).

    Edges of surfaces cancel in the mask, and the median leaves those of things out.
    """
    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    away = np.abs(cv2.filter2D(gray, cv2.CV_32F, mask))[::2, ::2]
    # The mask's norm is 6; the median of a normal distribution's absolute value is 0.6745.
    return float(np.median(away)) / (6.0 * 0.6745)
