"""Calibration of probabilities: logistic regressions on a few signs, fitted to answers of known truth.

A log-likelihood gain is no probability: simulator, noise and forms of effects are all a little
wrong, so a Bayes factor of e to 40 is wrong once in twenty. The weights in
`conf/certainty.yaml` were fitted to development exams. All signs mean the same on any machine.
Axes: `J` joints.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from diagnosis.detection import DetectionResult
from diagnosis.residual_model import CLUES, CURVE, FORMS, LATER, STARTS, TIME

REFERENCE_FACTOR = 1.5
"""Times that a clue must earn what it earns on the reference before it counts."""
LITTLE_NATS = 10.0
"""Evidence below is little."""
MUCH_NATS = 50.0
"""What effects explain is much beyond: then a part that they leave says less, as no form is exactly
that of the library."""
CLUE_NATS = 100.0
"""The same of a clue's evidence."""
OWN_CLUE_NATS = {STARTS: 50.0, CURVE: 1000.0, TIME: 1000.0, LATER: 1000.0}
"""The same of single clues: real forms differ most in starts and stops, little in their curve, and
not with the running time."""


def compute_probability(weights: Mapping[str, float], signs: Mapping[str, float]) -> float:
    """Return the probability that goes with signs."""
    return float(1.0 / (1.0 + np.exp(-compute_log_odds(weights, signs))))


def compute_log_odds(weights: Mapping[str, float], signs: Mapping[str, float]) -> float:
    """Return the logarithm of the odds, clipped to -6 to 6."""
    return float(np.clip(sum(weights[name] * value for name, value in signs.items()), -6.0, 6.0))


def subtract_reference_clues(result: DetectionResult) -> np.ndarray:
    """Return the gain of clues on the remaining residuals beyond `REFERENCE_FACTOR` times that on the reference, `(clues, J)`."""
    return np.maximum(result.clue_gains - REFERENCE_FACTOR * result.reference_clue_gains, 0.0)


def collect_outside_signs(result: DetectionResult) -> dict[str, float]:
    """Return the signs that something is there which no effect of the library is."""
    stages, left = {one.kind.stage for one in result.detected}, subtract_reference_clues(result)
    subsets = zip(result.tables, result.chosen.subsets, strict=True)
    gained = np.array([table.score(subset).total if subset else 0.0 for table, subset in subsets])
    explained = 1.0 + float(np.log1p(gained.sum() / MUCH_NATS))
    late = "timing" in stages  # frames that come late scatter errors, whatever else is there
    seen = bool(stages & {"kinematics", "sensing"})
    clues = {
        name: float(
            np.log1p(
                (row / (1.0 + gained / OWN_CLUE_NATS.get(name, CLUE_NATS))).max() / LITTLE_NATS
            )
        )
        for name, row in zip(
            CLUES, left, strict=False
        )  # the curve has not always been a clue of its own
    }
    return {
        "constant": 1.0,
        "clue": max((value for name, value in clues.items() if name not in FORMS), default=0.0),
        "form": clues[STARTS],
        "curve": clues.get(CURVE, 0.0),
        "scatter": 0.0 if late else _log_excess(result.scatter) / explained,
        "strays": _log_excess(result.strays) / explained,
        "tool": 0.0 if seen else _log_excess(np.array(result.tool_left)),
    }


def _log_excess(ratios: np.ndarray) -> float:
    return float(np.log(np.maximum(ratios, 1.0)).max())


def collect_effect_signs(
    margin: float, adds: float, size: float, names: int, outside: float
) -> dict[str, float]:
    """Return the signs that an effect is rightly named.

    Args:
        margin: By how much more it is worth than nothing in its place, and than any other effect.
        adds: Share of the gain of all effects of its joints that is lost without it.
        size: Its largest size, over the typical one.
        names: Effects that were named.
        outside: Logarithm of the odds that the cause lies outside.
    """
    return {
        "constant": 1.0,
        "margin": float(np.arcsinh(margin / LITTLE_NATS)),
        "adds": float(np.log(np.clip(adds, 0.01, 1.0))),
        "size": float(np.log(np.clip(size, 0.05, 3.0))),
        "names": names - 1.0,
        "outside": outside,
    }


def widen_interval(ends: np.ndarray, form: float) -> np.ndarray:
    """Return low end, value and high end of a size `(3, …)` with the error of its form added to both sides."""
    low, value, high = ends
    more = 1.96 * form * np.abs(value)
    return np.stack(
        [value - np.hypot(value - low, more), value, value + np.hypot(high - value, more)]
    )
