"""A policy trained behind a person, made ready for the machine: python benchmarks/deploy/person_bundle.py <trained> <folder>.

`<trained>` holds weights and contract only (`policy.safetensors`, `policy.json`: what a training run elsewhere sent back).
The network acts 16 episodes with the simulated person; over what it saw there, the ONNX file is compared with it and its golden
answers are taken, as `mode=export` does with a checkpoint.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import hydra
import torch
from hydra.utils import instantiate

from brokk_rl.rl.evaluation import evaluate
from brokk_rl.rl.export import export_onnx
from brokk_rl.rl.policy import CONTRACT, WEIGHTS, Trained, read_bundle
from brokk_rl.rl.vec_env import Plant

EPISODES, SEED = 16, 7


def main(trained: Path, folder: Path) -> None:
    with hydra.initialize_config_module("conf", version_base="1.3"):
        cfg = hydra.compose("config", overrides=["mode=evaluate", "follower=person", "sim=native", "sim.num_threads=1"])
    parts = {name: instantiate(cfg[name], _convert_="all") for name in ("machine", "sim", "task", "actuator", "follower")}
    loop = Plant(**parts, effects={}).build(torch.device("cpu"), EPISODES, EPISODES, SEED)
    network = Trained(folder=str(trained)).build(loop, 0)
    found, _, observations = evaluate(loop, network, loop.starts, SEED, 1)
    contract, _ = read_bundle(trained, loop.machine)
    folder.mkdir(parents=True, exist_ok=True)
    for name in (WEIGHTS, CONTRACT):
        shutil.copyfile(trained / name, folder / name)
    largest = export_onnx(folder, network.actor, loop.task, contract, observations)
    success = found["success_strict"]["mean"]
    sys.stdout.write(f"{len(observations)} observations, differ by {largest:.1e} at most; {success:.2f} of {EPISODES} inserted\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
