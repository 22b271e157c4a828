"""Rates of control steps by actuator model, and episodes of shipped and classical policy on each plant.

python benchmarks/h200/plants/rates.py <folder> [<number of environments> …]
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import hydra
import torch
from hydra.utils import instantiate

from brokk_rl.rl.evaluation import evaluate_policy
from brokk_rl.rl.loop import SimulatedPlant
from brokk_rl.rl.policy import TrainedPolicy

ACTUATORS = ("mlp", "hydraulic", "load_sensing", "post_compensated", "open_center")
STEPS = 200


def main(folder: Path, counts: list[int]) -> None:
    """Measure; write `rates.json`."""
    folder.mkdir(parents=True, exist_ok=True)
    rows, starts = [], None
    for num in counts:
        for actuator in ACTUATORS:
            overrides = ["mode=evaluate", "sim=warp", f"actuator={actuator}"]
            with hydra.initialize_config_module("conf", version_base="1.3"):
                cfg = hydra.compose("config", overrides=overrides)
            parts = {
                name: instantiate(cfg[name], _convert_="all")
                for name in ("machine", "sim", "task", "actuator", "follower")
            }
            config = SimulatedPlant(
                **parts, effect=instantiate(cfg.effect, _convert_="all"), event={}
            )
            torch.manual_seed(1024)
            loop = config.build(torch.device("cuda"), num, 1024, 1024, starts)
            starts = loop.starts
            loop.capture()
            action = torch.zeros(num, loop.num_actions, device="cuda")
            torch.cuda.synchronize()
            begun = time.monotonic()
            for _ in range(STEPS):
                loop.step(action)
            torch.cuda.synchronize()
            row = {
                "actuator": actuator,
                "num_envs": num,
                "env_steps_per_s": num * STEPS / (time.monotonic() - begun),
                "fault_rate": loop.statistics()["fault_rate"],
            }
            if num == 1024:
                trained = TrainedPolicy(path="tasks:policies/borehole_insertion", task=None)
                for name, policy in (
                    ("trained", trained),
                    ("classical", instantiate(cfg["rivals"]["classical"])),
                ):
                    result = evaluate_policy(loop, policy.build(loop, 0), starts, 1024, 1)
                    row[name] = result.summary
            rows.append(row)
            print(json.dumps(row), flush=True)
            (folder / "rates.json").write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main(Path(sys.argv[1]), [int(n) for n in sys.argv[2:]] or [1024, 16384])
