"""`brokk mode=export`: makes a policy folder of a checkpoint and proves its ONNX file."""

from __future__ import annotations

import logging

import torch

from brokk_rl.contracts.task import Task
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.policy_folder import (
    TaskDescription,
    describe_policy,
    describe_task,
    find_checkpoint,
    find_policy,
    read_checkpoint,
    write_policy,
)
from brokk_rl.rl.export import NOT_DEPLOYABLE, export_onnx
from brokk_rl.rl.policy import TrainedPolicy, make_actor, observe_once
from brokk_rl.session import Session
from brokk_rl.spec import spec

log = logging.getLogger(__name__)


@spec
class Export:
    """Exports a checkpoint as a policy folder: weights, contract and ONNX file.

    Attributes:
        session: Folder to write into.
        machine: The machine.
        task: The policy's own task.
        policy: A checkpoint, or a run folder for its newest one.
    """

    session: Session
    machine: Machine
    task: Task
    policy: TrainedPolicy

    def run(self) -> None:
        """Export.

        Raises:
            CheckpointError: The checkpoint cannot be used, or the file answers otherwise than the
                training run did.
            ConfigError: The task cannot be deployed.
        """
        path = find_checkpoint(self.policy.path)
        cpu = torch.device("cpu")
        content = read_checkpoint(path, cpu)
        self.machine.check_fingerprint(content["fingerprint"], str(path))
        description = describe_task(self.task)
        TaskDescription.from_json(content["task"], str(path)).require_same(
            description, f"the policy in {path}", "give the values of the policy"
        )
        task = self.task.build(self.machine, 1, cpu)
        if "deployable" not in task.offers:
            raise ConfigError(
                f"mode=export: {NOT_DEPLOYABLE.format(task=type(self.task).__name__)}"
            )
        network = content["network"]
        actor = make_actor(network, observe_once(task, self.machine, cpu), task.num_actions)
        actor.load_state_dict(content["actor_state_dict"])
        training = find_policy(str(path)).contract
        contract = describe_policy(
            network,
            task.describe(),
            task.max_episode_steps * self.machine.period_s,
            description,
            self.machine,
        )
        contract["plant"] |= training.get("plant", {})
        contract["trained"] = training.get("trained", {}) | {
            "checkpoint": str(path),
            "env_steps": content["book"]["env_steps"],
            "seconds": content["book"]["seconds"],
        }
        folder, answers = self.session.folder, content["answers"]
        write_policy(folder, contract, actor.state_dict())
        largest = export_onnx(folder, actor, task, self.machine, contract, answers)
        log.info(
            "%s: onnxruntime and the training run differ by at most %.1e over %d observations",
            folder,
            largest,
            len(answers[0]),
        )
