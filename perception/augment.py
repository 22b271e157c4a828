"""Augmentations: what light, dust, lens, sensor and file do to a picture, without moving anything in it.

The paper's five are blur, crop, contrast, gamma and noise; crop changes the geometry and is a window (`segment_window`). All
take and return RGB float32 in [0, 1], `(h, w, 3)`, and draw from the generator they are given and nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import cv2
import numpy as np

from brokk_rl.errors import ConfigError
from brokk_rl.spec import spec

Range = tuple[float, float]


class Augmentation(Protocol):
    """Changes a picture at random."""

    @property
    def probability(self) -> float:
        """How often it does; 0 switches it off."""
        ...

    def changed(self, picture: np.ndarray, generator: np.random.Generator) -> np.ndarray:
        """Returns a changed picture; values may leave [0, 1], they are clipped after the last one."""
        ...


def augmented(picture: np.ndarray, steps: Mapping[str, Augmentation], generator: np.random.Generator) -> np.ndarray:
    """Returns the picture after all augmentations in their order, each with its probability, clipped to [0, 1]."""
    for step in steps.values():
        if generator.random() < step.probability:
            picture = step.changed(picture, generator).astype(np.float32, copy=False)
    return np.clip(picture, 0.0, 1.0)


@spec
class Exposure:
    """More or less light on the sensor, with one gain for each colour.

    Attributes:
        probability: How often.
        gain: Range of the gain, drawn evenly in its logarithm.
        tint: Largest relative difference of a colour's gain.
    """

    probability: float
    gain: Range
    tint: float

    def check(self) -> None:
        _check(self, gain=self.gain)

    def changed(self, picture: np.ndarray, generator: np.random.Generator) -> np.ndarray:
        """Returns the picture with another exposure."""
        gain = np.exp(generator.uniform(*np.log(self.gain)))
        return picture * (gain * generator.uniform(1.0 - self.tint, 1.0 + self.tint, 3)).astype(np.float32)


@spec
class Contrast:
    """Stretches or squeezes about the mean.

    Attributes:
        probability: How often.
        gain: Range of the factor.
    """

    probability: float
    gain: Range

    def check(self) -> None:
        _check(self, gain=self.gain)

    def changed(self, picture: np.ndarray, generator: np.random.Generator) -> np.ndarray:
        """Returns the picture with another contrast."""
        mean = picture.mean()
        return mean + (picture - mean) * np.float32(generator.uniform(*self.gain))


@spec
class Gamma:
    """Another tone curve.

    Attributes:
        probability: How often.
        exponent: Range of the exponent.
    """

    probability: float
    exponent: Range

    def check(self) -> None:
        _check(self, exponent=self.exponent)

    def changed(self, picture: np.ndarray, generator: np.random.Generator) -> np.ndarray:
        """Returns the picture with another tone curve."""
        return np.clip(picture, 0.0, 1.0) ** np.float32(generator.uniform(*self.exponent))


@spec
class Shadow:
    """The shadow of something long: a band with soft edges, darker than the rest.

    Attributes:
        probability: How often.
        depth: Range of what is left of the light.
        width: Range of the band's width, as a part of the picture's.
        softness: Range of the edge's width, as a part of the picture's.
    """

    probability: float
    depth: Range
    width: Range
    softness: Range

    def check(self) -> None:
        _check(self, width=self.width, softness=self.softness)

    def changed(self, picture: np.ndarray, generator: np.random.Generator) -> np.ndarray:
        """Returns the picture with a shadow across it."""
        angle_rad, place = generator.uniform(0.0, np.pi), generator.uniform(0.2, 0.8, 2)
        half, soft = generator.uniform(*self.width) / 2.0, generator.uniform(*self.softness)
        height, width = picture.shape[:2]
        across = (np.arange(width) / width - place[0]) * np.cos(angle_rad)
        down = (np.arange(height) / width - place[1] * height / width) * np.sin(angle_rad)
        inside = np.clip((half - np.abs(across[None] + down[:, None])) / soft + 0.5, 0.0, 1.0)
        return picture * (1.0 - inside * (1.0 - generator.uniform(*self.depth))).astype(np.float32)[..., None]


@spec
class Haze:
    """Dust in the air: the picture fades into the dust's colour, unevenly (Koschmieder's law with a transmission that drifts).

    Attributes:
        probability: How often.
        transmission: Range of what comes through.
        brightness: Range of the dust's brightness.
        unevenness: Largest change of the transmission across the picture.
    """

    probability: float
    transmission: Range
    brightness: Range
    unevenness: float

    def check(self) -> None:
        _check(self, transmission=self.transmission, brightness=self.brightness)

    def changed(self, picture: np.ndarray, generator: np.random.Generator) -> np.ndarray:
        """Returns the picture through dust."""
        coarse = generator.uniform(-1.0, 1.0, (4, 5)).astype(np.float32) * self.unevenness
        drift = cv2.resize(coarse, picture.shape[1::-1], interpolation=cv2.INTER_CUBIC)
        through = np.clip(generator.uniform(*self.transmission) + drift, 0.05, 1.0)[..., None]
        dust = (generator.uniform(*self.brightness) * generator.uniform([0.95, 0.9, 0.85], [1.0, 1.0, 1.0])).astype(np.float32)
        return picture * through + dust * (1.0 - through)


@spec
class Blur:
    """Out of focus.

    Attributes:
        probability: How often.
        sigma_px: Range of the standard deviation, px of the network's picture.
    """

    probability: float
    sigma_px: Range

    def check(self) -> None:
        _check(self, sigma_px=self.sigma_px)

    def changed(self, picture: np.ndarray, generator: np.random.Generator) -> np.ndarray:
        """Returns the picture out of focus."""
        return cv2.GaussianBlur(picture, (0, 0), generator.uniform(*self.sigma_px))


@spec
class MotionBlur:
    """The camera moved along a line while the shutter was open.

    Attributes:
        probability: How often.
        length_px: Range of the way, px of the network's picture.
    """

    probability: float
    length_px: Range

    def check(self) -> None:
        _check(self, length_px=self.length_px)

    def changed(self, picture: np.ndarray, generator: np.random.Generator) -> np.ndarray:
        """Returns the picture smeared along a line; what is shown stays where it was, in the middle of the way."""
        length, angle_rad = generator.uniform(*self.length_px), generator.uniform(0.0, np.pi)
        half = int(np.ceil(length / 2.0)) + 1
        kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
        for along in np.linspace(-length / 2.0, length / 2.0, 8 * half + 1):
            x, y = half + along * np.cos(angle_rad), half + along * np.sin(angle_rad)
            column, row = int(x), int(y)
            right, lower = x - column, y - row
            kernel[row : row + 2, column : column + 2] += np.outer([1.0 - lower, lower], [1.0 - right, right]).astype(np.float32)
        return cv2.filter2D(picture, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)


@spec
class Noise:
    """Noise of the sensor: a constant part and one that grows with the root of the light, partly grainy.

    Attributes:
        probability: How often.
        constant: Range of the constant part's standard deviation, of full scale.
        photon: Range of the standard deviation at full light.
        grain_px: Range of the grain's size.
    """

    probability: float
    constant: Range
    photon: Range
    grain_px: Range

    def check(self) -> None:
        _check(self, grain_px=self.grain_px)

    def changed(self, picture: np.ndarray, generator: np.random.Generator) -> np.ndarray:
        """Returns the picture with noise."""
        noise, grain_px = generator.standard_normal(picture.shape, np.float32), generator.uniform(*self.grain_px)
        if grain_px > 0.3:
            noise = cv2.GaussianBlur(noise, (0, 0), grain_px) * np.float32(2.0 * np.sqrt(np.pi) * grain_px)
        constant, photon = generator.uniform(*self.constant), generator.uniform(*self.photon)
        return picture + noise * np.sqrt(constant**2 + photon**2 * np.clip(picture, 0.0, 1.0))


@spec
class Jpeg:
    """Compression of a video stream.

    Attributes:
        probability: How often.
        quality: Range of JPEG's quality, 1 to 100.
    """

    probability: float
    quality: Range

    def check(self) -> None:
        _check(self, quality=self.quality)

    def changed(self, picture: np.ndarray, generator: np.random.Generator) -> np.ndarray:
        """Returns the picture as a JPEG file gives it back."""
        levels = (np.clip(picture, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
        _, coded = cv2.imencode(".jpg", levels, [cv2.IMWRITE_JPEG_QUALITY, round(generator.uniform(*self.quality))])
        return np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR)).astype(np.float32) / 255.0


def _check(step: Augmentation, **ranges: Range) -> None:
    """Raises a `ConfigError` for a probability outside [0, 1] and for ranges that are empty or reach below 0."""
    if not 0.0 <= step.probability <= 1.0:
        raise ConfigError(f"{type(step).__name__}.probability: expected 0 to 1, got {step.probability}")
    for name, (low, high) in ranges.items():
        if not 0.0 <= low <= high:
            raise ConfigError(f"{type(step).__name__}.{name}: expected 0 <= lowest <= highest, got [{low}, {high}]")
