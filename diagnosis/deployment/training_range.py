"""Task evidence: whether a run lies where the policy's training has been.

The bundle holds the range of what the policy observed in training (`training_observations` of its
contract, written by `mode=export`). Axes: `T` rows of a log.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from brokk_rl.observation import TARGET_DISTANCE, RangeTable
from diagnosis.deployment.contract import PolicyContract
from diagnosis.deployment.replay import RunLog

FALSE_ALARMS = 0.01
"""Share of runs of the training's own distribution that may lie outside in any value; chosen by hand."""
LEAST_MARGIN = 0.05
"""Least margin, as a part of the range: samples are of single moments, a run passes through more. Chosen by hand."""
EXPORTED_ROWS = 256
"""Observations of the training that `mode=export` keeps."""
LEAST_SHARE = 0.1
"""Share of the rows outside from which the task is blamed. Chosen by hand."""


@dataclass(frozen=True)
class OutsideValue:
    """A value that lies outside the range of training, as `doctor.json` holds it.

    Attributes:
        field: Which one, such as `target.distance` or `q.q3`.
        share: Share of the rows outside.
        since_s: Time of the first row outside, s.
        log: Its lowest and highest value in the log.
        training: The same in training.
    """

    field: str
    share: float
    since_s: float
    log: tuple[float, float]
    training: tuple[float, float]


@dataclass(frozen=True)
class RangeEvidence:
    """Result of the comparison with the training's range.

    Attributes:
        outside: Values outside, the largest share first.
        cannot_tell: Why nothing can be said; empty where it can.
    """

    outside: tuple[OutsideValue, ...]
    cannot_tell: str

    @property
    def blamed(self) -> bool:
        """True if the run lies outside of the training's range."""
        return any(one.share >= LEAST_SHARE for one in self.outside)


def compare_with_training(log: RunLog, contract: PolicyContract) -> RangeEvidence:
    """Compare what the task gave in a log with the range of training."""
    if contract.training is None:
        advice = "export it again by mode=export, or add training_observations"
        name = contract.source.name
        text = f"{name} lacks the range of the training's observations; {advice}"
        return RangeEvidence((), text)
    table: RangeTable = dict(contract.training["ranges"])
    margin_share = measure_margin(contract.training.get("count", EXPORTED_ROWS), len(table))
    found = []
    for name, values in list_given_values(log, contract).items():
        if name not in table:
            continue
        low, high = table[name]
        margin = margin_share * (high - low)
        known = np.isfinite(values)
        outside = known & ((values < low - margin) | (values > high + margin))
        if outside.any():
            share = float(outside.sum() / known.sum())
            since_s = float(log.t_s[np.flatnonzero(outside)[0]])
            seen = (float(values[known].min()), float(values[known].max()))
            found.append(OutsideValue(name, share, since_s, seen, (low, high)))
    found.sort(key=lambda one: -one.share)
    return RangeEvidence(tuple(found), "")


def measure_margin(count: int, num_values: int) -> float:
    """Return the part of a range by which a run of the same distribution may leave it.

    A few hundred samples do not reach the ends of what they come from. Values are taken as normal: the
    range of a sample ends at its expected extremes (Blom), and only `FALSE_ALARMS` of all runs go further
    than the range and the margin in any value. With 256 samples of nine values 2 % of drawn runs do, of
    normal and of skewed values.

    Args:
        count: Samples of the range.
        num_values: Values that are compared, each at both ends.
    """
    extreme = norm.ppf((count - 0.375) / (count + 0.25))
    rarest = norm.isf(FALSE_ALARMS / (2 * num_values))
    return max(float(rarest - extreme) / (2.0 * float(extreme)), LEAST_MARGIN)


def list_given_values(log: RunLog, contract: PolicyContract) -> dict[str, np.ndarray]:
    """Return the values that a task gives and training has ranges of, by name, each `(T,)`; positions `(1,)`.

    A task gives targets and the pose at the start. Later poses follow from them by code and machine, which
    are judged by themselves, and one run stays long where samples of all runs seldom are.
    """
    found = {}
    for name, values in log.signals.items():
        if name == "target":
            for column, letter in enumerate("xyz"):
                found[f"target.{letter}"] = values[:, column]
            found[TARGET_DISTANCE] = np.hypot(values[:, 0], values[:, 1])
        elif name == "pitch":
            found["pitch"] = values[:, 0]
        elif name == "q":
            for column, joint in enumerate(contract.joints):
                found[f"q.{joint}"] = values[:1, column]
    return found
