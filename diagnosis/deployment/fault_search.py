"""Search for the mistake that explains how a log departs from the replay of its policy.

The way from log to valve is judged in stages, as far as the log holds what lies between them. In a
stage each distortion is replayed. It explains a row where the difference to the log falls below the
floor: the rounding of network and log. A distortion is named only if it explains nearly every row.
Axes: `T` rows, `R` rows that are asked for, `D` numbers that are compared.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from diagnosis.deployment.distortions import Distortion
from diagnosis.deployment.mistakes import MAX_DELAY
from diagnosis.deployment.replay import Change

Predict = Callable[[Sequence[Change], np.ndarray], np.ndarray]
"""Returns what a stage gives, `(R, D)`, with changes, at rows."""
LEAST_ROWS = 3
"""Departing rows below which nothing is found: a mask's edge decides a row by the last bit."""
LEAST_SHARE = 0.02
"""Share of departing rows below which nothing is found. The export allows a quarter of it; by hand."""
LEAST_START_SHARE = 0.3
"""Share of the rows at the beginning from which a departure there counts by itself. By hand."""
EXPLAINED = 0.95
"""Share of rows that a named mistake explains. Chosen by hand; with exact logs it explains all."""
EXPLAINED_DEPARTED = 0.9
"""Share of the departing rows among them. Chosen by hand."""
ALIKE = 0.01
"""Difference of the explained share within which mistakes cannot be told apart."""
LOSS_SCALE = 0.01
"""Difference, of full command or in standard deviations, from which the loss of a row grows with its
logarithm: what is wholly wrong must not outweigh what is nearly right. Chosen by hand."""
UNKNOWN = 1.0
"""Difference that stands for one that is not known."""
LEAST_GAIN = 0.5
"""Share of the loss that a named mistake removes at least: what explains a few rows at the edge of a
mask by a number that is nearly neutral is none. Chosen by hand."""
SCREEN_ROWS, SEARCH_ROWS = 40, 96
"""Departing rows by which mistakes are screened on their grids, and by which the best of them are
refined; a quarter as many of the others. Chosen by hand."""
NUM_SCREENED = 40
"""Mistakes that are refined. Chosen by hand."""
NUM_REFINED = 12
"""Mistakes, the best of the first comparison, that are replayed on all rows. Chosen by hand."""
NUM_FIRST, PAIR_GAIN = 2, 0.3
"""Limits of the search for two mistakes at once: how many are tried as the first, and the share of the
loss that a first one removes at least. Chosen by hand."""
TOLERANCE_REFINED = 1e-5
"""Relative tolerance of a refined number."""


@dataclass(frozen=True)
class ReplayStage:
    """A part of the way from log to valve, with what the log holds at its end.

    Attributes:
        name: `observation`, `network`, `policy` (both at once) or `delivery`.
        predict: Gives what the stage should have made.
        logged: What it made, `(T, D)`; NaN where it was not logged.
        floor: Largest difference that is rounding, `(T, D)`.
        labels: Names of the `D` numbers.
        distortions: Mistakes that it may hold.
        num_start: Rows at the beginning whose history the log does not hold.
    """

    name: str
    predict: Predict
    logged: np.ndarray
    floor: np.ndarray
    labels: tuple[str, ...]
    distortions: tuple[Distortion, ...]
    num_start: int

    @property
    def rows(self) -> np.ndarray:
        """Rows that can be compared."""
        return np.flatnonzero(np.isfinite(self.logged).all(1))


@dataclass(frozen=True)
class FittedDistortion:
    """A distortion with its number, and what it explains.

    Attributes:
        distortion: The distortion.
        value: Its number.
        begin: First row where it holds.
        end: Last one.
        explained: Share of the rows that is explained, with the replay as it is outside.
        explained_departed: The same of the rows that depart without it.
        gain: Share of the loss that it removes.
    """

    distortion: Distortion
    value: float
    begin: int
    end: int
    explained: float
    explained_departed: float
    gain: float

    @property
    def fits(self) -> bool:
        """True if it explains nearly every row."""
        explains = self.explained >= EXPLAINED and self.explained_departed >= EXPLAINED_DEPARTED
        return explains and self.gain >= LEAST_GAIN


@dataclass(frozen=True)
class StageResult:
    """Result of a stage.

    Attributes:
        stage: Its name.
        num_rows: Rows compared.
        departed: Rows that depart.
        logged: What the log holds, `(T, D)`.
        residual: Difference to the log, `(T, D)`; NaN where nothing was compared.
        floor: Floor, `(T, D)`.
        labels: Names of the `D` numbers.
        named: Mistakes that together explain the log; empty where none does or none is needed.
        alike: Mistakes that explain it as well as the first of `named`.
        ranking: Best mistakes, whether they explain enough or not.
        only_start: Only the beginning departs, which the log's history does not reach.
    """

    stage: str
    num_rows: int
    departed: np.ndarray
    logged: np.ndarray
    residual: np.ndarray
    floor: np.ndarray
    labels: tuple[str, ...]
    named: tuple[FittedDistortion, ...]
    alike: tuple[FittedDistortion, ...]
    ranking: tuple[FittedDistortion, ...]
    only_start: bool

    @property
    def departs(self) -> bool:
        """True if more rows depart than rounding explains."""
        return self.only_start or is_departure(len(self.departed), self.num_rows)

    def rank_labels(self) -> list[tuple[str, float]]:
        """Return the compared numbers by their share of departing rows, largest first."""
        if not len(self.departed):
            return []
        over = np.abs(self.residual[self.departed]) > self.floor[self.departed]
        shares = over.mean(0)
        order = np.argsort(-shares, kind="stable")
        return [(self.labels[column], float(shares[column])) for column in order if shares[column]]


def is_departure(num_departed: int, num_rows: int) -> bool:
    """Return whether so many departing rows are more than chance."""
    return num_departed >= max(LEAST_ROWS, LEAST_SHARE * num_rows)


def judge_stage(stage: ReplayStage) -> StageResult:
    """Compare a stage with the log; search for the mistake where it departs."""
    rows = stage.rows
    residual = np.full(stage.logged.shape, np.nan)
    residual[rows] = stage.predict((), rows) - stage.logged[rows]
    rows = rows[np.isfinite(residual[rows]).all(1)]
    departed = rows[(np.abs(residual[rows]) > stage.floor[rows]).any(1)]
    later = departed[departed >= stage.num_start]
    settled = rows[rows >= stage.num_start + MAX_DELAY]
    num_early = len(departed) - len(later)
    is_start = num_early >= max(LEAST_ROWS, LEAST_START_SHARE * stage.num_start)
    only_start = is_start and not is_departure(len(later), len(rows))
    named: tuple[FittedDistortion, ...] = ()
    alike: tuple[FittedDistortion, ...] = ()
    ranking: tuple[FittedDistortion, ...] = ()
    if only_start or is_departure(len(departed), len(rows)):
        judged = rows if only_start or len(settled) < LEAST_ROWS else settled
        search = _FaultSearch(stage, residual, judged)
        ranking = search.rank(())
        named, alike = search.choose(ranking)
    return StageResult(
        stage=stage.name,
        num_rows=len(rows),
        departed=departed,
        logged=stage.logged,
        residual=residual,
        floor=stage.floor,
        labels=stage.labels,
        named=named,
        alike=alike,
        ranking=ranking[:NUM_REFINED],
        only_start=only_start,
    )


class _FaultSearch:
    """Search within one stage, on the rows that are judged."""

    def __init__(self, stage: ReplayStage, residual: np.ndarray, rows: np.ndarray) -> None:
        self._stage, self._rows = stage, rows
        self._ok = (np.abs(residual[rows]) <= stage.floor[rows]).all(1)
        self._loss = _measure_loss(residual[rows])
        self._screen = self._choose_sample(SCREEN_ROWS)
        self._sample = self._choose_sample(SEARCH_ROWS)

    def _choose_sample(self, num: int) -> np.ndarray:
        """Return so many departing places in the judged rows, and a quarter as many others."""
        departed, others = np.flatnonzero(~self._ok), np.flatnonzero(self._ok)
        parts = [_select_evenly(departed, num), _select_evenly(others, num // 4)]
        return np.sort(np.concatenate(parts))

    def rank(self, given: tuple[Change, ...]) -> tuple[FittedDistortion, ...]:
        """Return all mistakes, beside those of `given`, best first."""
        screened = []
        for distortion in self._stage.distortions:
            gains = [
                self._measure(distortion, value, given, self._screen)[1]
                for value in distortion.values
            ]
            screened.append((max(gains), int(np.argmax(gains)), distortion))
        screened.sort(key=lambda one: -one[0])
        first = []
        for _, best, distortion in screened[:NUM_SCREENED]:
            value, gain = self._refine_value(distortion, best, given)
            first.append((gain, distortion, value))
        first.sort(key=lambda one: -one[0])
        found = [self._judge(one, value, given) for _, one, value in first[:NUM_REFINED]]
        found.sort(key=_rank_fit)
        return tuple(found)

    def choose(
        self, ranking: tuple[FittedDistortion, ...]
    ) -> tuple[tuple[FittedDistortion, ...], tuple[FittedDistortion, ...]]:
        """Return the mistakes that explain the log, one or two, and those like the first."""
        fitting = [one for one in ranking if one.fits]
        if fitting:
            best = fitting[0]
            alike = [one for one in fitting[1:] if one.explained >= best.explained - ALIKE]
            return (best,), tuple(alike)
        for first in sorted(ranking, key=lambda one: -one.gain)[:NUM_FIRST]:
            if first.gain < PAIR_GAIN:
                break
            change = first.distortion.build(first.value)
            for second in self.rank((change,))[:1]:
                if second.fits and second.distortion.field != first.distortion.field:
                    return (first, second), ()
        return (), ()

    def _refine_value(
        self, distortion: Distortion, best: int, given: tuple[Change, ...]
    ) -> tuple[float, float]:
        """Return the number of a distortion, near value `best` of its grid, and its gain."""

        def measure_gain(value: float) -> float:
            return self._measure(distortion, value, given, self._sample)[1]

        values = distortion.values
        value, gain = values[best], measure_gain(values[best])
        if distortion.is_continuous:
            low, high = values[max(0, best - 1)], values[min(len(values) - 1, best + 1)]
            found = minimize_scalar(
                lambda x: -measure_gain(float(x)),
                bounds=(low, high),
                method="bounded",
                options={"xatol": TOLERANCE_REFINED * max(abs(low), abs(high))},
            )
            if -found.fun > gain:
                value, gain = float(found.x), -float(found.fun)
        return value, gain

    def _measure(
        self, distortion: Distortion, value: float, given: tuple[Change, ...], places: np.ndarray
    ) -> tuple[np.ndarray, float, tuple[int, int]]:
        """Return residual at places of the judged rows, gain, and the segment where it holds."""
        rows = self._rows[places]
        predicted = self._stage.predict((*given, distortion.build(value)), rows)
        residual = predicted - self._stage.logged[rows]
        before = self._loss[places]
        segment, gained = _find_segment(before - _measure_loss(residual))
        return residual, gained / max(float(before.sum()), 1e-12), segment

    def _judge(
        self, distortion: Distortion, value: float, given: tuple[Change, ...]
    ) -> FittedDistortion:
        """Return a distortion with what it explains of all judged rows."""
        everywhere = np.arange(len(self._rows))
        residual, gain, (begin, end) = self._measure(distortion, value, given, everywhere)
        floor = self._stage.floor[self._rows]
        inside = (everywhere >= begin) & (everywhere < end)
        with np.errstate(invalid="ignore"):
            ok = np.where(inside, (np.abs(residual) <= floor).all(1), self._ok)
        departed = ~self._ok
        return FittedDistortion(
            distortion=distortion,
            value=value,
            # A mistake from the first judged row on has held from the beginning.
            begin=int(self._rows[min(begin, len(self._rows) - 1)]) if begin else 0,
            end=int(self._rows[max(begin, end - 1)]),
            explained=float(ok.mean()),
            explained_departed=float(ok[departed].mean()) if departed.any() else 1.0,
            gain=gain,
        )


def _rank_fit(one: FittedDistortion) -> tuple[float, int, float]:
    """Return the key by which fits are ordered: explained share, free numbers, gain."""
    return -round(one.explained / ALIKE), one.distortion.num_free, -one.gain


def _measure_loss(residual: np.ndarray) -> np.ndarray:
    """Return the mean loss of each row, `(R,)`: the logarithm of its differences."""
    return np.log1p(np.nan_to_num(np.abs(residual), nan=UNKNOWN) / LOSS_SCALE).mean(1)


def _find_segment(gained: np.ndarray) -> tuple[tuple[int, int], float]:
    """Return the segment of rows, begin and end, with the largest sum, and the sum (Kadane)."""
    best, best_at, total, begin = 0.0, (0, 0), 0.0, 0
    for row, value in enumerate(gained.tolist()):
        if total <= 0.0:
            total, begin = 0.0, row
        total += value
        if total > best:
            best, best_at = total, (begin, row + 1)
    return best_at, best


def _select_evenly(places: np.ndarray, most: int) -> np.ndarray:
    if len(places) <= most:
        return places
    return places[np.linspace(0, len(places) - 1, most).round().astype(int)]
