"""The table of evidence: how much each row earns on each joint of the field, less what it earns on the reference.

Axes: `C` rows, `J` joints, `N` increments, `P` numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from diagnosis.engine.baseline import JointBaseline, fit_reference, linearise
from diagnosis.engine.coverage import find_covered
from diagnosis.engine.descent import Prior, descend
from diagnosis.engine.measure import IncrementMeasure, measure_motion
from diagnosis.engine.nuisance import JointNuisance, compute_gain, count_part, estimate_nuisance
from diagnosis.engine.rows import SHARED, Row
from diagnosis.engine.side import Side

LOG_STEP = 0.03
"""Step of the finite difference of a size, as a logarithm."""
LOG_MOST = 1.0
"""Largest change of a size of the table, as a logarithm."""
REFINEMENTS = 4
"""Rounds of the search of sizes."""
JOINT_NATS = 12.0
"""Cost of each joint of an effect, or of one that all share; for its size, its form, and the choice of the best row.

The best row earns more than 11 nats on a tenth of the 384 left-out parts of the reference of 24 practice cranes.
The size of an effect that earns less on a joint is not searched.
"""
SIZES_BETWEEN = (0.88, 0.92, 0.96, 1.0, 1.04, 1.08, 1.13)
"""Factors between the sizes of the table, at which a common effect is sought."""
LOSS_LIMIT = -20.0
"""A joint takes at most so many nats from a common effect."""


@dataclass(frozen=True)
class JointRow:
    """The best row of an effect on one joint.

    Attributes:
        row: The row, its size searched.
        gain: Its gain on the field less what it earns on the reference, nats.
    """

    row: Row
    gain: float


class FieldJoint:
    """One joint of the field, its numbers those of the reference with effects that are there already.

    Args:
        side: The field.
        joint: Place of the joint.
        base: Its baseline.
        nuisance: Its ageing.
        numbers: Its numbers, `(P,)`.
        step: Step of a coarse sensor, units; 0: none.
        noise: Standard deviation of noise that its sensor adds, units.
        used: Samples that count, `(T,)` bool.
    """

    def __init__(
        self,
        side: Side,
        joint: int,
        base: JointBaseline,
        nuisance: JointNuisance,
        numbers: np.ndarray,
        step: float,
        noise: float,
        used: np.ndarray,
    ) -> None:
        self.side = side
        self.joint = joint
        self.numbers = numbers
        self.nuisance = nuisance
        healthy = side.simulate(joint, base.numbers)[0].astype(float)
        scale = base.scale
        if step or noise:
            memory = () if step else scale.memory
            scale = replace(scale, memory=memory, step=step, noise=noise)
        self.measure = IncrementMeasure(side, scale, measure_motion(side, healthy), used)
        self.increments, slopes = linearise(side, joint, numbers, self.measure)
        self.path = side.simulate(joint, numbers)[0].astype(float)
        self.projection = nuisance.project(slopes, base.spread)
        self.residual = self.measure(side.q[:, joint]).astype(float) - self.increments
        self.squares = float(self.projection.measure_squares(self.residual)[0])
        self.count = self.measure.count

    def simulate(self, tried: Sequence[Row]) -> np.ndarray:
        """Return the increments that rows add to the simulated joint, `(C, N)`."""
        paths = self.side.simulate(self.joint, self.side.model.change(self.numbers, tried))
        return self.measure(paths) - self.increments.astype(np.float32)

    def score(self, tried: Sequence[Row]) -> np.ndarray:
        """Return the gains of rows, nats, `(C,)`."""
        left = self.residual.astype(np.float32) - self.simulate(tried)
        squares = self.projection.measure_squares(left)
        return compute_gain(squares, self.squares, self.count)

    def refine(self, row: Row) -> Row:
        """Return the row where the size and all shapes fit best together."""
        groups = [row.sizes, *row.shapes]

        def resize(logs: np.ndarray) -> Row:
            found = row
            for places, factor in zip(groups, np.exp(logs), strict=True):
                found = found.resize(float(factor), places)
            return found

        def simulate(logs: np.ndarray) -> np.ndarray:
            return self.simulate([resize(one) for one in logs])

        none = np.zeros(len(groups))
        most = np.full(len(groups), LOG_MOST)
        # The deviation only keeps a size without any slope where it is.
        prior = Prior(none, 10.0 * most, LOG_STEP * most, -most, most)
        multiply = self.projection.multiply
        return resize(descend(simulate, self.residual, multiply, none, prior, REFINEMENTS))


class RowEvidence:
    """All that reference and field say about the rows.

    Args:
        reference: The machine as it was.
        field: The machine as it is.
    """

    def __init__(self, reference: Side, field: Side) -> None:
        self.reference = reference
        self.field = field
        self.bases = fit_reference(reference)
        field.ask_others([base.numbers for base in self.bases])
        self.covered = find_covered(reference, field)
        self.every = [*reference.model.rows, *reference.model.outside_rows]
        self.names = np.array([row.effect for row in self.every])
        self.nuisances = [estimate_nuisance(reference.model, base) for base in self.bases]
        self.steps = np.zeros(reference.num_joints)
        self.noises = np.zeros(reference.num_joints)
        self._viewed: dict[tuple[int, int, bytes], FieldJoint] = {}
        self._weighed: dict[FieldJoint, tuple[np.ndarray, dict[str, JointRow]]] = {}

    def _price(self, joint: FieldJoint, row: Row) -> float:
        """Return the most that a row earns on a left-out part of the reference, at the length of the field, nats.

        A joint that takes speeds pays nothing: of 14 practice machines with one effect 11 are named first without a
        price, and 9 with it. Without a price an opened arm has a limit of torque of 78 nats that is not there.
        """
        side, base = self.reference, self.bases[joint.joint]
        if side.model.integrates:
            return 0.0
        path = side.simulate(joint.joint, side.model.change(base.numbers, [row]))
        added = base.measure(path) - base.measure(side.simulate(joint.joint, base.numbers))
        earned = [0.0]
        for k, part in enumerate(self.nuisances[joint.joint].parts):
            own, count = base.part == k, count_part(base, k)
            squares = part.measure_squares(base.left_out[own] - added[:, own])
            before = float(part.measure_squares(base.left_out[own])[0])
            earned.append(float(compute_gain(squares, before, count)[0]) / count)
        return max(earned) * joint.count

    def view_field(
        self,
        numbers: Sequence[np.ndarray],
        field: Side | None = None,
        used: np.ndarray | None = None,
    ) -> list[FieldJoint]:
        """Return the joints of the field with these numbers `(P,)` each, seen in the samples `used` `(T,)`.

        A joint that an effect leaves as it is is the same object again.
        """
        side = self.field if field is None else field
        found = []
        for j, row in enumerate(numbers):
            key = (id(side), j, row.tobytes())
            joint = self._viewed.get(key)
            if joint is None or used is not None:
                base, nuisance = self.bases[j], self.nuisances[j]
                step, noise = self.steps[j], self.noises[j]
                counts = self.covered[j] if used is None else self.covered[j] & used
                joint = FieldJoint(side, j, base, nuisance, row, step, noise, counts)
            if used is None:
                self._viewed[key] = joint
            found.append(joint)
        return found

    def weigh_rows(self, joints: Sequence[FieldJoint]) -> dict[str, dict[int, JointRow]]:
        """Return the best row of each effect on each joint, by effect and joint."""
        found: dict[str, dict[int, JointRow]] = {}
        for name in dict.fromkeys(self.names.tolist()):
            if name in SHARED:
                found[name] = self.weigh_common(name, joints)
                continue
            found[name] = {}
            for joint in joints:
                _, rows = self._weigh_joint(joint)
                if name in rows:
                    found[name][joint.joint] = rows[name]
        return found

    def _weigh_joint(self, joint: FieldJoint) -> tuple[np.ndarray, dict[str, JointRow]]:
        """Return the gains of all rows on a joint `(C,)`, and the best row of each effect of its own."""
        if joint in self._weighed:
            return self._weighed[joint]
        gains = joint.score(self.every)
        found = {}
        for name in dict.fromkeys(self.names.tolist()):
            places = np.flatnonzero(self.names == name)
            best = places[np.argmax(gains[places])]
            if name in SHARED or gains[best] < LOSS_LIMIT:
                continue
            row, gain = self.every[best], float(gains[best])
            if gain > JOINT_NATS:
                row = joint.refine(row)
                gain = float(joint.score([row])[0]) - self._price(joint, row)
            found[name] = JointRow(row, gain)
        self._weighed[joint] = (gains, found)
        return gains, found

    def weigh_common(self, name: str, joints: Sequence[FieldJoint]) -> dict[int, JointRow]:
        """Return the row of an effect that has one size on all joints."""
        tables = [self._weigh_joint(joint)[0] for joint in joints]
        places = np.flatnonzero(self.names == name)
        total = np.sum([np.maximum(gains[places], LOSS_LIMIT) for gains in tables], 0)
        row = self.every[places[int(np.argmax(total))]]
        tried = [row.resize(factor) for factor in SIZES_BETWEEN]
        scores = np.maximum([joint.score(tried) for joint in joints], LOSS_LIMIT)
        best = int(np.argmax(scores.sum(0)))
        gains = scores[:, best].tolist()
        return {j.joint: JointRow(tried[best], gain) for j, gain in zip(joints, gains, strict=True)}
