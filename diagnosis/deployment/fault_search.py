"""Search for the mistake that explains how a log departs from the replay of its policy.

The way from log to valve is judged in stages, as far as the log holds what lies between them. In a
stage each distortion is replayed. It explains a row where the difference to the log falls below the
floor: the rounding of network and log. A distortion is named only if it explains nearly every row.
Axes: `T` rows, `R` rows that are asked for, `D` numbers that are compared.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from diagnosis.deployment.distortions import MAX_DELAY, Distortion
from diagnosis.deployment.replay import Change

Predict = Callable[[Sequence[Change], np.ndarray], np.ndarray]
"""Returns what a stage gives, `(R, D)`, with changes, at rows."""
LEAST_ROWS = 3
"""Departing rows below which nothing is found: a mask's edge decides a row by the last bit."""
LEAST_SHARE = 0.02
"""Share of departing rows below which nothing is found. The export allows a quarter of it; by hand."""
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
SEARCH_ROWS = 96
"""Departing rows by which mistakes are compared on their grids, and the best of them refined; a quarter as
many of the others. Chosen by hand."""
NUM_SCREENED = 40
"""Mistakes that are refined. Chosen by hand."""
NUM_REFINED = 12
"""Mistakes, the best of the first comparison, that are replayed on all rows. Chosen by hand."""
NUM_FIRST, PAIR_GAIN = 2, 0.3
"""Limits of the search for two mistakes at once: how many are tried as the first, and the share of the
loss that a first one removes at least. Chosen by hand."""
NUM_RANKED = 5
"""Mistakes and numbers of a ranking that are told."""
GAIN = attrgetter("gain")
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
        num_start: Rows at the beginning whose history the log does not hold: they are not compared.
    """

    name: str
    predict: Predict
    logged: np.ndarray
    floor: np.ndarray
    labels: tuple[str, ...]
    distortions: Sequence[Distortion]
    num_start: int


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
        stage: The stage.
        num_rows: Rows compared.
        departed: Rows that depart.
        residual: Difference to the log, `(T, D)`; NaN where nothing was compared.
        named: Mistakes that explain the log: none, one, or two at once.
        alike: Others that explain it as well as the first.
        ranking: All mistakes that come near, best first.
    """

    stage: ReplayStage
    num_rows: int
    departed: np.ndarray
    residual: np.ndarray
    named: tuple[FittedDistortion, ...] = ()
    alike: tuple[FittedDistortion, ...] = ()
    ranking: tuple[FittedDistortion, ...] = ()

    @property
    def departs(self) -> bool:
        """True if more rows depart than rounding explains."""
        return len(self.departed) >= max(LEAST_ROWS, LEAST_SHARE * self.num_rows)

    def rank_labels(self) -> list[tuple[str, float]]:
        """Return the compared numbers by their share of departing rows, largest first."""
        if not len(self.departed):
            return []
        over = np.abs(self.residual[self.departed]) > self.stage.floor[self.departed]
        shares = over.mean(0)
        order = np.argsort(-shares, kind="stable")
        return [(self.stage.labels[k], float(shares[k])) for k in order if shares[k]]

    def to_json(self, t_s: np.ndarray) -> dict[str, Any]:
        """Return it as plain JSON data, with times of the rows `(T,)`."""
        ranking = []
        for one in self.ranking[:NUM_RANKED]:
            mistake = one.distortion
            number = one.value if mistake.parameter else None
            row = {"kind": mistake.kind, "field": mistake.field, "value": number}
            ranking.append(row | {"explained": one.explained, "removes": one.gain})
        labels = self.rank_labels()[:NUM_RANKED]
        return {
            "stage": self.stage.name,
            "rows": self.num_rows,
            "departed": len(self.departed),
            "since_s": float(t_s[self.departed[0]]) if len(self.departed) else None,
            "where": [{"number": label, "share": share} for label, share in labels],
            "ranking": ranking,
        }


def judge_stage(stage: ReplayStage) -> StageResult:
    """Compare a stage with the log; search for the mistake where it departs."""
    rows = np.flatnonzero(np.isfinite(stage.logged).all(1))
    rows = rows[rows >= stage.num_start]
    residual = np.full(stage.logged.shape, np.nan)
    residual[rows] = stage.predict((), rows) - stage.logged[rows]
    rows = rows[np.isfinite(residual[rows]).all(1)]
    departed = rows[(np.abs(residual[rows]) > stage.floor[rows]).any(1)]
    result = StageResult(stage, len(rows), departed, residual)
    if not result.departs:
        return result
    settled = rows[rows >= stage.num_start + MAX_DELAY]
    judged = rows if len(settled) < LEAST_ROWS else settled
    search = _FaultSearch(stage, residual, judged, int(departed[0]))
    ranking = search.rank(())
    named, alike = search.choose(ranking)
    return replace(result, named=named, alike=alike, ranking=ranking)


class _FaultSearch:
    """Search within one stage, on the rows that are judged."""

    def __init__(
        self, stage: ReplayStage, residual: np.ndarray, rows: np.ndarray, first: int
    ) -> None:
        self._stage, self._rows = stage, rows
        self._begins = range(max(0, first - MAX_DELAY), first + 1)
        self._ok = np.asarray((np.abs(residual[rows]) <= stage.floor[rows]).all(1))
        self._loss = _measure_loss(residual[rows])
        departed, others = np.flatnonzero(~self._ok), np.flatnonzero(self._ok)
        some = _select_evenly(departed, SEARCH_ROWS), _select_evenly(others, SEARCH_ROWS // 4)
        self._sample = np.sort(np.concatenate(some))

    def rank(self, given: tuple[Change, ...]) -> tuple[FittedDistortion, ...]:
        """Return the mistakes that come nearest, beside those of `given`, best first."""
        screened = []
        for distortion in self._stage.distortions:
            values = distortion.values or self._begins
            tried = [self._try(distortion, one, given, self._sample) for one in values]
            screened.append(max(tried, key=GAIN))
        screened.sort(key=GAIN, reverse=True)
        refined = [self._refine(one, given) for one in screened[:NUM_SCREENED]]
        refined.sort(key=GAIN, reverse=True)
        everywhere = np.arange(len(self._rows))
        found = []
        for one in refined[:NUM_REFINED]:
            found.append(self._try(one.distortion, one.value, given, everywhere))
        return tuple(sorted(found, key=_rank_fit))

    def choose(
        self, ranking: tuple[FittedDistortion, ...]
    ) -> tuple[tuple[FittedDistortion, ...], tuple[FittedDistortion, ...]]:
        """Return the mistakes that explain the log, one or two, and those like the first."""
        fitting = [one for one in ranking if one.fits]
        if fitting:
            best = fitting[0]
            alike = [one for one in fitting[1:] if one.explained >= best.explained - ALIKE]
            return (best,), tuple(alike)
        for first in sorted(ranking, key=GAIN, reverse=True)[:NUM_FIRST]:
            if first.gain < PAIR_GAIN:
                break
            change = first.distortion.build(first.value)
            for second in self.rank((change,))[:1]:
                if second.fits and second.distortion.field != first.distortion.field:
                    return (first, second), ()
        return (), ()

    def _refine(self, screened: FittedDistortion, given: tuple[Change, ...]) -> FittedDistortion:
        """Return a distortion with a number near that of its grid."""
        distortion, values = screened.distortion, screened.distortion.values
        if not distortion.is_continuous:
            return screened
        place = values.index(screened.value)
        low, high = values[max(0, place - 1)], values[min(len(values) - 1, place + 1)]
        best = minimize_scalar(
            lambda number: -self._try(distortion, float(number), given, self._sample).gain,
            bounds=(low, high),
            method="bounded",
            options={"xatol": TOLERANCE_REFINED * max(abs(low), abs(high))},
        )
        refined = self._try(distortion, float(best.x), given, self._sample)
        return max(screened, refined, key=GAIN)

    def _try(
        self, distortion: Distortion, value: float, given: tuple[Change, ...], places: np.ndarray
    ) -> FittedDistortion:
        """Return a distortion with what it explains at some places of the judged rows."""
        rows, was_ok, before = self._rows[places], self._ok[places], self._loss[places]
        predicted = self._stage.predict((*given, distortion.build(value)), rows)
        residual = predicted - self._stage.logged[rows]
        (begin, end), gained = _find_segment(before - _measure_loss(residual))
        with np.errstate(invalid="ignore"):
            is_ok = np.asarray((np.abs(residual) <= self._stage.floor[rows]).all(1))
        ok = np.concatenate([was_ok[:begin], is_ok[begin:end], was_ok[end:]])
        return FittedDistortion(
            distortion=distortion,
            value=value,
            # A mistake from the first judged row on has held from the beginning.
            begin=int(rows[min(begin, len(rows) - 1)]) if begin else 0,
            end=int(rows[max(begin, end - 1)]),
            explained=float(ok.mean()),
            explained_departed=1.0 if was_ok.all() else float(ok[~was_ok].mean()),
            gain=gained / max(float(before.sum()), 1e-12),
        )


def _rank_fit(one: FittedDistortion) -> tuple[float, int, float]:
    """Return the key by which fits are ordered: explained share, free numbers, gain."""
    return -round(one.explained / ALIKE), int(bool(one.distortion.parameter)), -one.gain


def _measure_loss(residual: np.ndarray) -> np.ndarray:
    """Return the mean loss of each row, `(R,)`: the logarithm of its differences."""
    return np.log1p(np.nan_to_num(np.abs(residual), nan=UNKNOWN) / LOSS_SCALE).mean(1)


def _find_segment(gained: np.ndarray) -> tuple[tuple[int, int], float]:
    """Return the segment of rows, begin and end, with the largest sum, and the sum."""
    before = np.append(0.0, np.cumsum(gained))
    end = int(np.argmax(before - np.minimum.accumulate(before)))
    begin = end - int(np.argmin(before[end::-1]))
    return (begin, end), float(before[end] - before[begin])


def _select_evenly(places: np.ndarray, most: int) -> np.ndarray:
    count = min(most, len(places))
    return places[np.linspace(0, len(places) - 1, count).round().astype(int)]
