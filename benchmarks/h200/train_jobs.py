"""Trains many policies one after another in one process, and writes one JSON line for each.

    python benchmarks/h200/train_jobs.py <jobs.jsonl> <folder> --seconds 400 [words for all …]

A line of the jobs: `{"name": …, "words": […], "evaluate": [[…], …], "after": …, "seconds": …}`.
`words` are those of `brokk mode=train`. `evaluate` holds further words for one evaluation each
beside that under the conditions of the training, or under those of the words `evaluated_as`.
`after` names a job whose bundle this one needs, in `{folder}/<name>`. `seconds` bounds the
training; a job for which less than `least_s` is left is not begun. With `"classical": true` nothing is
trained, and the classical controller is evaluated.

Several such processes share a folder and its jobs. The numbers are those of `brokk mode=train`
with the same words, but that the starts are drawn once for all jobs of a task (`--start-seed`),
that there are no checkpoints, and that neither rivals nor an export follow. It saves the minute
that a process of its own spends on all of it.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import logging
import os
import shutil
import time
import traceback
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from brokk_rl.contracts.task import Policy
from brokk_rl.extensions import load_mode
from brokk_rl.modes.train import Train
from brokk_rl.policy_folder import describe_policy, write_policy
from brokk_rl.rl.evaluation import evaluate_policy
from brokk_rl.rl.group import TrainingGroup
from brokk_rl.rl.logger import PROGRESS
from brokk_rl.rl.loop import ControlLoop, SimulatedPlant, Starts
from brokk_rl.rl.policy import ClassicalPolicy, NetworkPolicy
from brokk_rl.rl.runner import TrainingRunner

log = logging.getLogger("train_jobs")
COLUMNS = {
    "seconds": "seconds",
    "env_steps": "env_steps",
    "episode/success_strict": "success_strict",
    "episode/success_paper": "success_paper",
    "episode/return": "return",
    "episode/length": "length",
    "episode/peak_force_n": "peak_force_n",
    "episode/valve_travel": "valve_travel",
    "episode/end/joint_limit": "joint_limits",
    "episodes": "episodes",
    "policy/action_std": "action_std",
    "policy/learning_rate": "learning_rate",
    "loss/value": "value_loss",
}
"""Columns of `progress.csv` that a learning curve keeps, and their names there."""
NUM_POINTS = 80
"""Points of a learning curve."""
SETTING_UP_S = 15.0
"""Time kept free for the set-up and the evaluations of a job."""
LEAST_S = 15.0
"""A training for which less time is left is not begun."""


def main() -> None:
    """Run the jobs that no other process has taken, while there is time."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("jobs", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seconds", type=float, required=True, help="until the last job is done")
    parser.add_argument("--start-seed", type=int, default=77, help="seed of the training's starts")
    parser.add_argument("--name", default="0", help="of this process, for its file of results")
    options, words = parser.parse_known_args()
    logging.basicConfig(level=logging.INFO, format=f"%(asctime)s {options.name} %(message)s")
    end_s = time.time() + options.seconds
    with options.jobs.open() as file:
        jobs = [json.loads(line) for line in file if line.strip()]
    (options.folder / "taken").mkdir(parents=True, exist_ok=True)
    for job in take_jobs(jobs, options.folder, end_s):
        left_s = min(end_s - time.time() - SETTING_UP_S, job.get("seconds", float("inf")))
        try:
            line = run_job(job, [*words, f"rl.budget.max_seconds={left_s:.0f}"], options)
        except Exception:
            line = {"name": job["name"], "words": job["words"], "error": traceback.format_exc()}
            log.exception("%s failed", job["name"])
        with (options.folder / f"results_{options.name}.jsonl").open("a") as file:
            file.write(json.dumps(line) + "\n")
        log.info("%s: %s", job["name"], {k: tell(v) for k, v in line.get("results", {}).items()})
        torch.cuda.empty_cache()


def take_jobs(jobs: list[dict], folder: Path, end_s: float) -> Iterator[dict]:
    """Yield the first job that no other process has taken and that waits for none, and again."""
    while time.time() + SETTING_UP_S + LEAST_S < end_s:
        left = [job for job in jobs if not (folder / "taken" / job["name"]).exists()]
        if not left:
            return
        for job in left:
            if "after" in job and not (folder / job["after"] / "policy.json").exists():
                continue
            if end_s - time.time() < job.get("least_s", 0.0):
                continue
            try:
                os.close(os.open(folder / "taken" / job["name"], os.O_CREAT | os.O_EXCL))
            except FileExistsError:
                continue
            yield job
            break
        else:
            time.sleep(1.0)


def run_job(job: dict, words: list[str], options: argparse.Namespace) -> dict[str, Any]:
    """Train and evaluate; return the line of the results."""
    own = [word.replace("{folder}", str(options.folder.resolve())) for word in job["words"]]
    spec = compose([*own, *words])
    line: dict[str, Any] = {"name": job["name"], "words": job["words"], "results": {}}
    actor = None
    if not job.get("classical"):
        actor, facts = train(spec, options.folder / job["name"], options)
        line |= facts
    seen = job.get("evaluated_as", own)
    for more in ([], *job.get("evaluate", [])):
        there = compose([*seen, *words, *more])
        line["results"][" ".join(more) or "own"] = evaluate(there, actor, options)
    return line


def compose(words: list[str]) -> Train:
    """Return the training that words of the command line ask for."""
    return load_mode("mode=train", "session.out=unused", *words)


def train(spec: Train, folder: Path, options: argparse.Namespace) -> tuple[Any, dict[str, Any]]:
    """Train; return the actor, and facts with the learning curve."""
    begun_s = time.time()
    device = spec.session.torch_device()
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    loop = build(spec, spec.rl.num_envs, spec.rl.num_starts, options.start_seed, options.folder)
    if spec.rl.near_starts:
        loop.bring_near(spec.rl.near_starts, options.start_seed)
    loop.capture(spec.rl.fuse)
    ready_s = time.time()
    (options.folder / "taken" / "first_loop").touch()
    spec.session.seed_all()
    group = TrainingGroup(device)
    with group:
        training = replace(spec.rl, save_interval=10**6, keep_checkpoints=1)
        runner = TrainingRunner(loop, training, folder, group)
        runner.run()
    logger = runner.logger
    actor = runner.alg.get_policy()
    facts = {
        "env_steps": logger.env_steps,
        "seconds": round(logger.seconds, 2),
        "seed": spec.session.seed,
        "num_envs": loop.num_envs,
        "set_up_s": round(ready_s - begun_s, 2),
        "device": torch.cuda.get_device_name() if device.type == "cuda" else "cpu",
    }
    contract = describe_policy(
        spec.rl.describe_network(),
        loop.task,
        loop.description,
        spec.machine,
        actuator=spec.actuator,
    )
    write_policy(folder, contract | {"trained": facts}, actor.state_dict())
    for checkpoint in folder.glob("model_*.pt"):
        checkpoint.unlink()
    return actor, facts | {"curve": read_curve(folder / PROGRESS)}


def evaluate(spec: Train, actor: Any, options: argparse.Namespace) -> dict[str, Any]:
    """Evaluate an actor, or the classical controller, as `mode=evaluate` does."""
    number, seed = spec.evaluation.episodes, spec.evaluation.seed
    torch.manual_seed(seed)  # effects draw from it, too
    loop = build(spec, number, number, seed, options.folder)
    loop.capture()
    policy: Policy = (
        NetworkPolicy(actor, loop) if actor else ClassicalPolicy(task=None).build(loop, 0)
    )
    return evaluate_policy(loop, policy, loop.starts, seed, 1).summary


def build(spec: Train, num_envs: int | None, pool: int, seed: int, folder: Path) -> ControlLoop:
    """Return the control loop of a training, with starts that are drawn once for all of a task."""
    config = SimulatedPlant(
        machine=spec.machine,
        sim=spec.sim,
        task=spec.task,
        actuator=spec.actuator,
        effect=spec.effect,
        follower=spec.follower,
        event=spec.event,
    )
    starts = draw_starts(spec, pool, seed, folder)
    device = spec.session.torch_device()
    starts = {name: value.to(device) for name, value in starts.items()}
    return config.build(device, num_envs, pool, seed, starts)


def draw_starts(spec: Train, pool: int, seed: int, folder: Path) -> Starts:
    """Return starts, from a file where they have been drawn before."""
    task: Any = spec.task
    parts = (task.depth_m, task.hole, task.arms, task.success, task.classical, task.switch.reach_m)
    key = hashlib.sha256(repr((parts, pool, seed)).encode()).hexdigest()[:12]
    path = folder / f"starts_{key}.pt"
    if not path.exists():
        process = task.build(spec.machine, 1, torch.device("cpu"))
        part = path.with_suffix(f".{os.getpid()}")
        torch.save(dict(process.starts(pool, seed)), part)
        part.replace(path)
    return torch.load(path)


def read_curve(path: Path) -> dict[str, list[float]]:
    """Return some rows of `progress.csv`, the last among them, by column."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    every = max(1, len(rows) // NUM_POINTS)
    kept = rows[(len(rows) - 1) % every :: every]
    curve = {}
    for column, name in COLUMNS.items():
        if column in rows[0]:
            curve[name] = [float(f"{float(row[column]):.4g}") for row in kept]
    return curve


def tell(result: dict[str, Any]) -> str:
    """Return the figures of an evaluation that a line of the log shows."""
    strict, paper = result["success_strict"]["mean"], result["success_paper"]["mean"]
    return (
        f"strict {strict:.3f}, paper's {paper:.3f}, travel {result['valve_travel']:.2f} /s, "
        f"force {result['peak_force_n']:.0f} N"
    )


if __name__ == "__main__":
    main()
