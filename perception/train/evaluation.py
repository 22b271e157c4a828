"""Evaluation of a segmenter on unseen frames, in numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from perception.segment.network import THRESHOLD
from perception.segment.unet import UNet
from perception.segment.window import center_window, cover_picture
from perception.train.samples import LOOKS, ROOM, TrainingViews

BATCH = 32


def crop_segmenter_views(
    views: TrainingViews, size_px: tuple[int, int]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the segmenter's pictures, `(F, 2, 3, h, w)` uint8, and their masks, `(F, 2, 2, h, w)`."""
    width, height = size_px
    full = tuple(views.layers.shape[3:])
    height_px, width_px = full
    beside = 0.5 * (1.0 - 1.0 / ROOM)
    room = (width_px * beside, height_px * beside, width_px / ROOM, height_px / ROOM)
    seen = np.empty((len(views), len(LOOKS), 5, height, width), np.uint8)
    windows = cover_picture(full, size_px), center_window(room, size_px, 0.0)
    for look, window in enumerate(windows):
        for frame in range(len(views)):
            layers = views.layers[frame, look].numpy().transpose(1, 2, 0)
            for part in (slice(0, 3), slice(3, 5)):
                taken = window.take(np.ascontiguousarray(layers[..., part]), size_px)
                seen[frame, look, part] = taken.transpose(2, 0, 1)
    layers = torch.from_numpy(seen)
    return layers[:, :, :3], layers[:, :, 3:] > 127


@torch.no_grad()
def predict(network: UNet, pictures: torch.Tensor, device: torch.device) -> torch.Tensor:
    """Return probabilities, `(F, 2, 2, h, w)` on the CPU, for pictures `(F, 2, 3, h, w)` uint8."""
    network.eval()
    flat, found = pictures.flatten(0, 1), []
    for first in range(0, len(flat), BATCH):
        batch = flat[first : first + BATCH].to(device).float() / 255.0
        found.append(torch.sigmoid(network(batch)).float().cpu())
    return torch.cat(found).unflatten(0, pictures.shape[:2])


def compute_metrics(
    probabilities: torch.Tensor, known: torch.Tensor, conditions: Sequence[str]
) -> dict[str, dict[str, Any]]:
    """Return figures for each condition, and for all frames under `all`.

    `block`: intersection over union of the block, seen as a whole. `mouth`: that of mouths, in the
    closer view; both over all pixels of all frames, `None` where there is nothing to find.
    `frames`: how many.
    """
    said = probabilities > THRESHOLD
    block, mouth = (said[:, 0, 0], known[:, 0, 0]), (said[:, 1, 1], known[:, 1, 1])
    table = {}
    for name in ("all", *sorted(set(conditions))):
        chosen = np.array([name in ("all", condition) for condition in conditions])
        index = torch.from_numpy(chosen)
        table[name] = {
            "block": _compute_iou(block[0][index], block[1][index]),
            "mouth": _compute_iou(mouth[0][index], mouth[1][index]),
            "frames": int(chosen.sum()),
        }
    return table


def _compute_iou(said: torch.Tensor, known: torch.Tensor) -> float | None:
    return float((said & known).sum() / (said | known).sum()) if known.any() else None
