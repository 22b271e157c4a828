"""Evaluation of a segmenter on unseen frames, as numbers and as pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from perception.segment.network import THRESHOLD
from perception.segment.unet import CHANNELS, UNet
from perception.segment.window import center_window, cover_picture
from perception.train.samples import LOOKS, ROOM, TrainingViews

BATCH = 32
SHOWN = 12
"""Frames in the picture of samples."""
COLOURS = {"block": (0, 114, 178), "mouth": (213, 94, 0)}


def crop_segmenter_views(
    views: TrainingViews, size_px: tuple[int, int]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the segmenter's pictures, `(F, 2, 3, h, w)` uint8, and their masks, `(F, 2, 2, h, w)`."""
    width, height = size_px
    full = tuple(views.layers.shape[3:])
    room = (
        full[1] * (1.0 - 1.0 / ROOM) / 2.0,
        full[0] * (1.0 - 1.0 / ROOM) / 2.0,
        full[1] / ROOM,
        full[0] / ROOM,
    )
    seen = np.empty((len(views), len(LOOKS), 5, height, width), np.uint8)
    for look, window in enumerate(
        (cover_picture(full, size_px), center_window(room, size_px, 0.0))
    ):
        for frame in range(len(views)):
            layers = views.layers[frame, look].numpy().transpose(1, 2, 0)
            for part in (slice(0, 3), slice(3, 5)):
                seen[frame, look, part] = window.take(
                    np.ascontiguousarray(layers[..., part]), size_px
                ).transpose(2, 0, 1)
    layers = torch.from_numpy(seen)
    return layers[:, :, :3], layers[:, :, 3:] > 127


@torch.no_grad()
def predict(network: UNet, pictures: torch.Tensor, device: torch.device) -> torch.Tensor:
    """Return probabilities, `(F, 2, 2, h, w)` on the CPU, for pictures `(F, 2, 3, h, w)` uint8."""
    network.eval()
    flat, found = pictures.flatten(0, 1), []
    for first in range(0, len(flat), BATCH):
        found.append(
            torch.sigmoid(network(flat[first : first + BATCH].to(device).float() / 255.0))
            .float()
            .cpu()
        )
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


def draw_samples(
    path: Path, pictures: torch.Tensor, probabilities: torch.Tensor, known: torch.Tensor
) -> None:
    """Write a PNG of some frames in both views: true masks as lines, predictions as colour."""
    rows = []
    for frame in np.linspace(0, len(pictures) - 1, min(SHOWN, len(pictures))).round().astype(int):
        tiles = []
        for look in range(len(LOOKS)):
            picture = np.ascontiguousarray(pictures[frame, look].numpy().transpose(1, 2, 0))
            for channel, name in enumerate(CHANNELS):
                weight = 0.45 * probabilities[frame, look, channel].numpy()[..., None]
                picture = (picture * (1 - weight) + np.array(COLOURS[name]) * weight).astype(
                    np.uint8
                )
                there = known[frame, look, channel].numpy().astype(np.uint8)
                outlines, _ = cv2.findContours(there, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
                cv2.drawContours(picture, outlines, -1, (255, 255, 255), 1)
            tiles.append(picture)
        rows.append(np.concatenate(tiles, axis=1))
    if len(rows) % 2:
        rows.append(np.zeros_like(rows[0]))
    sheet = np.concatenate(
        [np.concatenate(rows[k : k + 2], axis=1) for k in range(0, len(rows), 2)]
    )
    cv2.imwrite(str(path), cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))
