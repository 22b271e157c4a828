"""Worth of each tuned number of the ellipse detector: an ablation on the ellipse benchmark at reduced size.

    python benchmarks/perception/gates.py benchmarks/perception/gates.json --count 2

Each number of `conf/perception/ellipse/contour_arcs.yaml` is moved by 20 % both ways; each gate is
switched off, those without a number too. Every variant sees the same pictures, with and without a
size prior. Recorded are recall, precision, F and the median error of the centres, and by how much F
falls short of the default's, with its standard error over pictures (bootstrap of the differences).
A variant matters where that is more than two standard errors.
"""

from __future__ import annotations

import argparse
import functools
import json
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import cv2
import hydra
import numpy as np
from hydra.utils import instantiate
from rich.console import Console
from rich.progress import track
from rich.table import Table
from speed import processor

from brokk_rl.contracts.vision import Ellipse
from perception.benchmark.calibration_patterns import (
    CONDITIONS,
    NEGATIVES,
    count_matches,
    draw_negative,
    draw_pattern,
)
from perception.benchmark.occluded_ellipses import SHAPES, draw_lookalikes, draw_occluded_ellipses
from perception.benchmark.occluded_ellipses import STYLES as OCCLUDED
from perception.benchmark.photographs import STYLES, draw_photograph
from perception.contracts import EllipseDetector, SizePrior
from perception.ellipse import support

SIZE_PX = (512, 384)
"""Width and height of patterns and photographs; 960 x 720 in the full benchmark."""
PRIOR_SLACK = 1.35
"""Factor around the true sizes of a picture for its size prior, as `size_slack` of the finder."""
NUM_RESAMPLES = 400
STEP = 0.2
"""Part by which each number is moved, both ways."""
OFF = {
    "coverage": 0.01,
    "gap": 1.0,
    "rms_px": 1e3,
    "wave_px": 1e3,
    "wave_rad": 1e3,
    "angle_rms_rad": 1e3,
    "purity": 0.0,
    "evidence": 0.0,
    "score": 0.0,
    "smallest_px": 0.0,
    "prior_flattest": 0.0,
}
"""Value of each gate's number that lets everything pass."""


@dataclass(frozen=True)
class Picture:
    """A grey picture with its true ellipses, `(T, 5)`, and how large they may be."""

    gray: np.ndarray
    truth: np.ndarray
    prior: SizePrior | None


@dataclass(frozen=True)
class Counts:
    """Counts of each picture, `(P,)`, and the errors of all matched centres, px."""

    hits: np.ndarray
    found: np.ndarray
    true: np.ndarray
    error_px: np.ndarray

    def score(self, chosen: np.ndarray | slice = slice(None)) -> float:
        """Return F of some pictures."""
        both = self.found[chosen].sum() + self.true[chosen].sum()
        return 2.0 * float(self.hits[chosen].sum()) / max(float(both), 1.0)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=2, help="pictures of each kind")
    parser.add_argument("--seed", type=int, default=1000)
    given = parser.parse_args()
    cv2.setNumThreads(1)
    settings = load_settings()
    pictures = list(draw_pictures(given.count, given.seed))
    default = count_ellipses(settings.build(), pictures)
    rows = [describe("default", default, default, given.seed)]
    facts = describe_run(len(pictures), given.count, given.seed)
    for name, detector, changes in track(list(list_variants(settings)), transient=True):
        with changes():
            rows.append(describe(name, count_ellipses(detector, pictures), default, given.seed))
        given.out.write_text(json.dumps({**facts, "rows": rows}, indent=1) + "\n")
    table = Table(*rows[0])
    for row in rows:
        table.add_row(*(f"{v:.4g}" if isinstance(v, float) else str(v) for v in row.values()))
    Console(width=140).print(table)


def load_settings() -> Any:
    """Return the shipped spec of the detector."""
    with hydra.initialize_config_module("conf", version_base="1.3"):
        cfg = hydra.compose("config", ["mode=perceive", "perceive.input=."])
    return instantiate(cfg.perception.ellipse, _convert_="all")


def draw_pictures(count: int, seed: int) -> Iterator[Picture]:
    """Yield the pictures: each kind of the ellipse benchmark, those with ellipses twice."""
    draws: list[Callable[[np.random.Generator], tuple[np.ndarray, np.ndarray]]] = []
    for condition in CONDITIONS:
        draws.append(lambda rng, kind=condition: draw_pattern(rng, kind, *SIZE_PX))
    for style in STYLES:
        draws.append(lambda rng, kind=style: draw_photograph(rng, kind, *SIZE_PX))
    for style in OCCLUDED:
        draws.append(functools.partial(draw_occluded_ellipses, style=style))
    for kind in NEGATIVES:
        draws.append(lambda rng, kind=kind: (draw_negative(kind, rng), np.empty((0, 5))))
    for kind in SHAPES:
        draws.append(lambda rng, kind=kind: (draw_lookalikes(rng, kind), np.empty((0, 5))))
    for draw in draws:
        for number in range(count):
            gray, truth = draw(np.random.default_rng(seed + number))
            yield Picture(gray, truth, None)
            if len(truth):
                low, high = float(truth[:, 2].min()), float(truth[:, 2].max())
                yield Picture(gray, truth, SizePrior(low / PRIOR_SLACK, high * PRIOR_SLACK))


def list_variants(settings: Any) -> Iterator[tuple[str, EllipseDetector, Callable[[], Any]]]:
    """Yield name and detector of each variant, and the context in which it runs."""
    for field in fields(settings):
        value = getattr(settings, field.name)
        for name, factor in (("-20 %", 1.0 - STEP), ("+20 %", 1.0 + STEP)):
            moved = value * factor
            if isinstance(value, int):
                moved = max(round(moved), 6)
            if moved != value:
                detector = replace(settings, **{field.name: moved}).build()
                yield f"{field.name} {name}", detector, leave_functions
    for name, value in OFF.items():
        if hasattr(settings, name):
            yield f"{name} off", replace(settings, **{name: value}).build(), leave_functions
    for function, answer in (
        ("measure_strength", np.inf),
        ("find_smooth_continuations", False),
        ("find_inward_outlines", False),
        ("find_occluded", False),
    ):
        if hasattr(support, function):
            change = functools.partial(replace_function, function, answer)
            yield f"{function} off", settings.build(), change


@contextmanager
def leave_functions() -> Iterator[None]:
    """Run with the functions as they are."""
    yield


@contextmanager
def replace_function(name: str, answer: float | bool) -> Iterator[None]:
    """Run with a function of `perception.ellipse.support` that answers the same for all candidates."""
    original = getattr(support, name)

    def respond(*arguments: Any) -> np.ndarray:
        num_candidates = len(original(*arguments))
        return np.full(num_candidates, answer)

    setattr(support, name, respond)
    try:
        yield
    finally:
        setattr(support, name, original)


def count_ellipses(detector: EllipseDetector, pictures: Sequence[Picture]) -> Counts:
    """Return the counts of a detector on all pictures."""
    hits, found, true, errors = [], [], [], []
    for picture in pictures:
        seen = detector.detect(picture.gray, None, picture.prior)
        hits.append(count_matches(seen, picture.truth) if len(picture.truth) else 0)
        found.append(len(seen))
        true.append(len(picture.truth))
        errors += measure_errors(seen, picture.truth)
    return Counts(np.array(hits), np.array(found), np.array(true), np.array(errors))


def measure_errors(seen: Sequence[Ellipse], truth: np.ndarray) -> list[float]:
    """Return the distance of each ellipse from the nearest true centre, where that is its own."""
    errors = []
    for one in seen if len(truth) else ():
        distances = np.hypot(truth[:, 0] - one.x, truth[:, 1] - one.y)
        if distances.min() < 0.2 * one.b:
            errors.append(float(distances.min()))
    return errors


def describe(name: str, counts: Counts, default: Counts, seed: int) -> dict[str, Any]:
    """Return the figures of a variant, and its loss of F beside the default."""
    generator = np.random.default_rng(seed)
    losses = []
    for _ in range(NUM_RESAMPLES):
        chosen = generator.integers(len(counts.hits), size=len(counts.hits))
        losses.append(default.score(chosen) - counts.score(chosen))
    loss, std = default.score() - counts.score(), float(np.std(losses))
    error = float(np.median(counts.error_px)) if len(counts.error_px) else None
    changed = np.any((counts.hits != default.hits) | (counts.found != default.found))
    return {
        "variant": name,
        "recall": float(counts.hits.sum() / max(counts.true.sum(), 1)),
        "precision": float(counts.hits.sum() / max(counts.found.sum(), 1)),
        "f": counts.score(),
        "error_px": error,
        "f_loss": loss,
        "f_loss_std": std,
        "changes_counts": bool(changed),
        "matters": bool(abs(loss) > 2.0 * std and loss != 0.0),
    }


def describe_run(num_pictures: int, count: int, seed: int) -> dict[str, Any]:
    """Return commit, machine, versions and size of the run."""
    head = ["git", "rev-parse", "HEAD"]
    commit = subprocess.run(head, capture_output=True, text=True, check=False).stdout.strip()
    return {
        "commit": commit,
        "processor": processor(),
        "opencv": cv2.__version__,
        "numpy": np.__version__,
        "size_px": SIZE_PX,
        "pictures": num_pictures,
        "count": count,
        "seed": seed,
    }


if __name__ == "__main__":
    main()
