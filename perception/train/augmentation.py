"""Augmentations of brightness, sharpness and noise; nothing moves in the pictures.

The paper's five are blur, crop, contrast, gamma and noise; crop changes the geometry and is
`samples.Crop`. All take and return a batch of RGB pictures in [0, 1], `(B, 3, h, w)` float32 on any
device. Each picture is changed by its own draw from the given generator, of the same device.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Protocol

import cv2
import numpy as np
import torch
from torch.nn import functional

from brokk_rl.spec import NonNegativeRange, Share, spec


def recompress_jpeg(pictures: torch.Tensor, quality: torch.Tensor) -> torch.Tensor:
    """Return RGB pictures, `(B, 3, h, w)` in [0, 1], as JPEG of a quality, `(B, 1, 1, 1)`, leaves them."""
    pixels = (pictures.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)
    results = []
    for picture, percent in zip(
        pixels.permute(0, 2, 3, 1).cpu().numpy(), quality.ravel(), strict=True
    ):
        options = [cv2.IMWRITE_JPEG_QUALITY, round(float(percent))]
        data = cv2.imencode(".jpg", picture[..., ::-1], options)[1]
        results.append(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))[..., ::-1].copy())
    stacked = torch.from_numpy(np.stack(results)).to(pictures.device)
    return stacked.permute(0, 3, 1, 2).to(pictures.dtype) / 255.0


Range = tuple[float, float]


class Augmentation(Protocol):
    """Changes pictures at random."""

    @property
    def probability(self) -> float:
        """Share of pictures that it changes; 0 switches it off."""
        ...

    def changed(self, pictures: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """Return changed pictures; values may leave [0, 1], they are clipped after the last one."""
        ...


def apply_augmentations(
    pictures: torch.Tensor,
    steps: Mapping[str, Augmentation],
    chance: torch.Generator,
    generator: torch.Generator,
) -> torch.Tensor:
    """Return the pictures after all augmentations, each with its probability, clipped to [0, 1].

    `chance`, on the CPU, says which pictures each one changes (whoever asks a graphics card for
    that waits); `generator` says how.
    """
    for step in steps.values():
        chosen = torch.nonzero(torch.rand(len(pictures), generator=chance) < step.probability)[:, 0]
        if len(chosen):
            chosen = chosen.to(pictures.device, non_blocking=True)
            pictures = pictures.index_copy(0, chosen, step.changed(pictures[chosen], generator))
    return pictures.clamp(0.0, 1.0)


@spec
class Exposure:
    """More or less light on the sensor, with one gain for each colour.

    Attributes:
        probability: How often.
        gain: Range of the gain, drawn evenly in its logarithm.
        tint: Largest relative difference of a colour's gain.
    """

    probability: Share
    gain: NonNegativeRange
    tint: float

    def changed(self, pictures: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """Return the pictures with another exposure."""
        gain = _draw_uniform(
            (math.log(self.gain[0]), math.log(self.gain[1])), pictures, generator
        ).exp()
        return (
            pictures
            * gain
            * _draw_uniform((1.0 - self.tint, 1.0 + self.tint), pictures, generator, 3)
        )


@spec
class Contrast:
    """Stretches or squeezes about the mean.

    Attributes:
        probability: How often.
        gain: Range of the factor.
    """

    probability: Share
    gain: NonNegativeRange

    def changed(self, pictures: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """Return the pictures with another contrast."""
        mean = pictures.mean((1, 2, 3), keepdim=True)
        return mean + (pictures - mean) * _draw_uniform(self.gain, pictures, generator)


@spec
class Gamma:
    """Another tone curve.

    Attributes:
        probability: How often.
        exponent: Range of the exponent.
    """

    probability: Share
    exponent: NonNegativeRange

    def changed(self, pictures: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """Return the pictures with another tone curve."""
        return pictures.clamp(0.0, 1.0) ** _draw_uniform(self.exponent, pictures, generator)


@spec
class Shadow:
    """The shadow of something long: a band with soft edges, darker than the rest.

    Attributes:
        probability: How often.
        depth: Range of the remaining part of the light.
        width: Range of the band's width, as a part of the picture's.
        softness: Range of the edge's width, as a part of the picture's.
    """

    probability: Share
    depth: Range
    width: NonNegativeRange
    softness: NonNegativeRange

    def changed(self, pictures: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """Return the pictures with a shadow across them."""
        height, width = pictures.shape[2:]
        angle_rad = _draw_uniform((0.0, math.pi), pictures, generator)
        x, y = (_draw_uniform((0.2, 0.8), pictures, generator) for _ in range(2))
        across = torch.arange(width, device=pictures.device) / width - x
        down = torch.arange(height, device=pictures.device)[:, None] / width - y * height / width
        half, soft = (
            _draw_uniform(self.width, pictures, generator) / 2.0,
            _draw_uniform(self.softness, pictures, generator),
        )
        inside = (
            (half - (across * angle_rad.cos() + down * angle_rad.sin()).abs()) / soft + 0.5
        ).clamp(0.0, 1.0)
        return pictures * (1.0 - inside * (1.0 - _draw_uniform(self.depth, pictures, generator)))


@spec
class Haze:
    """Dust in the air: the picture fades unevenly into its colour (Koschmieder's law).

    Attributes:
        probability: How often.
        transmission: Range of the transmitted part of the light.
        brightness: Range of the dust's brightness.
        unevenness: Largest change of the transmission across the picture.
    """

    probability: Share
    transmission: NonNegativeRange
    brightness: NonNegativeRange
    unevenness: float

    def changed(self, pictures: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """Return the pictures through dust."""
        coarse = _draw_uniform(
            (-self.unevenness, self.unevenness), pictures, generator, 20
        ).reshape(-1, 1, 4, 5)
        drift = functional.interpolate(
            coarse, pictures.shape[2:], mode="bicubic", align_corners=False
        )
        through = (_draw_uniform(self.transmission, pictures, generator) + drift).clamp(0.05, 1.0)
        tint = torch.cat(
            [_draw_uniform((low, 1.0), pictures, generator) for low in (0.95, 0.9, 0.85)], 1
        )
        return pictures * through + _draw_uniform(self.brightness, pictures, generator) * tint * (
            1.0 - through
        )


@spec
class Blur:
    """Out of focus.

    Attributes:
        probability: How often.
        sigma_px: Range of the standard deviation, px of the network's picture.
    """

    probability: Share
    sigma_px: NonNegativeRange

    def changed(self, pictures: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """Return the pictures out of focus."""
        kernel = _build_gaussian_kernels(
            _draw_uniform(self.sigma_px, pictures, generator), self.sigma_px[1]
        )
        return _filter_pictures(_filter_pictures(pictures, kernel), kernel.transpose(2, 3))


@spec
class MotionBlur:
    """The camera moved along a line while the shutter was open.

    Attributes:
        probability: How often.
        length_px: Range of the way, px of the network's picture.
    """

    probability: Share
    length_px: NonNegativeRange

    def changed(self, pictures: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """Return the pictures smeared along a line, centred on where they were."""
        half = math.ceil(self.length_px[1] / 2.0) + 1
        length = _draw_uniform(self.length_px, pictures, generator)
        angle_rad = _draw_uniform((0.0, math.pi), pictures, generator)
        way = (
            length * torch.linspace(-0.5, 0.5, 8 * half + 1, device=pictures.device)[:, None, None]
        )
        place = torch.arange(-half, half + 1, device=pictures.device).float()
        # each step along the way falls on the four pixels around it
        near = (1.0 - (place - way * angle_rad.cos()).abs()).clamp_min(0.0)
        near = near * (1.0 - (place[:, None] - way * angle_rad.sin()).abs()).clamp_min(0.0)
        return _filter_pictures(pictures, near.mean(1, keepdim=True))


@spec
class PictureNoise:
    """Noise of the sensor: a constant part and one by the root of the light, with grain.

    Attributes:
        probability: How often.
        constant: Range of the constant part's standard deviation, of full scale.
        photon: Range of the standard deviation at full light.
        grain_px: Range of the grain's size.
    """

    probability: Share
    constant: Range
    photon: Range
    grain_px: NonNegativeRange

    def changed(self, pictures: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """Return the pictures with noise."""
        noise = torch.randn(pictures.shape, device=pictures.device, generator=generator)
        kernel = _build_gaussian_kernels(
            _draw_uniform(self.grain_px, pictures, generator), self.grain_px[1]
        )
        noise = _filter_pictures(
            _filter_pictures(noise, kernel), kernel.transpose(2, 3)
        ) / kernel.square().sum((2, 3), keepdim=True)
        constant = _draw_uniform(self.constant, pictures, generator)
        photon = _draw_uniform(self.photon, pictures, generator)
        return (
            pictures
            + noise * (constant.square() + photon.square() * pictures.clamp(0.0, 1.0)).sqrt()
        )


@spec
class Jpeg:
    """Compression of a video stream.

    Attributes:
        probability: How often.
        quality: Range of JPEG's quality, 1 to 100.
    """

    probability: Share
    quality: NonNegativeRange

    def changed(self, pictures: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """Return the pictures as a JPEG file gives them back."""
        return recompress_jpeg(pictures, _draw_uniform(self.quality, pictures, generator))


def _draw_uniform(
    limits: Range, pictures: torch.Tensor, generator: torch.Generator, count: int = 1
) -> torch.Tensor:
    """Return evenly drawn numbers, `(B, count, 1, 1)`, for a batch of pictures."""
    low, high = limits
    drawn = torch.rand((len(pictures), count, 1, 1), device=pictures.device, generator=generator)
    return low + (high - low) * drawn


def _build_gaussian_kernels(sigma_px: torch.Tensor, largest_px: float) -> torch.Tensor:
    """Return kernels, `(B, 1, 1, k)`, of standard deviations `(B, 1, 1, 1)` up to `largest_px`."""
    half = max(1, math.ceil(3.0 * largest_px))
    place = torch.arange(-half, half + 1, device=sigma_px.device)
    kernel = (-0.5 * (place / sigma_px.clamp_min(0.05)).square()).exp()
    return kernel / kernel.sum(3, keepdim=True)


def _filter_pictures(pictures: torch.Tensor, kernels: torch.Tensor) -> torch.Tensor:
    """Return each picture filtered by its own kernel, `(B, 1, k, l)`; borders are repeated."""
    down, across = kernels.shape[2] // 2, kernels.shape[3] // 2
    wide = functional.pad(pictures, (across, across, down, down), mode="replicate").flatten(0, 1)[
        None
    ]
    each = kernels.repeat_interleave(pictures.shape[1], 0)
    return functional.conv2d(wide, each, groups=len(each))[0].unflatten(0, pictures.shape[:2])
