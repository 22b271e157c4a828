"""Export the mean of the actors of all checkpoints that a training kept, as a policy folder.

    python examples/average_checkpoints.py runs/trained runs/mean
    python examples/average_checkpoints.py runs/trained runs/mean 1.08

A third number multiplies the output layer. A command just below the dead band of a valve then
moves it, as the exploration noise did while the policy learned. The golden answers are those of the
mean to observations that the training recorded, computed here.
"""

import sys
from pathlib import Path

import torch
from omegaconf import OmegaConf

from brokk_rl.build import build_node
from brokk_rl.policy_folder import (
    describe_task,
    list_checkpoints,
    read_checkpoint,
    read_contract,
    write_policy,
)
from brokk_rl.rl.export import export_onnx
from brokk_rl.rl.policy import PlainActor, observe_once, restore_actor

CPU = torch.device("cpu")


def average_networks(states):
    """Return the mean of networks by name, in double precision on the way."""
    mean = {}
    for name, value in states[0].items():
        values = torch.stack([state[name].double() for state in states])
        mean[name] = values.mean(0).to(value.dtype)
    return mean


def multiply_output(weights, gain):
    """Return a network whose last layer is `gain` times as large."""
    last = list(weights)[-1].removesuffix(".bias")
    return {
        name: gain * value if name.startswith(last) else value for name, value in weights.items()
    }


def export_mean(run, out, gain=1.0):
    """Write the policy folder `out` of the run folder `run`."""
    paths = list_checkpoints(run)
    states, newest = [], {}
    for path in paths:  # all of one is as large as its simulated machines
        newest = read_checkpoint(path, CPU)
        states.append(newest["actor_state_dict"])
    values = OmegaConf.to_container(OmegaConf.load(run / "resolved.yaml"))
    machine, task = build_node(values["machine"], "machine"), build_node(values["task"], "task")
    process = task.build(machine, 1, CPU)
    groups = observe_once(process, machine, CPU)
    weights = multiply_output(average_networks(states), gain)
    content = newest | {"weights": weights}
    actor = restore_actor(
        content, str(run), machine, describe_task(task), groups, process.num_actions
    )
    contract = read_contract(run, str(run))
    for name in ("parity", "training_observations"):  # those of the last checkpoint
        contract.pop(name, None)
    contract["trained"] |= newest["book"]
    contract["trained"]["mean_of_iterations"] = [int(path.stem[6:]) for path in paths]
    contract["trained"]["output_gain"] = gain
    observations = newest["answers"][0]
    with torch.no_grad():
        commands = process.deployable(PlainActor(actor).eval())(observations.float())
    out.mkdir(parents=True, exist_ok=True)
    write_policy(out, contract, actor.state_dict())
    export_onnx(out, actor, process, machine, contract, (observations, commands))


if __name__ == "__main__":
    output_gain = float(sys.argv[3]) if len(sys.argv) > 3 else 1.0
    export_mean(Path(sys.argv[1]), Path(sys.argv[2]), output_gain)
