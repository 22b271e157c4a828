"""The decision: which effects are named, none, or unknown.

The best effect is simulated, and the table made again beside it; further ones are named while they
earn enough there. The cause is unknown where a row outside the library or a flexible column explains
much more than the effects. `benchmarks/diagnosis/ablations.py` compares the constants.
Axes: `J` joints, `P` numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from diagnosis.engine.direct import find_lattice
from diagnosis.engine.evidence import JOINT_NATS, LOSS_LIMIT, FieldJoint, JointRow, RowEvidence
from diagnosis.engine.generic import GenericCauses
from diagnosis.engine.holds import HeldCourse, find_hold, hold_commands
from diagnosis.engine.rows import SHARED, Row
from diagnosis.engine.side import Side

LEAST_NATS = 32.0
"""Least gain of an effect, a further one or a cause outside the library, beyond what is explained without it.

Of 107 practice cases of three makes, whose causes act on the motion, the first step names 30 of 37 single effects. It calls
18 of 25 outside causes unknown, gives none of them a name, and accuses one of 30 unchanged or faint machines. With 40 nats, and
6 for a joint, these are 27, 17, one and one; with 32 and 6 they are 29, 17, three and two.
"""
DIRECT_NATS = 24.0
"""The same for what tool points or the scatter of samples show."""
NUMBER_NATS = 6.0
"""Cost of a number that tool points, the scatter of samples or a simulator show."""
RIVAL_SHARE = 0.25
"""Least gain of a further effect on a joint, over the largest of those before it there.

On 68 practice machines with several effects each, 25 sets are exact; with 0, 0.12, 0.5 and 1 these are 23, 23, 24 and 23.
With 0 a name is added on 13 of them.
"""
SHOWN_NATS = 1e3
"""A coarse sensor or a late clock shows by itself and comes before all that is simulated."""


@dataclass(frozen=True)
class EffectFinding:
    """An effect with what it earns.

    Attributes:
        effect: Its name.
        nets: What it earns on each of its joints, by their places: gain less all costs, nats.
        rows: Its row on each of them; empty for held commands and direct findings.
        hold: The course of held commands.
        is_common: It has one cause for the whole machine, so that no joint has it alone.
        is_outside: It is no effect of the library.
    """

    effect: str
    nets: Mapping[int, float]
    rows: Mapping[int, Row] = field(default_factory=dict)
    hold: HeldCourse | None = None
    is_common: bool = False
    is_outside: bool = False

    @property
    def name(self) -> str:
        """Name in the registry."""
        return self.effect.removesuffix("_all")

    @property
    def joints(self) -> tuple[int, ...]:
        """Places of its joints."""
        return tuple(self.nets)

    @property
    def nats(self) -> float:
        """Gain on all of its joints less all costs, nats."""
        return sum(self.nets.values())

    @property
    def shows_on_several(self) -> bool:
        """True if other joints than the strongest show a common effect, by as much as any effect has to earn.

        A common effect fits whatever one joint leaves: of 155 practice cases 44 have one of 18 nats or more of which
        the other joints show less, and on one of these it is there. A machine with one joint shows no more than it.
        """
        nets = self.nets.values()
        if not self.is_common or len(nets) < 2:
            return True
        return self.nats - max(nets) >= LEAST_NATS

    def limit(self, before: Sequence[EffectFinding]) -> EffectFinding:
        """Return it with the joints where it counts beside those `before` it; a common one keeps all, at nothing.

        A row is never quite of the right form, and what it leaves looks like other effects.
        """
        nets = {}
        for j, net in self.nets.items():
            strongest = max([one.nets.get(j, 0.0) for one in before], default=0.0)
            if net >= RIVAL_SHARE * strongest:
                nets[j] = net
            elif self.is_common:
                nets[j] = 0.0
        rows = {j: row for j, row in self.rows.items() if j in nets}
        return replace(self, nets=nets, rows=rows)


@dataclass(frozen=True)
class EvidenceTable:
    """Gains of all effects and rows on the field, beside the effects that are there already.

    Attributes:
        found: Effects and rows outside the library, the best first.
    """

    found: tuple[EffectFinding, ...]

    @property
    def owned(self) -> float:
        """Gain of the best effects of all joints together, nats."""
        return sum(one.nats for one in self.found if not (one.is_common or one.is_outside))

    def list_found(self, is_outside: bool = False) -> list[EffectFinding]:
        """Return the effects of the library, or the rows outside of it; common ones that several joints show."""
        return [one for one in self.found if one.shows_on_several and one.is_outside == is_outside]


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


class Decider:
    """The decision on one case.

    Args:
        reference: The machine as it was.
        field: The machine as it is.
        noises: Standard deviation of the noise that sensors of the field add, `(J,)`, units.
        clock_late_s: By how much the field's positions are known to be late.

    Attributes:
        recorded: The field as it was recorded, where errors of its encoders are corrected in `field`.
    """

    def __init__(
        self, reference: Side, field: Side, noises: np.ndarray, clock_late_s: float = 0.0
    ) -> None:
        self.clock_late_s = clock_late_s
        self.recorded = field
        self.evidence = RowEvidence(reference, field)
        self.evidence.noises = noises
        self.generic = GenericCauses(self.evidence)
        self.outside = frozenset(row.effect for row in reference.model.outside_rows)

    def decide(self) -> Decision:
        """Return the decision."""
        coarse = self._find_coarse()
        known = [self._describe_clock()] if self.clock_late_s else []
        if coarse:
            known.append(EffectFinding("quantisation", dict.fromkeys(coarse, SHOWN_NATS)))
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
            is_outside = effect in self.outside
            if not is_outside and effect not in SHARED:
                rows = {j: row for j, row in rows.items() if owners.get(j) == effect}
            found.append(add_up(effect, rows, is_outside))
        # A dead time has one size on each joint, or one on all.
        found.append(add_up("dead_time_all", evidence.weigh_common("dead_time", joints)))
        held = self._find_held(joints) if joints[0].side is evidence.field else None
        late = max([one.nats for one in found if one.name == "dead_time"], default=0.0)
        if held is not None and held.nats >= late + LEAST_NATS:
            found.append(held)
        return EvidenceTable(tuple(sorted(found, key=lambda one: -one.nats)))

    def _view(self, there: Sequence[EffectFinding]) -> list[FieldJoint]:
        """Return the joints of the field with effects."""
        numbers = [base.numbers for base in self.evidence.bases]
        return self.evidence.view_field(*apply_findings(there, numbers, self.evidence.field))

    def _describe_clock(self) -> EffectFinding:
        """Return the clock that is late; it is simulated as a dead time of all joints."""
        row = Row("dead_time", (("delay_s", "add", self.clock_late_s),))
        joints = range(self.evidence.field.num_joints)
        nets = dict.fromkeys(joints, SHOWN_NATS)
        return EffectFinding("dead_time", nets, dict.fromkeys(joints, row), is_common=True)

    def _find_held(self, joints: Sequence[FieldJoint]) -> EffectFinding | None:
        """Return the likelier of lost frames and jitter with what it earns.

        Commands that are all late alike are held, too: it counts where it earns enough beyond a dead time. True ones of
        18 opened and practice machines earn 67 nats and more beyond it, a late clock of a real excavator 3.
        """
        hold = find_hold(joints, self.evidence.bases)
        if hold is None:
            return None
        nets = dict(enumerate(share_cost(hold.gains, JOINT_NATS + hold.cost)))
        return EffectFinding(hold.law.effect, nets, hold=hold, is_common=True)

    def _find_coarse(self) -> list[int]:
        """Return the joints with a coarse sensor on the field; their steps enter the scale."""
        evidence = self.evidence
        for j in np.flatnonzero(evidence.noises == 0.0).tolist():
            # The correction of a scale changes the step, too, of a sensor that is as fine as before.
            if find_lattice(self.recorded, evidence.reference, j):
                evidence.steps[j] = find_lattice(evidence.field, evidence.reference, j)
        return np.flatnonzero(evidence.steps).tolist()

    def _weigh_generic(self, there: Sequence[EffectFinding]) -> tuple[str, float]:
        """Return the group that earns most on all joints, and what it earns, nats."""
        total: dict[str, float] = {}
        for joint in self._view(there):
            for name, nats in self.generic.weigh(joint).items():
                total[name] = total.get(name, 0.0) + max(nats - JOINT_NATS, 0.0)
        return max(total.items(), key=lambda group: group[1], default=("", 0.0))


def find_owners(
    table: Mapping[str, Mapping[int, JointRow]], outside: frozenset[str]
) -> dict[int, str]:
    """Return the effect of the library that earns most on each joint; none where none pays.

    A joint counts for its own effect alone. Of 106 changed joints of 280 practice machines that earn 16 nats or more
    the true effect is the best one on 96; four of the others have stiction, which a dead band explains better.
    """
    best: dict[int, tuple[float, str]] = {}
    for effect, rows in table.items():
        if effect in SHARED or effect in outside:
            continue
        for j, row in rows.items():
            net = row.gain - JOINT_NATS
            if net > 0.0:
                best[j] = max(best.get(j, (0.0, "")), (net, effect))
    return {j: effect for j, (_, effect) in best.items()}


def is_unknown(table: EvidenceTable, generic_nats: float, is_coarse: bool) -> bool:
    """Return whether something outside the library explains the field much better than the library.

    The library explains what its best effect earns, or the best ones of all joints together.

    Args:
        table: What everything earns before any effect is simulated.
        generic_nats: Gain of the best group of flexible columns.
        is_coarse: A sensor of the field is coarse; its steps look like any cause.
    """
    best = max([one.nats for one in table.list_found()], default=0.0)
    odd = max([one.nats for one in table.list_found(is_outside=True)], default=0.0)
    explained = max(best, table.owned, 0.0)
    return max(odd, generic_nats) > explained + LEAST_NATS and not is_coarse


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
    while further and further[0].name not in names and further[0].nats >= LEAST_NATS:
        found.append(further[0])
        own = {one.name for one in found}
        others = [one.limit(found) for one in weigh(found).found if one.name not in own]
        further = EvidenceTable(tuple(sorted(others, key=lambda one: -one.nats))).list_found()
    return found


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


def share_cost(gains: Sequence[float], cost: float) -> list[float]:
    """Return what is left of gains when they bear a cost in proportion; none where they are less than it.

    Args:
        gains: What an effect earns on each joint, nats.
        cost: What belongs to none of them alone, nats.
    """
    gained = sum(gains)
    left = 1.0 - cost / gained if gained > cost else 0.0
    return [left * gain for gain in gains]


def add_up(effect: str, rows: Mapping[int, JointRow], is_outside: bool = False) -> EffectFinding:
    """Return an effect with the joints that it pays on."""
    gains = {j: row.gain for j, row in rows.items()}
    is_common = effect in SHARED or effect.endswith("_all")
    if is_common:
        nets = dict(zip(gains, share_cost([*gains.values()], JOINT_NATS), strict=True))
    else:
        nets = {j: gain - JOINT_NATS for j, gain in gains.items() if gain > JOINT_NATS}
    own = {j: rows[j].row for j in nets if gains[j] > LOSS_LIMIT}
    return EffectFinding(effect, nets, own, is_common=is_common, is_outside=is_outside)
