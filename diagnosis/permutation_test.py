"""Permutation tests of the field's error against the reference's, with bounded false discoveries.

Samples of one recording are dependent, so whole recordings change sides, never samples. With too
few recordings for a small p, recordings are cut into parts of `PART_S`; their dependence (pose,
oil) is small against that within a window.
Axes: `W` windows, `B` blocks, `C` cells.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np
from scipy.stats import false_discovery_control

from diagnosis.free_runs import WindowedRuns

MIN_PERMUTATIONS = 1000
"""Least number of ways to distribute recordings over two sides: with fewer, no cell of some forty
could be significant at the false discovery rate."""
PART_S = 30.0
"""Length of the parts of recordings, s; chosen by hand: six windows of 5 s."""
NUM_PERMUTATIONS = 2000
"""Random permutations; the smallest p is 1 / 2001."""
FALSE_DISCOVERY_RATE = 0.05
"""The usual level."""


@dataclass(frozen=True)
class ExchangeBlocks:
    """Blocks of windows that change sides together.

    Attributes:
        field: Block of each window of the field's free runs, `(W,)`.
        reference: The same of the reference's, with numbers of their own.
        unit: Name of a block in reports.
    """

    field: np.ndarray
    reference: np.ndarray
    unit: str


def assign_blocks(field: WindowedRuns, reference: WindowedRuns) -> ExchangeBlocks:
    """Return recordings as blocks, or parts of them where recordings are too few."""
    sides = [np.unique(side.source, return_inverse=True)[1] for side in (field, reference)]
    few = comb(len(set(sides[0])) + len(set(sides[1])), len(set(sides[0]))) < MIN_PERMUTATIONS
    if not few:
        return ExchangeBlocks(sides[0], sides[1], "recordings")
    cut = [number_parts(side) for side in (field, reference)]
    return ExchangeBlocks(
        cut[0], cut[1], f"parts of recordings of {PART_S:g} s each (whole ones are too few)"
    )


def number_parts(runs: WindowedRuns) -> np.ndarray:
    """Return the number of the part of `PART_S` of a recording that each window lies in, `(W,)`."""
    begin_s = np.array(
        [
            runs.recordings[s].t_s[r] - runs.recordings[s].t_s[0]
            for s, r in zip(runs.source, runs.row, strict=True)
        ]
    )
    return np.unique(np.stack([runs.source, begin_s // PART_S], 1), axis=0, return_inverse=True)[
        1
    ].ravel()


def sum_by_block(values: np.ndarray, block: np.ndarray) -> np.ndarray:
    """Return sums over the windows of each block, `(B, …)`, of `values`, `(W, …)`."""
    found = np.zeros((int(block.max()) + 1, *values.shape[1:]))
    np.add.at(found, block, values)
    return found


def compute_excess_p(
    field: tuple[np.ndarray, np.ndarray],
    reference: tuple[np.ndarray, np.ndarray],
    generator: np.random.Generator,
) -> np.ndarray:
    """Return how probable so large a mean would be if field and reference were alike, `(C,)`.

    Args:
        field: Sums and counts of each block, both `(B, C)`; a cell's mean is the ratio of their
            totals.
        reference: The same of the reference.
        generator: Draws the permutations.

    Returns:
        One-sided p; NaN where one of both sides never visited the cell.
    """
    sums, counts = (np.concatenate(pair) for pair in zip(field, reference, strict=True))
    num_field, total = len(field[0]), len(sums)
    sides = np.zeros((NUM_PERMUTATIONS, total))
    sides[
        np.arange(NUM_PERMUTATIONS)[:, None],
        generator.random((NUM_PERMUTATIONS, total)).argsort(1)[:, :num_field],
    ] = 1.0
    sides = np.concatenate(
        [np.arange(total)[None] < num_field, sides]
    )  # the first row is the observation
    with np.errstate(invalid="ignore", divide="ignore"):
        difference = sides @ sums / (sides @ counts) - (1.0 - sides) @ sums / (
            (1.0 - sides) @ counts
        )
        seen = difference[0]
        # a draw in which one side never visits the cell says nothing against chance; rounding must
        # not tell equals apart
        larger = ~(difference < seen - 1e-12 * np.abs(seen))
    return np.where(np.isfinite(seen), larger.mean(0), np.nan)


def estimate_standard_error(sums: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return the standard error of the ratio of totals, `(C,)`; NaN for fewer than two blocks.

    Source: the ratio estimator's, Cochran 1977, section 2.11.

    Args:
        sums: Of each block, `(B, C)`.
        counts: Of each block, `(B, C)`.
    """
    if len(sums) < 2:
        return np.full(sums.shape[1], np.nan)
    total = np.maximum(counts.sum(0), 1.0)
    off = sums - sums.sum(0) / total * counts
    return np.sqrt(len(sums) / (len(sums) - 1) * (off**2).sum(0)) / total


def adjust_p_values(p: np.ndarray) -> np.ndarray:
    """Return p adjusted for the false discovery rate; NaN stays NaN.

    Source: Benjamini and Hochberg 1995.
    """
    found, given = np.full(p.shape, np.nan), np.isfinite(p)
    if given.any():
        found[given] = false_discovery_control(p[given])
    return found
