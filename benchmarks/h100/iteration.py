"""Measures the parts of one iteration of a training on a GPU, in several precisions.

    python benchmarks/h100/iteration.py <worlds> <folder> eager,fused,bf16,fp32

It writes `iteration_<worlds>.json`: for each variant five iterations, and acting, control steps and
storing by themselves. `eager` is `rl.fuse=false` for PPO; the control step is fused in all of them.
"""

from __future__ import annotations

import copy
import json
import sys
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "h200"))
from train_jobs import build, compose  # pyright: ignore[reportMissingImports]

from brokk_rl.rl.runner import TrainingRunner, allow_tensor_cores

VARIANTS = {
    "eager": (False, True, False),
    "fused": (True, True, False),
    "bf16": (True, True, True),
    "fp32": (True, False, False),
}
"""`rl.fuse` of PPO, `rl.tf32`, `use_mixed_precision`."""
NUM_STEPS = 24


def wait() -> float:
    """Return the time in seconds once the GPU is done."""
    torch.cuda.synchronize()
    return time.perf_counter()


def main() -> None:
    """Measure the variants one after another on the same control loop."""
    num_envs, folder, names = int(sys.argv[1]), Path(sys.argv[2]), sys.argv[3].split(",")
    folder.mkdir(parents=True, exist_ok=True)
    words = ["preset=gpu", f"sim.num_worlds={num_envs}", "rl.num_starts=4096"]
    spec = compose([*words, "sim.parity_worlds=0"])
    loop = build(spec, num_envs, 4096, 7, folder)
    loop.capture(True)
    device = torch.device("cuda")
    found: dict[str, Any] = {}
    for name in names:
        fuse, tf32, mixed = VARIANTS[name]
        torch._dynamo.reset()
        torch.manual_seed(0)
        begun_s = time.time()
        runner_config = copy.deepcopy(spec.rl.runner)
        runner_config["algorithm"]["use_mixed_precision"] = mixed
        training = replace(spec.rl, runner=runner_config, fuse=fuse, tf32=tf32)
        runner = TrainingRunner(loop, training, folder)
        learner = cast(Any, runner.alg)
        rows, first_s = [], 0.0
        with allow_tensor_cores(tf32):
            for number in range(6):
                times = [wait()]
                with torch.inference_mode():
                    seen = loop.get_observations()
                    for _ in range(NUM_STEPS):
                        action = learner.act(seen)
                        seen, reward, done, extras = loop.step(action)
                        learner.process_env_step(seen, reward, done, extras)
                    times.append(wait())
                    learner.compute_returns(seen)
                    times.append(wait())
                if number:  # once by itself: the update does it again
                    learner.shuffle(torch.randperm(num_envs * NUM_STEPS, device=device))
                times.append(wait())
                figures = learner.update()
                times.append(wait())
                rows.append([round(1e3 * (b - a), 2) for a, b in pairwise(times)])
                if number == 0:
                    first_s = time.time() - begun_s
            with torch.inference_mode():
                times = [wait()]
                for _ in range(NUM_STEPS):
                    learner.act(seen)
                times.append(wait())
                for _ in range(NUM_STEPS):
                    loop.step(action)
                times.append(wait())
                for _ in range(NUM_STEPS):
                    learner.process_env_step(seen, reward, done, extras)
                times.append(wait())
                learner.storage.clear()
        parts = [1e3 * (b - a) for a, b in pairwise(times)]
        found[name] = {
            "first_s": first_s,
            "collect_returns_shuffle_update_ms": rows,
            **dict(zip(("act_ms", "step_ms", "store_ms"), parts, strict=True)),
            "figures": figures,
            "mem": torch.cuda.max_memory_allocated() / 1e9,
        }
    (folder / f"iteration_{num_envs}.json").write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
