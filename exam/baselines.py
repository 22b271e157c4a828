"""Baselines of an exam: a constant answer, and forward selection by a textbook rule.

Forward selection sees the same errors, noise and simulated effects as the diagnosis. It lacks the
penalty from the reference, sets that do not grow from their best member, and the verdict `unknown`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from brokk_rl.contracts.actuator import ActuatorFit
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.spec import spec
from diagnosis import responses
from diagnosis.answer import ANSWER_FILE, Answer, Ranked, Selected, Verdict, Where
from diagnosis.error_covariance import compute_loss
from exam import oracle
from exam.oracle import JointErrors


@spec
class ConstantAnswer:
    """Give the same answer to every case: an effect on all joints, or no gap.

    Attributes:
        effect: The effect; `null` for none.
        probability: With which it is stated.
    """

    effect: str | None
    probability: float

    def check(self) -> None:
        if not 0 <= self.probability <= 1:
            raise ConfigError(f"candidate.probability: expected 0 to 1, got {self.probability}")

    def answer(self, case: Path, out: Path, machine: Machine) -> None:
        """Write it."""
        out.mkdir(parents=True, exist_ok=True)
        build_single_answer(self.effect, machine.joint_names, self.probability).write(
            out / ANSWER_FILE
        )


def build_single_answer(effect: str | None, joints: tuple[str, ...], probability: float) -> Answer:
    """Return an answer that names one effect, or `none`, and nothing else."""
    verdict: Verdict = "effects" if effect else "none"
    selected = (
        Selected(
            effect=effect, joints=joints, probability=probability, parameters={}, gap_closed=None
        )
        if effect
        else None
    )
    return Answer(
        verdict=verdict,
        selected=(selected,) if selected else (),
        ranking=(Ranked(effect or "none", joints if effect else (), probability),),
        where=Where({}, (), None),
        gap=None,
        next_experiment=None,
    )


SetScore = Callable[[JointErrors, frozenset[str]], float]
MAX_EFFECTS = 4
"""Effects that a joint gets at most: as many as a set of the diagnosis (`diagnosis.search`)."""


@spec
class ForwardSelection:
    """Add the best effect to each joint as long as it gains more than chance does.

    Chance is measured on repeats of the same case: parts of the reference held against a simulator
    that was fitted to the rest. What the best effect gains there, no effect has to be there for.

    Attributes:
        fit: How the simulator is made from the reference.
        rule: `held_out`: log likelihood on the half of the recordings that was not fitted to,
            `bic`: on all of them, less half the logarithm of their number for each parameter.
    """

    fit: ActuatorFit
    rule: Literal["held_out", "bic"]

    def answer(self, case: Path, out: Path, machine: Machine) -> None:
        """Write the answer.

        Raises:
            RecordingError: the simulator cannot be fitted.
        """
        gains: dict[str, dict[str, float]] = {}
        score = score_held_out if self.rule == "held_out" else score_bic
        evidence = oracle.load_case_evidence(case, self.fit, machine, with_repeats=True)
        for j, (joint, errors) in enumerate(zip(machine.joint_names, evidence.errors, strict=True)):
            least = learn_threshold([repeat[j] for repeat in evidence.repeats], score)
            for name, gain in select_forward(errors, score, least).items():
                gains.setdefault(name, {})[joint] = gain
        out.mkdir(parents=True, exist_ok=True)
        _build_answer(gains).write(out / ANSWER_FILE)


def learn_threshold(repeats: Sequence[JointErrors], worth: SetScore) -> float:
    """Return the largest gain of a single effect on repeats in which nothing changed, or 0."""
    largest = 0.0
    for errors in repeats:
        for name in errors.shapes:
            largest = max(largest, worth(errors, frozenset({name})))
    return largest


def select_forward(errors: JointErrors, worth: SetScore, least: float) -> dict[str, float]:
    """Return the effects that a joint gets, and how much each was worth when it came.

    Args:
        errors: Of the joint.
        worth: Gain of a set in log likelihood.
        least: Gain that each further effect must exceed.
    """
    chosen: frozenset[str] = frozenset()
    found: dict[str, float] = {}
    before = 0.0
    while len(chosen) < MAX_EFFECTS:
        worths = {}
        for name in errors.shapes:
            if name not in chosen:
                worths[name] = worth(errors, chosen | {name})
        best = max(worths, key=worths.__getitem__, default=None)
        if best is None or worths[best] <= before + least:
            break
        chosen, found[best], before = chosen | {best}, worths[best] - before, worths[best]
    return found


def score_held_out(errors: JointErrors, names: frozenset[str]) -> float:
    """Return the gain in log likelihood on the half that was not fitted to."""
    return float(
        compute_loss(errors.z)
        - compute_loss(
            errors.z - responses.cross_validate_change(errors.z, errors.rays(names), errors.fold)
        )
    )


def score_bic(errors: JointErrors, names: frozenset[str]) -> float:
    """Return the gain in log likelihood on all entries, less the price of the parameters."""
    rays = errors.rays(names)
    left = errors.z - responses.sum_responses(rays, responses.fit_sizes(errors.z, rays))
    return float(compute_loss(errors.z) - compute_loss(left)) - 0.5 * len(rays) * float(
        np.log(len(errors.z))
    )


def _build_answer(gains: dict[str, dict[str, float]]) -> Answer:
    """Return the answer: an effect is as probable as its worth in log likelihood makes it."""
    selected, ranking = [], []
    for name in sorted(gains, key=lambda name: -sum(gains[name].values())):
        joints = tuple(gains[name])
        # the logistic function of the gain; beyond 50 nats the exponential says 1.0 anyway
        chance = 1.0 / (1.0 + float(np.exp(-min(sum(gains[name].values()), 50.0))))
        selected.append(
            Selected(effect=name, joints=joints, probability=chance, parameters={}, gap_closed=None)
        )
        ranking.append(Ranked(name, joints, chance))
    return Answer(
        verdict="effects" if selected else "none",
        selected=tuple(selected),
        ranking=tuple(ranking) or (Ranked("none", (), 0.5),),
        where=Where({}, (), None),
        gap=None,
        next_experiment=None,
    )
