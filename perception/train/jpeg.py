"""What JPEG leaves of pictures, in torch, for a whole batch at once and without files (ITU-T T.81; colours at full resolution)."""

from __future__ import annotations

import functools
import math

import torch
from torch.nn import functional

LUMINANCE_STEPS = (
    (16, 11, 10, 16, 24, 40, 51, 61), (12, 12, 14, 19, 26, 58, 60, 55), (14, 13, 16, 24, 40, 57, 69, 56),
    (14, 17, 22, 29, 51, 87, 80, 62), (18, 22, 37, 56, 68, 109, 103, 77), (24, 35, 55, 64, 81, 104, 113, 92),
    (49, 64, 78, 87, 103, 121, 120, 101), (72, 92, 95, 98, 112, 100, 103, 99),
)  # fmt: skip
COLOUR_STEPS = (
    (17, 18, 24, 47, 99, 99, 99, 99), (18, 21, 26, 66, 99, 99, 99, 99), (24, 26, 56, 99, 99, 99, 99, 99),
    (47, 66, 99, 99, 99, 99, 99, 99), *((99,) * 8,) * 4,
)  # fmt: skip
"""Steps of quantisation at quality 50 (annex K)."""
YCC = ((0.299, 0.587, 0.114), (-0.168736, -0.331264, 0.5), (0.5, -0.418688, -0.081312))
"""Luminance and two colour differences of RGB (JFIF)."""


def recompressed(pictures: torch.Tensor, quality: torch.Tensor) -> torch.Tensor:
    """Returns RGB pictures in [0, 1], `(B, 3, h, w)`, as files of a quality, `(B, 1, 1, 1)` from 1 to 100, give them back."""
    height, width = pictures.shape[2:]
    percent = torch.where(quality < 50.0, 5000.0 / quality, 200.0 - 2.0 * quality) / 100.0
    tables, matrix, inverse, middle, wave = _constants(pictures.device)
    steps = (tables * percent).round().clamp(1.0, 255.0)[:, :, None, None]  # (B, 3, 1, 1, 8, 8)
    ycc = torch.einsum("ij,bjhw->bihw", matrix, pictures.clamp(0.0, 1.0) * 255.0)
    ycc = functional.pad(ycc, (0, -width % 8, 0, -height % 8), mode="replicate")
    blocks = (
        ycc.unflatten(3, (-1, 8)).unflatten(2, (-1, 8)).transpose(3, 4)
    )  # (B, 3, rows, columns, 8, 8)
    kept = (wave @ (blocks - middle) @ wave.T / steps).round() * steps
    back = (
        (wave.T @ kept @ wave + middle)
        .transpose(3, 4)
        .flatten(4, 5)
        .flatten(2, 3)[..., :height, :width]
    )
    return torch.einsum("ij,bjhw->bihw", inverse, back) / 255.0


@functools.cache
def _constants(device: torch.device) -> tuple[torch.Tensor, ...]:
    """Returns, on a device, the steps at quality 50, YCC of RGB and back, the middle of each channel and the cosines."""
    number = torch.arange(8.0)
    wave = ((number + 0.5) * number[:, None] * (math.pi / 8.0)).cos()
    wave = wave * torch.where(number > 0, 0.5, 0.125**0.5)[:, None]  # orthonormal
    matrix, middle = torch.tensor(YCC), torch.tensor([128.0, 0.0, 0.0]).reshape(3, 1, 1, 1, 1)
    tables = torch.tensor([LUMINANCE_STEPS, COLOUR_STEPS, COLOUR_STEPS], dtype=torch.float32)
    return tuple(one.to(device) for one in (tables, matrix, torch.linalg.inv(matrix), middle, wave))
