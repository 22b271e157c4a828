"""Online check of a stereo pair: vertical disparity shows that the pair is not rectified.

The rows of a rectified pair correspond. Where they do not, a pitch, a roll or a focal length of one
camera differs, and the disparity across is wrong by a similar amount. A shift across alone shows
nothing here: a board at known distances measures it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from brokk_rl.contracts.vision import Rejection
from brokk_rl.signals import Frame
from brokk_rl.spec import NonNegative, Positive, spec

# All numbers below were chosen by hand.
REASON = "vertical disparity of the pair, px"
GRID = (12, 7)
"""Patches across and down the picture."""
SIDE_PX, BORDER_PX = 25, 3
"""Side of a patch, and its border without a full blur."""
SMOOTH_PX = 1.0
"""Blur of both pictures, px: noise would bias the gradient."""
STEPS = 2
"""Least-squares steps of a patch; the second one is about a tenth of the first."""
LEAST_KNOWN = 0.9
"""Least part of a patch with depth: less has an edge of an occluder in it."""
ALIKE = 0.8
"""Least correlation of the two patches."""
LEAST_SLOPE = 1.0
"""Least mean squared vertical gradient of a patch, (grey levels a pixel)²."""
LARGEST_PX = 3.0
"""Longest shift of a patch that is no wrong match."""
LEAST_PATCHES = 20
"""Patches from which three numbers are fitted."""
ROUNDS = 5
"""Rounds of reweighting."""
TUKEY = 4.685
"""Tukey's biweight, 95 % efficient with Gaussian noise."""


@dataclass(frozen=True)
class PairAlignment:
    """Vertical disparity of a pair: `pitch_px (1 + y²) + roll_px x + focal_px y`.

    `x` and `y` are coordinates at depth 1. All are what the right picture shows lower, px.

    Attributes:
        pitch_px: By a turn about the x axis, or a shift of the picture; focal length times angle.
        roll_px: By a turn about the optical axis, likewise.
        focal_px: By another focal length.
        rms_px: Root mean square over the whole picture, less what noise alone gives.
        std_px: Standard deviation of `rms_px`.
        num_patches: Patches that it rests on.
    """

    pitch_px: float
    roll_px: float
    focal_px: float
    rms_px: float
    std_px: float
    num_patches: int


@spec
class RectificationCheck:
    """Refuse frames whose pair is not rectified.

    Attributes:
        limit_px: Largest root mean square of the vertical disparity over the picture.
        num_sigma: Standard deviations by which it must exceed the limit.
    """

    limit_px: Positive
    num_sigma: NonNegative

    def find_fault(self, frame: Frame) -> Rejection | None:
        """Return why the pair of a frame is refused; `None` if it is not, or nothing can be seen."""
        found = measure_alignment(frame)
        if found is None or found.rms_px - self.num_sigma * found.std_px <= self.limit_px:
            return None
        return Rejection("frame", REASON, found.rms_px, self.limit_px)


def measure_alignment(frame: Frame) -> PairAlignment | None:
    """Return the vertical disparity of a frame's pair.

    Patches with known depth are registered in both directions (Lucas and Kanade 1981), and three
    numbers are fitted robustly to their vertical shifts.

    Returns:
        `None` without a right picture, or where fewer than `LEAST_PATCHES` patches have texture.
    """
    if frame.right is None or frame.baseline_m is None or frame.right.shape != frame.color.shape:
        return None
    columns, rows, shift_px = _register_patches(frame, frame.right, frame.baseline_m)
    if len(shift_px) < LEAST_PATCHES:
        return None
    design = _build_design(frame, columns, rows)
    weight = np.ones(len(shift_px))
    solution, scale = np.zeros(3), 0.0
    for _ in range(ROUNDS):
        root = np.sqrt(weight)
        solution = np.linalg.lstsq(design * root[:, None], shift_px * root, rcond=None)[0]
        away = shift_px - design @ solution
        scale = 1.4826 * float(np.median(np.abs(away))) + 1e-6
        weight = np.maximum(1.0 - (away / (TUKEY * scale)) ** 2, 0.0) ** 2
    cov = scale**2 * np.linalg.pinv(design.T @ (design * weight[:, None]))
    height, width = frame.depth_m.shape
    across, down = np.meshgrid(np.linspace(0, width - 1, 15), np.linspace(0, height - 1, 9))
    everywhere = _build_design(frame, across.ravel(), down.ravel())
    gram = everywhere.T @ everywhere / len(everywhere)
    noise = float(np.trace(gram @ cov))
    rms_px = float(np.sqrt(max(float(solution @ gram @ solution) - noise, 0.0)))
    pitch, roll, focal = (float(value) for value in solution)
    return PairAlignment(pitch, roll, focal, rms_px, float(np.sqrt(noise)), len(shift_px))


def _build_design(frame: Frame, columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
    matrix = frame.camera_matrix
    x = (columns - matrix[0, 2]) / matrix[0, 0]
    y = (rows - matrix[1, 2]) / matrix[1, 1]
    return np.stack([1.0 + y**2, x, y], axis=1)


def _register_patches(
    frame: Frame, right: np.ndarray, baseline_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return columns and rows of patches in the right picture, and their vertical shifts, px."""
    height, width = frame.depth_m.shape
    half = SIDE_PX // 2
    margin = half + 4
    grid_u = np.linspace(margin, width - 1 - margin, GRID[0]).astype(int)
    grid_v = np.linspace(margin, height - 1 - margin, GRID[1]).astype(int)
    middle_u, middle_v = (some.ravel() for some in np.meshgrid(grid_u, grid_v))
    step = np.arange(-half, half + 1)
    u = (middle_u[:, None, None] + step[None, None, :]).repeat(SIDE_PX, 1)
    v = (middle_v[:, None, None] + step[None, :, None]).repeat(SIDE_PX, 2)
    depth = frame.depth_m[v, u]
    known = np.isfinite(depth)
    enough = known.mean((1, 2)) >= LEAST_KNOWN
    u, v, depth, known = u[enough], v[enough], depth[enough], known[enough]
    if not len(u):
        return np.zeros(0), np.zeros(0), np.zeros(0)
    weight = known.astype(np.float32)
    disparity = frame.camera_matrix[0, 0] * baseline_m / np.where(known, depth, np.inf)
    disparity = _fit_patch_planes(disparity, weight, step)
    gray, partner = (cv2.cvtColor(one, cv2.COLOR_RGB2GRAY) for one in (frame.color, right))
    # The left gradient, whose noise is independent, serves as instrument (see `pose.alignment`).
    mine, *instruments = _filter_patches(gray[v, u].astype(np.float32), weight)
    place_u, place_v = (u - disparity).astype(np.float32), v.astype(np.float32)
    partner = partner.astype(np.float32)
    shift = np.zeros((len(u), 2), np.float32)
    likeness = np.zeros(len(u))
    for _ in range(STEPS):
        maps = place_u + shift[:, 0, None, None], place_v + shift[:, 1, None, None]
        seen, *rises = _filter_patches(_sample(partner, *maps), weight)
        energy, own = (seen**2).sum((1, 2)), (mine**2).sum((1, 2))
        likeness = (seen * mine).sum((1, 2)) / np.maximum(np.sqrt(energy * own), 1e-6)
        gain = np.sqrt(energy / np.maximum(own, 1e-6))
        off = gain[:, None, None] * mine - seen
        normal = np.empty((len(u), 2, 2))
        target = np.empty((len(u), 2, 1))
        for i, instrument in enumerate(instruments):
            target[:, i, 0] = (instrument * off).sum((1, 2))
            for j, rise in enumerate(rises):
                normal[:, i, j] = (instrument * rise).sum((1, 2))
        # Not singular where a patch has an edge of one direction only.
        normal += 1e-3 * np.eye(2)
        shift = shift + np.linalg.solve(normal, target)[..., 0].astype(np.float32)
        shift = np.clip(np.nan_to_num(shift), -2 * LARGEST_PX, 2 * LARGEST_PX)
    slope_energy = (instruments[1] ** 2).mean((1, 2))
    good = (likeness > ALIKE) & (slope_energy > LEAST_SLOPE)
    good &= np.abs(shift).max(1) < LARGEST_PX
    middle = np.s_[:, half, half]
    return place_u[middle][good], place_v[middle][good], shift[good, 1].astype(float)


def _fit_patch_planes(values: np.ndarray, weight: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return the plane of each patch `(n, s, s)`.

    A matcher answers vertical shifts with shifts across, pixel by pixel, and hides a third of them.
    """
    across, down = np.meshgrid(step, step)
    design = np.stack([np.ones(across.size), across.ravel(), down.ravel()], axis=1)
    flat, share = values.reshape(len(values), -1), weight.reshape(len(values), -1)
    normal = np.einsum("np,pi,pj->nij", share, design, design)
    target = np.einsum("np,pi,np->ni", share, design, flat)
    plane = np.linalg.solve(normal, target[..., None])[..., 0]
    return (plane @ design.T).reshape(values.shape)


def _sample(picture: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return a picture, `(h, w)` float32, at places `(n, s, s)`."""
    flat = u.reshape(len(u), -1), v.reshape(len(v), -1)
    values = cv2.remap(picture, *flat, cv2.INTER_CUBIC)
    return np.asarray(values).reshape(u.shape)


def _filter_patches(values: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return blurred patches `(n, s, s)` and their slopes across and down.

    Each is taken less its mean, and is 0 where it does not count.
    """
    smooth = gaussian_filter(values, (0.0, SMOOTH_PX, SMOOTH_PX))
    down, across = np.gradient(smooth, axis=(1, 2))
    # The border of a patch is blurred with nothing beyond it.
    weight = weight.copy()
    for side in (np.s_[:, :BORDER_PX], np.s_[:, -BORDER_PX:]):
        weight[side] = 0.0
        weight.swapaxes(1, 2)[side] = 0.0
    total = np.maximum(weight.sum((1, 2)), 1.0)
    parts = []
    for part in (smooth, across, down):
        mean = (part * weight).sum((1, 2)) / total
        parts.append((part - mean[:, None, None]) * weight)
    return tuple(parts)
