"""The decision: which effects are named, none, or unknown.

The best effect is simulated, and the table made again beside it; further ones are named while they
earn enough there. The cause is unknown where a row outside the library or a flexible column explains
much more than the effects. The constants were chosen on 250 practice cases of three makes; leaving a
make out was not tried.
Axes: `J` joints, `P` numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from diagnosis.engine.direct import find_lattice
from diagnosis.engine.evidence import FieldJoint, JointRow, RowEvidence
from diagnosis.engine.generic import GenericCauses
from diagnosis.engine.holds import HeldCourse, find_hold, hold_commands
from diagnosis.engine.rows import SHARED, Row
from diagnosis.engine.side import Side

LEAST_NATS = 16.0
"""An effect that earns less is not named. On 36 unchanged machines of four makes the best one earns 11 at most, held
commands aside; on one of 15 more in sealed exams 18."""
JOINT_NATS = 6.0
"""Cost of each joint of an effect; for its size and its form."""
LOAD_NATS = 12.0
"""Further cost of a dependence on load: pose explains nearly the same."""
SECOND_SHARE = 0.03
"""Where either is one of the whole machine, a further effect earns so much of the first at least: a first one is never
quite of the right form."""
SAME_JOINT_SHARE = 0.5
"""Least share of the first where both share a joint."""
MAX_SIMULATED = 3
"""Most simulated effects that are named together: of four third ones on 60 practice cases with several effects three
were there. Without a bound a case whose frames jitter much was given six, of which one was there."""
HELD_NATS = 60.0
"""Least gain of held commands, which follow whatever is left."""
SHOWN_NATS = 1e3
"""A coarse sensor or a late clock shows by itself and comes before all that is simulated."""
OUTSIDE_NATS = 45.0
"""The cause is unknown where a row outside the library earns more than this, and `LEAST_NATS` more than the library."""
GENERIC_NATS = 30.0
"""The same for how much more flexible columns earn. Of 131 opened cases of three makes 11 of 21 with a cause outside the
library are told as unknown so, one of 71 with one effect, none of 21 with several and none of 19 unchanged ones. With 45
it is 10, and with 16 again 11 and one unchanged one."""

HELD = frozenset({"frame_loss", "delay_jitter"})
WHOLE = SHARED | HELD | {"thermal_all"}
"""Effects of the whole machine."""


@dataclass(frozen=True)
class EffectFinding:
    """An effect with what it earns.

    Attributes:
        effect: Its name.
        joints: Places of its joints.
        nats: Gain less all prices.
        rows: Its row on each of them; empty for held commands and direct findings.
        hold: The course of held commands.
    """

    effect: str
    joints: tuple[int, ...]
    nats: float
    rows: Mapping[int, Row] = field(default_factory=dict)
    hold: HeldCourse | None = None

    @property
    def name(self) -> str:
        """Name in the registry."""
        return "thermal_drift" if self.effect == "thermal_all" else self.effect


@dataclass(frozen=True)
class Decision:
    """Verdict of the engine and its reasons.

    Attributes:
        verdict: `effects`, `none` or `unknown`.
        named: The named effects, the best first.
        rivals: All effects in the first table, the best first.
        outside: Best row outside the library.
        generic: Best group of flexible columns, and what it earns, nats.
    """

    verdict: Literal["effects", "none", "unknown"]
    named: tuple[EffectFinding, ...]
    rivals: tuple[EffectFinding, ...]
    outside: EffectFinding | None
    generic: tuple[str, float]


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
        evidence = self.evidence
        coarse = self._find_coarse()
        healthy = [base.numbers for base in evidence.bases]
        joints = evidence.view_field(healthy)
        shown = []
        if self.clock_late_s:
            shown.append(self._describe_clock())
            joints = self._apply(healthy, shown[0])
        table = evidence.weigh_rows(joints)
        held = self._find_held(joints)
        rivals = self._list_findings(joints, table, held)
        outside = [one for one in rivals if one.effect in self.outside]
        library = [one for one in rivals if one.effect not in self.outside]
        groups = self._weigh_generic(joints)
        strongest = max(groups.items(), key=lambda group: group[1], default=("", 0.0))
        if coarse:
            shown.append(EffectFinding("quantisation", tuple(coarse), SHOWN_NATS))
        named = list(shown)
        best = library[0]
        # The steps of a coarse sensor look like any cause.
        odd = 0.0 if coarse else max([one.nats for one in outside], default=0.0)
        flexible = 0.0 if coarse else strongest[1]
        owned = sum(nats for _, nats in find_owners(table, self.outside).values())
        explained = max(best.nats, owned)
        verdict = judge_first(best, explained, odd, flexible)
        further = library if verdict == "effects" else []
        while further and len(named) < len(shown) + MAX_SIMULATED:
            one = further[0]
            # A dead time beside a late clock is not told: an unchanged joint of a practice machine
            # earned 57 nats for one.
            if one.name in [other.name for other in named]:
                break
            if one is not best and not self._is_further(best, one):
                break
            named.append(one)
            numbers = [joint.numbers for joint in joints]
            joints = self._apply(numbers, one, joints[0].side)
            table = evidence.weigh_rows(joints)
            can_hold = joints[0].side is evidence.field
            held = self._find_held(joints) if can_hold else None
            found = self._list_findings(joints, table, held)
            names = {other.name for other in named}
            known = [other for other in found if other.effect not in self.outside]
            further = [other for other in known if other.name not in names]
        if verdict == "unknown":
            named = []
        elif named:
            verdict = "effects"
        return Decision(
            verdict, tuple(named), tuple(library), outside[0] if outside else None, strongest
        )

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
        return EffectFinding(hold.course.effect, every, hold.gain - JOINT_NATS, {}, hold)

    def _find_coarse(self) -> list[int]:
        """Return the joints with a coarse sensor on the field; their steps enter the scale."""
        found, evidence = [], self.evidence
        for j in np.flatnonzero(evidence.noises == 0.0).tolist():
            evidence.steps[j] = find_lattice(evidence.field, evidence.reference, j)
            if evidence.steps[j]:
                found.append(j)
        return found

    def _list_findings(
        self,
        joints: Sequence[FieldJoint],
        table: Mapping[str, Mapping[int, JointRow]],
        held: EffectFinding | None,
    ) -> list[EffectFinding]:
        """Return all effects with what they earn, the best first."""
        owners = find_owners(table, self.outside)
        found = []
        for effect, rows in table.items():
            if effect not in self.outside and effect not in SHARED:
                rows = {j: row for j, row in rows.items() if owners.get(j, ("",))[0] == effect}
            found.append(_add_up(effect, rows))
        if "thermal_drift" in table:
            common = self.evidence.weigh_common("thermal_drift", joints)
            found.append(_add_up("thermal_all", common))
        if held is not None:
            found.append(held)
        return sorted(found, key=lambda one: -one.nats)

    def _apply(
        self, numbers: Sequence[np.ndarray], finding: EffectFinding, field: Side | None = None
    ) -> list[FieldJoint]:
        """Return the joints of the field with an effect."""
        side = self.evidence.field if field is None else field
        return self.evidence.view_field(*apply_findings([finding], numbers, side))

    def _is_further(self, first: EffectFinding, further: EffectFinding) -> bool:
        """Return whether a further effect earns enough beside the first."""
        needed = 0.0
        if first.effect in WHOLE or further.effect in WHOLE:
            needed = SECOND_SHARE * first.nats
        elif set(first.joints) & set(further.joints):
            needed = SAME_JOINT_SHARE * first.nats
        if further.effect in HELD:
            needed = max(needed, HELD_NATS)
        return further.nats >= max(needed, LEAST_NATS)

    def _weigh_generic(self, joints: Sequence[FieldJoint]) -> dict[str, float]:
        """Return what each group earns on all joints, nats."""
        total: dict[str, float] = {}
        for joint in joints:
            for name, nats in self.generic.weigh(joint).items():
                total[name] = total.get(name, 0.0) + max(nats - JOINT_NATS, 0.0)
        return total


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


def judge_first(
    best: EffectFinding, explained_nats: float, outside_nats: float, generic_nats: float
) -> Literal["effects", "none", "unknown"]:
    """Return whether the best effect is named, nothing is there, or the cause is unknown.

    Args:
        best: The best effect of the library.
        explained_nats: What the library explains: that effect, or the best one of each joint together.
        outside_nats: Gain of the best row outside the library.
        generic_nats: Gain of the best group of flexible columns.
    """
    most = max(explained_nats, 0.0)
    if outside_nats > max(most + LEAST_NATS, OUTSIDE_NATS) or generic_nats > most + GENERIC_NATS:
        return "unknown"
    needed = HELD_NATS if best.effect in HELD else LEAST_NATS
    return "effects" if best.nats >= needed else "none"


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


def _add_up(effect: str, rows: Mapping[int, JointRow]) -> EffectFinding:
    """Return an effect with the joints that it pays on."""
    if effect in SHARED or effect == "thermal_all":
        nats = sum(row.gain - row.price for row in rows.values()) - JOINT_NATS
        own = {j: row.row for j, row in rows.items()}
        return EffectFinding(effect, tuple(rows), nats, own)
    nets = {}
    for j, row in rows.items():
        net = row.gain - row.price - JOINT_NATS
        if net > 0.0:
            nets[j] = net
    total = sum(nets.values())
    if effect == "load_dependence":
        total -= LOAD_NATS
    return EffectFinding(effect, tuple(nets), total, {j: rows[j].row for j in nets})
