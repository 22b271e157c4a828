"""Squared errors of free runs by what they belong to, so that the parts add up to all of it.

An error of position stays after what caused it is over, so it is traced back to where it arose: the
error of a window is the sum of its increments, `e = Σ_c e_c` with `e_c` those of the samples in
category `c`, and `Σ_t e_c(t) e(t)` is the part of the squared error that category `c` answers for.
The parts add up exactly; one below 0 works against the others. Frequency bands add up by Parseval's
theorem, recordings and running time by themselves.
Axes: `W` windows, `K` steps, `J` joints, `C` categories.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from brokk_rl.machine import Machine
from diagnosis.free_runs import WindowedRuns
from diagnosis.occasions import Dimension, dimensions
from diagnosis.sanity import name_of

BANDS_HZ = (0.3, 1.0, 3.0)
"""Bounds of the frequency bands."""
AGES = 4
"""Parts into which the running time is cut."""
SPAN_S = 0.25
"""Tests look at what is added to the error within this time: it hangs together less than the error
itself, which stays."""


@dataclass(frozen=True)
class Sums:
    """What each window adds to each joint and category, all `(W, J, C)`.

    Attributes:
        categories: Their names.
        square: Part of the squared error.
        tested: By what field and reference are compared: of a band, its part of the squared error;
            else what was added to the error
            within `SPAN_S`: within a category its size (a few windows would decide its square), of
                a joint as a whole its square
            (in the mean size a short regime would drown).
        count: Samples.
    """

    categories: tuple[str, ...]
    square: np.ndarray
    tested: np.ndarray
    count: np.ndarray


def traced(error: np.ndarray, label: np.ndarray, num_categories: int) -> np.ndarray:
    """Returns the error by the category in which it arose, `(C, W, K, J)`; it adds up to `error`, with 0 in place of NaN.

    Args:
        error: Errors of free runs, `(W, K, J)`, NaN after the end of a recording.
        label: Number of the category of each sample, `(W, K, J)`.
        num_categories: `C`.
    """
    given = np.isfinite(error)
    added = np.diff(np.where(given, error, 0.0), axis=1, prepend=0.0) * given
    return np.stack([np.cumsum(added * (label == c), 1) for c in range(num_categories)]) * given


def by_joint(runs: WindowedRuns, machine: Machine) -> Sums:
    """Returns the sums of each joint as a single category."""
    count = np.isfinite(runs.error).sum(1)[..., None].astype(float)
    return Sums(
        ("",),
        np.nansum(runs.error**2, 1)[..., None],
        (_added(runs, machine) ** 2).sum(1)[..., None],
        count,
    )


def by_occasion(runs: WindowedRuns, machine: Machine, dead_time_s: np.ndarray) -> dict[str, Sums]:
    """Returns the sums by regime, direction, load (where masses are known) and frequency."""
    every = dimensions(list(runs.recordings), machine, dead_time_s)
    return {dimension.name: _arisen(runs, dimension, machine) for dimension in every} | {
        "frequency": _bands(runs, machine)
    }


def by_time(runs: WindowedRuns, machine: Machine) -> dict[str, Sums]:
    """Returns the sums by recording and by running time, which are those of whole windows."""
    edges = np.linspace(runs.elapsed_s.min(), runs.elapsed_s.max(), AGES + 1)
    age = np.clip(np.searchsorted(edges, runs.elapsed_s, "right") - 1, 0, AGES - 1)
    whole = by_joint(runs, machine)

    def sums(names: tuple[str, ...], label: np.ndarray) -> Sums:
        belongs = label[:, None, None] == np.arange(len(names))
        return Sums(names, whole.square * belongs, whole.tested * belongs, whole.count * belongs)

    ages = tuple(f"{low:.0f} to {high:.0f} s" for low, high in pairwise(edges))
    return {
        "running time": sums(ages, age),
        "recording": sums(tuple(map(name_of, runs.recordings)), runs.source),
    }


def _added(runs: WindowedRuns, machine: Machine) -> np.ndarray:
    """Returns the size of what was added to the error within the last `SPAN_S`, `(W, K, J)`, 0 after the end of a recording."""
    span = max(1, round(SPAN_S / machine.period_s))
    before = np.pad(runs.error, ((0, 0), (span, 0), (0, 0)))[:, : runs.error.shape[1]]
    return np.nan_to_num(np.abs(runs.error - before))


def _arisen(runs: WindowedRuns, dimension: Dimension, machine: Machine) -> Sums:
    label, error, added = (
        runs.cut(dimension.label),
        np.nan_to_num(runs.error),
        _added(runs, machine),
    )
    names = dimension.categories
    square = (traced(runs.error, label, len(names)) * error).sum(2)
    belongs = np.stack([label == c for c in range(len(names))])
    sums = (square, (added * belongs).sum(2), belongs.sum(2).astype(float))
    return Sums(names, *(np.moveaxis(values, 0, 2) for values in sums))


def _bands(runs: WindowedRuns, machine: Machine) -> Sums:
    """Splits by Parseval's theorem; after the end of a recording the error counts as 0, which adds nothing."""
    error = np.nan_to_num(runs.error)
    power = np.abs(np.fft.rfft(error, axis=1)) ** 2 / error.shape[1]
    hertz = np.fft.rfftfreq(error.shape[1], machine.period_s)
    power[:, (hertz > 0) & (hertz < 0.5 / machine.period_s - 1e-9)] *= 2.0  # the mirrored half
    edges = (0.0, *BANDS_HZ, np.inf)
    square = np.stack(
        [power[:, (hertz >= low) & (hertz < high)].sum(1) for low, high in pairwise(edges)], 2
    )
    names = (
        f"below {BANDS_HZ[0]:g} Hz",
        *(f"{a:g} to {b:g} Hz" for a, b in pairwise(BANDS_HZ)),
        f"above {BANDS_HZ[-1]:g} Hz",
    )
    count = np.repeat(np.isfinite(runs.error).sum(1)[..., None].astype(float), len(names), 2)
    return Sums(names, square, square, count)
