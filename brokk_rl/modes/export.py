"""`brokk mode=export`: makes a policy bundle of a checkpoint and proves its ONNX file."""

from __future__ import annotations

import logging
from pathlib import Path

import torch

from brokk_rl.contracts.task import Task
from brokk_rl.errors import CheckpointError, ConfigError
from brokk_rl.machine import Machine
from brokk_rl.modes.train import find_checkpoint, read_follower
from brokk_rl.rl.export import NOT_DEPLOYABLE, export_onnx
from brokk_rl.rl.policy import make_actor, observe_once, write_bundle
from brokk_rl.rl.runner import read_checkpoint
from brokk_rl.session import Session
from brokk_rl.spec import spec
from brokk_rl.task_description import TaskDescription, apply_behaviour, describe_task

log = logging.getLogger(__name__)


@spec
class Export:
    """Exports a checkpoint as a policy bundle: weights, contract and ONNX file.

    Attributes:
        session: Folder to write into.
        machine: The machine.
        task: Conditions around the policy's own task.
        checkpoint: A checkpoint, or a run folder for its newest one.
        asked: Keys of the task that were given on the command line.
    """

    session: Session
    machine: Machine
    task: Task
    checkpoint: str
    asked: tuple[str, ...]

    def run(self) -> None:
        """Export.

        Raises:
            CheckpointError: The checkpoint cannot be used, or the file answers otherwise than the
                training run did.
            ConfigError: The task cannot be deployed, or something was asked for that the policy
                does not have.
        """
        path = find_checkpoint(Path(self.checkpoint), "checkpoint")
        cpu = torch.device("cpu")
        content = read_checkpoint(path, cpu)
        self.machine.check_fingerprint(content.get("fingerprint", {}), str(path))
        if "task" not in content:
            raise CheckpointError(
                f"{path} is of a version whose checkpoints do not describe themselves: it holds "
                "neither its task nor answers of its network. Resume its run with a larger budget, "
                "which writes a checkpoint that does."
            )
        own = TaskDescription.from_json(content["task"], str(path))
        spec_of_task = apply_behaviour(self.task, own, self.asked, f"the policy in {path}")
        task = spec_of_task.build(self.machine, 1, cpu)
        if "deployable" not in task.offers:
            raise ConfigError(
                f"mode=export: {NOT_DEPLOYABLE.format(task=type(self.task).__name__)}"
            )
        network = content["network"]
        observations = observe_once(task, self.machine, cpu)
        actor = make_actor(network["actor"], network["obs_groups"], observations, task.num_actions)
        actor.load_state_dict(content["actor_state_dict"])
        facts = {
            "checkpoint": str(path),
            "env_steps": content["book"]["env_steps"],
            "seconds": content["book"]["seconds"],
            "follower": read_follower(path.parent),
        }
        folder, description = self.session.folder, describe_task(spec_of_task)
        contract = write_bundle(folder, actor, network, task, description, self.machine, facts)
        answers = content["answers"]
        largest = export_onnx(folder, actor, task, self.machine, contract, answers)
        log.info(
            "%s: onnxruntime and the training run differ by at most %.1e over %d observations",
            folder,
            largest,
            len(answers[0]),
        )
