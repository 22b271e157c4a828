"""Measurements of speed, and of the code that a training runs."""

from __future__ import annotations

from pathlib import Path

from measurement import Measurement, Table, load_json

CODE = ("brokk_rl", "tasks", "actuators/models", "actuators/effects", "conf")
BENCH = "brokk mode=bench preset=gpu bench.num_envs=[16384] session.out={out}/"


def read_rates(folder: Path) -> Table:
    """Return the rates for each number of worlds."""
    rows: Table = []
    for one in load_json(folder / "bench/benchmark.json")["rows"]:
        row = {
            "worlds": one["num_envs"],
            "physics alone, 1e6 steps/s": round(one["physics_env_steps_per_s"] / 1e6, 2),
            "whole control step, 1e6/s": round(one["env_steps_per_s"] / 1e6, 2),
            "training, 1e6 control steps/s": round(one["train_env_steps_per_s"] / 1e6, 2),
        }
        rows.append(row)
    return rows


def read_scaling(folder: Path) -> Table:
    """Return the rates of one, two and four GPUs, and the share of so many times one."""
    rows: Table = []
    rates = {}
    for num_gpus in (1, 2, 4):
        path = folder / f"{num_gpus}/benchmark.json"
        rates[num_gpus] = load_json(path)["train_env_steps_per_s"]
        row = {
            "GPUs": num_gpus,
            "training, 1e6 control steps/s": round(rates[num_gpus] / 1e6, 2),
            "of n times one": round(rates[num_gpus] / (num_gpus * rates[1]), 3),
        }
        rows.append(row)
    return rows


def read_success(folder: Path) -> Table:
    """Return the seconds until the levels of success, a row for each seed."""
    rows: Table = []
    for one in load_json(folder / "sweep/sweep.json")["rows"]:
        row = {"seed": one["seed"]}
        for level in ("0.95", "0.99"):
            row[f"s until {level}"] = one[f"seconds_to_{level}"] - one["first_iteration_s"]
        rows.append({name: round(value, 1) for name, value in row.items()})
    return rows


def read_main_path(folder: Path) -> Table:
    """Return how many files and functions run before the first update ends."""
    counts = (folder / "path.txt").read_text().splitlines()[-1].split(", ")
    return [{count.split()[1]: count.split()[0] for count in counts}]


MEASUREMENTS = (
    Measurement(
        name="rates",
        title="Control steps a second",
        conditions="Training includes simulation, actuator networks, effects, task and PPO. Physics alone steps resting arms without contact; it is the upper bound.",
        commands=(
            "brokk mode=bench preset=gpu bench.num_envs=[4096,16384,65536] bench.seconds=0.5 bench.iterations=8 rl.num_starts=4096 session.out={out}/bench",
        ),
        code=CODE,
        read=read_rates,
        where="one GPU of 80 GB",
        minutes=5,
    ),
    Measurement(
        name="seconds_to_success",
        title="Seconds of training until success",
        conditions="4,096 worlds, five seeds. A level is passed when so large a part of the newest 4,096 episodes of training succeeds, exploration included; "
        "they scatter by 0.0016, so 0.99 is passed a little early. Seconds count from the second iteration, since the first one compiles for up to 10 s. The controller alone has 0.972.",
        commands=(
            "python benchmarks/success_sweep.py {out}/sweep --num-envs 4096 --epochs 4 --mini-batches 8 --seeds 1 2 3 4 5 --max-seconds 60 preset=gpu",
        ),
        code=CODE,
        read=read_success,
        where="one GPU of 80 GB",
        minutes=6,
    ),
    Measurement(
        name="scaling",
        title="Several GPUs",
        conditions="One policy on one, two and four GPUs, 16,384 worlds on each, not fused. The baseline is one GPU.",
        commands=(
            f"{BENCH}1",
            f"torchrun --nproc-per-node=2 .venv/bin/{BENCH}2",
            f"torchrun --nproc-per-node=4 .venv/bin/{BENCH}4",
        ),
        code=CODE,
        read=read_scaling,
        where="four GPUs of one computer",
        minutes=10,
    ),
    Measurement(
        name="main_path",
        title="Code on the way to the first update",
        conditions="Files and functions of the project that run from `brokk mode=train` to the end of the first PPO update.",
        commands=("bash -c 'python benchmarks/main_path.py > {out}/path.txt'",),
        code=("brokk_rl", "tasks", "actuators"),
        read=read_main_path,
        where="one core",
        minutes=2,
    ),
)
