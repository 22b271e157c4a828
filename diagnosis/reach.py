"""How far the effects that were found close the gap: foretold, achieved, by joint and by effect, and on recordings apart.

All errors are those of free runs on parts of the recordings that the sizes were not fitted to; only
what is foretold comes from the parts that they were fitted to.
Axes: `W` windows, `K` steps, `J` joints, `B` draws of the bootstrap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from brokk_rl import open_loop
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis import gap
from diagnosis.answer import Estimate, Gap, JointClosed
from diagnosis.case import HORIZON_S, running_s
from diagnosis.engine import Findings
from diagnosis.repair import refitted, simulate
from diagnosis.simulator import Base

BEYOND = 1.25
"""So many times the floor is more than what the simulator errs by anyway, where it exceeds the
floor for sure."""


@dataclass(frozen=True, eq=False)
class Reach:
    """Errors before, after and at the floor.

    Attributes:
        base: The simulator and its floor.
        machine: The machine.
        after: Free runs with the effects, `(W, K, J)`; those without where none was found.
        own: The same with sizes fitted to the window's own half; `None` where none were fitted.
        generator: Draws the bootstraps.
    """

    base: Base
    machine: Machine
    after: np.ndarray
    own: np.ndarray | None
    generator: np.random.Generator

    @cached_property
    def before(self) -> np.ndarray:
        """Mean square errors of the simulator as it was, `(W,)`."""
        evidence = self.base.field.evidence
        return gap.squares(evidence.base, self._measured, self.machine)

    @cached_property
    def floor(self) -> np.ndarray | None:
        """Mean square errors at the floor, by window; `None` where it is unknown."""
        if not self.base.nulls:
            return None
        parts = [one.evidence for one in self.base.nulls]
        return np.concatenate(
            [gap.squares(one.base, one.candidates.cut.measured, self.machine) for one in parts]
        )

    @cached_property
    def draws(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Windows of each bootstrap, the same for all shares."""
        return gap.draws(len(self.before), len(self._floor), self.generator)

    @property
    def _measured(self) -> np.ndarray:
        return self.base.field.evidence.candidates.cut.measured

    @property
    def _floor(self) -> np.ndarray:
        """The floor, or 0 where it is unknown."""
        return np.zeros(1) if self.floor is None else self.floor

    def shares(self, paths: np.ndarray) -> np.ndarray:
        """Returns the share of the gap that free runs close, then the same of each draw, `(1 + B,)`."""
        return gap.shares(
            self.before, gap.squares(paths, self._measured, self.machine), self._floor, self.draws
        )

    @cached_property
    def has_gap(self) -> bool:
        """Whether there is a floor, and errors that exceed it."""
        return self.floor is not None and gap.rmse(self.before) >= gap.SIGNIFICANT * gap.rmse(
            self.floor
        )

    def gap(self) -> Gap:
        """Returns the errors, all joints together and joint by joint."""
        left = gap.squares(self.after, self._measured, self.machine)
        closed = gap.estimate(self.shares(self.after)) if self.has_gap else None
        floor = None if self.floor is None else gap.rmse(self.floor)
        of = "" if floor is None else "flexible model" if self.base.is_flexible else "reference"
        return Gap(
            gap.rmse(self.before),
            gap.rmse(left),
            floor,
            closed,
            gap.unit_of(self.machine),
            of,
            self._joints(),
        )

    def foretold(self) -> Estimate | None:
        """Returns the share that should be closed, as the parts that were fitted to say; `None` without a gap or a fit."""
        return (
            gap.estimate(self.shares(self.own)) if self.has_gap and self.own is not None else None
        )

    def by_effect(self, findings: Findings, names: Sequence[str]) -> dict[str, Estimate]:
        """Returns what each chosen effect closes, its Shapley value; without a floor of the whole error."""
        values = gap.shapley(names, lambda some: self.shares(self._with(findings, some)))
        return {name: gap.estimate(value) for name, value in values.items()}

    def beyond(self) -> list[str]:
        """Returns the joints whose error after repair exceeds the floor for sure."""
        if self.floor is None:
            return []
        left = np.square(self.after - self._measured).mean(1)  # (W, J)
        parts = [one.evidence for one in self.base.nulls]
        floor = np.concatenate(
            [np.square(one.base - one.candidates.cut.measured).mean(1) for one in parts]
        )
        drawn = [
            np.sqrt(left[f].mean(0) / np.maximum(floor[g].mean(0), 1e-18)) for f, g in self.draws
        ]
        ratio = np.sqrt(left.mean(0) / np.maximum(floor.mean(0), 1e-18))
        beyond = (ratio > BEYOND) & (np.quantile(drawn, 0.025, axis=0) > 1.0)
        return [
            name
            for name, is_beyond in zip(self.machine.joint_names, beyond, strict=True)
            if is_beyond
        ]

    def _with(self, findings: Findings, names: frozenset[str]) -> np.ndarray:
        """Returns free runs with some of the chosen effects, their sizes fitted anew."""
        if not names:
            return self.base.field.evidence.base
        if names == findings.chosen.names:
            return self.after
        subsets = [subset & names for subset in findings.chosen.subsets]
        start = [table.score(s).sizes for table, s in zip(findings.tables, subsets, strict=True)]
        return refitted(findings.evidence, subsets, findings.rays, start)

    def _joints(self) -> dict[str, JointClosed]:
        evidence = self.base.field.evidence
        before, after = (
            _by_joint([paths], [self._measured]) for paths in (evidence.base, self.after)
        )
        parts = [one.evidence for one in self.base.nulls]
        floor = (
            _by_joint([one.base for one in parts], [one.candidates.cut.measured for one in parts])
            if parts
            else None
        )
        return _closed(self.machine, before, after, floor)


def apart(findings: Findings, recordings: Sequence[Recording], machine: Machine) -> dict[str, Any]:
    """Returns how far the effects carry on recordings that nothing was fitted to, as plain JSON data.

    Raises:
        RecordingError: no recording is long enough.
    """
    assert findings.repair is not None, "there is something to carry"
    begun = running_s(recordings)
    cuts = [
        open_loop.cut_windows([one], machine, HORIZON_S, HORIZON_S)
        for one in recordings
        if _is_long(one, machine)
    ]
    running = [at for one, at in zip(recordings, begun, strict=True) if _is_long(one, machine)]
    cut = (
        open_loop.join_windows(cuts)
        if cuts
        else open_loop.cut_windows(recordings, machine, HORIZON_S, HORIZON_S)
    )
    running_at = np.repeat(running, [len(one.q) for one in cuts])
    candidates = replace(findings.evidence.candidates, cut=cut, running_s=running_at)
    none = simulate(candidates, findings.repair.rays, 0.0 * findings.repair.sizes[None])[0]
    paths = simulate(candidates, findings.repair.rays, findings.repair.sizes[None])[0]
    before, after = (_by_joint([one], [cut.measured]) for one in (none, paths))
    joints = {name: vars(one) for name, one in _closed(machine, before, after, None).items()}
    return {"seconds": HORIZON_S * len(cut.q), "recordings": len(cuts), "joints": joints}


def _is_long(recording: Recording, machine: Machine) -> bool:
    return open_loop.find_longest_horizon_s([recording], machine) >= HORIZON_S


def _by_joint(paths: Sequence[np.ndarray], measured: Sequence[np.ndarray]) -> np.ndarray:
    """Returns the root mean square error of each joint, `(J,)`."""
    squares = np.concatenate(
        [np.square(one - other).mean(1) for one, other in zip(paths, measured, strict=True)]
    )
    return np.sqrt(squares.mean(0))


def _closed(
    machine: Machine, before: np.ndarray, after: np.ndarray, floor: np.ndarray | None
) -> dict[str, JointClosed]:
    found = {}
    for j, name in enumerate(machine.joint_names):
        least = None if floor is None else float(floor[j])
        above = (
            None
            if least is None or before[j] < gap.SIGNIFICANT * least
            else (before[j] - after[j]) / (before[j] - least)
        )
        share = float(1.0 - after[j] / max(before[j], 1e-12))
        found[name] = JointClosed(
            float(before[j]), float(after[j]), least, share, None if above is None else float(above)
        )
    return found
