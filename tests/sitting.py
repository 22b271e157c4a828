"""A study without a machine: a plan on the disk, recordings, a stage that a test moves, and who leads sittings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from composed import MACHINE

from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.record import Recording, make_motion
from brokk_rl.session import write_json
from study import design, study_folder
from study.conductor import Conductor, Consent
from study.trial import MachineView, Times

CONSENT = Consent(
    version="v1", text={"en": ("You may stop at any time.",), "de": ("Sie können aufhören.",)}
)
FACTS = {"twin": True}
START = MACHINE.home + np.array([0.3, 0, 0, 0, 0])
"""The first joint is turned away from the hole, which lies where the arm is at home."""


def make_design(count: int = 2, practice: int = 0, trials: int = 2) -> design.Design:
    """Returns a design of studies whose holes all lie where the arm is at home."""
    tip = compute_tool_kinematics(MACHINE, MACHINE.home).tip_in_base_m
    center_m = (float(tip[0]), float(tip[1]), float(tip[2]) + 0.12)
    hole = design.Hole(center_in_base_m=center_m, radius_m=0.05)
    return design.Design(
        num_participants=count,
        holes=dict.fromkeys("ABCD"[:trials], hole),
        starts=dict.fromkeys("1234"[:trials], tuple(START.tolist())),
        practice_trials=practice,
        limit_s=20.0,
        success=design.Success(depth_m=0.1, clearance_m=0.013),
        primary="time_s",
        alpha=0.05,
    )


def plan(place: Path, count: int = 2, practice: int = 0, trials: int = 2) -> list[design.Trial]:
    """Plans such a study in `place`."""
    made = make_design(count, practice, trials)
    planned = design.plan_trials(made, np.random.default_rng(0))
    write_json(place / study_folder.PLAN, design.format_plan(made, MACHINE, 0, planned))
    return planned


def recorded(q: np.ndarray, u: np.ndarray | None = None, **extra: np.ndarray) -> Recording:
    """Returns a recording at 20 Hz of positions and commands, `(T, J)`."""
    commands = np.zeros_like(q) if u is None else u
    motion = make_motion(MACHINE, "a test", np.arange(len(q)) / 20.0, commands, q)
    return replace(motion, extra=extra)


def inserted_after(num: int) -> np.ndarray:
    """Returns positions, `(num + 10, J)`, with the tool in the hole after so many samples."""
    q = np.repeat(MACHINE.home[None], num + 10, 0)
    q[:num, 0] += np.linspace(0.3, 0.05, num)
    return q


class Arm:
    """A stage (`study.trial.LoopStage`) with an arm that is where a test says, and a clock that a test moves."""

    def __init__(self) -> None:
        self.now_s, self.recorded = 100.0, None
        self.q: np.ndarray | None = START

    def sight(self) -> MachineView:
        return MachineView(self.q, "valid", self.recorded is not None)

    def prepare(self, hole: design.Hole, start: np.ndarray) -> None:
        self.q = start.copy()

    def record(self, folder: Path | None) -> None:
        self.recorded = folder

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
    return Conductor(place, MACHINE, arm, CONSENT, times, FACTS, arm.clock)  # type: ignore[arg-type]


def agreed(lead: Conductor, who: str = "P01") -> None:
    """Begins a sitting with consent."""
    lead.choose(who)
    assert lead.take({"do": "consent", "agreed": True, "language": "de"}) == ""


def begun(lead: Conductor, arm: Arm) -> None:
    """Begins the trial that is ready."""
    assert lead.take({"do": "begin"}) == ""
    arm.later(lead, 1.2)
    assert lead.running


def done(lead: Conductor, arm: Arm, seconds: float = 3.0) -> None:
    """Does the trial that is ready, inserts after a while, and goes on."""
    begun(lead, arm)
    arm.later(lead, seconds)
    arm.q = MACHINE.home
    saved(lead, arm)
    assert lead.take({"do": "next"}) == ""


def saved(lead: Conductor, arm: Arm) -> None:
    """Waits until the trial is over."""
    arm.later(lead, 0.8)
    assert lead.view()["phase"] == "over"
