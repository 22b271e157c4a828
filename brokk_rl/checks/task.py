"""Checker of tasks: the promises of `brokk_rl.contracts.task` on which training relies."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import torch

from brokk_rl.checks.exercise import (
    NUM_ENVS,
    build_rest_history,
    check_in_place,
    check_rows,
    check_same,
    copy_tensors,
    is_same,
    isolate_randomness,
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
    """Check a task against `TaskProcess`, and the optional methods that it offers.

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
        places = view_tensors(process.state), view_tensors(process.episode)

        groups = _check_observation(process, history, start)
        _check_commands(process, machine, device)
        _check_optional(process, groups, machine)
        _check_episode(process, history, device)
        check_in_place(process.state, places[0], "state")
        check_in_place(process.episode, places[1], "episode")
        before = copy_tensors(process.state)
        process.reset(torch.arange(NUM_ENVS, device=device) == 0, start)
        for name, value in process.state.items():
            text = f"reset: state '{name}' changed in environments outside the mask"
            assert is_same(value[1:], before[name][1:]), text


def _check_attributes(process: TaskProcess) -> None:
    sizes = (process.num_actions, process.max_episode_steps)
    assert min(sizes) > 0, "num_actions and max_episode_steps: expected 1 or more"
    reasons = process.reasons
    assert len(set(reasons)) == len(reasons), f"reasons: expected different names, got {reasons}"
    assert FAULT in reasons, f"reasons: expected '{FAULT}', for worlds that diverged, in {reasons}"
    check_rows(process.state, "state")
    check_rows(process.episode, "episode")
    for mapping, name in (("state", STEPS), ("episode", SUCCESS)):
        value = getattr(process, mapping).get(name)
        is_good = value is not None and value.shape == (NUM_ENVS,)
        assert is_good, f"{mapping}: expected an entry '{name}' of shape (N,)"
    unknown = process.figures.keys() - process.episode.keys()
    assert not unknown, f"figures: there is no {', '.join(unknown)} in episode"


def _check_starts(process: TaskProcess, machine: Machine) -> dict[str, torch.Tensor]:
    """Check the drawn starts; return some of them."""
    start, again = process.starts(NUM_ENVS, 1), process.starts(NUM_ENVS, 1)
    other = process.starts(NUM_ENVS, 2)
    for name in ("q", "scene"):
        assert name in start, f"starts: no '{name}' among {', '.join(start)}"
    check_rows(start, "starts")
    for name, value in start.items():
        assert value.isfinite().all(), f"starts: '{name}' is not finite"
        assert is_same(value, again[name]), f"starts: '{name}' differs for the same seed"
    assert not is_same(start["q"], other["q"]), "starts: another seed gives the same arms"
    q = start["q"].cpu().numpy()
    inside = (q >= machine.lower) & (q <= machine.upper)
    assert inside.all(), "starts: an arm begins outside its joint limits"
    return start


def _check_observation(
    process: TaskProcess, history: History, start: dict[str, torch.Tensor]
) -> dict[str, torch.Tensor]:
    """Check the observation after a reset; return copies of its groups."""
    everywhere = torch.ones(NUM_ENVS, dtype=torch.bool, device=start["q"].device)
    found = []
    for _ in range(2):
        torch.manual_seed(0)
        process.reset(everywhere, start)
        found.append(copy_tensors(process.observe(history)))
    groups, again = found
    check_same(again, groups, "reset, observe: the same seed gives another observation")
    assert "policy" in groups, f"observe: no group 'policy' among {', '.join(groups)}"
    check_rows(groups, "observe")
    for name, value in groups.items():
        is_good = value.dtype == torch.float32 and bool(value.isfinite().all())
        assert is_good, f"observe: '{name}' is not finite float32"
    return groups


def _check_commands(process: TaskProcess, machine: Machine, device: torch.device) -> None:
    for size in COMMAND_SIZES:
        u = process.command(size * torch.randn(NUM_ENVS, process.num_actions, device=device))
        assert u.shape == (NUM_ENVS, machine.num_joints), f"command: got shape {tuple(u.shape)}"
        text = "command: leaves [-1, 1]; actions of the policy arrive unclipped"
        assert (u.abs() <= 1).all(), text


def _check_optional(
    process: TaskProcess, groups: dict[str, torch.Tensor], machine: Machine
) -> None:
    """Check the optional methods that need no particular target."""
    num_actions = process.num_actions
    if "classical_action" in process.offers:
        shape = tuple(process.classical_action(groups).shape)
        assert shape == (NUM_ENVS, num_actions), f"classical_action: got shape {shape}"
    if "deployable" not in process.offers:
        return
    vector, description = groups["policy"], process.describe()
    json.dumps(description)
    size = description["size"]
    known = restore_encoder(machine, description).size
    assert known == size, f"describe: a vector of {size} numbers, but its parts have {known}"
    assert vector.shape == (NUM_ENVS, size), f"observe: expected a policy vector of {size} numbers"
    with torch.no_grad():
        u = process.deployable(_RestingNetwork(num_actions))(vector)
    is_command = u.shape == (NUM_ENVS, machine.num_joints) and bool((u.abs() <= 1).all())
    text = "deployable: expected commands (B, J) in [-1, 1] for policy vectors (B, O)"
    assert is_command, text


class _RestingNetwork(torch.nn.Module):
    """A network whose action is zero."""

    def __init__(self, num_actions: int) -> None:
        super().__init__()
        self._num_actions = num_actions

    def forward(self, groups: dict[str, torch.Tensor]) -> torch.Tensor:
        return groups["policy"].new_zeros(len(groups["policy"]), self._num_actions)


def _check_episode(process: TaskProcess, history: History, device: torch.device) -> None:
    """Run to the time limit with an arm that never moves."""
    nowhere = torch.zeros(NUM_ENVS, dtype=torch.bool, device=device)
    force_n = torch.zeros(NUM_ENVS, device=device)
    world: Any = SimpleNamespace(q=history.q[:, -1], contact_force_n=force_n, faults=nowhere)
    kept, over = copy_tensors(vars(history)), nowhere.clone()
    for _ in range(process.max_episode_steps):
        step = process.step(history, world)
        for name, value in vars(step).items():
            shape = tuple(value.shape)
            assert shape == (NUM_ENVS,), f"step: '{name}' has shape {shape}"
        assert step.reward.isfinite().all(), "step: the reward is not finite"
        is_bool = step.terminated.dtype == step.timed_out.dtype == torch.bool
        assert is_bool, "step: terminated and timed_out must be bool"
        both = step.terminated & step.timed_out
        assert not both.any(), "step: an episode both terminated and timed out"
        ended = step.terminated | step.timed_out
        text = "reason must be -1 while the episode goes on, and its index where it ended"
        assert ((step.reason >= 0) == ended).all(), f"step: {text}"
        is_index = step.reason < len(process.reasons)
        assert is_index.all(), "step: reason is no index into reasons"
        process.observe(history)
        over |= ended
    text = f"step: no time-out after max_episode_steps = {process.max_episode_steps}"
    assert over.all(), text
    check_same(vars(history), kept, "step, observe: changed the history")
