"""Checker of excitations."""

from __future__ import annotations

import numpy as np

from brokk_rl.checks.exercise import require
from brokk_rl.contracts.actuator import Excitation, Segment
from brokk_rl.machine import Machine

DURATION_S = 300.0
"""Length of the plan of a check, s. Chosen by hand; not searched."""


def check_excitation(excitation: Excitation, machine: Machine) -> None:
    """Check the segments of an excitation: limits, time, exclusive joints, repeatability."""
    still = np.zeros((20, machine.num_joints))
    before = [
        Segment(name="before_00", start=machine.home, u=still, stops="inward", stop_margin=0.1)
    ]
    global_state = np.random.get_state(legacy=False)
    first, again = (
        excitation.segments(machine, DURATION_S, np.random.default_rng(1), before) for _ in range(2)
    )
    untouched = str(np.random.get_state(legacy=False)) == str(global_state)
    require(untouched, "segments: drew from numpy's global generator")
    require(excitation.weight(1.0) > 0, "weight: expected more than 0")
    require(
        len(first) > 0,
        f"segments: none in {DURATION_S:g} s; raise a ConfigError where there is no room",
    )
    names = [segment.name for segment in (*before, *first)]
    require(len(set(names)) == len(names), f"segments: names repeat: {', '.join(names)}")
    num_steps = sum(len(segment.u) for segment in first)
    require(
        num_steps * machine.period_s <= DURATION_S + machine.period_s,
        f"segments: {num_steps} steps are over {DURATION_S:g} s",
    )
    for segment in first:
        _check_segment(segment, machine)
        require(
            segment.repeat_of in (None, *names),
            f"{segment.name}: repeats '{segment.repeat_of}', which there is not",
        )
    same = len(first) == len(again) and all(
        a.name == b.name and np.array_equal(a.u, b.u) and np.array_equal(a.start, b.start)
        for a, b in zip(first, again, strict=True)
    )
    require(same, "segments: the same seed gives others")


def _check_segment(segment: Segment, machine: Machine) -> None:
    name, u = segment.name, segment.u
    require(
        segment.start.shape == (machine.num_joints,),
        f"{name}: start has shape {segment.start.shape}",
    )
    inside = (segment.start >= machine.lower) & (segment.start <= machine.upper)
    require(bool(inside.all()), f"{name}: starts at {segment.start}, outside the limits")
    require(
        u.ndim == 2 and u.shape[1] == machine.num_joints and len(u) > 0,
        f"{name}: program has shape {u.shape}",
    )
    require(
        bool(np.isfinite(u).all()) and float(np.abs(u).max()) <= 1.0,
        f"{name}: commands outside [-1, 1]",
    )
    exclusive = machine.is_exclusive
    together = (u[:, exclusive] != 0).any(1) & (u[:, ~exclusive] != 0).any(1)
    require(
        not together.any(),
        f"{name}: an exclusive joint is commanded together with others in step {np.argmax(together)}",
    )
    require(segment.stops in ("home", "inward"), f"{name}: stops is '{segment.stops}'")
    require(
        0 <= segment.stop_margin < 0.5, f"{name}: stop_margin {segment.stop_margin} leaves no way"
    )
