"""Adds the range of a policy's observations to a bundle that was exported without it.

    python benchmarks/doctor/add_ranges.py tasks/policies/borehole_insertion

`mode=export` writes the range from the checkpoint. A bundle without a checkpoint gets it from episodes of its
own task, on machines that the training draws: one observation of each environment at several moments.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from brokk_rl import extensions
from brokk_rl.build import build_node
from brokk_rl.observation import measure_ranges, restore_encoder
from brokk_rl.policy_folder import describe_spec, find_policy
from brokk_rl.rl.loop import SimulatedPlant
from brokk_rl.rl.policy import TrainedPolicy

NUM_ENVS, NUM_MOMENTS, APART = 256, 8, 40
"""Environments, moments, and control periods between two of them: 16 s in all."""


def measure(folder: Path) -> dict[str, object]:
    """Returns `training_observations` of a bundle."""
    contract, cpu = json.loads((folder / "policy.json").read_text()), torch.device("cpu")
    machine = extensions.load_option("machine", "brokk170")
    task = extensions.load_option("task", contract["task"]["name"])
    policy = TrainedPolicy(path=str(folder), task=None)
    follower = "person" if contract["task"]["behaviour"]["advice"] else "none"
    sim = replace(extensions.load_option("sim", "native"), num_worlds=NUM_ENVS, num_threads=2)
    node = find_policy(str(folder)).task.apply_to(describe_spec(task))
    config = SimulatedPlant(
        machine=machine, sim=sim, task=build_node(node, "task"), actuator=extensions.load_option("actuator", "mlp"),
        effect={"library": extensions.load_option("effect", "library")}, event={},
        follower=extensions.load_option("follower", follower),
    )  # fmt: skip
    torch.manual_seed(0)
    loop = config.build(cpu, NUM_ENVS, 4 * NUM_ENVS, 0)
    actor, vectors = policy.build(loop, 0), []
    with torch.inference_mode():
        groups = loop.get_observations()
        for step in range(NUM_MOMENTS * APART):
            if step % APART == 0:
                vectors.append(groups["policy"].numpy().copy())
            groups = loop.step(actor.act(groups.to_dict()))[0]
    stacked = np.concatenate(vectors)
    encoder = restore_encoder(machine, contract["observation"])
    assert encoder.has_target, "a policy of a tool-pose task"
    ranges = measure_ranges(encoder, stacked, machine.joint_names)
    return {"count": len(stacked), "ranges": ranges}


def main() -> None:
    """Adds the range to each bundle that is named."""
    for name in sys.argv[1:]:
        path = Path(name) / "policy.json"
        contract = json.loads(path.read_text())
        contract["training_observations"] = measure(Path(name))
        path.write_text(json.dumps(contract, indent=2) + "\n")


if __name__ == "__main__":
    main()
