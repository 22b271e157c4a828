"""Score of one answer against one label: the row of its case.

A name is right strictly when it is a true effect. It is right with equivalents when it is of the class of
a true effect (see `CaseDistribution.classes`), or has one in its `same_as`. Figures are strict unless they
say otherwise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from diagnosis.answer import Answer, Selected
from exam.case_distribution import CaseDistribution

CI90_OVER_CI95 = 1.6449 / 1.9600
"""From half a 95 % interval to half a 90 % interval of a normal distribution."""


@dataclass(frozen=True)
class ParameterScore:
    """A parameter of an effect that is named strictly, on a joint that has it.

    Attributes:
        error: Absolute error over the true distance from the value that changes nothing.
        in_90: Whether the 90 % interval holds the truth: the 95 % interval drawn together as for a
            normal distribution.
    """

    error: float
    in_90: bool


class Claim(NamedTuple):
    """A statement with a probability, and whether it is true; equivalents count."""

    probability: float
    is_true: bool


@dataclass(frozen=True, kw_only=True)
class CaseScore:
    """Score of one answer.

    Attributes:
        kind: Kind of the case; see `case_distribution.KINDS`.
        truth: Effects that are there.
        named: Effects that are named, most probable first.
        stands_for: The true effect that each name stands for, equivalents included; empty for none.
        verdict: `effects`, `none`, `unknown`, or `failed` where there is no answer.
        joints_right: Whether a name that stands for an effect has exactly its joints, for each effect
            that joints can have.
        claims: Statements whose truth the label knows.
        numbers: Parameters of strictly right names.
        examined: Share of the gap closed on withheld recordings, by the examiner's simulation of
            `effects.yaml`; `None` where there is no gap in the motion, or nobody examined it.
        outside: Name of the fault outside the library.
        other_hand: Whether another hand drives the field than the reference.
    """

    kind: str
    truth: tuple[str, ...]
    named: tuple[str, ...]
    stands_for: tuple[str, ...]
    verdict: str
    joints_right: tuple[bool, ...]
    claims: tuple[Claim, ...]
    numbers: tuple[ParameterScore, ...]
    examined: float | None
    outside: str | None
    other_hand: bool

    @property
    def first(self) -> bool:
        """True if the most probable name is a true effect."""
        return bool(self.named) and self.named[0] in self.truth

    @property
    def first_equivalent(self) -> bool:
        """True if the most probable name stands for a true effect."""
        return bool(self.named) and bool(self.stands_for[0])

    @property
    def exact(self) -> bool:
        """True if the true effects are named and no other."""
        return sorted(self.named) == sorted(self.truth)

    @property
    def exact_equivalent(self) -> bool:
        """True if the names stand for the true effects, each for one."""
        return sorted(self.stands_for) == sorted(self.truth)

    @property
    def alarm(self) -> bool:
        """True if a false effect is named, or the cause called unknown."""
        return self.verdict == "unknown" or not all(self.stands_for)


def score_answer(
    label: Mapping[str, Any],
    answer: Answer | None,
    mix: CaseDistribution,
    examined: Mapping[str, Any] | None = None,
) -> CaseScore:
    """Return the score of `answer`; `None` is a missing answer.

    Args:
        label: The truth, as `dataset.make_label` has it.
        answer: The answer.
        mix: Says which effects cannot be told apart, and which ones all joints have together: nobody is asked for
            their joints.
        examined: The examiner's own figures; see `examiner.examine_case`.
    """
    kind, outside = label["kind"], label["outside"]
    true = {one["effect"]: one for one in label["effects"]}
    verdict = answer.verdict if answer else "failed"
    chosen: list[Selected] = []
    if answer is not None and verdict == "effects":
        chosen = sorted(answer.selected, key=lambda one: -one.probability)
    stands_for = match_effects(list(true), chosen, mix.classes)
    together = {name for name, trouble in mix.troubles.items() if trouble.joints == "all"}
    claims, joints_right, numbers = [], [], []
    for one, effect in zip(chosen, stands_for, strict=True):
        claims.append(Claim(one.probability, bool(effect)))
        if effect and effect not in together:
            joints_right.append(set(one.joints) == set(true[effect]["joints"]))
        # Parameters of another effect of the class are other quantities.
        if effect == one.effect:
            numbers.extend(score_parameters(true[effect], one))
    # A verdict without names is a statement too. An effect below the noise makes `none` true.
    right_kinds = {"none": ("none", "faint"), "unknown": ("outside",)}
    if answer is not None and verdict in right_kinds:
        ranked = [one.probability for one in answer.ranking if one.effect == verdict]
        claims.append(Claim(ranked[0] if ranked else 1.0, kind in right_kinds[verdict]))
    return CaseScore(
        kind=kind,
        truth=tuple(true),
        named=tuple(one.effect for one in chosen),
        stands_for=tuple(stands_for),
        verdict=verdict,
        joints_right=tuple(joints_right),
        claims=tuple(claims),
        numbers=tuple(numbers),
        examined=examined["closed"] if examined is not None else None,
        outside=outside["ailment"] if outside else None,
        other_hand=label.get("other_hand", False),
    )


def match_effects(
    true: Sequence[str], chosen: Sequence[Selected], classes: Sequence[Sequence[str]]
) -> list[str]:
    """Return the true effect that each name stands for, empty for none; equal names go first."""
    found = [one.effect if one.effect in true else "" for one in chosen]
    for k, one in enumerate(chosen):
        if found[k]:
            continue
        equivalent = set(one.same_as)
        for group in classes:
            if one.effect in group:
                equivalent.update(group)
        found[k] = next((e for e in true if e in equivalent and e not in found), "")
    return found


def score_parameters(true: Mapping[str, Any], one: Selected) -> list[ParameterScore]:
    """Return the scores of all parameters of an effect on the joints that have it and are named."""
    found = []
    for name, by_joint in true["parameters"].items():
        said, values = one.parameters.get(name, {}), dict(by_joint)
        is_shared = len(set(values.values())) == 1 and len(set(said.values())) == 1
        if "machine" in said:  # a number that joints do not have
            values = {"machine": next(iter(by_joint.values()))}
        elif is_shared and set(said) >= set(values):
            values = dict(list(values.items())[:1])  # one that they share counts once
        for joint in values.keys() & said.keys():
            value, estimate = values[joint], said[joint]
            low, high = estimate.ci95
            short = estimate.mean + CI90_OVER_CI95 * (low - estimate.mean)
            long = estimate.mean + CI90_OVER_CI95 * (high - estimate.mean)
            error = abs(estimate.mean - value) / max(abs(value - true["nothing"][name]), 1e-9)
            found.append(ParameterScore(error, short <= value <= long))
    return found
