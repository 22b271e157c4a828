"""Promises of followers, excitations, links and worlds, as `brokk_rl.contracts` states them."""

from __future__ import annotations

import math

import numpy as np
import torch

from brokk_rl.checks import (
    NUM_ENVS,
    check_in_place,
    check_memory,
    check_same,
    isolate_randomness,
    view_tensors,
)
from brokk_rl.contracts.actuator import Excitation, Follower, FollowerModel, Segment
from brokk_rl.contracts.link import Link
from brokk_rl.contracts.world import Simulator, World
from brokk_rl.errors import BrokkError
from brokk_rl.machine import Machine, mask_exclusive_joints
from brokk_rl.signals import Command

CPU = torch.device("cpu")
NUM_PROPOSALS = 60
"""Control periods of a follower's check."""
DURATION_S = 300.0
"""Length of the plan of a check, s."""
PLACED_M = 0.2
"""Distance by which a block is put farther away."""


def check_excitation(excitation: Excitation, machine: Machine) -> None:
    """Check the segments of an excitation: limits, time, exclusive joints, repeatability."""
    global_state = str(np.random.get_state(legacy=False))
    first, again = (
        excitation.segments(machine, DURATION_S, np.random.default_rng(1)) for _ in range(2)
    )
    untouched = str(np.random.get_state(legacy=False)) == global_state
    assert untouched, "segments: drew from numpy's global generator"
    assert excitation.share > 0, "share: expected more than 0"
    text = f"segments: none in {DURATION_S:g} s; raise a ConfigError where there is no room"
    assert first, text
    names = [segment.name for segment in first]
    assert len(set(names)) == len(names), f"segments: names repeat: {', '.join(names)}"
    num_steps = sum(len(segment.u) for segment in first)
    is_short = num_steps * machine.period_s <= DURATION_S + machine.period_s
    assert is_short, f"segments: {num_steps} steps are over {DURATION_S:g} s"
    assert len(first) == len(again), "segments: the same seed gives others"
    for segment, same in zip(first, again, strict=True):
        _check_segment(segment, machine)
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


@isolate_randomness()
def check_follower(follower: Follower, machine: Machine) -> None:
    """Check the model of `Follower.build` against `FollowerModel`."""
    model = follower.build(machine, NUM_ENVS, CPU)
    first = check_memory(model, machine, CPU, lambda alter: _follow(model, machine, alter))
    assert (first.abs() <= 1.0).all(), "step: commands leave [-1, 1]"
    exclusive = torch.as_tensor(machine.is_exclusive)
    both = (first[..., exclusive] != 0).any(-1) & (first[..., ~exclusive] != 0).any(-1)
    assert not both.any(), "step: an exclusive joint moves together with others"
    assert (first != 0).any(), "step: nothing is ever given"
    model.reset(torch.ones(NUM_ENVS, dtype=torch.bool))
    still = torch.zeros(NUM_ENVS, machine.num_joints)
    for _ in range(NUM_PROPOSALS):
        given = model.step(still)
        assert not given.any(), "reset: a new person gives a command that nobody has proposed"


def _follow(model: FollowerModel, machine: Machine, alter_first: bool) -> torch.Tensor:
    """Return the given commands, `(T, N, J)`, for held, full, random and zero proposals."""
    generator = torch.Generator().manual_seed(0)
    exclusive = torch.as_tensor(machine.is_exclusive)
    found = []
    u = torch.zeros(NUM_ENVS, machine.num_joints)
    for step in range(NUM_PROPOSALS):
        if step < 10 or step % 4 == 0:
            u = torch.rand(u.shape, generator=generator) * 2 - 1
            u = (u.sign(), u, torch.zeros_like(u))[step % 3]
            positioning = torch.rand(NUM_ENVS, generator=generator) < 0.5
            u = torch.where(mask_exclusive_joints(exclusive, positioning), u, 0.0)
        proposed = u.clone()
        if alter_first:
            proposed[0] = -proposed[0].roll(1)
        kept = proposed.clone()
        found.append(model.step(proposed).clone())
        check_same(proposed, kept, "step: changed the proposal")
    return torch.stack(found)


def check_world(
    simulator: Simulator, machine: Machine, scenes: torch.Tensor, device: torch.device | str = "cpu"
) -> None:
    """Check a simulator against `World`.

    Args:
        simulator: The spec.
        machine: The machine.
        scenes: Valid scenes out of the arm's way at its home position, `(NUM_ENVS, S)`.
        device: Where to run.
    """
    device = torch.device(device)
    world = simulator.build(machine, device, NUM_ENVS)
    assert world.num_worlds == NUM_ENVS, f"num_worlds: expected {NUM_ENVS}, got {world.num_worlds}"
    place = view_tensors(_view_results(world, machine))
    home = torch.as_tensor(machine.home, dtype=torch.float32, device=device).repeat(NUM_ENVS, 1)
    everywhere, scenes = torch.ones(NUM_ENVS, dtype=torch.bool, device=device), scenes.to(device)
    reach = machine.max_speed * machine.period_s * 0.5
    steps = torch.as_tensor(reach, dtype=torch.float32, device=device).repeat(NUM_ENVS, 1)

    world.reset(everywhere, home, scenes)
    assert torch.allclose(world.q, home, atol=1e-4), "reset: q is not where the arm was put"
    assert not world.faults.any(), "reset: faults at rest at home"
    stored = world.state_dict()
    first = _push_joints(world, steps)
    assert first.isfinite().all(), "step: q is not finite"
    assert (first[-1] != home).any(), "step: the arm does not move"
    check_in_place(_view_results(world, machine), place, "step")
    # The order of additions on a GPU is not fixed.
    tolerance = 0.0 if device.type == "cpu" else 1e-5
    world.load_state_dict(stored)
    text = "load_state_dict: the same steps from the same state lead elsewhere"
    check_same(_push_joints(world, steps), first, text, tolerance)
    world.load_state_dict(stored)
    altered = steps.clone()
    altered[0] = 0.0
    text = "step: what happens in world 0 changes the others"
    check_same(_push_joints(world, altered)[:, 1:], first[:, 1:], text, tolerance)
    before, some = world.q.clone(), torch.arange(NUM_ENVS, device=device) == 0
    world.reset(some, home, scenes)
    check_same(world.q[1:], before[1:], "reset: q changed in worlds outside the mask")
    text = "reset: the world of the mask is not where it was put"
    assert torch.allclose(world.q[0], home[0], atol=1e-4), text
    elsewhere = scenes.clone()
    elsewhere[:, 0] += PLACED_M
    before = world.q.clone()
    world.place(some, elsewhere)
    check_same(world.q, before, "place: the arm moved with the block")


def _view_results(world: World, machine: Machine) -> dict[str, torch.Tensor]:
    """Return the tensors that a world refreshes; check their shapes and kinds."""
    found = {"q": world.q, "contact_force_n": world.contact_force_n, "faults": world.faults}
    for name, value in found.items():
        shape = (NUM_ENVS, machine.num_joints) if name == "q" else (NUM_ENVS,)
        kind = torch.bool if name == "faults" else torch.float32
        text = f"{name}: expected {kind} of shape {shape}, got {value.dtype} {tuple(value.shape)}"
        assert value.dtype == kind and tuple(value.shape) == shape, text
    return found


def _push_joints(world: World, steps: torch.Tensor) -> torch.Tensor:
    """Return the positions over some control periods in which every joint advances, `(T, N, J)`."""
    found = []
    for _ in range(5):
        world.step(steps)
        found.append(world.q.clone())
    return torch.stack(found)
