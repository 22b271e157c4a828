"""A sitting without a machine: a plan on the disk, a stage that a test moves, and the study's pages served to a browser."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from browser import SHOWN, Scripted
from composed import option

from brokk_rl.errors import RecordingError
from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.session import write_json
from study import design, study_folder
from study.conductor import Conductor, Words
from study.trial import Times
from study.twin_control import MachineView

TEXT = {"en": ("You may stop at any time.",), "de": ("Sie können jederzeit aufhören.",)}
FACTS = {"simulated": False, "twin": True}


def plan(
    place: Path, machine: Machine, count: int = 2, practice: int = 0, trials: int = 2
) -> list[design.Trial]:
    """Plans a study in which the hole lies where the arm is at home, and trials begin with the first joint turned away."""
    tip = compute_tool_kinematics(machine, machine.home).tip_in_base_m
    hole = design.Hole(
        center_in_base_m=(float(tip[0]), float(tip[1]), float(tip[2]) + 0.12), radius_m=0.05
    )
    names = "ABCD"[:trials]
    start = tuple(float(q) for q in machine.home + np.array([0.3, 0, 0, 0, 0]))
    what = design.Design(
        num_participants=count, order="counterbalanced", holes=dict.fromkeys(names, hole), starts=dict.fromkeys(names, start),
        practice_trials=practice, practice_minutes=10.0, limit_s=20.0,
        success=design.Success(depth_m=0.1, clearance_m=0.013), primary="time_s", alpha=0.05,
    )  # fmt: skip
    planned = design.plan_trials(what, np.random.default_rng(0))
    write_json(place / study_folder.PLAN, design.format_plan(what, machine, 0, planned))
    return planned


class Arm:
    """A stage (`study.twin_control.Stage`) with an arm that is where a test says, and a clock that a test moves."""

    def __init__(self, machine: Machine) -> None:
        self.machine, self.now_s = machine, 100.0
        self.q: np.ndarray | None = machine.home + np.array([0.3, 0, 0, 0, 0])
        self.advised, self.recorded = "valid", None
        self.prepared: list[Any] = []
        self.fails = ""

    def sight(self) -> MachineView:
        return MachineView(self.q, self.advised, self.recorded is not None)

    def prepare(self, hole: design.Hole, start: np.ndarray) -> None:
        self.prepared.append(hole)
        self.q = start.copy()

    def record(self, folder: Path | None) -> None:
        self.recorded = folder

    def keep(self, folder: Path, begin_s: float, end_s: float) -> Recording:
        if self.fails:
            raise RecordingError(self.fails)
        num = int((end_s - begin_s) / self.machine.period_s) + 1
        q = np.repeat(self.machine.home[None], num, 0)
        q[: num - 10, 0] += np.linspace(0.3, 0.05, num - 10)
        extra = {f"advice_{name}": np.zeros(num, np.float32) for name in self.machine.joint_names}
        return Recording(
            machine=self.machine.name, joints=self.machine.joint_names, units=("rad",) * 5, rate_hz=20.0,
            t_s=np.arange(num) / 20.0, u=np.zeros_like(q), q=q, extra=extra,
        )  # fmt: skip

    def clock(self) -> float:
        return self.now_s

    def later(self, conductor: Conductor, seconds: float) -> None:
        """Lets time go by."""
        for _ in range(round(seconds / 0.05)):
            self.now_s += 0.05
            conductor.tick()


def conductor(place: Path, arm: Arm) -> Conductor:
    """Returns who leads sittings of the study in `place`."""
    times = Times(countdown_s=1.0, settle_s=0.5, start_tolerance=0.05)
    words = Words("v1", TEXT)
    return Conductor(place, arm.machine, arm, words, times, FACTS, lambda name: 7, clock=arm.clock)


def in_trial(lead: Conductor, arm: Arm, seconds: float = 3.0) -> None:
    """Does the trial that is ready, and inserts after a while."""
    assert lead.take({"do": "begin"}) == ""
    arm.later(lead, 1.2)
    assert lead.running
    arm.later(lead, seconds)
    arm.q = arm.machine.home
    arm.later(lead, 0.8)
    saved(lead, arm)


def saved(lead: Conductor, arm: Arm) -> None:
    """Waits until the trial is on the disk."""
    for _ in range(400):
        arm.later(lead, 0.05)
        if lead.view().get("phase") == "over":
            return
        import time

        time.sleep(0.01)
    raise AssertionError(lead.view())


def machine() -> Machine:
    """Returns the shipped machine."""
    return option("machine", "brokk170")


def feed() -> Scripted:
    """Returns the feed of a page beside it."""
    return Scripted(SHOWN)
