"""Checkers of what stands between commands and motion: actuators, and effects around them."""

from __future__ import annotations

import torch

from brokk_rl.checks.exercise import (
    NUM_ENVS,
    build_rest_history,
    check_memory,
    check_same,
    copy_tensors,
    isolate_randomness,
)
from brokk_rl.contracts.actuator import Actuator, ActuatorModel, Effect
from brokk_rl.history import History
from brokk_rl.machine import Machine

NUM_STEPS = 20
"""Control periods of a check. Chosen by hand; not searched."""


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
