"""The rim of a hole in full resolution: where brightness rises most steeply across an ellipse that is known roughly."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from brokk_rl.sight import Ellipse
from perception import conic

SIGMA_PX = 1.0
"""Blur along a profile before its slope is taken."""
STEP_PX = 0.5
"""Between the samples of a profile."""
ROUNDS_PX = (1.5, 0.6, 0.35)
"""Rounds of the fit: the distance from the ellipse at which a point counts a quarter."""
INLIER_PX = 1.0
"""What lies farther from the final ellipse is no part of the rim."""
STRAY = 0.35
"""Slope of the edge against the ellipse from which it is another's."""
LEAST_SHARE = 0.6
"""Of the coverage that the rough ellipse had: with less, the rough one stays."""


def refined(gray: np.ndarray, rough: Ellipse, reach_px: float) -> Ellipse:
    """Returns the ellipse through the steepest places of profiles across a rough one; the rough one where they do not agree.

    Args:
        gray: Picture, `(h, w)` uint8.
        rough: Dark inside.
        reach_px: How far from the rough ellipse its rim may lie.
    """
    row = np.array([[rough.x, rough.y, rough.a, rough.b, rough.theta_rad]])
    number = int(np.clip(2 * conic.perimeter(row[0, 2], row[0, 3]), 64, 256))
    angles = np.arange(number) * (2 * np.pi / number)
    points, outward, length = (value[0] for value in conic.sample(row, angles))
    offset = np.arange(-reach_px - 2.0, reach_px + 2.0 + 1e-9, STEP_PX)
    place = points[:, None] + offset[None, :, None] * outward[:, None]
    height, width = gray.shape
    if place[..., 0].min() < 1 or place[..., 1].min() < 1 or place[..., 0].max() > width - 2 or place[..., 1].max() > height - 2:
        return rough
    profile = cv2.remap(gray, place[..., 0].astype(np.float32), place[..., 1].astype(np.float32), cv2.INTER_LINEAR).astype(
        np.float32
    )
    slope = np.gradient(cv2.GaussianBlur(profile, (0, 0), SIGMA_PX / STEP_PX, sigmaY=0.8), axis=1)
    peak = 1 + np.argmax(slope[:, 1:-1], 1)
    rows = np.arange(number)
    before, here, after = (slope[rows, peak + shift] for shift in (-1, 0, 1))
    bend = before - 2 * here + after
    shift = np.where(bend < 0, 0.5 * (before - after) / np.where(bend < 0, bend, -1.0), 0.0).clip(-0.5, 0.5)
    at = offset[peak] + STEP_PX * shift
    steep = here > 0.3 * np.median(here)
    good = steep & (peak > 1) & (peak < slope.shape[1] - 2) & _follows(at, length * (2 * np.pi / number))
    edge = points + at[:, None] * outward
    found = row
    for scale_px in ROUNDS_PX:
        weight = good / (1.0 + (conic.distance(found, edge[None])[0] / scale_px) ** 2) ** 2
        size = float(np.sqrt(found[0, 2] * found[0, 3]))
        even = weight / np.maximum(conic.slopes(found, edge[None])[0] * size, 1e-3) ** 2
        found = conic.fit(edge[None], even[None])
        if not np.isfinite(found).all():
            return rough
    off = conic.distance(found, edge[None])[0]
    on = good & (np.abs(off) < INLIER_PX)
    coverage = float(length[on].sum() / length.sum())
    moved = np.abs(found[0, :4] - row[0, :4]).max()
    if coverage < LEAST_SHARE * rough.coverage or moved > reach_px + 1.0:
        return rough
    x, y, a, b, theta = map(float, found[0])
    rms_px = float(np.sqrt(np.mean(off[on] ** 2)))
    return replace(rough, x=x, y=y, a=a, b=b, theta_rad=theta, rms_px=rms_px, coverage=coverage)


def _follows(at: np.ndarray, step_px: np.ndarray) -> np.ndarray:
    """Says where the edge runs along the ellipse, not across it as that of something before it does, `(P,)` bool.

    Args:
        at: Distance of the edge from the ellipse at each place around it, `(P,)` px.
        step_px: From each place to the next, `(P,)`.
    """
    reach = max(2, round(2.0 / float(step_px.mean())))
    rise = np.abs(np.roll(at, -reach) - np.roll(at, reach)) / (2 * reach * step_px)
    return rise < STRAY
