"""Sample size: smallest attainable p and power by number of participants."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from study import permutation_tests

SIZES = (5, 6, 8, 10, 12, 14, 16, 20, 24)
"""Numbers of participants in the table of a plan."""
LARGE_DZ = 0.8
"""A large effect (Cohen 1988), for which a sufficient size is looked for."""
SUFFICIENT_POWER = 0.8
"""Share of studies that must find a large effect: the usual four in five."""
MOST_PARTICIPANTS = 40
"""Largest size that is tried. Chosen by hand."""
EFFECTS_DZ = (0.5, LARGE_DZ, 1.2)
"""A medium, a large and a very large effect, in standard deviations of a person's difference."""
STUDIES, MOST_COUNTED = 1000, 60_000_000
"""Studies drawn for each number and effect, and fewer where there are so many ways to count."""


@dataclass(frozen=True)
class SampleSize:
    """Power of one number of participants.

    Attributes:
        num_participants: The number.
        smallest_paired_p: Least two-sided p of an exact paired test.
        smallest_p: Least two-sided p of the test over sequences.
        power: Share of studies that find an effect of each of `EFFECTS_DZ` with the test over
            sequences.
    """

    num_participants: int
    smallest_paired_p: float
    smallest_p: float
    power: tuple[float, ...]


@cache
def evaluate_size(num: int, alpha: float) -> SampleSize:
    """Return smallest p and power of `num` participants."""
    # In each pair one of the two begins guided; a last one alone has a coin too.
    first, pairs = np.arange(num) % 2 == 0, np.arange(num) // 2
    num_pairs = (num + 1) // 2
    smallest = permutation_tests.get_smallest_sequence_p(num_pairs)
    ways = permutation_tests.count_sequences(num_pairs)
    # Fewer studies where a test counts many ways, so that the time stays bounded.
    studies = min(STUDIES, MOST_COUNTED // ways) if ways <= permutation_tests.MOST_WAYS else STUDIES
    # Seeded by the size: the table is the same each time.
    chance = np.random.default_rng(num).standard_normal((studies, num))
    power = []
    for dz in EFFECTS_DZ:
        power.append(
            float(
                (
                    permutation_tests.compute_sequence_p(
                        chance + np.where(first, dz, -dz), first, pairs
                    )
                    <= alpha
                ).mean()
            )
            if smallest <= alpha
            else 0.0
        )
    return SampleSize(num, permutation_tests.get_smallest_paired_p(num), smallest, tuple(power))


def find_sufficient_size(alpha: float) -> int | None:
    """Return the smallest even number of participants that reaches `SUFFICIENT_POWER`, or `None`."""
    large = EFFECTS_DZ.index(LARGE_DZ)
    # Even numbers: both sequences then have as many people.
    for num in range(6, MOST_PARTICIPANTS + 1, 2):
        if evaluate_size(num, alpha).power[large] >= SUFFICIENT_POWER:
            return num
    return None


def find_smallest_sizes(alpha: float) -> tuple[int, int]:
    """Return the smallest sizes at which the paired test and the sequence test can reach `alpha`."""
    paired = 1
    while permutation_tests.get_smallest_paired_p(paired) > alpha:
        paired += 1
    sequence = 2
    while permutation_tests.get_smallest_sequence_p((sequence + 1) // 2) > alpha:
        sequence += 1
    return paired, sequence
