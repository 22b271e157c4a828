"""Checker of followers."""

from __future__ import annotations

import torch

from brokk_rl.checks.exercise import NUM_ENVS, check_memory, is_same, isolate_randomness
from brokk_rl.contracts.actuator import Follower, FollowerModel
from brokk_rl.machine import Machine, mask_exclusive_joints

NUM_STEPS = 60
"""Control periods of a check. Chosen by hand; not searched."""


def check_follower(
    follower: Follower, machine: Machine, device: torch.device | str = "cpu"
) -> None:
    """Check the model of `Follower.build` against `FollowerModel`."""
    place = torch.device(device)
    with isolate_randomness():
        _check_model(follower.build(machine, NUM_ENVS, place), machine, place)


def _check_model(model: FollowerModel, machine: Machine, device: torch.device) -> None:
    first = check_memory(
        model, machine, device, lambda alter: _follow(model, machine, device, alter)
    )
    assert (first.abs() <= 1.0).all(), "step: commands leave [-1, 1]"
    exclusive = torch.as_tensor(machine.is_exclusive, device=device)
    both = (first[..., exclusive] != 0).any(-1) & (first[..., ~exclusive] != 0).any(-1)
    assert not both.any(), "step: an exclusive joint moves together with others"
    assert (first != 0).any(), "step: nothing is ever given"
    model.reset(torch.ones(NUM_ENVS, dtype=torch.bool, device=device))
    still = torch.zeros(NUM_ENVS, machine.num_joints, device=device)
    for _ in range(NUM_STEPS):
        given = model.step(still)
        assert not given.any(), "reset: a new person gives a command that nobody has proposed"


def _follow(
    model: FollowerModel, machine: Machine, device: torch.device, alter_first: bool
) -> torch.Tensor:
    """Return the given commands, `(T, N, J)`, for held, full, random and zero proposals."""
    generator = torch.Generator().manual_seed(0)
    exclusive = torch.as_tensor(machine.is_exclusive)
    found = []
    u = torch.zeros(NUM_ENVS, machine.num_joints)
    for step in range(NUM_STEPS):
        if step < 10 or step % 4 == 0:
            u = torch.rand(u.shape, generator=generator) * 2 - 1
            u = (u.sign(), u, torch.zeros_like(u))[step % 3]
            positioning = torch.rand(NUM_ENVS, generator=generator) < 0.5
            u = torch.where(mask_exclusive_joints(exclusive, positioning), u, 0.0)
        proposed = u.clone()
        if alter_first:
            proposed[0] = -proposed[0].roll(1)
        proposed = proposed.to(device)
        kept = proposed.clone()
        found.append(model.step(proposed).clone())
        assert is_same(proposed, kept), "step: changed the proposal"
    return torch.stack(found)
