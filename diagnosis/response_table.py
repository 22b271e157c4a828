"""Inner products of responses to effects: information about sizes, and effects that look alike.

The squared length of a whitened response is the Fisher information about the size of its effect. The
part that small faults of the simulator or another effect explain is subtracted.
Axes: `J` joints, `E` entries (whitened increments), `M` rows of responses.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from actuators.recordings.preview import PreviewCallback
from diagnosis.decision import SAME_NATS, SAME_SHARE
from diagnosis.effect_library import EffectType
from diagnosis.error_covariance import T_FREEDOM
from diagnosis.residuals import Residuals, build_rays
from diagnosis.responses import SIZE_PRIOR

TRIED_SIZES = np.geomspace(0.02, 4.0, 240)
"""Sizes over the typical one among which the smallest is sought; steps of 2 %."""
INFORMATION_SHARE = (T_FREEDOM + 1.0) / (T_FREEDOM + 3.0)
"""Fisher information of the t distribution about its place, over that of a normal one: 3/4."""
TRIED_MINUTES = np.geomspace(0.25, 240.0, 80)
"""Times of an excitation that are tried; steps of 9 %."""
RIVAL_SIGMA = 4.0
"""Prior standard deviation of the size of an effect in the place of another, over the typical one: all
that the search tries."""

RayKey = tuple[str, str]
"""Name of an effect and of its number; an effect with one size for all its numbers has no second."""


@dataclass(frozen=True, eq=False)
class ResponseTable:
    """Inner products of the whitened responses of each joint.

    Attributes:
        products: `(J, M, M)`; the first rows are the faults of the simulator, at one prior sigma.
        num_faults: Number of faults.
        rows: Row of each size of `sizes`, by effect and number.
        sizes: Sizes over the typical one that were simulated.
        seconds: Length of the motions.
    """

    products: np.ndarray
    num_faults: int
    rows: Mapping[RayKey, Sequence[int]]
    sizes: Mapping[RayKey, np.ndarray]
    seconds: float

    def scale_to(self, seconds: float) -> ResponseTable:
        """Return the table of as much longer motions of the same making."""
        return replace(self, products=self.products * (seconds / self.seconds), seconds=seconds)

    def measure_information(self, joint: int, row: int, beside: Sequence[int] = ()) -> float:
        """Return the information about the length of a response beside faults and other responses.

        Faults have a prior of one standard deviation each, other responses one of `RIVAL_SIGMA`.
        """
        known = [*range(self.num_faults), *beside]
        inner = INFORMATION_SHARE * self.products[joint]
        own = inner[row, row]
        if not known:
            return float(own)
        precision = np.ones(len(known))
        precision[self.num_faults :] = RIVAL_SIGMA**-2.0
        cross = inner[known, row]
        explained = cross @ np.linalg.solve(inner[np.ix_(known, known)] + np.diag(precision), cross)
        return max(float(own - explained), 0.0)

    def list_keys(self, effect: str) -> list[RayKey]:
        """Return the numbers of an effect that were simulated."""
        return [key for key in self.rows if key[0] == effect]

    def get_typical_row(self, key: RayKey) -> int:
        """Return the row of the size nearest to the typical one."""
        return self.rows[key][int(np.argmin(np.abs(self.sizes[key] - 1.0)))]

    def expect_gains(self, joint: int, key: RayKey) -> np.ndarray:
        """Return the expected gain of each of `TRIED_SIZES` before penalties, nats.

        It is the logarithm of a Bayes factor by Laplace's approximation: half the squared length of
        the response, less the prior of the size and Occam's factor of all numbers of the effect.
        """
        unit = self._interpolate(joint, key)
        occam = sum(np.log1p(self._interpolate(joint, other)) for other in self.list_keys(key[0]))
        return 0.5 * (unit - SIZE_PRIOR**-2.0) * TRIED_SIZES**2 - 0.5 * occam

    def _interpolate(self, joint: int, key: RayKey) -> np.ndarray:
        """Return the information over the squared size at each of `TRIED_SIZES`."""
        sizes = self.sizes[key]
        known = [self.measure_information(joint, row) for row in self.rows[key]]
        return np.interp(np.log(TRIED_SIZES), np.log(sizes), np.array(known) / sizes**2)


def find_smallest_size(gains: np.ndarray, price: float, largest: float) -> float | None:
    """Return the smallest of `TRIED_SIZES` from which the gain exceeds the price; `None` for none up to `largest`."""
    told = (gains > price) & (largest + 1e-9 >= TRIED_SIZES)
    return float(TRIED_SIZES[int(np.argmax(told))]) if told.any() else None


def simulate_responses(
    residuals: Residuals, kinds: Sequence[EffectType], sizes: Sequence[float], tell: PreviewCallback
) -> tuple[np.ndarray, dict[RayKey, list[int]], dict[RayKey, np.ndarray]]:
    """Return whitened faults and responses, `(J, M, E)`, the rows of each number, and its sizes."""
    parts, rows, used = [residuals.faults], {}, {}
    count = residuals.faults.shape[1]
    for number, kind in enumerate(kinds):
        tell(f"simulating {kind.name}", number / len(kinds))
        for ray in build_rays(kind, sizes):
            tried = ray.sizes[ray.sizes > 0.0]
            one = replace(ray, sizes=np.concatenate([[0.0], tried]))
            parts.append(residuals.response(one)[:, 1:])
            key = (kind.name, ray.name)
            rows[key], used[key] = list(range(count, count + len(tried))), tried
            count += len(tried)
    return np.concatenate(parts, 1), rows, used


def find_needed_minutes(
    table: ResponseTable, joints: Sequence[int], key: RayKey, price: float
) -> float | None:
    """Return the time after which the typical size is told; `None` beyond the longest tried."""

    def is_told(minutes: float) -> bool:
        longer, gain = table.scale_to(60.0 * minutes), 0.0
        for j in joints:
            known = {
                other: longer.measure_information(j, longer.get_typical_row(other))
                for other in longer.list_keys(key[0])
            }
            gain += 0.5 * (known[key] - SIZE_PRIOR**-2.0 - sum(map(np.log1p, known.values())))
        return gain > price

    return _find_first_minutes(is_told)


def find_separating_minutes(
    table: ResponseTable, joints: Sequence[int], pair: tuple[str, str]
) -> float | None:
    """Return the time after which two effects are told apart on all joints; `None` beyond the longest tried."""

    def are_apart(minutes: float) -> bool:
        longer = table.scale_to(60.0 * minutes)
        return all(compare_pair(longer, j, pair) == "apart" for j in joints)

    return _find_first_minutes(are_apart)


def compare_pair(
    table: ResponseTable, joint: int, pair: tuple[str, str]
) -> Literal["unseen", "alike", "apart"]:
    """Return whether each of two effects at its typical size is explained by the other.

    The same limits make two effects equivalent in the answer of a diagnosis. `unseen` where one of
    them leaves too little to compare.
    """
    explained = [_is_explained(table, joint, *order) for order in (pair, pair[::-1])]
    if None in explained:
        return "unseen"
    return "alike" if all(explained) else "apart"


def _is_explained(table: ResponseTable, joint: int, effect: str, other: str) -> bool | None:
    """Return whether another effect explains all numbers of an effect; `None` where they show nothing."""
    beside = [row for key in table.list_keys(other) for row in table.rows[key]]
    explained = []
    for key in table.list_keys(effect):
        row = table.get_typical_row(key)
        own = table.measure_information(joint, row)
        if 0.5 * own < SAME_NATS:
            return None
        left = table.measure_information(joint, row, beside)
        explained.append(left < (1.0 - SAME_SHARE) * own or 0.5 * left < SAME_NATS)
    return all(explained)


def find_soonest(minutes: Mapping[str, float | None]) -> tuple[str | None, float | None]:
    """Return the excitation that needs the least time, and that time."""
    known = {name: time for name, time in minutes.items() if time is not None}
    if not known:
        return None, None
    best = min(known, key=known.__getitem__)
    return best, known[best]


def _find_first_minutes(is_enough: Callable[[float], bool]) -> float | None:
    """Return the first of `TRIED_MINUTES` that is enough; longer ones are taken to be enough too."""
    low, high = 0, len(TRIED_MINUTES)
    while low < high:
        middle = (low + high) // 2
        if is_enough(float(TRIED_MINUTES[middle])):
            high = middle
        else:
            low = middle + 1
    return float(TRIED_MINUTES[low]) if low < len(TRIED_MINUTES) else None


def multiply_rows(columns: np.ndarray) -> np.ndarray:
    """Return the inner products of rows `(J, M, E)`, `(J, M, M)`."""
    return columns @ columns.swapaxes(1, 2)
