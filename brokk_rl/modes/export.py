"""`brokk mode=export`: makes a policy folder of a checkpoint and proves its ONNX file."""

from __future__ import annotations

import logging

import torch

from brokk_rl.contracts.task import Task
from brokk_rl.machine import Machine
from brokk_rl.policy_folder import (
    describe_policy,
    describe_task,
    find_checkpoint,
    find_policy,
    write_policy,
)
from brokk_rl.rl.export import NOT_DEPLOYABLE, export_onnx
from brokk_rl.rl.policy import TrainedPolicy, observe_once, restore_actor
from brokk_rl.session import Session
from brokk_rl.sim.shapes import write_shapes
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
        stored = find_policy(str(path))
        content = stored.read()
        cpu = torch.device("cpu")
        description = describe_task(self.task)
        task = self.task.build(self.machine, 1, cpu)
        task.require("deployable", NOT_DEPLOYABLE)
        groups = observe_once(task, self.machine, cpu)
        who = f"the policy in {path}"
        actor = restore_actor(content, who, self.machine, description, groups, task.num_actions)
        contract = describe_policy(content["network"], task, description, self.machine)
        contract["plant"] |= stored.contract.get("plant", {})
        contract["trained"] = stored.contract.get("trained", {}) | {"checkpoint": str(path)}
        contract["trained"] |= content["book"]
        folder = self.session.folder
        answers = content["answers"]
        write_policy(folder, contract, actor.state_dict())
        largest = export_onnx(folder, actor, task, self.machine, contract, answers)
        if self.machine.mjcf is not None:
            write_shapes(self.machine, folder)
        text = "%s: onnxruntime and the training run differ by at most %.1e over %d observations"
        log.info(text, folder, largest, len(answers[0]))
