"""Prices and probabilities of the diagnosis, from development exams: what was weighed is chosen from again at other prices.

Nothing is simulated, so hundreds of prices are tried in minutes. Exams of several plants go in at once: what is right for one
machine only is not found. What is left after a choice is taken from the run that weighed; it hardly depends on prices.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from brokk_rl.diagnosis import answer, verdict, weighing
from brokk_rl.diagnosis.answer import Answer, Selected, Where
from brokk_rl.diagnosis.engine import Prices
from brokk_rl.diagnosis.exam import marking, seal
from brokk_rl.diagnosis.exam.marking import QUIET, Claim, Mark
from brokk_rl.diagnosis.library import Kind
from brokk_rl.errors import ConfigError, RecordingError
from brokk_rl.machine import Machine

log = logging.getLogger(__name__)

RANGES = {
    "joint": (2.0, 12.0), "reference": (0.5, 3.0), "name": (2.0, 25.0), "partial": (2.0, 25.0), "share": (0.005, 0.08),
    "remainder": (8.0, 80.0), "explained": (0.15, 0.75), "scatter": (1.15, 2.4), "tool": (1.5, 3.0),
}  # fmt: skip
"""Prices that are tried, log-uniform."""
NEAR = 0.25
"""Around the best so far the second half of the trials is drawn: standard deviation of the logarithm."""
QUIET_WEIGHT = 2.0
"""A false alarm costs as much as so many effects that are missed."""
TEMPERATURES = np.geomspace(0.5, 30.0, 40)


@dataclass(frozen=True)
class Item:
    """One case: its label, and what was weighed."""

    label: Mapping[str, Any]
    told: Mapping[str, Any]


def items(folders: Sequence[Path]) -> list[Item]:
    """Returns the cases whose answers lie in `folders`, each a run folder of `exam.do=run` on a development exam.

    Raises:
        ConfigError: an exam is sealed: nothing is tuned to it.
        RecordingError: no answer says what was weighed.
    """
    found = []
    for folder in folders:
        exam = folder.parent  # answers may lie in the folder of their exam
        if not (exam / seal.LABELS).is_file():
            exam = Path(yaml.safe_load((folder / "resolved.yaml").read_text())["exam"]["folder"])
        if json.loads((exam / "exam.json").read_text())["sealed"]:
            raise ConfigError(f"exam.answers: {exam} is a sealed exam; prices are fitted to development exams only")
        for label in seal.opened(exam)["cases"]:
            place = folder / label["case"] / answer.FILE
            told = json.loads(place.read_text()).get("weighed") if place.is_file() else None
            found += [Item(label, told)] if told else []
    if not found:
        raise RecordingError(
            f"{', '.join(map(str, folders))}: no answer says what was weighed; expected run folders of exam.do=run"
        )
    return found


def answered(item: Item, prices: Prices, kinds: Sequence[Kind], machine: Machine) -> Answer:
    """Returns what the diagnosis would say at these prices; it has no numbers."""
    found = weighing.findings(item.told, prices, kinds)
    unknown = verdict.is_unknown(found, prices)
    selected: list[Selected] = [] if unknown else [verdict.other(one, prices, machine) for one in found.others]
    for name in () if unknown else found.chosen.names:
        swaps = verdict.rivals(found, name)
        like = verdict.same_as(swaps, verdict.own_gain(found, name))
        chance = verdict.probability(verdict.margin(found, prices, name, swaps, like), prices)
        joints = tuple(j for j, subset in zip(machine.joint_names, found.chosen.subsets, strict=True) if name in subset)
        selected.append(Selected(effect=name, joints=joints, probability=chance, parameters={}, gap_closed=None, same_as=like))
    told = "unknown" if unknown else "effects" if selected else "none"
    chance = verdict.unknown_chance(found, prices)
    ranked = tuple(verdict.ranking(found, selected, prices, machine, chance))
    return Answer(
        verdict=told, selected=tuple(selected), ranking=ranked, where=Where({}, (), None), gap=None, next_experiment=None
    )  # fmt: skip


def worth(mark: Mark) -> tuple[float, float]:
    """Returns what an answer is worth, of what could be."""
    if mark.kind in QUIET:
        return QUIET_WEIGHT * (mark.verdict == "none"), QUIET_WEIGHT
    if mark.kind == "outside":
        return float(mark.verdict == "unknown"), 1.0
    right, named, there = len(mark.hits), len(mark.named), len(mark.truth)
    exact = float(right == named == there) * (0.8 + 0.2 * float(np.mean(mark.joints_right or (True,))))
    return 0.6 * exact + 0.4 * (mark.first if there == 1 else 2.0 * right / max(named + there, 1)), 1.0


@dataclass(frozen=True)
class Calibration:
    """Fits prices to cases.

    Attributes:
        machine: The machine of all cases.
        kinds: The library.
        classes: Effects that cannot be told apart.
        of_machine: Effects that all joints have together.
        trials: Prices that are tried.
        seed: Of the trials.
        workers: Processes.
    """

    machine: Machine
    kinds: Sequence[Kind]
    classes: Sequence[Sequence[str]]
    of_machine: Sequence[str]
    trials: int
    seed: int
    workers: int

    def marks(self, cases: Sequence[Item], prices: Prices) -> list[Mark]:
        """Returns the marks of all cases at these prices."""
        said = [answered(item, prices, self.kinds, self.machine) for item in cases]
        return [marking.mark(i.label, one, self.classes, self.of_machine) for i, one in zip(cases, said, strict=True)]

    def value(self, cases: Sequence[Item], prices: Prices) -> float:
        """Returns the mean worth of the answers."""
        pairs = np.array([worth(mark) for mark in self.marks(cases, prices)])
        return float(pairs[:, 0].sum() / pairs[:, 1].sum())

    def fitted(self, cases: Sequence[Item], start: Prices, advance: Callable[[], None]) -> Prices:
        """Returns the prices of the best answers: half the trials anywhere, half around the best; then the temperature."""
        generator, best = np.random.default_rng(self.seed), (self.value(cases, start), start)
        with ProcessPoolExecutor(self.workers, initializer=_begin, initargs=(self, cases)) as pool:
            for half in (0, 1):
                trials = [self._drawn(best[1], half, generator) for _ in range(self.trials // 2)]
                for prices, value in zip(trials, pool.map(_value, trials), strict=True):
                    advance()
                    if value > best[0]:
                        best = value, prices
        found = best[1]
        claims = [(t, self._claims(cases, replace(found, temperature=float(t)))) for t in TEMPERATURES]
        return replace(found, temperature=float(min(claims, key=lambda pair: surprise(pair[1]))[0]))

    def _claims(self, cases: Sequence[Item], prices: Prices) -> list[Claim]:
        return [claim for mark in self.marks(cases, prices) for claim in mark.claims]

    def _drawn(self, near: Prices, half: int, generator: np.random.Generator) -> Prices:
        drawn = {}
        for name, (low, high) in RANGES.items():
            at = (
                np.log(getattr(near, name)) + NEAR * generator.standard_normal()
                if half
                else generator.uniform(*np.log([low, high]))
            )
            drawn[name] = round(float(np.clip(np.exp(at), low, high)), 3)
        return replace(near, **drawn)


_work: list[Any] = []
"""What a process values: a calibration and its cases, sent once."""


def _begin(calibration: Calibration, cases: Sequence[Item]) -> None:
    _work[:] = [calibration, cases]


def _value(prices: Prices) -> float:
    return _work[0].value(_work[1], prices)


def surprise(claims: Sequence[Claim]) -> float:
    """Returns the mean negative log likelihood of what is true."""
    chance = np.clip([one.probability if one.is_true else 1.0 - one.probability for one in claims], 1e-3, 1.0)
    return float(-np.log(chance).mean()) if claims else 0.0
