"""Orders in which code may hand over the joints: all of a few, those of legs and kinds, and any that a log shows.

Axes: `T` rows, `C` columns.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

MAX_PERMUTED = 5
"""Up to so many columns all orders are tried."""
MAX_IN_GROUP = 4
"""Up to so many legs, and so many kinds of joints, all orders of them are tried: 576 at most."""
MATCH_SHARE = 0.05
"""Largest difference of two columns that are the same, as a part of the spread of all; float32 and rounding
leave less than a hundredth."""

Order = tuple[int, ...]
"""Column `order[k]` stands in place `k`."""


def list_orders(names: Sequence[str]) -> Iterator[Order]:
    """Yield orders of columns but their own.

    All of a few columns. Of many: swaps, the reverse and rotations, and where the names are made of two
    words, a leg or side and a kind, each order of legs and of kinds with either of them outside, as robots
    and simulators have them, and what undoes it.
    """
    same = tuple(range(len(names)))
    if len(names) <= MAX_PERMUTED:
        candidates = itertools.permutations(same)
    else:
        candidates = itertools.chain(_list_simple(same), _list_grouped(names))
    seen = {same}
    for order in candidates:
        for one in (order, invert_order(order)):
            if one not in seen:
                seen.add(one)
                yield one


def invert_order(order: Order) -> Order:
    """Return the order that undoes another one."""
    return tuple(int(place) for place in np.argsort(order))


def _list_simple(same: Order) -> Iterator[Order]:
    yield same[::-1]
    for shift in range(1, len(same)):
        yield same[shift:] + same[:shift]
    for one, other in itertools.combinations(same, 2):
        swapped = list(same)
        swapped[one], swapped[other] = other, one
        yield tuple(swapped)


def _list_grouped(names: Sequence[str]) -> Iterator[Order]:
    """Yield orders of legs and kinds, wherever names of several words part into a whole table of them."""
    for cut in range(1, 4):
        places = {}
        for place, name in enumerate(names):
            words = name.split("_")
            places["_".join(words[:cut]), "_".join(words[cut:])] = place
        legs = list(dict.fromkeys(leg for leg, _ in places))
        kinds = list(dict.fromkeys(kind for _, kind in places))
        is_whole = len(places) == len(names) == len(legs) * len(kinds)
        if not is_whole or min(len(legs), len(kinds)) < 2:
            continue
        for some, others in itertools.product(_list_ways(legs), _list_ways(kinds)):
            yield tuple(places[leg, kind] for leg in some for kind in others)
            yield tuple(places[leg, kind] for kind in others for leg in some)


def _list_ways(group: list[str]) -> Iterator[tuple[str, ...]]:
    return itertools.permutations(group) if len(group) <= MAX_IN_GROUP else iter([tuple(group)])


def match_order(known: np.ndarray, seen: np.ndarray) -> Order | None:
    """Return the order of known columns that gives those that were seen, `None` where none does.

    Args:
        known: Columns as they should be, `(T, C)`.
        seen: Columns as they are, `(T, C)`.
    """
    rows = np.isfinite(known).all(1) & np.isfinite(seen).all(1)
    if not rows.any():
        return None
    apart = np.median(np.abs(seen[rows][:, :, None] - known[rows][:, None, :]), axis=0)
    places, columns = linear_sum_assignment(apart)
    spread = float(np.std(known[rows]))
    order = tuple(int(column) for column in columns)
    is_same = order == tuple(range(len(order)))
    return None if is_same or apart[places, columns].max() > MATCH_SHARE * spread else order
