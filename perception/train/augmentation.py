"""Augmentations of brightness, sharpness and noise; nothing moves in the pictures.

The paper's five are blur, crop, contrast, gamma and noise; crop changes the geometry and is
`samples.Crop`. Rendered scenes vary light, dust, shadows and sensor by themselves.
"""

from __future__ import annotations

import math
from typing import Annotated

import torch
from annotated_types import Ge, MultipleOf

from brokk_rl.spec import NonNegative, PositiveRange, Share, spec


@spec
class Augmentation:
    """Changes of pictures by kornia, each drawn for itself.

    Attributes:
        probability: Share of the pictures that each change meets.
        brightness: Range of the added brightness plus 1: 1 changes nothing.
        contrast: Range of the factor on the brightness.
        gamma: Range of the exponent of the tone curve.
        blur_px: Range of the standard deviation of the blur, px of the network's picture.
        motion_px: Way of the camera while the shutter was open, px.
        noise: Standard deviation of the noise, of full scale.
    """

    probability: Share
    brightness: PositiveRange
    contrast: PositiveRange
    gamma: PositiveRange
    blur_px: PositiveRange
    motion_px: Annotated[int, Ge(4), MultipleOf(2)]
    noise: NonNegative

    def build(self) -> torch.nn.Module:
        """Return the changes of RGB pictures in [0, 1], `(B, 3, h, w)`; they draw from torch."""
        from kornia import augmentation

        share = self.probability
        side_px = 2 * math.ceil(3.0 * self.blur_px[1]) + 1
        return torch.nn.Sequential(
            augmentation.RandomBrightness(self.brightness, p=share),
            augmentation.RandomContrast(self.contrast, p=share),
            augmentation.RandomGamma(self.gamma, p=share),
            augmentation.RandomGaussianBlur((side_px, side_px), self.blur_px, p=share),
            augmentation.RandomMotionBlur(self.motion_px + 1, 180.0, 0.0, p=share),
            augmentation.RandomGaussianNoise(0.0, self.noise, p=share),
        )
