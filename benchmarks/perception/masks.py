"""How well a segmenter finds block and mouths in frames that it has not seen, at their full size.

    python benchmarks/perception/masks.py <out.json> <segmenter> [override ...] -- <folder> ...

`<segmenter>` is an option of perception/segmenter, overrides begin with `segmenter.`; folders hold
frames with masks (`brokk mode=render`), each one is a row. Frames without depth will do for the
networks.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import cv2
import hydra
import numpy as np
from hydra.utils import instantiate
from rich.console import Console
from rich.progress import track
from rich.table import Table

from brokk_rl.contracts.vision import FrameSource
from perception import dataset
from perception.contracts import Segmenter
from perception.segment.network import THRESHOLD
from perception.train.evaluation import match_pieces

FIGURES = ("block", "mouth", "found", "false", "ms")


def main() -> None:
    cut = sys.argv.index("--")
    out, name, *overrides = sys.argv[1:cut]
    cv2.setNumThreads(1)
    rows = {}
    for folder in sys.argv[cut + 1 :]:
        segmenter, source = built(name, overrides, folder)
        rows[Path(folder).name] = judged(segmenter, source, Path(folder).name)
    Path(out).write_text(
        json.dumps({"segmenter": name, "overrides": overrides, "rows": rows}, indent=1) + "\n"
    )
    table = Table(
        "frames of",
        "count",
        "block IoU",
        "mouth IoU",
        "mouths found",
        "false a frame",
        "ms",
        title=name,
    )
    for row, figures in rows.items():
        cells = ("–" if figures[key] is None else f"{figures[key]:.3g}" for key in FIGURES)
        table.add_row(row, str(figures["frames"]), *cells)
    Console(width=120).print(table)


def built(name: str, overrides: list[str], folder: str) -> tuple[Segmenter, FrameSource]:
    with hydra.initialize_config_module("conf", version_base="1.3"):
        cfg = hydra.compose(
            "config",
            ["~mode", f"+perception/segmenter@segmenter={name}", "+perception/source@source=folder", f"source.folder={folder}",
             "source.needs=camera", *overrides],
        )  # fmt: skip
    segmenter, source = (
        instantiate(cfg[key], _convert_="all").build() for key in ("segmenter", "source")
    )
    return segmenter, source


def judged(segmenter: Segmenter, source: FrameSource, name: str) -> dict[str, float | int | None]:
    """Returns overlaps over all pixels of all frames, pieces that are mouths or none, and the time of a frame."""
    shared, either, real, counts = (np.zeros(size, int) for size in (2, 2, 2, 3))
    ms = []
    with source:
        for _ in track(range(source.num_frames or 0), name, transient=True):
            frame = source.read_latest()
            if frame is None:
                break
            start = time.perf_counter()
            masks = segmenter.segment(frame)
            ms.append(1000 * (time.perf_counter() - start))
            label = dataset.read_label(Path(frame.name))
            mouth = (
                np.zeros_like(label.hole_mask)
                if masks.hole_mask is None
                else masks.hole_mask > THRESHOLD
            )
            for channel, (said, known) in enumerate(
                ((masks.block > THRESHOLD, label.block), (mouth, label.hole_mask))
            ):
                shared[channel] += (said & known).sum()
                either[channel] += (said | known).sum()
                real[channel] += known.sum()
            counts += match_pieces(mouth, label.hole_mask)
    block, mouth = (
        float(a / b) if any_real else None
        for a, b, any_real in zip(shared, either, real, strict=True)
    )
    found, there, false = counts
    return {
        "frames": len(ms), "block": block, "mouth": mouth, "found": float(found / there) if there else None,
        "false": float(false / len(ms)), "ms": float(np.median(ms)),
    }  # fmt: skip


if __name__ == "__main__":
    main()
