"""Measurements of speed."""

from __future__ import annotations

from pathlib import Path

from measurement import Measurement, Table, load_json

from rooms.training import TRAINING_CODE

RATES = "brokk mode=bench preset=gpu bench.num_envs=[4096,16384,65536] bench.seconds=0.5 bench.iterations=8 rl.num_starts=4096"


def read_rates(folder: Path) -> Table:
    """Return the rates for each number of worlds."""
    rows: Table = []
    plain = load_json(folder / "bench/benchmark.json")["rows"]
    mixed = load_json(folder / "bench16/benchmark.json")["rows"]
    for one, other in zip(plain, mixed, strict=True):
        row = {
            "worlds": one["num_envs"],
            "physics alone, 1e6 steps/s": round(one["physics_env_steps_per_s"] / 1e6, 2),
            "whole control step, 1e6/s": round(one["env_steps_per_s"] / 1e6, 2),
            "training, 1e6 control steps/s": round(one["train_env_steps_per_s"] / 1e6, 2),
            "training in bfloat16": round(other["train_env_steps_per_s"] / 1e6, 2),
        }
        rows.append(row)
    return rows


MEASUREMENTS = (
    Measurement(
        name="rates",
        title="Control steps a second",
        conditions="Training includes simulation, actuator networks, effects, task and PPO. Physics alone steps resting arms without contact. With 16,384 worlds half of an iteration is the control step, a third the update; the first waits 7 s for `torch.compile`.",
        commands=(
            f"{RATES} session.out={{out}}/bench",
            f"{RATES} rl.runner.algorithm.use_mixed_precision=true session.out={{out}}/bench16",
        ),
        code=TRAINING_CODE,
        read=read_rates,
        where="one GPU of 80 GB, 5 min",
    ),
)
