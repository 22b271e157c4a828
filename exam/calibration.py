"""Fit of the diagnosis' penalties and probability weights to development exams.

A run of the diagnosis stores its candidate sets, so another penalty is tried without simulation:
hundreds of trials take minutes. Exams of several plants are used at once, so that the result is not
specific to one machine. The remainder after a choice is that of the stored run; it hardly depends on
penalties.
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
from scipy.optimize import minimize

from brokk_rl.errors import ConfigError, RecordingError
from brokk_rl.machine import Machine
from diagnosis import answer, decision
from diagnosis import calibration as certainty
from diagnosis.answer import Answer, Selected, Where
from diagnosis.calibration import ProbabilityModel
from diagnosis.detection import Penalties
from diagnosis.effect_library import EffectType
from exam import dataset, score
from exam.score import QUIET_KINDS, CaseScore, ParameterScore

log = logging.getLogger(__name__)

RANGES = {
    "joint": (2.0, 12.0), "reference": (0.5, 3.0), "name": (2.0, 25.0), "partial": (2.0, 25.0), "share": (0.005, 0.08),
    "tool": (1.5, 3.0),
}  # fmt: skip
"""Prices that are tried, log-uniform."""
TRIAL_SIGMA = 0.25
"""Around the best so far the second half of the trials is drawn: standard deviation of the
logarithm."""
QUIET_WEIGHT = 2.0
"""A false alarm costs as much as so many effects that are missed."""
PRIOR_PRECISION = 10.0
"""Precision of a weight about where it begins, which earlier answers told; signs are of about unit
size."""
FORM_ERRORS = np.linspace(0.0, 0.3, 61)
TARGET_COVERAGE = 0.9
"""Share of true sizes that 90 % intervals should hold."""


@dataclass(frozen=True)
class WeighedCase:
    """One case: its label, what was weighed, and what was said."""

    label: Mapping[str, Any]
    told: Mapping[str, Any]
    said: Answer | None = None

    @property
    def family(self) -> str:
        """What the case is about, in one word."""
        outside, effects = self.label["outside"], self.label["effects"]
        return outside["ailment"] if outside else effects[0]["effect"] if effects else "none"


def load_weighed_cases(folders: Sequence[Path]) -> list[WeighedCase]:
    """Returns the cases whose answers lie in `folders`, each a run folder of `exam.do=run` on a development exam.

    Raises:
        ConfigError: an exam is sealed: nothing is tuned to it.
        RecordingError: no answer says what was weighed.
    """
    found = []
    for folder in folders:
        exam = folder.parent  # answers may lie in the folder of their exam
        if not (exam / dataset.LABELS_FILE).is_file():
            exam = Path(yaml.safe_load((folder / "resolved.yaml").read_text())["exam"]["folder"])
        if json.loads((exam / "exam.json").read_text())["sealed"]:
            raise ConfigError(
                f"exam.answers: {exam} is a sealed exam; prices are fitted to development exams only"
            )
        for label in dataset.open_labels(exam)["cases"]:
            place = folder / label["case"] / answer.ANSWER_FILE
            said = answer.read_answer(place) if place.is_file() else None
            told = said.more.get("weighed") if said else None
            found += [WeighedCase(label, told, said)] if told else []
    if not found:
        raise RecordingError(
            f"{', '.join(map(str, folders))}: no answer says what was weighed; expected run folders of exam.do=run"
        )
    return found


def split_by_family(cases: Sequence[WeighedCase]) -> tuple[list[WeighedCase], list[WeighedCase]]:
    """Returns two halves of the cases; what the cases of one are about is not what those of the other are about."""
    families = sorted({item.family for item in cases} - {"none"})
    side = {name: number % 2 for number, name in enumerate(families)}
    quiet = iter(range(len(cases)))
    sides = [side[item.family] if item.family in side else next(quiet) % 2 for item in cases]
    first, second = (
        [item for item, other in zip(cases, sides, strict=True) if other == half] for half in (0, 1)
    )
    return first, second


@dataclass(frozen=True)
class ClaimSigns:
    """Signs of what an answer states, as `certainty` has them, and of what the label knows whether it is true."""

    outside: dict[str, float]
    right: list[tuple[str, dict[str, float]]]
    none: dict[str, float]


def answer_case(
    item: WeighedCase,
    prices: Penalties,
    weights: ProbabilityModel,
    kinds: Sequence[EffectType],
    machine: Machine,
) -> tuple[Answer, ClaimSigns]:
    """Returns what the diagnosis would say at these prices, without numbers, and why it is so sure."""
    found = decision.drop_unlikely_effects(
        decision.restore_result(item.told, prices, kinds), prices, weights
    )
    unknown = decision.is_unknown(found, prices, weights)
    selected = (
        []
        if unknown
        else [
            decision.describe_detected_effect(found, one, weights, machine)
            for one in found.detected
        ]
    )
    signs = [
        (one.kind.name, decision.read_detected_signs(found, weights, one)) for one in found.detected
    ]
    for name in found.chosen.names:
        swaps = decision.rank_substitutions(found, name)
        like = decision.list_equivalents(swaps, decision.compute_own_gain(found, name))
        signs.append((name, decision.read_chosen_signs(found, prices, weights, name, swaps, like)))
        joints = tuple(
            j
            for j, subset in zip(machine.joint_names, found.chosen.subsets, strict=True)
            if name in subset
        )
        chance = certainty.compute_probability(weights.right, signs[-1][1])
        one = Selected(
            effect=name,
            joints=joints,
            probability=chance,
            parameters={},
            gap_closed=None,
            same_as=like,
        )
        selected += [] if unknown else [one]
    told = "unknown" if unknown else "effects" if selected else "none"
    chance = decision.compute_unknown_probability(found, prices, weights)
    ranked = tuple(decision.rank_hypotheses(found, selected, prices, weights, machine, chance))
    said = Answer(
        verdict=told, selected=tuple(selected), ranking=ranked, where=Where({}, (), None), gap=None, next_experiment=None
    )  # fmt: skip
    return said, ClaimSigns(
        certainty.collect_outside_signs(found),
        signs,
        decision.read_none_signs(found, prices, weights),
    )


def value_answer(mark: CaseScore) -> tuple[float, float]:
    """Returns what an answer is worth, of what could be."""
    if mark.kind in QUIET_KINDS:
        return QUIET_WEIGHT * (mark.verdict == "none"), QUIET_WEIGHT
    if mark.kind == "outside":
        return float(mark.verdict == "unknown"), 1.0
    right, named, there = len(mark.hits), len(mark.named), len(mark.truth)
    exact = float(right == named == there) * (
        0.8 + 0.2 * float(np.mean(mark.joints_right or (True,)))
    )
    return 0.6 * exact + 0.4 * (
        mark.first if there == 1 else 2.0 * right / max(named + there, 1)
    ), 1.0


@dataclass(frozen=True)
class PenaltyFit:
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
    kinds: Sequence[EffectType]
    classes: Sequence[Sequence[str]]
    of_machine: Sequence[str]
    trials: int
    seed: int
    workers: int

    def marks(
        self, cases: Sequence[WeighedCase], prices: Penalties, weights: ProbabilityModel
    ) -> list[CaseScore]:
        """Returns the marks of all cases at these prices, with these weights."""
        return [mark for mark, _ in self._marked(cases, prices, weights)]

    def _marked(
        self, cases: Sequence[WeighedCase], prices: Penalties, weights: ProbabilityModel
    ) -> list[tuple[CaseScore, ClaimSigns]]:
        said = [answer_case(item, prices, weights, self.kinds, self.machine) for item in cases]
        return [
            (score.score_answer(i.label, one, self.classes, self.of_machine), claims)
            for i, (one, claims) in zip(cases, said, strict=True)
        ]

    def value(
        self, cases: Sequence[WeighedCase], prices: Penalties, weights: ProbabilityModel
    ) -> float:
        """Returns the mean worth of the answers."""
        pairs = np.array([value_answer(mark) for mark in self.marks(cases, prices, weights)])
        return float(pairs[:, 0].sum() / pairs[:, 1].sum())

    def fitted(
        self,
        cases: Sequence[WeighedCase],
        start: Penalties,
        weights: ProbabilityModel,
        advance: Callable[[], None],
    ) -> tuple[Penalties, ProbabilityModel]:
        """Returns the prices of the best answers: half the trials anywhere, half around the best; then the weights of signs."""
        weights = self.weighed(cases, start, weights)
        generator, best = (
            np.random.default_rng(self.seed),
            (self.value(cases, start, weights), start),
        )
        with ProcessPoolExecutor(
            self.workers, initializer=_start_worker, initargs=(self, cases, weights)
        ) as pool:
            for half in (0, 1):
                trials = [self._drawn(best[1], half, generator) for _ in range(self.trials // 2)]
                for prices, value in zip(trials, pool.map(_evaluate_trial, trials), strict=True):
                    advance()
                    if value > best[0]:
                        best = value, prices
        return best[1], self.weighed(cases, best[1], weights)

    def weighed(
        self, cases: Sequence[WeighedCase], prices: Penalties, start: ProbabilityModel
    ) -> ProbabilityModel:
        """Returns the weights under which what is true of these cases is most probable, and what forms add to errors."""
        is_outside = [item.label["kind"] == "outside" for item in cases]
        outside = fit_logistic(
            [claims.outside for _, claims in self._marked(cases, prices, start)],
            is_outside,
            start.outside,
        )
        weights = replace(start, outside=outside)
        named, true = self._named(cases, prices, weights)
        found = {
            "right": fit_logistic(named, true, start.right) if len(set(true)) > 1 else start.right
        }
        silent = [
            (claims.none, mark.kind in QUIET_KINDS)
            for mark, claims in self._marked(cases, prices, weights)
            if mark.verdict == "none"
        ]
        if len({quiet for _, quiet in silent}) > 1:
            found["none"] = fit_logistic(
                [signs for signs, _ in silent], [quiet for _, quiet in silent], start.none
            )
        return replace(weights, form=self.forms(cases, weights.form), **found)

    def _named(
        self, cases: Sequence[WeighedCase], prices: Penalties, weights: ProbabilityModel
    ) -> tuple[list[dict[str, float]], list[bool]]:
        """Returns the signs of all effects that are named, and whether they are there."""
        signs, true = [], []
        for mark, claims in self._marked(cases, prices, weights):
            if mark.verdict == "effects":
                stand = {name for _, name in mark.hits}
                signs += [one for _, one in claims.right]
                true += [name in stand for name, _ in claims.right]
        return signs, true

    def forms(self, cases: Sequence[WeighedCase], now: Mapping[str, float]) -> dict[str, float]:
        """Returns the smallest errors of form, by stage, with which 90 % intervals hold nine in ten true sizes.

        What moves the machine (timing, actuation) has one, what measures it (sensing, kinematics)
        another.
        """
        stages, found = {kind.name: kind.stage for kind in self.kinds}, dict(now)
        for group in (("timing", "actuation"), ("sensing", "kinematics", "perception")):
            errors = []
            for item in cases:
                mark = score.score_answer(item.label, item.said, self.classes, self.of_machine)
                errors += [
                    (one, now[stages[one.effect]])
                    for one in mark.numbers
                    if stages[one.effect] in group
                ]
            holds = [
                form
                for form in FORM_ERRORS
                if errors
                and np.mean([_is_covered(one, was, form) for one, was in errors]) >= TARGET_COVERAGE
            ]
            found |= dict.fromkeys(group, round(float(holds[0]), 3)) if holds else {}
        return found

    def _drawn(self, near: Penalties, half: int, generator: np.random.Generator) -> Penalties:
        drawn = {}
        for name, (low, high) in RANGES.items():
            at = (
                np.log(getattr(near, name)) + TRIAL_SIGMA * generator.standard_normal()
                if half
                else generator.uniform(*np.log([low, high]))
            )
            drawn[name] = round(float(np.clip(np.exp(at), low, high)), 3)
        return replace(near, **drawn)


_work: list[Any] = []
"""What a process values: a calibration, its cases and weights, sent once."""


def _start_worker(
    calibration: PenaltyFit, cases: Sequence[WeighedCase], weights: ProbabilityModel
) -> None:
    _work[:] = [calibration, cases, weights]


def _evaluate_trial(prices: Penalties) -> float:
    calibration, cases, weights = _work
    return calibration.value(cases, prices, weights)


def fit_logistic(
    signs: Sequence[Mapping[str, float]], true: Sequence[bool], start: Mapping[str, float]
) -> dict[str, float]:
    """Returns the weights of a logistic regression, pulled towards those at which it begins but for the constant."""
    names, y = list(signs[0]), np.array(true, dtype=float)
    x, begin = (
        np.array([[one[name] for name in names] for one in signs]),
        np.array([start[name] for name in names]),
    )
    pull = np.array([0.0 if name == "constant" else PRIOR_PRECISION for name in names])

    def loss(w: np.ndarray) -> tuple[float, np.ndarray]:
        at, off = x @ w, w - begin
        slope = x.T @ (1.0 / (1.0 + np.exp(-at)) - y) + pull * off
        return float(np.logaddexp(0.0, at).sum() - y @ at + 0.5 * pull @ off**2), slope

    found = minimize(loss, begin, jac=True, method="L-BFGS-B")
    return {name: round(float(value), 3) for name, value in zip(names, found.x, strict=True)}


def _is_covered(number: ParameterScore, was: float, form: float) -> bool:
    """Says whether the 90 % interval would hold the truth if forms added `form` to the error, and not `was`."""
    own = np.sqrt(max(number.deviation**2 - (was * number.said) ** 2, 0.0))
    return bool(number.error <= 1.645 * np.hypot(own, form * number.said))
