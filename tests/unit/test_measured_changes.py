"""Measured changes are those that were planted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from composed import MACHINE
from motion import make_recording

from brokk_rl.record import Recording
from diagnosis.measured_changes import MeasuredChange, measure_changes, shift_by_dead_time

PERIOD_S = 0.05
OUT = "speed at full command, moving out"


TWO_JOINTS = replace(
    MACHINE, joints=MACHINE.joints[2:4], exclusive=(), levers=(), name="two", dead_time_s=0.0
)
"""A machine of two arms that answers at once."""


def record(seed: int, slower_out: float = 0.0, heavier: float = 0.0) -> Recording:
    """Return a minute of levels; the first joint is slower out and takes more torque by shares."""
    rng = np.random.default_rng(seed)
    size = rng.choice([0.0, 0.5, 0.8], (12, 2)).repeat(2, 0)
    level = (size * np.tile([[1.0], [-1.0]], (12, 1))).repeat(50, 0)
    gain = np.where((level > 0) & (np.arange(2) == 0), 1.0 - slower_out, 1.0)
    speed = level * gain * TWO_JOINTS.max_speed
    q = np.cumsum(speed, 0) * PERIOD_S + 2e-4 * rng.standard_normal(speed.shape)
    torque = (1.0 + heavier) * (20.0 * np.sign(speed[:, 0]) + 5.0 * speed[:, 0]) + 50.0
    noisy = torque + rng.standard_normal(len(q))
    name = f"torque_{TWO_JOINTS.joint_names[0]}_nm"
    extra = {name: noisy.astype(np.float32)}
    return make_recording(TWO_JOINTS, level, q, f"{seed}", extra=extra)


def compare(
    reference: list[Recording] | None = None, repeats: float = 0.0, **change: float
) -> dict[tuple[str, str], MeasuredChange]:
    known = reference or [record(seed) for seed in range(4)]
    field = [record(seed, **change) for seed in range(4, 7)]
    found = measure_changes(known, field, TWO_JOINTS, repeats)
    return {(one.joint, one.quantity): one for one in found}


def test_a_slower_and_heavier_joint_is_measured_and_the_other_is_unchanged() -> None:
    first, second = TWO_JOINTS.joint_names
    found = compare(slower_out=0.1, heavier=0.2)
    slower = found[first, OUT]
    assert slower.change == pytest.approx(-0.1 * TWO_JOINTS.max_speed[0], rel=0.05)
    heavier = found[first, "torque, moving out"].change - found[first, "torque, moving in"].change
    assert heavier == pytest.approx(0.2 * 40.0, rel=0.1)
    assert slower.is_beyond and found[first, "torque, moving out"].is_beyond
    assert not found[first, "speed at full command, moving in"].is_beyond
    assert not found[second, OUT].is_beyond


def test_a_change_within_what_the_machine_repeats_is_none() -> None:
    quantity = TWO_JOINTS.joint_names[0], OUT
    assert compare(slower_out=0.02)[quantity].is_beyond
    assert not compare(repeats=0.02, slower_out=0.02)[quantity].is_beyond
    reference = []
    for day in range(3):
        one = record(day, slower_out=0.05 * day)
        reference.append(replace(one, metadata={"created": f"2026-03-0{day + 1}T09:00:00"}))
    assert not compare(reference, slower_out=0.1)[quantity].is_beyond


def test_the_command_in_force_is_that_of_a_dead_time_before() -> None:
    u = np.arange(20.0)[:, None] / 20.0
    assert shift_by_dead_time(u, 0.5, PERIOD_S)[:, 0].tolist() == [0.0] * 11 + u[:9, 0].tolist()
