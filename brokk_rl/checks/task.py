"""Checker of tasks."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import torch

from brokk_rl import observation
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
from brokk_rl.contracts.task import Task, TaskProcess
from brokk_rl.history import History
from brokk_rl.machine import Machine


def check_task(task: Task, machine: Machine, device: torch.device | str = "cpu") -> None:
    """Checks what `Task.build` returns against `TaskProcess`; nothing moves while it does."""
    device = torch.device(device)
    with isolate_randomness():
        process = task.build(machine, NUM_ENVS, device)
        require(
            process.num_actions > 0 and process.max_episode_steps > 0,
            "num_actions and max_episode_steps: expected 1 or more",
        )
        require(
            len(set(process.reasons)) == len(process.reasons) > 0,
            f"reasons: expected different names, got {process.reasons}",
        )
        json.dumps(process.describe())
        start = {name: value.to(device) for name, value in _check_starts(process, machine).items()}
        everywhere = torch.ones(NUM_ENVS, dtype=torch.bool, device=device)
        history = build_rest_history(machine, device, start["q"])
        require_rows(process.state, "state")
        require_rows(process.episode, "episode")
        place = view_tensors(process.state), view_tensors(process.episode)

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
        size = process.describe()["size"]
        own = [
            observation.compute_size(machine, pitch, proposals)
            for proposals in (False, True)
            for pitch in (False, True)
        ]
        require(
            size in own,
            f"describe: a vector of {size} numbers, expected one of brokk_rl.observation, {own}",
        )
        require(
            tuple(groups["policy"].shape) == (NUM_ENVS, size),
            f"observe: expected a policy vector of {size} numbers",
        )
        for name, value in groups.items():
            require(
                value.dtype == torch.float32 and bool(value.isfinite().all()),
                f"observe: '{name}' is not finite float32",
            )
        action = process.classical_action(groups)
        require(
            tuple(action.shape) == (NUM_ENVS, process.num_actions),
            f"classical_action: got shape {tuple(action.shape)}",
        )

        _check_commands(process, machine, device)
        _check_episode(process, history, device)
        kept_place = is_in_place(process.state, place[0]) and is_in_place(process.episode, place[1])
        require(
            kept_place, "state, episode: a tensor moved or changed its shape; write it in place"
        )
        before = copy_tensors(process.state)
        some = everywhere.clone()
        some[1:] = False
        process.reset(some, start)
        for name, value in process.state.items():
            require(
                is_same(value[1:], before[name][1:]),
                f"reset: state '{name}' changed in environments outside the mask",
            )


def _check_starts(process: TaskProcess, machine: Machine) -> dict[str, torch.Tensor]:
    start, again, other = (
        process.starts(NUM_ENVS, 1),
        process.starts(NUM_ENVS, 1),
        process.starts(NUM_ENVS, 2),
    )
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


def _check_commands(process: TaskProcess, machine: Machine, device: torch.device) -> None:
    for size in (0.0, 0.5, 100.0):
        u = process.command(size * torch.randn(NUM_ENVS, process.num_actions, device=device))
        require(
            tuple(u.shape) == (NUM_ENVS, machine.num_joints), f"command: got shape {tuple(u.shape)}"
        )
        require(
            bool((u.abs() <= 1).all()),
            "command: leaves [-1, 1]; actions of the policy arrive unclipped",
        )


def _check_episode(process: TaskProcess, history: History, device: torch.device) -> None:
    """Runs to the time limit with an arm that never moves."""
    world: Any = SimpleNamespace(
        q=history.q[:, -1],
        contact_force_n=torch.zeros(NUM_ENVS, device=device),
        faults=torch.zeros(NUM_ENVS, dtype=torch.bool, device=device),
    )
    kept, timed_out = (
        copy_tensors(vars(history)),
        torch.zeros(NUM_ENVS, dtype=torch.bool, device=device),
    )
    over = timed_out.clone()
    for _ in range(process.max_episode_steps):
        step = process.step(history, world)
        for name in ("reward", "terminated", "timed_out", "reason"):
            require(
                tuple(getattr(step, name).shape) == (NUM_ENVS,),
                f"step: '{name}' has shape {tuple(getattr(step, name).shape)}",
            )
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
        over |= step.terminated
    require(
        bool((timed_out | over).all()),
        f"step: no time-out after max_episode_steps = {process.max_episode_steps}",
    )
    require(
        all(is_same(value, kept[name]) for name, value in vars(history).items()),
        "step, observe: changed the history",
    )
