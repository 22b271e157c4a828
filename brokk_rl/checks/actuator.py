"""Checkers of what stands between a policy and motion: actuators, effects around them, followers."""

from __future__ import annotations

import torch

from brokk_rl.checks.exercise import (
    NUM_ENVS,
    build_rest_history,
    check_memory,
    check_same,
    copy_tensors,
    is_same,
    isolate_randomness,
)
from brokk_rl.contracts.actuator import Actuator, ActuatorModel, Effect, Follower, FollowerModel
from brokk_rl.history import History
from brokk_rl.machine import Machine, mask_exclusive_joints

NUM_STEPS = 20
"""Control periods of a check. Chosen by hand; not searched."""
NUM_PROPOSALS = 60
"""Control periods of a follower's check. Chosen by hand; not searched."""


def check_actuator(
    actuator: Actuator, machine: Machine, device: torch.device | str = "cpu"
) -> None:
    """Check the model of `Actuator.build` against `ActuatorModel`."""
    place = torch.device(device)
    with isolate_randomness():
        check_actuator_model(actuator.build(machine, NUM_ENVS, place), machine, place)


def check_effect(effect: Effect, machine: Machine, device: torch.device | str = "cpu") -> None:
    """Check that an effect around the simplest actuator model is again an actuator model."""
    place = torch.device(device)
    with isolate_randomness():
        inner = _Proportional(machine, place)
        check_actuator_model(effect.wrap(inner, machine, NUM_ENVS, place), machine, place)


def check_actuator_model(model: ActuatorModel, machine: Machine, device: torch.device) -> None:
    """Check an actuator model for `NUM_ENVS` environments; see `ActuatorModel` for the promises."""
    check_memory(model, machine, device, lambda alter: _drive(model, machine, device, alter))
    model.reset(torch.ones(NUM_ENVS, dtype=torch.bool, device=device))
    history = build_rest_history(machine, device)
    moved = (model.step(history) - history.q[:, -1]).abs().amax(0).cpu().numpy()
    limit = machine.max_speed * machine.period_s
    text = f"reset: at rest and without a command the joints move by {moved} in one period"
    assert (moved <= limit).all(), text


class _Proportional:
    """The simplest actuator model: speed proportional to the command.

    Attributes:
        drive_changes: Changes by effects on drives, which do nothing to it.
    """

    def __init__(self, machine: Machine, device: torch.device) -> None:
        self.state: dict[str, torch.Tensor] = {}
        self.drive_changes: dict[str, torch.Tensor] = {}
        step = machine.max_speed * machine.period_s
        self._step = torch.as_tensor(step, dtype=torch.float32, device=device)

    def reset(self, mask: torch.Tensor) -> None:
        """Have no memory."""

    def step(self, history: History) -> torch.Tensor:
        return history.q[:, -1] + history.u[:, -1] * self._step


def _drive(
    model: ActuatorModel, machine: Machine, device: torch.device, alter_first: bool
) -> torch.Tensor:
    """Return positions under random and full commands, `(T, N, J)`.

    `alter_first` changes the commands of environment 0.
    """
    generator = torch.Generator().manual_seed(0)
    history, found = build_rest_history(machine, device), []
    for step in range(NUM_STEPS):
        u = torch.rand((NUM_ENVS, machine.num_joints), generator=generator) * 2 - 1
        u = u.sign() if step % 4 == 0 else u
        if alter_first:
            u[0] = -u[0]
        history.push_u(u.to(device))
        kept = copy_tensors(vars(history))
        q = model.step(history).clone()
        check_same(vars(history), kept, "step: changed the history")
        history.push_q(q)
        found.append(q)
    return torch.stack(found)


def check_follower(
    follower: Follower, machine: Machine, device: torch.device | str = "cpu"
) -> None:
    """Check the model of `Follower.build` against `FollowerModel`."""
    place = torch.device(device)
    with isolate_randomness():
        _check_follower_model(follower.build(machine, NUM_ENVS, place), machine, place)


def _check_follower_model(model: FollowerModel, machine: Machine, device: torch.device) -> None:
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
    for _ in range(NUM_PROPOSALS):
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
    for step in range(NUM_PROPOSALS):
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
