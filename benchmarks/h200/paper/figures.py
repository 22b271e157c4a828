"""Draws the figures of the paper that a simulation can make.

    python benchmarks/h200/paper/figures.py <results.jsonl> <bundle> <folder>

`results.jsonl` and the bundle come from `benchmarks/h200/train_jobs.py`. The names of jobs end in
their seed (`found_3`), and those of one prefix are one curve. Writes `curves.png` (reward and
success by the paper's criterion while learning) and `trajectories.png` (path of the chisel from
some starts, and the commands of one of them).
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from brokk_rl.build import build_node
from brokk_rl.extensions import load_mode
from brokk_rl.kinematics import Kinematics
from brokk_rl.policy_folder import describe_spec, find_policy
from brokk_rl.rl.evaluation import RecordedEpisode, evaluate_policy
from brokk_rl.rl.loop import SimulatedPlant
from brokk_rl.rl.policy import TrainedPolicy

NUM_PATHS = 8
"""Episodes whose path is shown."""
WHOLE = 0.95
"""Part of the largest budget of a prefix below which a training was cut short and is not drawn."""
CPU = ("session.device=cpu", "sim=native")
COLUMNS = {"return": "Reward of an episode", "success_paper": "Success by the paper's criterion"}


def main() -> None:
    """Draw all figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("results", type=Path)
    parser.add_argument("bundle", type=Path)
    parser.add_argument("folder", type=Path)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    with options.results.open() as file:
        lines = [json.loads(line) for line in file]
    draw_curves([line for line in lines if "curve" in line], options.folder / "curves.png")
    words = next(line["words"] for line in lines if line["name"] == options.bundle.name)
    draw_trajectories(words, options.bundle, options.folder / "trajectories.png")


def draw_curves(lines: list[dict[str, Any]], picture: Path) -> None:
    """Draw reward and success of each prefix: the mean over seeds, and each seed thinly."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for line in lines:
        groups.setdefault(line["name"].rpartition("_")[0], []).append(line)
    figure = Figure(figsize=(10, 3.8), layout="constrained")
    for axis, (column, title) in zip(figure.subplots(1, 2), COLUMNS.items(), strict=True):
        for index, (name, group) in enumerate(groups.items()):
            whole = WHOLE * max(run["env_steps"] for run in group)
            runs = [run for run in group if run["env_steps"] >= whole]
            last = min(run["curve"]["env_steps"][-1] for run in runs)
            steps = np.linspace(0, last, 200)
            values = []
            for run in runs:
                curve = run["curve"]
                scale = read_scale(run["words"]) if column == "return" else 1.0
                values.append(np.interp(steps, curve["env_steps"], curve[column]) / scale)
                axis.plot(steps / 1e6, values[-1], color=f"C{index}", alpha=0.3, linewidth=0.7)
            axis.plot(steps / 1e6, np.mean(values, 0), color=f"C{index}", label=name)
        axis.set_title(title, loc="left", fontsize=10)
        axis.set_xlabel("control steps, millions")
        axis.grid(alpha=0.3)
        axis.legend(frameon=False, fontsize=8)
    figure.savefig(picture, dpi=130)


def read_scale(words: list[str]) -> float:
    """Return the weight of the paper's r^d in a training, whose reward is so much smaller."""
    return float(compose(words).task.reward["distance"].weight)


def draw_trajectories(words: list[str], bundle: Path, picture: Path) -> None:
    """Draw paths of the chisel's tip from above and from the side, and one episode's commands."""
    spec = compose([*words, *CPU])
    trained = TrainedPolicy(path=str(bundle), task=None)
    config = SimulatedPlant(
        machine=spec.machine,
        sim=spec.sim,
        task=build_node(find_policy(trained.path).task.apply_to(describe_spec(spec.task)), "task"),
        actuator=spec.actuator,
        effect=spec.effect,
        follower=spec.follower,
        event=spec.event,
    )
    torch.manual_seed(spec.evaluation.seed)
    loop = config.build(torch.device("cpu"), NUM_PATHS, NUM_PATHS, spec.evaluation.seed)
    policy = trained.build(loop, 0)
    seed, starts = spec.evaluation.seed, loop.starts
    episodes = evaluate_policy(loop, policy, starts, seed, NUM_PATHS).episodes
    figure = Figure(figsize=(13, 4.2), layout="constrained")
    above, side, levers = figure.subplots(1, 3)
    for index, episode in enumerate(episodes):
        draw_path(spec.machine, episode, f"C{index}", above, side)
    above.set_aspect("equal")
    for axis, title, x, y in (
        (above, "From above", "x, m", "y, m"),
        (side, "From the side", "distance from the slew axis, m", "height, m"),
        (levers, "Commands of the first episode", "s", "share of full valve opening"),
    ):
        axis.set_title(title, loc="left", fontsize=10)
        axis.set_xlabel(x)
        axis.set_ylabel(y)
        axis.grid(alpha=0.3)
    for joint, name in enumerate(spec.machine.joint_names):
        levers.plot(episodes[0].t_s, episodes[0].u[:, joint], label=name, linewidth=1)
    levers.legend(frameon=False, fontsize=8)
    figure.savefig(picture, dpi=130)


def draw_path(machine: Any, episode: RecordedEpisode, color: str, above: Any, side: Any) -> None:
    """Draw the path of one episode: a star at its start, a dot at its end, a cross at the hole."""
    q = torch.as_tensor(episode.q, dtype=torch.float32)
    tip = Kinematics(machine).pose(q).tip_in_base_m.numpy()
    for axis, points in (
        (above, tip[:, :2]),
        (side, np.stack((np.hypot(tip[:, 0], tip[:, 1]), tip[:, 2]), 1)),
    ):
        axis.plot(*points.T, color=color, linewidth=1)
        axis.plot(*points[0], "*", color=color, markersize=9)
        axis.plot(*points[-1], "o", color=color, markersize=5)
    x, y, z = episode.scene[:3]
    above.plot(x, y, "x", color="black", markersize=6)
    side.plot(np.hypot(x, y), z, "x", color="black", markersize=6)


def compose(words: list[str]) -> Any:
    """Return the training that words of the command line ask for."""
    return load_mode("mode=train", "session.out=unused", *words)


if __name__ == "__main__":
    main()
