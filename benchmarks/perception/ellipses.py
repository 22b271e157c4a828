"""The table of ellipses: calibration patterns under every condition, photographs' styles, hidden ellipses, pictures without any.

    python benchmarks/perception/ellipses.py <out> --count 10 contour_arcs edge_drawing

One-to-one assignment with an intersection over union above 0.8. Writes `ellipses.json` into <out>.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import hydra
import numpy as np
from hydra.utils import instantiate
from rich.console import Console
from rich.progress import track
from rich.table import Table

from perception.benchmark.calibration_patterns import (
    CONDITIONS,
    NEGATIVES,
    count_matches,
    draw_negative,
    draw_pattern,
)
from perception.benchmark.occluded_ellipses import SHAPES, draw_lookalikes, draw_occluded_ellipses
from perception.benchmark.occluded_ellipses import STYLES as HIDDEN
from perception.benchmark.photographs import STYLES, draw_photograph
from perception.contracts import EllipseDetector

NONE = np.empty((0, 5))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument(
        "options", nargs="+", help="an option of perception/ellipse, with overrides after it"
    )
    parser.add_argument("--count", type=int, default=10, help="pictures of each kind")
    parser.add_argument("--seed", type=int, default=1000)
    given = parser.parse_args()
    cv2.setNumThreads(1)
    given.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for option in given.options:
        detector = build(option)
        for kind, draw in track(list(kinds()), description=option, transient=True):
            rows.append(
                {"ellipse": option, "kind": kind, **judged(detector, draw, given.count, given.seed)}
            )
            (given.out / "ellipses.json").write_text(json.dumps(rows, indent=1) + "\n")
    table = Table(*rows[0])
    for row in rows:
        table.add_row(
            *(
                "–" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)
                for value in row.values()
            )
        )
    Console().print(table)


def kinds() -> Iterator[tuple[str, Callable[[np.random.Generator], tuple[np.ndarray, np.ndarray]]]]:
    """Yields each kind of picture and what draws one."""
    for condition in CONDITIONS:
        yield (
            f"pattern, {condition}",
            lambda generator, condition=condition: draw_pattern(generator, condition),
        )
    for style in STYLES:
        yield (
            f"photograph, {style}",
            lambda generator, style=style: draw_photograph(generator, style),
        )
    for style in HIDDEN:
        yield (
            f"hidden, {style}",
            lambda generator, style=style: draw_occluded_ellipses(generator, style),
        )
    for kind in NEGATIVES:
        yield (
            f"nothing, {kind}",
            lambda generator, kind=kind: (draw_negative(kind, generator), NONE),
        )
    for kind in SHAPES:
        yield (
            f"nothing, {kind}",
            lambda generator, kind=kind: (draw_lookalikes(generator, kind), NONE),
        )


def build(option: str) -> EllipseDetector:
    """Returns the detector of an option."""
    name, *overrides = option.split()
    with hydra.initialize_config_module("conf", version_base="1.3"):
        cfg = hydra.compose(
            "config",
            ["mode=perceive", "perceive.input=.", f"perception/ellipse={name}", *overrides],
        )
    return instantiate(cfg.perception.ellipse, _convert_="all").build()


def judged(
    detector: EllipseDetector, draw: Callable, count: int, seed: int
) -> dict[str, float | int | None]:
    """Returns what a detector makes of so many pictures of a kind."""
    hits = found = there = 0
    ms = []
    for number in range(count):
        picture, truth = draw(np.random.default_rng(seed + number))
        start = time.perf_counter()
        seen = detector.detect(picture, None, None)
        ms.append(1000 * (time.perf_counter() - start))
        hits, found, there = (
            hits + (count_matches(seen, truth) if len(truth) else 0),
            found + len(seen),
            there + len(truth),
        )
    precision, recall = hits / found if found else None, hits / there if there else None
    f = 2 * precision * recall / (precision + recall) if precision and recall else None
    return {"pictures": count, "true": there, "false": found - hits, "precision": precision, "recall": recall, "f": f,
            "ms_median": float(np.median(ms))}  # fmt: skip


if __name__ == "__main__":
    main()
