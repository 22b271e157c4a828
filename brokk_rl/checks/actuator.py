"""Checkers of actuator models and of the effects around them."""

from __future__ import annotations

import torch

from brokk_rl.checks.exercise import (
    NUM_ENVS,
    build_rest_history,
    copy_tensors,
    is_in_place,
    is_same,
    isolate_randomness,
    require,
    require_memory_in_state,
    require_rows,
    view_tensors,
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
    with isolate_randomness():
        check_actuator_model(
            actuator.build(machine, NUM_ENVS, torch.device(device)), machine, torch.device(device)
        )


def check_effect(effect: Effect, machine: Machine, device: torch.device | str = "cpu") -> None:
    """Check that an effect around the simplest actuator model is again an actuator model."""
    with isolate_randomness():
        inner = _Proportional(machine, torch.device(device))
        check_actuator_model(
            effect.wrap(inner, machine, NUM_ENVS, torch.device(device)),
            machine,
            torch.device(device),
        )


def check_actuator_model(model: ActuatorModel, machine: Machine, device: torch.device) -> None:
    """Check an actuator model for `NUM_ENVS` environments; see `ActuatorModel` for the promises."""
    everywhere = torch.ones(NUM_ENVS, dtype=torch.bool, device=device)
    model.reset(everywhere)
    require_rows(model.state, "state")
    place = view_tensors(model.state)
    begin = copy_tensors(model.state)

    first = _drive(model, machine, device)
    require(
        first.shape == (NUM_STEPS, NUM_ENVS, machine.num_joints),
        f"step: expected {(NUM_ENVS, machine.num_joints)} positions",
    )
    require(
        first.dtype == torch.float32 and first.device.type == device.type,
        f"step: expected float32 on {device}, got {first.dtype}",
    )
    require(
        bool(first.isfinite().all()),
        "step: positions are not finite under full and random commands",
    )
    require(
        is_in_place(model.state, place),
        "state: a tensor moved or changed its shape; write it in place",
    )

    require_memory_in_state(
        model, begin, first, lambda alter: _drive(model, machine, device, alter_first=alter)
    )

    model.reset(everywhere)
    history = build_rest_history(machine, device)
    moved = (model.step(history) - history.q[:, -1]).abs().amax(0).cpu().numpy()
    limit = machine.max_speed * machine.period_s
    require(
        bool((moved <= limit).all()),
        f"reset: at rest and without a command the joints move by {moved} in one period",
    )


class _Proportional:
    """The simplest actuator model: speed proportional to the command.

    Attributes:
        drive_changes: Changes by effects on drives, which do nothing to it.
    """

    def __init__(self, machine: Machine, device: torch.device) -> None:
        self.state: dict[str, torch.Tensor] = {}
        self.drive_changes: dict[str, torch.Tensor] = {}
        self._step = torch.as_tensor(
            machine.max_speed * machine.period_s, dtype=torch.float32, device=device
        )

    def reset(self, mask: torch.Tensor) -> None:
        """Have no memory."""

    def step(self, history: History) -> torch.Tensor:
        return history.q[:, -1] + history.u[:, -1] * self._step


def _drive(
    model: ActuatorModel, machine: Machine, device: torch.device, alter_first: bool = False
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
        require(
            all(is_same(value, kept[name]) for name, value in vars(history).items()),
            "step: changed the history",
        )
        history.push_q(q)
        found.append(q)
    return torch.stack(found)
