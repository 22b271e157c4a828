"""A simulated study at the twin: what hands give goes over the bus description to the valves, and what is shown comes back."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from composed import option

from brokk_rl.errors import ConfigError
from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.session import Session
from brokk_rl.signals import Command
from deploy.twin.faults import ActiveFaults
from study.trial_contract import OperatorView, TrialBatch
from study.twins import BEFORE_S, make_desks

MACHINE = option("machine", "brokk170")
GROUND = option("ground", "twin")
START = np.array([0.1, -0.95, 0.55, 1.15, 0.6])
RIM_M = np.array([2.6, 0.3, 0.75])
GIVEN = np.array([0.5, 0.0, -0.4, 0.3, 0.2])
DEAD_SAMPLES = 11


def desk(tmp_path: Path, guided: bool = True) -> Any:
    session = Session(out=str(tmp_path), seed=0, device="cpu")
    return make_desks(GROUND, MACHINE, session, [(7, START, RIM_M, guided)])[0]


def test_what_is_given_reaches_the_valves_as_the_bus_rounds_it(tmp_path: Path) -> None:
    one = desk(tmp_path)
    for _ in range(20):
        one.period(GIVEN)
    for _ in range(3):
        # The exclusive joint: the button goes over the bus, too.
        one.period(np.array([0.0, 0.6, 0.0, 0.0, 0.0]))
    found = one.recording()
    assert found.u[2:19] == pytest.approx(np.tile(GIVEN, (17, 1)), abs=0.01)
    assert found.u[-1] == pytest.approx([0.0, 0.6, 0.0, 0.0, 0.0], abs=0.01)
    still, moved = found.q[: DEAD_SAMPLES - 1], found.q[DEAD_SAMPLES + 5 :]
    assert np.abs(still[:, 0] - START[0]).max() < 0.003 and moved[-1, 0] > START[0] + 0.02, (
        "the dead time, then motion"
    )
    assert found.t_s[0] == 0.0 and len(found.t_s) == 23, (
        "what went before the trial is no part of it"
    )


def test_advice_is_shown_from_the_beginning_and_follows_hands_that_follow_it(
    tmp_path: Path,
) -> None:
    one = desk(tmp_path)
    (q, shown), first = one.seen(), None
    for _ in range(round(12.0 / MACHINE.period_s)):
        first = shown.copy() if first is None else first
        q, shown = one.period(shown)
    tip = compute_tool_kinematics(MACHINE, q).tip_in_base_m
    assert first is not None and np.abs(first).max() > 0.02, (
        f"after {BEFORE_S} s the history is full"
    )
    assert np.hypot(*(tip - RIM_M)[:2]) < 0.013 and tip[2] < RIM_M[2] - 0.05, (
        "followed exactly, it leads into the hole"
    )
    assert np.abs(one.recording().extra["advice_q1"]).max() > 0.02


def test_what_is_not_shown_is_not_recorded(tmp_path: Path) -> None:
    one = desk(tmp_path, guided=False)
    one.period(GIVEN)
    assert not [name for name in one.recording().extra if name.startswith("advice")]


def test_a_twin_is_put_elsewhere_with_its_block(tmp_path: Path) -> None:
    link = replace(GROUND.plant, start=tuple(START), hole_in_base_m=(2.6, 0.0, 0.75)).build(
        MACHINE, 1, Session(out=str(tmp_path), seed=0, device="cpu")
    )
    for _ in range(30):
        link.send(Command(GIVEN))
    other = np.array([-0.3, -0.9, 0.5, 1.2, 0.5])
    link.place(other, np.array([2.4, -0.9, 0.72]))
    assert link.read().q == pytest.approx(other, abs=0.003)
    for _ in range(10):  # nothing of the commands before is still on its way
        link.send(Command(np.zeros(5)))
    assert link.read().q == pytest.approx(other, abs=0.01)


def test_a_place_is_asked_for_once_and_nonsense_refused() -> None:
    faults = ActiveFaults()
    faults.request(
        json.dumps({"place": {"q": [0.0] * 5, "hole_in_base_m": [2.6, 0.0, 0.75]}}).encode(), 0.0
    )
    assert faults.take_place() == ([0.0] * 5, [2.6, 0.0, 0.75]) and faults.take_place() is None
    with pytest.raises(ConfigError, match="expected JSON"):
        faults.request(b'{"place": {"q": [0.0]}}', 0.0)


class Still:
    """Operators who do nothing."""

    def step(self, view: OperatorView) -> np.ndarray:
        return np.where(np.arange(5) == 0, 0.4, 0.0) * np.ones_like(view.q)


@pytest.mark.slow
def test_how_many_processes_share_the_twins_changes_nothing(tmp_path: Path) -> None:
    rim = np.tile(RIM_M, (3, 1))
    batch = TrialBatch(
        q=np.tile(START, (3, 1)), rim_in_base_m=rim, radius_m=np.full(3, 0.05), guided=np.array([True, False, True]), limit_s=2.0,
        depth_m=0.1, clearance_m=0.013,
    )  # fmt: skip
    session = Session(out=str(tmp_path), seed=0, device="cpu")
    one, two = (
        replace(GROUND, num_processes=count).run(MACHINE, session, batch, Still())
        for count in (1, 2)
    )
    for here, there in zip(one, two, strict=True):
        assert (
            (here.q == there.q).all()
            and (here.u == there.u).all()
            and here.extra.keys() == there.extra.keys()
        )
