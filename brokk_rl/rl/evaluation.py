"""Evaluating a policy: one episode from each of a fixed list of starts, figures with intervals, and a few episodes to look at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from brokk_rl.contracts.task import Policy
from brokk_rl.intervals import compute_wilson_interval
from brokk_rl.rl.vec_env import ControlLoop, Starts


@dataclass(frozen=True)
class RecordedEpisode:
    """One recorded episode, `T` control steps.

    Attributes:
        t_s: Time, `(T,)`.
        q: Joint positions, `(T, J)`.
        u: Commands, `(T, J)`.
        force_n: Peak contact force of each step, `(T,)`.
        scene: Scene vector, `(S,)`.
        success: Whether it ended inserted.
    """

    t_s: np.ndarray
    q: np.ndarray
    u: np.ndarray
    force_n: np.ndarray
    scene: np.ndarray
    success: bool


@torch.no_grad()
def evaluate_policy(
    loop: ControlLoop, policy: Policy, starts: Starts, seed: int, num_recorded: int
) -> tuple[dict[str, Any], list[RecordedEpisode], torch.Tensor]:
    """Runs one episode from each start.

    Args:
        loop: As many environments as starts.
        policy: Acts.
        starts: Each entry `(N, …)`; the same starts and seed give every policy the same holes,
            errors and noise.
        seed: Seed of the noise.
        num_recorded: Episodes recorded.

    Returns:
        The fields of `evaluation.json` (without `seed`, `actuator`, `policy`), the recorded
        episodes, and some hundreds of observation vectors `(B, O)`.
    """
    torch.manual_seed(seed)
    loop.begin(starts)
    loop.statistics()
    num = loop.num_envs
    running = torch.ones(num, dtype=torch.bool, device=loop.device)
    figures = {name: torch.zeros_like(value) for name, value in loop.finished.items()}
    reason = torch.full((num,), -1.0, device=loop.device)
    tape: list[tuple[torch.Tensor, ...]] = []
    seen: list[torch.Tensor] = []
    groups = loop.get_observations()
    for step in range(loop.task.max_episode_steps):
        if step % 8 == 0:
            seen.append(groups["policy"][:16].clone())
            if not running.any():
                break
        groups, _, done, _ = loop.step(policy.act(dict(groups.items())))  # type: ignore[arg-type]
        now = done & running
        for name, value in loop.finished.items():
            figures[name] = torch.where(now, value, figures[name])
        reason = torch.where(now, loop.reason, reason)
        tape.append(
            tuple(
                part[:num_recorded].clone()
                for part in (loop.end_q, loop.end_u, loop.end_force_n, running)
            )
        )
        running &= ~done
    return (
        _summarize(figures, reason, loop),
        _collect_episodes(tape, starts, figures, loop),
        torch.cat(seen),
    )


def _summarize(
    figures: dict[str, torch.Tensor], reason: torch.Tensor, loop: ControlLoop
) -> dict[str, Any]:
    table = {name: value.cpu().numpy() for name, value in figures.items()}
    strict, paper = table["success_strict"] > 0, table["success_paper"] > 0
    times = table["time_to_insert_s"][strict]
    endings = reason.cpu().numpy()
    return {
        "episodes": len(strict),
        "success_strict": _estimate_share(strict),
        "success_paper": _estimate_share(paper),
        "time_to_insert_s": {
            "median": float(np.median(times)) if len(times) else None,
            "p95": float(np.quantile(times, 0.95)) if len(times) else None,
        },
        "lateral_error_m": float(table["lateral_error_m"].mean()),
        "peak_force_n": float(table["peak_force_n"].mean()),
        "valve_travel": float(table["valve_travel"].mean()),
        "terminations": {
            name: int((endings == index).sum()) for index, name in enumerate(loop.task.reasons)
        },
    }


def _estimate_share(happened: np.ndarray) -> dict[str, Any]:
    low, high = compute_wilson_interval(int(happened.sum()), len(happened))
    return {"mean": float(happened.mean()), "ci95": [low, high]}


def _collect_episodes(
    tape: list[tuple[torch.Tensor, ...]],
    starts: Starts,
    figures: dict[str, torch.Tensor],
    loop: ControlLoop,
) -> list[RecordedEpisode]:
    q, u, force, running = (torch.stack(parts).cpu().numpy() for parts in zip(*tape, strict=True))
    episodes = []
    for row in range(q.shape[1]):
        length = max(2, int(running[:, row].sum()))
        first = starts["q"][row].cpu().numpy()[None]
        episodes.append(
            RecordedEpisode(
                t_s=np.arange(length + 1) * loop.machine.period_s,
                q=np.concatenate((first, q[:length, row])),
                u=np.concatenate((np.zeros_like(first), u[:length, row])),
                force_n=np.concatenate(([0.0], force[:length, row])),
                scene=starts["scene"][row].cpu().numpy(),
                success=bool(figures["success_strict"][row] > 0),
            )
        )
    return episodes
