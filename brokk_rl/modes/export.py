"""`brokk mode=export`: makes a policy bundle of a checkpoint and proves its ONNX file."""

from __future__ import annotations

import logging
from pathlib import Path

import torch

from brokk_rl.contracts.actuator import Actuator, Follower
from brokk_rl.contracts.task import Task, supports_deployment
from brokk_rl.contracts.world import Simulator
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.modes.train import find_checkpoint, read_follower
from brokk_rl.rl.evaluation import evaluate_policy
from brokk_rl.rl.export import NOT_DEPLOYABLE, export_onnx
from brokk_rl.rl.policy import NetworkPolicy, make_actor, write_bundle
from brokk_rl.rl.runner import TrainingConfig, read_checkpoint
from brokk_rl.rl.vec_env import ControlLoopConfig
from brokk_rl.session import Session
from brokk_rl.spec import spec

log = logging.getLogger(__name__)


@spec
class Export:
    """Exports a checkpoint as a policy bundle: weights, contract and ONNX file.

    Attributes:
        session: Folder to write into.
        machine: The machine.
        sim: Physics in which the observations of the parity check arise.
        task: The policy's task.
        actuator: Actuator model of the same check.
        follower: Follower of the same check; a policy that proposes to a person is another one.
        rl: Training configuration that gives the network's shape.
        checkpoint: A checkpoint, or a run folder for its newest one.
        num_checked: Episodes that the parity check runs.
    """

    session: Session
    machine: Machine
    sim: Simulator
    task: Task
    actuator: Actuator
    follower: Follower
    rl: TrainingConfig
    checkpoint: str
    num_checked: int

    def run(self) -> None:
        """Export.

        Raises:
            CheckpointError: The checkpoint cannot be used, or file and network differ.
            ConfigError: The task cannot be deployed.
        """
        path = find_checkpoint(Path(self.checkpoint))
        cpu = torch.device("cpu")
        content = read_checkpoint(path, cpu)
        self.machine.check_fingerprint(content.get("fingerprint", {}), str(path))
        config = ControlLoopConfig(
            machine=self.machine,
            sim=self.sim,
            task=self.task,
            actuator=self.actuator,
            effects={},
            follower=self.follower,
        )
        seed = self.session.stream("starts")
        loop = config.build(cpu, self.num_checked, self.num_checked, seed)
        task = loop.task
        if not supports_deployment(task):
            raise ConfigError(
                f"mode=export: {NOT_DEPLOYABLE.format(task=type(self.task).__name__)}"
            )
        network = self.rl.runner_config()
        actor = make_actor(network["actor"], network["obs_groups"], loop)
        actor.load_state_dict(content["actor_state_dict"])
        policy = NetworkPolicy(actor, loop)
        evaluation = evaluate_policy(loop, policy, loop.starts, self.session.seed, 1)
        facts = {
            "checkpoint": str(path),
            "env_steps": content["book"]["env_steps"],
            "seconds": content["book"]["seconds"],
            "follower": read_follower(path.parent),
        }
        folder, observations = self.session.folder, evaluation.observations
        contract = write_bundle(folder, actor, self.rl, loop, facts)
        largest = export_onnx(folder, actor, task, contract, observations)
        log.info(
            "%s: onnxruntime and torch differ by at most %.1e over %d observations",
            folder,
            largest,
            len(observations),
        )
