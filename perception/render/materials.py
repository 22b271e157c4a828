"""Materials: colour and grain, filtered to the size of a pixel so that both views agree."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

TEXTURE_SIDE = 1024
"""Texels of a texture along each side; it repeats beyond."""
NUM_TEXTURES = 4
_FINEST_OCTAVE, _COARSEST_OCTAVE = 10, 3
_ROW = 1024
"""Points are handed to OpenCV in rows of this length, as it takes no longer ones."""


@dataclass(frozen=True)
class Material:
    """A matt surface.

    Attributes:
        color: Reflected part of the light, RGB, each in [0, 1].
        contrast: Standard deviation of its brightness over the surface, relative to the mean.
        texel_m: Size of the finest grain.
        texture: Which of the `NUM_TEXTURES` patterns of grain.
        shift: Where the pattern begins, texels.
        marks: Brightness painted over it, `(h, w)` float32, 1 for none, and the size of its texels
            in m; repeats beyond.
    """

    color: tuple[float, ...]
    contrast: float
    texel_m: float
    texture: int = 0
    shift: tuple[float, ...] = (0.0, 0.0)
    marks: tuple[np.ndarray, float] | None = None

    def albedo(self, uv_m: np.ndarray, pixel_m: np.ndarray) -> np.ndarray:
        """Return the reflected part of the light, `(M, 3)`.

        Args:
            uv_m: Where on the surface, `(M, 2)`.
            pixel_m: Size of a pixel there, `(M,)`.
        """
        uv = uv_m / np.float32(self.texel_m) + np.asarray(self.shift, np.float32)
        level = np.log2(np.maximum(pixel_m / self.texel_m, 1.0))
        grain = _sample_pyramid(_build_pyramid(self.texture), uv, level)
        bright = np.clip(1.0 + self.contrast * grain, 0.15, 1.9)[:, None]
        if self.marks is not None:
            picture, size_m = self.marks
            center = uv_m / np.float32(size_m) + np.array(picture.shape[::-1], np.float32) / 2
            bright = bright * _interpolate_bilinear(picture, center)[:, None]
        return bright * np.asarray(self.color, np.float32)


@lru_cache(maxsize=NUM_TEXTURES)
def _build_pyramid(number: int) -> tuple[np.ndarray, ...]:
    """Return a periodic pattern, mean 0 and deviation 1, and its reductions by two to one texel.

    The patterns are the same for every scene: a scene differs in where, how strong and in which
    colours they appear.
    """
    generator = np.random.default_rng(9000 + number)
    # Strength of each octave relative to the one twice as coarse: from cloudy to speckled.
    rise = (0.9, 1.0, 1.15, 1.3)[number]
    total = np.zeros((TEXTURE_SIDE, TEXTURE_SIDE), np.float32)
    for octave in range(_COARSEST_OCTAVE, _FINEST_OCTAVE + 1):
        coarse = generator.standard_normal((1 << octave, 1 << octave)).astype(np.float32)
        pad = 2
        scale = TEXTURE_SIDE >> octave
        padded = np.pad(coarse, pad, mode="wrap")
        wide = cv2.resize(padded, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        inner = slice(pad * scale, pad * scale + TEXTURE_SIDE)
        total += rise ** (octave - _COARSEST_OCTAVE) * wide[inner, inner]
    if number >= NUM_TEXTURES // 2:  # gravel: bright and dark stones
        total = np.tanh(2.0 * total / total.std())
    levels = [(total - total.mean()) / total.std()]
    while levels[-1].shape[0] > 1:
        side = levels[-1].shape[0] // 2
        levels.append(
            cv2.resize(levels[-1], (side, side), interpolation=cv2.INTER_AREA).reshape(side, side)
        )
    return tuple(levels)


def _sample_pyramid(
    pyramid: tuple[np.ndarray, ...], uv: np.ndarray, level: np.ndarray
) -> np.ndarray:
    """Return the pattern at `uv`, `(M, 2)` finest texels, blended between the levels at `level`."""
    level = np.minimum(level, len(pyramid) - 1.001)
    total = np.zeros(len(uv), np.float32)
    for number in range(int(level.min()), int(level.max()) + 2):
        weight = 1.0 - np.abs(level - number)
        rows = np.flatnonzero(weight > 0)
        if len(rows):
            total[rows] += weight[rows] * _interpolate_bilinear(
                pyramid[number], (uv[rows] + 0.5) / np.float32(1 << number) - 0.5
            )
    return total


def _interpolate_bilinear(picture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Return the periodic picture at `uv`, `(M, 2)` as x and y."""
    height, width = picture.shape[:2]
    size = np.array([width, height], np.float32)
    wrapped = uv - np.floor(uv / size) * size
    count = len(uv)
    rows = -(-count // _ROW)
    maps = np.zeros((2, rows * _ROW), np.float32)
    maps[:, :count] = wrapped.T
    x, y = maps.reshape(2, rows, _ROW)
    found = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return found.ravel()[:count]
