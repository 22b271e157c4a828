"""Who a simulated person is: numbers that differ from person to person and stay the same through all of a person's trials."""

from __future__ import annotations

import zlib

import numpy as np

from brokk_rl.errors import ConfigError

Range = float | tuple[float, float]
"""A number of a person, or a range [low, high] from which each person has one."""


class Traits:
    """Draws the numbers of persons.

    Args:
        persons: Number of the person in each trial, `(N,)`.
        seed: The same seed, person and name give the same place within a range, whatever the range:
            who is slow is slow in all.
    """

    def __init__(self, persons: np.ndarray, seed: int) -> None:
        self._persons, self._seed = np.asarray(persons, int), seed

    def draw(self, name: str, value: Range) -> np.ndarray:
        """Return the number `name` in each trial, `(N, 1)`."""
        low, high = value if isinstance(value, tuple) else (value, value)
        if high < low:
            raise ConfigError(f"operator: {name} is [{low}, {high}], expected the lower end first")
        count = int(self._persons.max(initial=0)) + 1
        place = np.random.default_rng((self._seed, zlib.crc32(name.encode()))).random(count)
        return (low + (high - low) * place[self._persons])[:, None]
