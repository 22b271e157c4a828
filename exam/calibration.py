"""Fit of the diagnosis' penalties and probability weights to development exams.

A run of the diagnosis stores its candidate sets, so another penalty is tried without simulation:
hundreds of trials take minutes. Exams of several plants are used at once, so that the result is not
specific to one machine. The remainder after a choice is that of the stored run; it hardly depends
on penalties.
"""

from __future__ import annotations

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
from diagnosis import answer, decision, hypotheses
from diagnosis import calibration as certainty
from diagnosis.answer import Answer, Selected, Where
from diagnosis.detection import DetectionResult
from diagnosis.effect_library import EffectType
from diagnosis.request import Penalties, ProbabilityModel
from exam import dataset, score
from exam.score import QUIET_KINDS, CaseScore

log = logging.getLogger(__name__)

RANGES = {
    "joint": (2.0, 12.0), "reference": (0.5, 3.0), "name": (2.0, 25.0), "partial": (2.0, 25.0), "share": (0.005, 0.08),
}  # fmt: skip
"""Ranges of the penalties, log-uniform; chosen by hand: wider than any good answer needs."""
TRIAL_SIGMA = 0.25
"""Standard deviation of the logarithm about the best penalties so far, in the second half of the
trials; chosen by hand."""
QUIET_WEIGHT = 2.0
"""Cost of a false alarm in missed effects; chosen by hand: trust is lost faster than won."""
PRIOR_PRECISION = 10.0
"""Prior precision of a weight about its start; chosen by hand for predictors of about unit size."""
CHOICE_PRECISION = 1.0
"""The same of a weight of the choice; chosen by hand, on 310 practice cases 0.3 to 3 do alike."""
FORM_ERRORS = np.linspace(0.0, 0.3, 61)
"""Model-form errors that are tried, relative, in steps of 0.005."""
TARGET_COVERAGE = 0.9
"""Share of true sizes that 90 % intervals must cover."""
LEAST_NUMBERS = 8
"""Sizes of an effect from which it has a model-form error of its own: of fewer, one decides. Chosen by hand."""


@dataclass(frozen=True)
class SizeError:
    """Error of a stated size of an effect, over its true size.

    Attributes:
        error: Absolute error.
        deviation: Stated standard deviation, without the error of the effect's form.
        said: The stated size.
    """

    error: float
    deviation: float
    said: float

    def is_covered(self, form: float) -> bool:
        """Return whether the 90 % interval holds the truth at a model-form error of `form`."""
        return self.error <= 1.645 * float(np.hypot(self.deviation, form * self.said))


@dataclass(frozen=True)
class WeighedCase:
    """One case: its label, the stored candidate sets, and the answer."""

    label: Mapping[str, Any]
    told: Mapping[str, Any]
    said: Answer | None = None

    @property
    def family(self) -> str:
        """Kind of cause of the case, in one word."""
        outside, effects = self.label["outside"], self.label["effects"]
        return outside["ailment"] if outside else effects[0]["effect"] if effects else "none"


def load_weighed_cases(folders: Sequence[Path]) -> list[WeighedCase]:
    """Return the cases with answers in `folders`, run folders of `exam.do=run`.

    Raises:
        ConfigError: an exam is sealed: nothing is tuned to it.
        RecordingError: no answer holds candidate sets.
    """
    found = []
    for folder in folders:
        exam = folder.parent  # answers may lie in the folder of their exam
        if not (exam / dataset.LABELS_FILE).is_file():
            exam = Path(yaml.safe_load((folder / "resolved.yaml").read_text())["exam"]["folder"])
        if dataset.is_sealed(exam):
            raise ConfigError(
                f"exam.answers: {exam} is a sealed exam; prices are fitted to development exams only"
            )
        for label in dataset.open_labels(exam)["cases"]:
            place = folder / label["case"] / answer.ANSWER_FILE
            said = answer.read_answer(place) if place.is_file() else None
            told = said.more.get("weighed") if said else None
            found += [WeighedCase(label, told, said)] if told and "hypotheses" in told else []
    if not found:
        raise RecordingError(
            f"{', '.join(map(str, folders))}: no answer says what was weighed; expected run folders of exam.do=run"
        )
    return found


def split_by_family(cases: Sequence[WeighedCase]) -> tuple[list[WeighedCase], list[WeighedCase]]:
    """Return two halves of the cases that share no kind of cause."""
    families = sorted({item.family for item in cases} - {"none"})
    side = {name: number % 2 for number, name in enumerate(families)}
    halves: tuple[list[WeighedCase], list[WeighedCase]] = ([], [])
    num_quiet = 0
    for item in cases:
        if item.family in side:
            halves[side[item.family]].append(item)
        else:  # cases without a cause alternate, so that both halves hold some
            halves[num_quiet % 2].append(item)
            num_quiet += 1
    return halves


@dataclass(frozen=True)
class ClaimSigns:
    """Predictors of the statements of an answer, as `diagnosis.calibration` has them."""

    outside: dict[str, float]
    right: list[tuple[str, dict[str, float]]]


def answer_case(
    item: WeighedCase,
    prices: Penalties,
    weights: ProbabilityModel,
    kinds: Sequence[EffectType],
    machine: Machine,
) -> tuple[Answer, ClaimSigns]:
    """Return the answer at these penalties, without parameters, and the predictors behind it."""
    known = hypotheses.read_hypotheses(item.told["hypotheses"])
    choice = hypotheses.choose_hypothesis(known, weights)
    restored = decision.restore_result(item.told, prices, kinds)
    found = hypotheses.apply_choice(restored, choice, prices, weights)
    unknown = hypotheses.is_unknown(choice, found)
    selected: list[Selected] = []
    signs: list[tuple[str, dict[str, float]]] = []
    for one in found.detected:
        # an unknown cause leaves all names out; their predictors still count for the fit
        if not unknown:
            selected.append(decision.describe_detected_effect(found, one, weights, machine))
        signs.append((one.kind.name, decision.read_detected_signs(found, weights, one)))
    for name in sorted(found.chosen.names):
        named, predictors = _describe_chosen_effect(found, name, prices, weights, machine)
        signs.append((name, predictors))
        if not unknown:
            selected.append(named)
    told = "unknown" if unknown else "effects" if selected else "none"
    ranked = tuple(choice.rank(selected, machine.joint_names))
    said = Answer(
        verdict=told, selected=tuple(selected), ranking=ranked, where=Where({}, (), None), gap=None, next_experiment=None
    )  # fmt: skip
    return said, ClaimSigns(certainty.collect_outside_signs(found), signs)


def _describe_chosen_effect(
    found: DetectionResult,
    name: str,
    prices: Penalties,
    weights: ProbabilityModel,
    machine: Machine,
) -> tuple[Selected, dict[str, float]]:
    """Return a chosen effect without parameters, and the predictors of its probability."""
    swaps = decision.rank_substitutions(found, name)
    like = decision.list_equivalents(swaps, decision.compute_own_gain(found, name))
    signs = decision.read_chosen_signs(found, prices, weights, name, swaps, like)
    joints = []
    for joint, subset in zip(machine.joint_names, found.chosen.subsets, strict=True):
        if name in subset:
            joints.append(joint)
    selected = Selected(
        effect=name,
        joints=tuple(joints),
        probability=certainty.compute_probability(weights.right, signs),
        parameters={},
        gap_closed=None,
        same_as=like,
    )
    return selected, signs


def rate_answer(mark: CaseScore) -> tuple[float, float]:
    """Return the points of an answer and the most that it could have."""
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
    """Fit prices to cases.

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
        """Return the marks of all cases at these prices, with these weights."""
        return [mark for mark, _ in self._marked(cases, prices, weights)]

    def _marked(
        self, cases: Sequence[WeighedCase], prices: Penalties, weights: ProbabilityModel
    ) -> list[tuple[CaseScore, ClaimSigns]]:
        marked = []
        for item in cases:
            said, claims = answer_case(item, prices, weights, self.kinds, self.machine)
            mark = score.score_answer(item.label, said, self.classes, self.of_machine)
            marked.append((mark, claims))
        return marked

    def value(
        self, cases: Sequence[WeighedCase], prices: Penalties, weights: ProbabilityModel
    ) -> float:
        """Return the mean worth of the answers."""
        pairs = np.array(list(map(rate_answer, self.marks(cases, prices, weights))))
        return float(pairs[:, 0].sum() / pairs[:, 1].sum())

    def fitted(
        self,
        cases: Sequence[WeighedCase],
        start: Penalties,
        weights: ProbabilityModel,
        advance: Callable[[], None],
    ) -> tuple[Penalties, ProbabilityModel]:
        """Return the best penalties of a random search, and the weights of the predictors."""
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
        """Return the weights with the largest likelihood, and the model-form errors."""
        # the signs of outside causes are fitted first: they are a sign of the others
        is_outside = [item.label["kind"] == "outside" for item in cases]
        signs = [claims.outside for _, claims in self._marked(cases, prices, start)]
        outside = fit_logistic(signs, is_outside, start.outside)
        weights = replace(start, outside=outside)
        named, true = self._named(cases, prices, weights)
        found = {
            "right": fit_logistic(named, true, start.right) if len(set(true)) > 1 else start.right
        }
        choice = fit_choice(cases, weights.choice)
        by_stage, by_effect = self.fit_forms(cases, weights)
        return replace(weights, form=by_stage, form_of_effect=by_effect, choice=choice, **found)

    def _named(
        self, cases: Sequence[WeighedCase], prices: Penalties, weights: ProbabilityModel
    ) -> tuple[list[dict[str, float]], list[bool]]:
        """Return the signs of all effects that are named, and whether they are there."""
        signs, true = [], []
        for mark, claims in self._marked(cases, prices, weights):
            if mark.verdict == "effects":
                stand = {name for _, name in mark.hits}
                for name, predictors in claims.right:
                    signs.append(predictors)
                    true.append(name in stand)
        return signs, true

    def fit_forms(
        self, cases: Sequence[WeighedCase], now: ProbabilityModel
    ) -> tuple[dict[str, float], dict[str, float]]:
        """Return the smallest model-form errors, by stage and by effect, with which 90 % intervals cover 90 %.

        Timing and actuation share one; sensing, kinematics and perception share another. An effect with
        `LEAST_NUMBERS` sizes or more has its own. What the cases do not decide stays.
        """
        stages = {kind.name: kind.stage for kind in self.kinds}
        errors = self.collect_size_errors(cases, now)
        by_stage = dict(now.form)
        for group in (("timing", "actuation"), ("sensing", "kinematics", "perception")):
            mine = [effect for effect in errors if stages[effect] in group]
            least = find_form_error([one for effect in mine for one in errors[effect]])
            if least is not None:
                by_stage |= dict.fromkeys(group, least)
        return by_stage, now.form_of_effect | find_effect_forms(errors)

    def collect_size_errors(
        self, cases: Sequence[WeighedCase], now: ProbabilityModel
    ) -> dict[str, list[SizeError]]:
        """Return the errors of all stated sizes, by effect; `now` stated their intervals."""
        stages = {kind.name: kind.stage for kind in self.kinds}
        found: dict[str, list[SizeError]] = {}
        for item in cases:
            mark = score.score_answer(item.label, item.said, self.classes, self.of_machine)
            for one in mark.numbers:
                form = now.get_form_error(one.effect, stages[one.effect])
                own = np.sqrt(max(one.deviation**2 - (form * one.said) ** 2, 0.0))
                found.setdefault(one.effect, []).append(SizeError(one.error, float(own), one.said))
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
"""State of a worker process: the fit, its cases and weights, sent once."""


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
    """Fit a logistic regression with a normal prior about the start; the constant is free."""
    names, y = list(signs[0]), np.array(true, dtype=float)
    x = np.array([list(map(one.__getitem__, names)) for one in signs])
    begin = np.array(list(map(start.__getitem__, names)))
    # the share of true statements differs between exams: nothing pulls at the constant
    pull = np.where(np.array(names) == "constant", 0.0, PRIOR_PRECISION)

    def loss(w: np.ndarray) -> tuple[float, np.ndarray]:
        at, off = x @ w, w - begin
        slope = x.T @ (1.0 / (1.0 + np.exp(-at)) - y) + pull * off
        return float(np.logaddexp(0.0, at).sum() - y @ at + 0.5 * pull @ off**2), slope

    found = minimize(loss, begin, jac=True, method="L-BFGS-B")
    return {name: round(float(value), 3) for name, value in zip(names, found.x, strict=True)}


def fit_choice(
    cases: Sequence[WeighedCase], start: Mapping[str, Mapping[str, float]]
) -> dict[str, dict[str, float]]:
    """Fit the conditional logit over hypotheses with a normal prior about the start; stakes are kept.

    Cases in which none is right are left out.
    """
    keys = [(verdict, sign) for verdict in start if verdict != "stakes" for sign in start[verdict]]
    begin = np.array([start[verdict][sign] for verdict, sign in keys])
    tables = []
    for item in cases:
        rows = item.told["hypotheses"]
        right = np.array([_is_right(row["name"], item) for row in rows], dtype=float)
        if right.any():
            signs = [[_read_sign(row, *key) for key in keys] for row in rows]
            tables.append((np.array(signs), right))

    def loss(w: np.ndarray) -> tuple[float, np.ndarray]:
        total, slope = (
            0.5 * CHOICE_PRECISION * float((w - begin) @ (w - begin)),
            CHOICE_PRECISION * (w - begin),
        )
        for signs, right in tables:
            score = signs @ w
            odds = np.exp(score - score.max())
            among = odds * right
            total += float(np.log(odds.sum()) - np.log(among.sum()))
            slope = slope + signs.T @ (odds / odds.sum() - among / among.sum())
        return total, slope

    best = minimize(loss, begin, jac=True, method="L-BFGS-B").x if tables else begin
    found = {verdict: dict(signs) for verdict, signs in start.items()}
    for (verdict, sign), value in zip(keys, best, strict=True):
        found[verdict][sign] = round(float(value), 3)
    return found


def _read_sign(row: Mapping[str, Any], verdict: str, sign: str) -> float:
    name = row["name"]
    own = name if name in ("none", "unknown") else "effects"
    return float(row["signs"].get(sign, 0.0)) if own == verdict else 0.0


def _is_right(name: str, item: WeighedCase) -> bool:
    """Return whether a hypothesis is right, beside what sensors, frames and tool points show."""
    if item.label["outside"]:
        return name == "unknown"
    shown = {one["effect"] for one in item.told["others"]}
    left = {one["effect"] for one in item.label["effects"]} - shown
    return name in left if left else name == "none"


def find_effect_forms(errors: Mapping[str, Sequence[SizeError]]) -> dict[str, float]:
    """Return the model-form error of each effect with enough sizes."""
    found = {}
    for effect, sizes in sorted(errors.items()):
        least = find_form_error(sizes) if len(sizes) >= LEAST_NUMBERS else None
        if least is not None:
            found[effect] = least
    return found


def find_form_error(errors: Sequence[SizeError]) -> float | None:
    """Return the smallest model-form error that covers enough, `None` where none does."""
    if not errors:
        return None
    for form in FORM_ERRORS:
        if np.mean([one.is_covered(form) for one in errors]) >= TARGET_COVERAGE:
            return round(float(form), 3)
    return None
