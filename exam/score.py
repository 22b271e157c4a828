"""Score of one answer against one label.

An answer names an effect rightly, over classes, when it names the true one, one of its class (see
`CaseDistribution.classes`), or has the true one in its `same_as`; strictly, when it names the true
one. A case whose effect is below the noise counts as one without a gap.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from diagnosis.answer import Answer, Selected

QUIET_KINDS = ("none", "faint")
"""Kinds of cases in which nothing can be seen."""
CI95_OVER_SIGMA = 3.92
"""Length of a 95 % interval of a normal distribution over its standard deviation: 2 times 1.96."""
CI90_OVER_CI95 = 1.6449 / 1.9600
"""From half a 95 % interval to half a 90 % interval of a normal distribution."""


@dataclass(frozen=True)
class ParameterScore:
    """A parameter of an effect that was rightly named, on a joint that has it.

    Attributes:
        effect: Of which effect.
        parameter: Its name.
        error: Absolute error over the true distance from the value that changes nothing.
        deviation: The stated standard deviation, over the same.
        said: The stated distance from the value that changes nothing, over the same.
        in_95: Whether the 95 % interval holds the truth.
        in_90: The same for the 90 % interval, which is the 95 % interval drawn together as for a
            normal distribution.
    """

    effect: str
    parameter: str
    error: float
    deviation: float
    said: float
    in_95: bool
    in_90: bool


@dataclass(frozen=True)
class Claim:
    """A statement with a probability, and whether it is true."""

    probability: float
    is_true: bool


@dataclass(frozen=True, kw_only=True)
class CaseScore:
    """Score of one answer.

    Attributes:
        case: Which case.
        kind: Its kind; see `mix.KINDS`.
        truth: Effects that are there, none of them in a quiet case.
        named: Effects that are named, most probable first.
        hits: Pairs of a true effect and the named one that stands for it, over classes.
        verdict: `effects`, `none`, `unknown`, or `failed` where there is no answer.
        first: Whether the most probable name is right, over classes; strictly.
        first_strictly: See `first`.
        joints_right: Whether a rightly named effect has exactly its joints, for each that joints
            can have.
        unknown: Probability that the cause lies outside the library.
        claims: Statements whose truth the label knows.
        numbers: Parameters of strictly right names.
        size: Largest size of an effect or outside fault, of typical.
        moved_rad: Change of the motion by the cause over 5 s, on the joint with the largest.
        closed: Share of the gap closed, by the answer's own account.
        examined: Share of the gap closed on withheld recordings, by the examiner's simulation of
            `effects.yaml`; `None` where there is no gap in the motion, or nobody examined it.
        was_examined: Whether the examiner simulated the answer.
        differs: Whether the examiner's share and the answer's own disagree.
        seconds: Time the answer took.
        outside: Name of the fault outside the library.
    """

    case: str
    kind: str
    truth: tuple[str, ...]
    named: tuple[str, ...]
    hits: tuple[tuple[str, str], ...]
    verdict: str
    first: bool
    first_strictly: bool
    joints_right: tuple[bool, ...]
    unknown: float
    claims: tuple[Claim, ...]
    numbers: tuple[ParameterScore, ...]
    size: float
    moved_rad: float
    closed: float | None
    examined: float | None
    was_examined: bool
    differs: bool
    seconds: float | None
    outside: str | None


def score_answer(
    label: Mapping[str, Any],
    answer: Answer | None,
    classes: Sequence[Sequence[str]],
    of_machine: Sequence[str],
    seconds: float | None = None,
    examination: Mapping[str, Any] | None = None,
) -> CaseScore:
    """Return the score of `answer`; `None` is a missing answer.

    Args:
        label: The truth, as `dataset.make_label` has it.
        answer: The answer.
        classes: Effects that recordings of commands and positions cannot tell apart.
        of_machine: Effects that all joints have together; nobody is asked for their joints.
        seconds: Time it took.
        examination: The examiner's own figures; see `examiner.Examination`.
    """
    kind = label["kind"]
    true = {one["effect"]: one for one in label["effects"]} if kind not in QUIET_KINDS else {}
    chosen = (
        sorted(answer.selected, key=lambda one: -one.probability)
        if answer and answer.verdict == "effects"
        else []
    )
    pairs = _match_effects(list(true), chosen, classes)
    stands_for = {id(one): effect for effect, one in pairs}
    verdict = answer.verdict if answer else "failed"
    top = chosen[0] if chosen else None
    unknown = _get_probability(answer, "unknown")
    claims = [Claim(one.probability, id(one) in stands_for) for one in chosen]
    # a verdict without names is a statement too, and a quiet kind makes "none" true
    if verdict in ("none", "unknown"):
        claims.append(
            Claim(
                _get_probability(answer, verdict),
                kind in QUIET_KINDS if verdict == "none" else kind == "outside",
            )
        )
    outside = label["outside"]
    sizes = [one["size"] for one in label["effects"]] + ([outside["size"]] if outside else [])
    joints_right: list[bool] = []
    numbers: list[ParameterScore] = []
    for effect, one in pairs:
        if effect not in of_machine:
            joints_right.append(set(one.joints) == set(true[effect]["joints"]))
        # parameters of another effect of the class are other quantities
        if effect == one.effect:
            numbers.extend(_score_parameters(true[effect], one))
    gap = answer.gap if answer else None
    return CaseScore(
        case=label["case"],
        kind=kind,
        truth=tuple(true),
        named=tuple(one.effect for one in chosen),
        hits=tuple((effect, one.effect) for effect, one in pairs),
        verdict=verdict,
        first=top is not None and id(top) in stands_for,
        first_strictly=top is not None and top.effect in true,
        joints_right=tuple(joints_right),
        unknown=unknown,
        claims=tuple(claims),
        numbers=tuple(numbers),
        size=max(sizes, default=0.0),
        moved_rad=max(label["moved_rad"].values()),
        closed=gap.closed.mean if gap and gap.closed else None,
        examined=examination["closed"] if examination else None,
        was_examined=examination is not None,
        differs=bool(examination and examination["differs"]),
        seconds=seconds,
        outside=outside["ailment"] if outside else None,
    )


def _match_effects(
    true: Sequence[str], chosen: Sequence[Selected], classes: Sequence[Sequence[str]]
) -> list[tuple[str, Selected]]:
    """Return each true effect with the name that stands for it; equal names go first."""
    found, left = [], list(chosen)
    for stands in (_is_same, lambda effect, one: _is_equivalent(effect, one, classes)):
        for effect in true:
            match = next(filter(partial(stands, effect), left), None)
            if match is not None and effect not in dict(found):
                found.append((effect, match))
                left.remove(match)
    return found


def _is_same(effect: str, one: Selected) -> bool:
    return one.effect == effect


def _is_equivalent(effect: str, one: Selected, classes: Sequence[Sequence[str]]) -> bool:
    if effect in one.same_as:
        return True
    return any({effect, one.effect} <= set(group) for group in classes)


def _get_probability(answer: Answer | None, name: str) -> float:
    """Return the probability of `none` or `unknown`; where it is not ranked, 1 or 0 by the verdict."""
    if answer is None:
        return 0.0
    ranked = [one.probability for one in answer.ranking if one.effect == name]
    return ranked[0] if ranked else float(answer.verdict == name)


def _score_parameters(true: Mapping[str, Any], one: Selected) -> list[ParameterScore]:
    """Return the marks of all parameters of an effect on the joints that have it and are named."""
    found = []
    for name, by_joint in true["parameters"].items():
        said = one.parameters.get(name, {})
        values = dict(by_joint)
        if "machine" in said:  # a number that joints do not have
            values = {"machine": next(iter(by_joint.values()))}
        elif (
            len(set(values.values())) == 1
            and len(set(said.values())) == 1
            and set(said) >= set(values)
        ):
            values = dict(list(values.items())[:1])  # one that they share counts once
        for joint, value in values.items():
            if joint not in said:
                continue
            estimate, nothing = said[joint], true["nothing"][name]
            size, (low, high) = max(abs(value - nothing), 1e-9), estimate.ci95
            short = estimate.mean + CI90_OVER_CI95 * (low - estimate.mean)
            long = estimate.mean + CI90_OVER_CI95 * (high - estimate.mean)
            number = ParameterScore(
                effect=one.effect,
                parameter=name,
                error=abs(estimate.mean - value) / size,
                deviation=(high - low) / CI95_OVER_SIGMA / size,
                said=abs(estimate.mean - nothing) / size,
                in_95=low <= value <= high,
                in_90=short <= value <= long,
            )
            found.append(number)
    return found
