"""Evaluation of a policy: one episode from each of a fixed list of starts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from brokk_rl.contracts.task import REWARD, SUCCESS, Figure, Policy
from brokk_rl.rl.loop import ControlLoop, Starts
from brokk_rl.statistics import compute_wilson_interval

TRAINING_ONLY = ("return", "length")
"""Figures of an episode that training logs and evaluation leaves out."""
CHECKED_EVERY = 8
"""Control steps between two looks at whether an episode still runs, which a GPU has to wait for.
Chosen by hand."""


@dataclass(frozen=True)
class RecordedEpisode:
    """One recorded episode, `T` control steps.

    Attributes:
        t_s: Time, `(T,)`.
        q: Joint positions, `(T, J)`.
        u: Commands, `(T, J)`.
        force_n: Peak contact force of each step, `(T,)`.
        scene: Scene vector, `(S,)`.
        target_m: Target of the tip in the base frame, `(3,)`; `None` where the task has none.
        success: Whether it ended with strict success.
    """

    t_s: np.ndarray
    q: np.ndarray
    u: np.ndarray
    force_n: np.ndarray
    scene: np.ndarray
    target_m: np.ndarray | None
    success: bool


@dataclass(frozen=True)
class PolicyEvaluation:
    """Result of `evaluate_policy`.

    Attributes:
        summary: Fields of `evaluation.json`, without `seed`, `actuator` and `policy`.
        episodes: The recorded episodes.
    """

    summary: dict[str, Any]
    episodes: list[RecordedEpisode]


@torch.no_grad()
def evaluate_policy(
    loop: ControlLoop,
    policy: Policy,
    starts: Starts,
    seed: int,
    num_recorded: int,
    on_step: Callable[[], None] = lambda: None,
) -> PolicyEvaluation:
    """Run one episode from each start.

    Args:
        loop: As many environments as starts.
        policy: Acts.
        starts: Each entry `(N, …)`; the same starts and seed give every policy the same holes,
            errors and noise.
        seed: Seed of the noise.
        num_recorded: Episodes recorded.
        on_step: Called after each of at most `loop.task.max_episode_steps` control steps.
    """
    torch.manual_seed(seed)
    if loop.sensor is not None:
        loop.sensor.begin()
    loop.begin(starts)
    loop.statistics()  # forget episodes of before
    num = loop.num_envs
    running = torch.ones(num, dtype=torch.bool, device=loop.device)
    figures = {name: torch.zeros_like(value) for name, value in loop.finished.items()}
    reason = torch.full((num,), -1.0, device=loop.device)
    tape = []
    groups = loop.get_observations()
    for step in range(loop.task.max_episode_steps):
        if step % CHECKED_EVERY == 0 and not running.any():
            break
        groups, _, done, _ = loop.step(policy.act(dict(groups.items())))  # type: ignore[arg-type]
        # an environment that has finished goes on with further episodes, which do not count
        ended = done & running
        for name, value in loop.finished.items():
            figures[name] = torch.where(ended, value, figures[name])
        reason = torch.where(ended, loop.reason, reason)
        shown = (loop.end_q, loop.end_u, loop.end_force_n, running)
        tape.append([value[:num_recorded].clone() for value in shown])
        running &= ~done
        if loop.sensor is not None:
            loop.sensor.attend(running.cpu().numpy())
        on_step()
    summary = _summarize(figures, reason, loop.task.reasons, loop.task.figures)
    if loop.sensor is not None:
        summary["target"] = loop.sensor.summarize()
    return PolicyEvaluation(
        summary=summary,
        episodes=_collect_episodes(tape, starts, figures[SUCCESS], loop.machine.period_s),
    )


def _summarize(
    figures: dict[str, torch.Tensor],
    reason: torch.Tensor,
    reasons: tuple[str, ...],
    words: Mapping[str, Figure],
) -> dict[str, Any]:
    """Return the fields of `evaluation.json`; a figure without words is reported as its mean."""
    success = figures[SUCCESS].cpu().numpy() > 0
    summary: dict[str, Any] = {"episodes": len(success)}
    for name, value in figures.items():
        if name in TRAINING_ONLY or name.startswith(REWARD):
            continue
        values, word = value.cpu().numpy(), words.get(name)
        if word and word.unit == "share":
            interval = compute_wilson_interval(int((values > 0).sum()), len(values))
            summary[name] = {"mean": float((values > 0).mean()), "ci95": list(interval)}
        elif word and word.of_success:
            times_s = values[success]
            summary[name] = {"median": None, "p95": None}
            if len(times_s):
                p95 = float(np.quantile(times_s, 0.95))
                summary[name] = {"median": float(np.median(times_s)), "p95": p95}
        else:
            summary[name] = float(values.mean())
    endings = reason.cpu().numpy()
    summary["terminations"] = {
        name: int((endings == index).sum()) for index, name in enumerate(reasons)
    }
    return summary


def _collect_episodes(
    tape: Sequence[Sequence[torch.Tensor]], starts: Starts, success: torch.Tensor, period_s: float
) -> list[RecordedEpisode]:
    """Cut positions, commands, forces and running of all steps into one episode per environment."""
    q, u, force_n, running = (torch.stack(steps).cpu().numpy() for steps in zip(*tape, strict=True))
    episodes, targets = [], starts.get("target_m")
    for row in range(q.shape[1]):
        length = max(2, int(running[:, row].sum()))
        first = starts["q"][row].cpu().numpy()[None]
        episodes.append(
            RecordedEpisode(
                t_s=np.arange(length + 1) * period_s,
                q=np.concatenate((first, q[:length, row])),
                u=np.concatenate((np.zeros_like(first), u[:length, row])),
                force_n=np.concatenate(([0.0], force_n[:length, row])),
                scene=starts["scene"][row].cpu().numpy(),
                target_m=None if targets is None else targets[row].cpu().numpy(),
                success=bool(success[row] > 0),
            )
        )
    return episodes
