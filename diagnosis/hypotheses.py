"""Hypotheses about the cause of a gap, weighed against each other: none, unknown, and each effect.

The search asks which set of effects pays its penalties. That says little about the odds between two
names, since forms of effects differ from machine to machine, and a likelihood is too sure of itself.
A conditional logit (McFadden 1974), learned from development cases, turns signs that mean the same on
any machine into probabilities that add up to 1. The search still says which further effects there are.
Axes: `H` hypotheses, `J` joints.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from diagnosis import calibration, decision
from diagnosis.answer import Ranked, Selected, Verdict
from diagnosis.calibration import LITTLE_NATS, MUCH_NATS
from diagnosis.detection import DetectionResult
from diagnosis.gap import GapClosure
from diagnosis.refine import compute_gain, fit_set
from diagnosis.request import Penalties, ProbabilityModel
from diagnosis.search import MIN_SIZE, EffectSet, Subset

# Chosen by hand; not searched.
LEAST_GAIN = 2.0
"""Gain beyond that on the reference from which an effect is taken to act on a joint, nats."""
LEAST_TOTAL = 3.0
"""Gain on all joints below which an effect is no hypothesis, nats."""
SAME_ODDS = 0.4
"""Odds against the likeliest effect from which recordings cannot tell another one from it: 2.5 to 1."""
MAX_SAME = 3
"""Most names that are given as equivalent."""
SET_RATIO = 1.5
"""Gain of a set over that of the likeliest effect alone from which the set is told, where it does not hold
that effect."""
MIN_NAMED = 0.5
"""Probability from which an effect that sensors, frames or tool points show is named."""
MAX_LISTED = 8
"""Longest ranking."""


@dataclass(frozen=True)
class Hypothesis:
    """A possible cause.

    Attributes:
        name: Of the effect, or `none` or `unknown`.
        joints: Joints that show the effect.
        signs: By name; see `ProbabilityModel`.
    """

    name: str
    joints: tuple[int, ...]
    signs: Mapping[str, float]

    @property
    def verdict(self) -> Verdict:
        """The verdict that it leads to."""
        return self.name if self.name in ("none", "unknown") else "effects"  # pyright: ignore[reportReturnType]


def list_hypotheses(
    result: DetectionResult, known: GapClosure, penalties: Penalties, shared: Subset
) -> list[Hypothesis]:
    """Return the effects that the recordings may show, the one with the largest gain first, `none` and `unknown`.

    Args:
        result: The findings, with the effects scored alone.
        known: Errors of the simulator as it was.
        penalties: Penalties of effects.
        shared: Effects with one cause for all joints.
    """
    gains: dict[str, float] = {}
    found: dict[str, Hypothesis] = {}
    for name in sorted({name for table in result.alone for name in table.shapes}):
        rows = []
        for j, table in enumerate(result.alone):
            if name in table.shapes:
                row = _read_joint(result, penalties, j, name, shared)
                if name in shared or (row.beyond > LEAST_GAIN and row.size > MIN_SIZE):
                    rows.append(row)
        gain = sum(row.gain for row in rows)
        if not rows or gain < LEAST_TOTAL:
            continue
        signs = {
            "gain": _compress(gain),
            "reference": _compress(sum(row.reference for row in rows)),
            "joints": float(sum(row.gain > LEAST_GAIN for row in rows)),
            "size": float(np.log(max(row.size for row in rows))),
            "shared": float(name in shared),
        }
        gains[name] = gain
        found[name] = Hypothesis(name, tuple(row.joint for row in rows), signs)
    ordered = [found[name] for name in sorted(gains, key=lambda name: -gains[name])]
    return [*ordered, *_list_others(result, known, max(gains.values(), default=0.0))]


@dataclass(frozen=True)
class _JointRow:
    """Evidence of a joint for an effect: gain, gain on the reference, gain beyond its price there, size."""

    joint: int
    gain: float
    reference: float
    beyond: float
    size: float


def _read_joint(
    result: DetectionResult, penalties: Penalties, j: int, name: str, shared: Subset
) -> _JointRow:
    subset = frozenset({name})
    scored = result.alone[j].score(subset)
    price = 0.0
    if scored.total > penalties.joint:  # else it is not tried on the reference
        price = result.price(j, subset) - penalties.joint * (name not in shared)
    reference = price / max(penalties.reference, 1e-9)
    size = float(np.abs(scored.sizes[name]).max())
    return _JointRow(j, scored.total, reference, scored.total - price, max(size, 1e-3))


def _list_others(result: DetectionResult, known: GapClosure, most: float) -> list[Hypothesis]:
    """Return `none` and `unknown`: signs of the gap, of the best effect, and of what the search left unexplained."""
    squares = known.joint_squares(known.base.field.residuals.base)[0]
    floor = squares if known.joint_floor is None else known.joint_floor[0]
    ratio = np.sqrt(squares / np.maximum(floor, 1e-18))
    signs = {
        **calibration.collect_outside_signs(result),
        "error": float(np.log(np.sqrt(squares.sum() / max(floor.sum(), 1e-18)))),
        "worst": float(np.log(ratio.max())),
        "gain": _compress(most),
    }
    return [Hypothesis(name, (), signs) for name in ("none", "unknown")]


def _compress(nats: float) -> float:
    return float(np.arcsinh(nats / LITTLE_NATS))


@dataclass(frozen=True)
class Choice:
    """Hypotheses with their probabilities, and the verdict.

    Attributes:
        known: The hypotheses.
        odds: Their probabilities, `(H,)`.
        verdict: The verdict.
        best: The likeliest effect; `None` without any.
    """

    known: Sequence[Hypothesis]
    odds: np.ndarray
    verdict: Verdict
    best: Hypothesis | None

    def probability(self, *names: str) -> float:
        """Return the probability of one of some effects, or of a verdict without effects."""
        pairs = zip(self.known, self.odds, strict=True)
        return float(sum(p for one, p in pairs if one.name in names))

    def list_equivalents(self) -> tuple[str, ...]:
        """Return the effects that are nearly as likely as the best one."""
        if self.best is None:
            return ()
        least = SAME_ODDS * self.probability(self.best.name)
        others = [one.name for one in self.known if one.verdict == "effects"]
        near = [name for name in others if name != self.best.name]
        found = [name for name in near if self.probability(name) > least]
        return tuple(sorted(found, key=lambda name: -self.probability(name))[:MAX_SAME])

    def list_class(self) -> tuple[str, ...]:
        """Return the best effect and those that are nearly as likely; empty without any."""
        return (self.best.name, *self.list_equivalents()) if self.best else ()

    def rank(self, selected: Sequence[Selected], joint_names: Sequence[str]) -> list[Ranked]:
        """Return effects, `none` and `unknown`, the most probable first; those `selected` as they are told."""
        told = {one.effect: Ranked(one.effect, one.joints, one.probability) for one in selected}
        most = 1.0 - max([one.probability for one in selected], default=0.0)
        for one in self.known:
            least = most if one.verdict != "effects" else 1.0
            joints = tuple(joint_names[j] for j in one.joints)
            row = Ranked(one.name, joints, min(self.probability(one.name), least))
            told.setdefault(one.name, row)
        return sorted(told.values(), key=lambda row: -row.probability)[:MAX_LISTED]


def choose_hypothesis(known: Sequence[Hypothesis], weights: ProbabilityModel) -> Choice:
    """Return the probabilities and the verdict: the likeliest of some effect, none and unknown, by their stakes."""
    scores = []
    for one in known:
        own = weights.choice[one.verdict]
        scores.append(sum(own[name] * value for name, value in one.signs.items()))
    odds = np.exp(np.array(scores) - max(scores))
    odds = odds / odds.sum()
    mass: dict[Verdict, float] = {"effects": 0.0, "none": 0.0, "unknown": 0.0}
    for one, p in zip(known, odds, strict=True):
        mass[one.verdict] += float(p) * weights.choice["stakes"][one.verdict]
    sets = [k for k, one in enumerate(known) if one.verdict == "effects"]
    best = known[max(sets, key=lambda k: odds[k])] if sets else None
    return Choice(known, odds, max(mass, key=mass.__getitem__), best)


def apply_choice(
    result: DetectionResult, choice: Choice, penalties: Penalties, weights: ProbabilityModel
) -> DetectionResult:
    """Return the findings with the chosen effect, and with further ones of the search that are probable beside it.

    Detected effects stay where they are probable, and beside an unknown cause where they are sure.
    """
    least = decision.MIN_CERTAIN if choice.verdict == "unknown" else MIN_NAMED
    detected = []
    for one in result.detected:
        signs = decision.read_detected_signs(result, weights, one)
        if calibration.compute_probability(weights.right, signs) >= least:
            detected.append(one)
    searched = decision.drop_unlikely_effects(result, penalties, weights)
    late = any(one.kind.stage == "timing" for one in result.detected)
    if late and detected:
        return replace(searched, detected=detected)  # it was weighed beside late frames
    best = choice.best
    if choice.verdict != "effects" or best is None:
        empty = EffectSet((frozenset(),) * len(result.tables), 0.0)
        return replace(result, chosen=empty, fitted=None, detected=detected)
    alone = result.alone or result.tables
    gain = sum(alone[j].score(frozenset({best.name})).total for j in best.joints)
    names = searched.chosen.names
    # Of effects that cannot be told apart the search names the one that it has simulated.
    is_alike = bool(names) and names <= {*choice.list_equivalents()}
    if best.name in names or is_alike or _has_much_more_gain(searched, gain):
        return replace(searched, detected=detected)
    subsets = [frozenset[str]() for _ in alone]
    start: list[dict[str, np.ndarray]] = [{} for _ in alone]
    for j in best.joints:
        subsets[j] = frozenset({best.name})
        start[j] = dict(alone[j].score(subsets[j]).sizes)
    chosen, fitted, rays = EffectSet(tuple(subsets), gain), None, result.rays
    if result.alone_rays is not None:
        rays = result.alone_rays
        fitted = fit_set(result.residuals, subsets, rays, start)
    return replace(
        result, tables=list(alone), rays=rays, chosen=chosen, fitted=fitted, detected=detected
    )


def _has_much_more_gain(searched: DetectionResult, gain: float) -> bool:
    """Return whether a set of the search explains much more than `gain`: no effect alone explains a large gap."""
    if searched.fitted is None or len(searched.chosen.names) < 2:
        return False
    explained = compute_gain(searched.residuals.z, searched.fitted.z)
    return explained > max(SET_RATIO * gain, gain + MUCH_NATS)


def is_unknown(choice: Choice, result: DetectionResult) -> bool:
    """Return whether an unknown cause is told: nothing that was detected for sure stands beside it."""
    return choice.verdict == "unknown" and not result.detected
