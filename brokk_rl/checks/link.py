"""Checkers of links to a machine, and of the excitations that are sent over them."""

from __future__ import annotations

import math

import numpy as np

from brokk_rl.contracts.actuator import Excitation, Segment
from brokk_rl.contracts.link import Link
from brokk_rl.errors import BrokkError
from brokk_rl.machine import Machine
from brokk_rl.signals import Command

DURATION_S = 300.0
"""Length of the plan of a check, s. Chosen by hand; not searched."""


def check_excitation(excitation: Excitation, machine: Machine) -> None:
    """Check the segments of an excitation: limits, time, exclusive joints, repeatability."""
    still = np.zeros((20, machine.num_joints))
    start = Segment(name="before_00", start=machine.home, u=still, stops="inward", stop_margin=0.1)
    global_state = str(np.random.get_state(legacy=False))
    first, again = (
        excitation.segments(machine, DURATION_S, np.random.default_rng(1), [start])
        for _ in range(2)
    )
    untouched = str(np.random.get_state(legacy=False)) == global_state
    assert untouched, "segments: drew from numpy's global generator"
    assert excitation.weight(1.0) > 0, "weight: expected more than 0"
    text = f"segments: none in {DURATION_S:g} s; raise a ConfigError where there is no room"
    assert first, text
    names = [segment.name for segment in (start, *first)]
    assert len(set(names)) == len(names), f"segments: names repeat: {', '.join(names)}"
    num_steps = sum(len(segment.u) for segment in first)
    is_short = num_steps * machine.period_s <= DURATION_S + machine.period_s
    assert is_short, f"segments: {num_steps} steps are over {DURATION_S:g} s"
    assert len(first) == len(again), "segments: the same seed gives others"
    for segment, same in zip(first, again, strict=True):
        _check_segment(segment, machine)
        text = f"{segment.name}: repeats '{segment.repeat_of}', which there is not"
        assert segment.repeat_of in (None, *names), text
        for one, other in ((segment.u, same.u), (segment.start, same.start)):
            assert np.array_equal(one, other), "segments: the same seed gives others"


def _check_segment(segment: Segment, machine: Machine) -> None:
    name, u, start = segment.name, segment.u, segment.start
    assert start.shape == (machine.num_joints,), f"{name}: start has shape {start.shape}"
    inside = (start >= machine.lower) & (start <= machine.upper)
    assert inside.all(), f"{name}: starts at {start}, outside the limits"
    is_program = u.ndim == 2 and u.shape[1] == machine.num_joints and len(u) > 0
    assert is_program, f"{name}: program has shape {u.shape}"
    # NaN fails the comparison
    assert (np.abs(u) <= 1.0).all(), f"{name}: commands outside [-1, 1]"
    exclusive = machine.is_exclusive
    together = (u[:, exclusive] != 0).any(1) & (u[:, ~exclusive] != 0).any(1)
    text = f"an exclusive joint is commanded together with others in step {np.argmax(together)}"
    assert not together.any(), f"{name}: {text}"
    assert segment.stops in ("home", "inward"), f"{name}: stops is '{segment.stops}'"
    margin = segment.stop_margin
    assert 0 <= margin < 0.5, f"{name}: stop_margin {margin} leaves no way"


def check_link(link: Link, machine: Machine, num_runs: int = 1) -> None:
    """Check a closed link to a machine, or to `num_runs` simulated ones, against `Link`.

    It sends only a standstill, and a command that is no number: the link must refuse that by a
    `BrokkError` or send a standstill.
    """
    with link as open_link:
        first = open_link.read()
        shape = (num_runs, machine.num_joints) if num_runs > 1 else (machine.num_joints,)
        found = np.shape(first.q)
        assert found == shape, f"read: expected positions of shape {shape}, got {found}"
        is_finite = np.isfinite(np.asarray(first.q)).all() and math.isfinite(first.t_s)
        assert is_finite, "read: positions or time are not finite"
        sent = open_link.send(Command(np.zeros(shape))).u
        text = f"send: a standstill was sent as {sent}"
        assert np.array_equal(np.asarray(sent), np.zeros(shape)), text
        assert open_link.read().t_s >= first.t_s, "read: time runs backwards"
        for name, value in getattr(open_link, "extra", dict)().items():
            text = f"extra: '{name}' has shape {np.shape(value)}, expected one number a machine"
            assert np.shape(value) in ((), (num_runs,)), text
        try:
            sent = open_link.send(Command(np.full(shape, np.nan))).u
        except BrokkError:
            return
        text = f"send: a command that is no number was sent as {sent}"
        assert not np.asarray(sent).any(), text
