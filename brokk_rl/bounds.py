"""Bounds of configured numbers: `check` of a spec calls these functions.

NaN is refused by every bound, since no comparison with it holds.
"""

from __future__ import annotations

import math
from typing import Any

from brokk_rl.errors import ConfigError


def require_number(
    name: str,
    value: Any,
    least: float | None = None,
    most: float | None = None,
    above: float | None = None,
    whole: bool = False,
) -> None:
    """Refuse a value that is no finite number within bounds; `None` is a bound that is not there.

    Args:
        name: Key of the value, for the message.
        value: The value.
        least: Smallest allowed value.
        most: Largest allowed value.
        above: Bound below all allowed values.
        whole: Whether it must be an integer.

    Raises:
        ConfigError: The value lies outside; the message names key, bounds and value.
    """
    kind = int if whole else (int, float)
    good = isinstance(value, kind) and not isinstance(value, bool) and math.isfinite(value)
    good = good and (least is None or value >= least) and (most is None or value <= most)
    if good and (above is None or value > above):
        return
    words = []
    if least is not None and most is not None:
        words.append(f"from {least:g} to {most:g}")
    elif least is not None:
        words.append(f"of {least:g} or more")
    elif most is not None:
        words.append(f"{'of' if above is None else 'up to'} {most:g}{' or less' * (above is None)}")
    if above is not None:
        words.append(f"above {above:g}")
    noun = "a whole number" if whole else "a finite number"
    raise ConfigError(f"{name}: expected {' '.join([noun, *words])}, got {value}")


def require_range(name: str, value: tuple[float, float], least: float | None = None) -> None:
    """Refuse a range that is not (lowest, highest), finite, and at least `least`."""
    low, high = value
    if not (math.isfinite(low) and math.isfinite(high) and low <= high):
        raise ConfigError(f"{name}: expected (lowest, highest), finite, got [{low}, {high}]")
    if least is not None:
        require_number(name, low, least)
