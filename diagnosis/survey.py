"""All that can be said about a gap before any effect is fitted: are the recordings sound, where does it lie, what points where."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from brokk_rl.inspection import Thresholds
from brokk_rl.machine import Machine
from diagnosis.answer import JointGap, RegimeGap, Where
from diagnosis.budget import Budget, account
from diagnosis.free_runs import WindowedRuns
from diagnosis.geometry import Geometry, geometry
from diagnosis.probes import Probe, probes
from diagnosis.sanity import Remark, examine
from diagnosis.stages import Known, StageFinding, foremost, stages
from diagnosis.where import Location, locate

LISTED = 12
"""Regimes and probes that are told, the foremost ones."""


@dataclass(frozen=True)
class Survey:
    """What was seen; the parts are explained in the modules that their types come from."""

    remarks: Sequence[Remark]
    location: Location
    probes: Sequence[Probe]
    stages: Sequence[StageFinding]
    budget: Budget | None
    geometry: Geometry | None
    machine: Machine

    def where(self) -> Where:
        """Returns the fields `where` of `diagnosis.json`: shares are those of what exceeds the floor."""
        joints = {
            name: JointGap(j.rmse, j.floor, j.gap) for name, j in self.location.joints.items()
        }
        regimes = [
            RegimeGap(p.joint, p.category, p.gap) for p in self.location.largest() if p.gap > 0.0
        ]
        stage = foremost(self.stages, self.location.has_gap)
        return Where(
            joints,
            tuple(regimes[:LISTED]),
            stage,
            {joint.name: joint.unit for joint in self.machine.joints},
        )

    def more(self) -> dict[str, Any]:
        """Returns further fields of `diagnosis.json`, plain JSON data."""
        return {
            "sanity": [remark.plain() for remark in self.remarks],
            "location": self.location.plain(),
            "probes": [probe.plain() for probe in self.probes[:LISTED]],
            "stages": [stage.plain() for stage in self.stages],
            "budget": self.budget and self.budget.plain(),
            "geometry": self.geometry and self.geometry.plain(),
        }


def survey(
    before: WindowedRuns,
    floor: WindowedRuns | None,
    after: WindowedRuns | None,
    machine: Machine,
    thresholds: Thresholds,
    dead_time_s: np.ndarray,
    generator: np.random.Generator,
    whole: WindowedRuns | None = None,
) -> Survey:
    """Returns what is to be said.

    Args:
        before: Free runs of the simulator as it was through field recordings.
        floor: The same through reference recordings that it was not fitted to; `None`: there is no
            floor.
        after: Free runs with the selected effects, for the budget; `None` without.
        machine: The machine.
        thresholds: When a stretch of a recording is worth telling.
        dead_time_s: Time from command to motion of each joint, `(J,)`.
        generator: Draws the permutations.
        whole: Free runs through whole field recordings.
    """
    location = locate(before, floor, machine, dead_time_s, generator, whole)
    clues = probes(before, floor, machine, dead_time_s)
    shapes = [geometry(runs.recordings, machine) if runs else None for runs in (before, floor)]
    accounts = [
        account(runs, machine) if runs and machine.has_bodies else None
        for runs in (before, after, floor)
    ]
    budget = Budget(accounts[0], accounts[1], accounts[2], {}) if accounts[0] else None
    rows = stages(Known(location, clues, budget, shapes[0], shapes[1]), before, floor, machine)
    if budget:
        of_geometry = {
            row.stage: row.rms_m for row in rows if row.part is None and row.rms_m is not None
        }
        budget = Budget(budget.before, budget.after, budget.floor, of_geometry)
    return Survey(
        examine(before.recordings, machine, thresholds),
        location,
        clues,
        rows,
        budget,
        shapes[0],
        machine,
    )
