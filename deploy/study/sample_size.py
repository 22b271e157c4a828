"""How many participants: what a number of them can show at all, and how likely it does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from deploy.study import exact

SIZES = (5, 6, 8, 10, 12, 14, 16, 20, 24)
EFFECTS_DZ = (0.5, 0.8, 1.2)
"""A medium, a large and a very large effect, in standard deviations of a person's difference."""
STUDIES, MOST_COUNTED = 1000, 60_000_000
"""Studies drawn for each number and effect, and fewer where there are so many ways to count."""


@dataclass(frozen=True)
class Size:
    """What a number of participants can show.

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
def table(alpha: float, sizes: Sequence[int] = SIZES) -> list[Size]:
    """Returns what each size can show, by simulated studies with normal differences."""
    return [size(num, alpha) for num in sizes]


@cache
def size(num: int, alpha: float) -> Size:
    """Returns what `num` participants can show."""
    num_first = (num + 1) // 2
    first = np.arange(num) < num_first
    smallest = exact.smallest_sequence_p(num_first, num)
    ways = exact.num_sequences(num_first, num)
    studies = min(STUDIES, MOST_COUNTED // ways) if ways <= exact.MOST_WAYS else STUDIES
    chance = np.random.default_rng(num).standard_normal((studies, num))
    power = [
        float((exact.sequence_p(chance + np.where(first, dz, -dz), first) <= alpha).mean())
        if smallest <= alpha
        else 0.0
        for dz in EFFECTS_DZ
    ]
    return Size(num, exact.smallest_paired_p(num), smallest, tuple(power))


def enough(alpha: float, power: float = 0.8, effect: int = 1, most: int = 40) -> int | None:
    """Returns the least even number of participants that finds an effect of `EFFECTS_DZ[effect]` with `power`."""
    return next(
        (num for num in range(6, most + 1, 2) if size(num, alpha).power[effect] >= power), None
    )


def least(alpha: float) -> tuple[int, int]:
    """Returns the least numbers with which a paired test, and the test over sequences, can reach `alpha` at all."""
    paired = next(num for num in range(1, 100) if exact.smallest_paired_p(num) <= alpha)
    return paired, next(
        num for num in range(2, 100) if exact.smallest_sequence_p((num + 1) // 2, num) <= alpha
    )
