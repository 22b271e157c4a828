"""Checker of tasks: the promises of `brokk_rl.contracts.task` on which training relies."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import torch

from brokk_rl.checks.exercise import (
    NUM_ENVS,
    build_rest_history,
    copy_tensors,
    is_in_place,
    is_same,
    isolate_randomness,
    require,
    require_rows,
    view_tensors,
)
from brokk_rl.contracts.task import FAULT, STEPS, SUCCESS, Task, TaskProcess
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.observation import restore_encoder

COMMAND_SIZES = (0.0, 0.5, 100.0)
"""Standard deviations of the random actions tried: rest, usual, and far beyond the commands'
range."""


def check_task(task: Task, machine: Machine, device: torch.device | str = "cpu") -> None:
    """Check a task against `TaskProcess`, and against the optional contracts that it offers.

    The arm does not move meanwhile: no simulator is needed.

    Raises:
        AssertionError: A promise is broken; the message names it.
    """
    device = torch.device(device)
    with isolate_randomness():
        process = task.build(machine, NUM_ENVS, device)
        _check_attributes(process)
        drawn = _check_starts(process, machine)
        start = {name: value.to(device) for name, value in drawn.items()}
        history = build_rest_history(machine, device, start["q"])
        state_places, episode_places = view_tensors(process.state), view_tensors(process.episode)

        groups = _check_observation(process, history, start)
        _check_commands(process, machine, device)
        _check_optional(process, groups, machine)
        _check_episode(process, history, device)
        require(
            is_in_place(process.state, state_places)
            and is_in_place(process.episode, episode_places),
            "state, episode: a tensor moved or changed its shape; write it in place",
        )
        _check_reset_mask(process, start, device)


def _check_attributes(process: TaskProcess) -> None:
    require(
        process.num_actions > 0 and process.max_episode_steps > 0,
        "num_actions and max_episode_steps: expected 1 or more",
    )
    require(
        len(set(process.reasons)) == len(process.reasons) > 0,
        f"reasons: expected different names, got {process.reasons}",
    )
    require(
        FAULT in process.reasons,
        f"reasons: expected '{FAULT}', for worlds that diverged, among {process.reasons}",
    )
    require_rows(process.state, "state")
    require_rows(process.episode, "episode")
    for mapping, name, text in (("state", STEPS, "control steps"), ("episode", SUCCESS, "success")):
        value = getattr(process, mapping).get(name)
        require(
            value is not None and tuple(value.shape) == (NUM_ENVS,),
            f"{mapping}: expected an entry '{name}' ({text} of the episode) of shape (N,)",
        )


def _check_starts(process: TaskProcess, machine: Machine) -> dict[str, torch.Tensor]:
    """Check the drawn starts; return some of them."""
    start, again = process.starts(NUM_ENVS, 1), process.starts(NUM_ENVS, 1)
    other = process.starts(NUM_ENVS, 2)
    for name in ("q", "scene"):
        require(name in start, f"starts: no '{name}' among {', '.join(start)}")
    for name, value in start.items():
        require(
            len(value) == NUM_ENVS and bool(value.isfinite().all()),
            f"starts: '{name}' is not finite for each of {NUM_ENVS} starts",
        )
        require(is_same(value, again[name]), f"starts: '{name}' differs for the same seed")
    require(not is_same(start["q"], other["q"]), "starts: another seed gives the same arms")
    q = start["q"].cpu().numpy()
    require(
        bool(((q >= machine.lower) & (q <= machine.upper)).all()),
        "starts: an arm begins outside its joint limits",
    )
    return start


def _check_observation(
    process: TaskProcess, history: History, start: dict[str, torch.Tensor]
) -> dict[str, torch.Tensor]:
    """Check the observation after a reset; return copies of its groups."""
    everywhere = torch.ones(NUM_ENVS, dtype=torch.bool, device=start["q"].device)
    torch.manual_seed(0)
    process.reset(everywhere, start)
    groups = copy_tensors(process.observe(history))
    torch.manual_seed(0)
    process.reset(everywhere, start)
    again = process.observe(history)
    require(
        all(is_same(again[name], value) for name, value in groups.items()),
        "reset, observe: the same seed gives another observation",
    )
    require("policy" in groups, f"observe: no group 'policy' among {', '.join(groups)}")
    require_rows(groups, "observe")
    for name, value in groups.items():
        require(
            value.dtype == torch.float32 and bool(value.isfinite().all()),
            f"observe: '{name}' is not finite float32",
        )
    return groups


def _check_commands(process: TaskProcess, machine: Machine, device: torch.device) -> None:
    for size in COMMAND_SIZES:
        u = process.command(size * torch.randn(NUM_ENVS, process.num_actions, device=device))
        require(
            tuple(u.shape) == (NUM_ENVS, machine.num_joints), f"command: got shape {tuple(u.shape)}"
        )
        require(
            bool((u.abs() <= 1).all()),
            "command: leaves [-1, 1]; actions of the policy arrive unclipped",
        )


def _check_optional(
    process: TaskProcess, groups: dict[str, torch.Tensor], machine: Machine
) -> None:
    """Check the optional methods that the task offers."""
    num_actions = process.num_actions
    if "classical_action" in process.offers:
        action = process.classical_action(groups)
        require(
            tuple(action.shape) == (NUM_ENVS, num_actions),
            f"classical_action: got shape {tuple(action.shape)}",
        )
    if "deployable" in process.offers:
        _check_deployment(process, groups["policy"], machine, num_actions)


def _check_deployment(
    process: TaskProcess, vector: torch.Tensor, machine: Machine, num_actions: int
) -> None:
    description = process.describe()
    json.dumps(description)
    size = description["size"]
    encoder = restore_encoder(machine, description)
    require(
        encoder.size == size,
        f"describe: a vector of {size} numbers, but its parts have {encoder.size}",
    )
    require(
        tuple(vector.shape) == (NUM_ENVS, size),
        f"observe: expected a policy vector of {size} numbers",
    )
    policy = process.deployable(_RestingNetwork(num_actions))
    with torch.no_grad():
        u = policy(vector)
    require(
        tuple(u.shape) == (NUM_ENVS, machine.num_joints) and bool((u.abs() <= 1).all()),
        "deployable: expected commands (B, J) in [-1, 1] for policy vectors (B, O)",
    )


class _RestingNetwork(torch.nn.Module):
    """A network whose action is zero."""

    def __init__(self, num_actions: int) -> None:
        super().__init__()
        self._num_actions = num_actions

    def forward(self, groups: dict[str, torch.Tensor]) -> torch.Tensor:
        return groups["policy"].new_zeros(len(groups["policy"]), self._num_actions)


def _check_episode(process: TaskProcess, history: History, device: torch.device) -> None:
    """Run to the time limit with an arm that never moves."""
    world: Any = SimpleNamespace(
        q=history.q[:, -1],
        contact_force_n=torch.zeros(NUM_ENVS, device=device),
        faults=torch.zeros(NUM_ENVS, dtype=torch.bool, device=device),
    )
    kept, timed_out = (
        copy_tensors(vars(history)),
        torch.zeros(NUM_ENVS, dtype=torch.bool, device=device),
    )
    terminated = timed_out.clone()
    for _ in range(process.max_episode_steps):
        step = process.step(history, world)
        for name in ("reward", "terminated", "timed_out", "reason"):
            shape = tuple(getattr(step, name).shape)
            require(shape == (NUM_ENVS,), f"step: '{name}' has shape {shape}")
        require(bool(step.reward.isfinite().all()), "step: the reward is not finite")
        require(
            step.terminated.dtype == step.timed_out.dtype == torch.bool,
            "step: terminated and timed_out must be bool",
        )
        require(
            not bool((step.terminated & step.timed_out).any()),
            "step: an episode both terminated and timed out",
        )
        ended = step.terminated | step.timed_out
        require(
            bool(((step.reason >= 0) == ended).all()),
            "step: reason must be -1 while the episode goes on, and its index where it ended",
        )
        require(
            bool((step.reason < len(process.reasons)).all()),
            "step: reason is no index into reasons",
        )
        process.observe(history)
        timed_out |= step.timed_out
        terminated |= step.terminated
    require(
        bool((timed_out | terminated).all()),
        f"step: no time-out after max_episode_steps = {process.max_episode_steps}",
    )
    require(
        all(is_same(value, kept[name]) for name, value in vars(history).items()),
        "step, observe: changed the history",
    )


def _check_reset_mask(
    process: TaskProcess, start: dict[str, torch.Tensor], device: torch.device
) -> None:
    """Check that a reset of environment 0 leaves the state of the others alone."""
    before = copy_tensors(process.state)
    only_first = torch.arange(NUM_ENVS, device=device) == 0
    process.reset(only_first, start)
    for name, value in process.state.items():
        require(
            is_same(value[1:], before[name][1:]),
            f"reset: state '{name}' changed in environments outside the mask",
        )
