"""The decision: which effects are named, none, or unknown.

The best effect is simulated, and the table made again beside it; further ones are named while they
earn enough there. The cause is unknown where a row outside the library or a flexible column explains
much more than the effects. `benchmarks/diagnosis/thresholds.py` compares the constants.
Axes: `J` joints, `P` numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from diagnosis.engine.direct import find_lattice
from diagnosis.engine.evidence import FieldJoint, JointRow, RowEvidence
from diagnosis.engine.generic import GenericCauses
from diagnosis.engine.holds import HeldCourse, find_hold, hold_commands
from diagnosis.engine.rows import SHARED, Row
from diagnosis.engine.side import Side

LEAST_NATS = 18.0
"""An effect that earns less is not named. 14 to 20 decide alike."""
JOINT_NATS = 6.0
"""Cost of each joint of an effect; for its size and its form."""
LOAD_NATS = 12.0
"""Further cost of a dependence on load: pose explains nearly the same."""
SHARE = 0.3
"""Least share of the first that a further effect earns where they have a joint in common: a first one is never quite of
the right form. 0.25 to 0.4 decide alike."""
SHOWN_NATS = 1e3
"""A coarse sensor or a late clock shows by itself and comes before all that is simulated."""
OUTSIDE_NATS = 45.0
"""The cause is unknown where a row outside the library earns so much more than the library."""
GENERIC_NATS = 30.0
"""The same for flexible columns, which pay for their number."""
COMMON = ("thermal_drift", "dead_time")
"""Effects that have one size on all joints, or one on each."""


@dataclass(frozen=True)
class EffectFinding:
    """An effect with what it earns.

    Attributes:
        effect: Its name.
        joints: Places of its joints.
        nats: Gain less all prices.
        rows: Its row on each of them; empty for held commands and direct findings.
        hold: The course of held commands.
        elsewhere: What an effect of the whole machine earns on other joints than its strongest one, nats.
    """

    effect: str
    joints: tuple[int, ...]
    nats: float
    rows: Mapping[int, Row] = field(default_factory=dict)
    hold: HeldCourse | None = None
    elsewhere: float = np.inf

    @property
    def name(self) -> str:
        """Name in the registry."""
        return self.effect.removesuffix("_all")


@dataclass(frozen=True)
class EvidenceTable:
    """Gains of all effects and rows on the field, beside the effects that are there already.

    Attributes:
        found: Effects and rows outside the library, the best first.
        owned: What the best effects of all joints earn together, nats.
        outside: Names of the rows outside the library.
    """

    found: tuple[EffectFinding, ...]
    owned: float
    outside: frozenset[str]

    def list_found(self, outside: bool = False) -> list[EffectFinding]:
        """Return the effects of the library, or the rows outside of it; one of the whole machine shows on several joints."""
        shown = [one for one in self.found if one.elsewhere >= LEAST_NATS]
        return [one for one in shown if (one.effect in self.outside) == outside]


@dataclass(frozen=True)
class Decision:
    """Verdict of the engine and its reasons.

    Attributes:
        verdict: `effects`, `none` or `unknown`.
        named: The named effects, the best first.
        table: What everything earns before any effect is simulated.
        generic: Best group of flexible columns, and what it earns, nats.
    """

    verdict: Literal["effects", "none", "unknown"]
    named: tuple[EffectFinding, ...]
    table: EvidenceTable
    generic: tuple[str, float]

    @property
    def outside(self) -> EffectFinding | None:
        """Best row outside the library."""
        return next(iter(self.table.list_found(outside=True)), None)


class Decider:
    """The decision on one case.

    Args:
        reference: The machine as it was.
        field: The machine as it is.
        noises: Standard deviation of the noise that sensors of the field add, `(J,)`, units.
        clock_late_s: By how much the field's positions are known to be late.
    """

    def __init__(
        self,
        reference: Side,
        field: Side,
        noises: np.ndarray | None = None,
        clock_late_s: float = 0.0,
    ) -> None:
        self.clock_late_s = clock_late_s
        self.evidence = RowEvidence(reference, field)
        if noises is not None:
            self.evidence.noises = noises
        self.generic = GenericCauses(self.evidence)
        self.outside = frozenset(row.effect for row in self.evidence.outside)

    def decide(self) -> Decision:
        """Return the decision."""
        coarse = self._find_coarse()
        known = []
        if self.clock_late_s:
            known.append(self._describe_clock())
        if coarse:
            known.append(EffectFinding("quantisation", tuple(coarse), SHOWN_NATS))
        table = self.weigh(known)
        generic = self._weigh_generic(known)
        if is_unknown(table, generic[1], is_coarse=bool(coarse)):
            return Decision("unknown", (), table, generic)
        named = [*known, *select(table, lambda found: self.weigh([*known, *found]), known)]
        return Decision("effects" if named else "none", tuple(named), table, generic)

    def weigh(self, there: Sequence[EffectFinding]) -> EvidenceTable:
        """Return what everything earns beside effects that are there already."""
        evidence = self.evidence
        joints = self._view(there)
        table = evidence.weigh_rows(joints)
        owners = find_owners(table, self.outside)
        found = []
        for effect, rows in table.items():
            if effect not in self.outside and effect not in SHARED:
                rows = {j: row for j, row in rows.items() if owners.get(j, ("",))[0] == effect}
            found.append(_add_up(effect, rows))
        for effect in COMMON:
            if effect in table:
                found.append(_add_up(f"{effect}_all", evidence.weigh_common(effect, joints)))
        held = self._find_held(joints) if joints[0].side is evidence.field else None
        if held is not None:
            found.append(held)
        found.sort(key=lambda one: -one.nats)
        return EvidenceTable(tuple(found), sum(nats for _, nats in owners.values()), self.outside)

    def _view(self, there: Sequence[EffectFinding]) -> list[FieldJoint]:
        """Return the joints of the field with effects."""
        numbers = [base.numbers for base in self.evidence.bases]
        return self.evidence.view_field(*apply_findings(there, numbers, self.evidence.field))

    def _describe_clock(self) -> EffectFinding:
        """Return the clock that is late; it is simulated as a dead time of all joints."""
        row = Row("dead_time", (("delay_s", "add", self.clock_late_s),))
        joints = range(self.evidence.field.num_joints)
        return EffectFinding("dead_time", tuple(joints), SHOWN_NATS, dict.fromkeys(joints, row))

    def _find_held(self, joints: Sequence[FieldJoint]) -> EffectFinding | None:
        """Return the likelier of lost frames and jitter with what it earns."""
        hold = find_hold(joints, self.evidence.bases)
        if hold is None:
            return None
        every = tuple(range(len(joints)))
        nats, elsewhere = add_up_common(hold.gains, hold.prior - JOINT_NATS)
        return EffectFinding(hold.course.effect, every, nats, {}, hold, elsewhere)

    def _find_coarse(self) -> list[int]:
        """Return the joints with a coarse sensor on the field; their steps enter the scale."""
        found, evidence = [], self.evidence
        for j in np.flatnonzero(evidence.noises == 0.0).tolist():
            evidence.steps[j] = find_lattice(evidence.field, evidence.reference, j)
            if evidence.steps[j]:
                found.append(j)
        return found

    def _weigh_generic(self, there: Sequence[EffectFinding]) -> tuple[str, float]:
        """Return the group that earns most on all joints, and what it earns, nats."""
        total: dict[str, float] = {}
        for joint in self._view(there):
            for name, nats in self.generic.weigh(joint).items():
                total[name] = total.get(name, 0.0) + max(nats - JOINT_NATS, 0.0)
        return max(total.items(), key=lambda group: group[1], default=("", 0.0))


def find_owners(
    table: Mapping[str, Mapping[int, JointRow]], outside: frozenset[str]
) -> dict[int, tuple[str, float]]:
    """Return the effect of the library that earns most on each joint, and how much, nats; none where none pays.

    A joint counts for its own effect alone. Of 65 changed joints of opened cases that earn 16 nats or more, the
    true effect is the best one on 64, dependence on load aside.
    """
    best: dict[int, tuple[str, float]] = {}
    for effect, rows in table.items():
        if effect in SHARED or effect in outside:
            continue
        for j, row in rows.items():
            net = row.gain - row.price - JOINT_NATS
            if net > best.get(j, ("", 0.0))[1]:
                best[j] = (effect, net)
    return best


def is_unknown(table: EvidenceTable, generic_nats: float, is_coarse: bool) -> bool:
    """Return whether something outside the library explains the field much better than the library.

    The library explains what its best effect earns, or the best ones of all joints together.

    Args:
        table: What everything earns before any effect is simulated.
        generic_nats: Gain of the best group of flexible columns.
        is_coarse: A sensor of the field is coarse; its steps look like any cause.
    """
    best = max([one.nats for one in table.list_found()], default=0.0)
    odd = max([one.nats for one in table.list_found(outside=True)], default=0.0)
    explained = max(best, table.owned, 0.0)
    is_odd = odd > explained + OUTSIDE_NATS or generic_nats > explained + GENERIC_NATS
    return is_odd and not is_coarse


def select(
    table: EvidenceTable,
    weigh: Callable[[Sequence[EffectFinding]], EvidenceTable],
    known: Sequence[EffectFinding] = (),
) -> list[EffectFinding]:
    """Return the effects that are named, the best first; each earns enough beside those before it.

    Args:
        table: What everything earns before any effect is simulated.
        weigh: Returns what everything earns beside effects.
        known: Effects that show by themselves. A dead time beside a late clock is not told: an unchanged joint of
            a practice machine earned 57 nats for one.
    """
    found: list[EffectFinding] = []
    names = {one.name for one in known}
    further = table.list_found()
    while further and further[0].name not in names and is_enough(further[0], found):
        found.append(further[0])
        own = {one.name for one in found}
        further = [one for one in weigh(found).list_found() if one.name not in own]
    return found


def is_enough(one: EffectFinding, before: Sequence[EffectFinding]) -> bool:
    """Return whether an effect earns enough beside those `before` it."""
    if before and set(before[0].joints) & set(one.joints) and one.nats < SHARE * before[0].nats:
        return False
    return one.nats >= LEAST_NATS


def apply_findings(
    findings: Sequence[EffectFinding], numbers: Sequence[np.ndarray], side: Side
) -> tuple[list[np.ndarray], Side]:
    """Return the numbers `(P,)` of all joints of a side, and the side, with effects."""
    changed = list(numbers)
    for one in findings:
        for j, row in one.rows.items():
            changed[j] = side.model.change(changed[j], [row])[0]
        if one.hold is not None:
            side = hold_commands(side, one.hold.delays)
    return changed, side


def add_up_common(gains: Sequence[float], rest: float) -> tuple[float, float]:
    """Return what an effect of the whole machine earns, nats, and the part of it that other joints than the strongest show.

    A common cause fits whatever one joint leaves: of 155 practice cases 44 have one of 18 nats or more of which the
    other joints show less, and on one of these it is there. A machine with one joint shows no more than that one.

    Args:
        gains: What it earns on each joint, nats.
        rest: What belongs to none of them, prior and costs; the joints bear it in proportion to their gains.
    """
    gained = sum(gains)
    others = gained - max(gains) if len(gains) > 1 else gained
    total = gained + rest
    return total, total * others / gained if gained > 0.0 else total


def _add_up(effect: str, rows: Mapping[int, JointRow]) -> EffectFinding:
    """Return an effect with the joints that it pays on."""
    if effect in SHARED or effect.endswith("_all"):
        gains = [row.gain - row.price for row in rows.values()]
        nats, elsewhere = add_up_common(gains, -JOINT_NATS)
        own = {j: row.row for j, row in rows.items()}
        return EffectFinding(effect, tuple(rows), nats, own, elsewhere=elsewhere)
    nets = {}
    for j, row in rows.items():
        net = row.gain - row.price - JOINT_NATS
        if net > 0.0:
            nets[j] = net
    total = sum(nets.values())
    if effect == "load_dependence":
        total -= LOAD_NATS
    return EffectFinding(effect, tuple(nets), total, {j: rows[j].row for j in nets})
