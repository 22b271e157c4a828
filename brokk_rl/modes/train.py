"""`brokk mode=train`: trains a policy, evaluates it beside its rivals and writes its folder."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import pandas as pd
import torch

from brokk_rl import distributed
from brokk_rl.build import describe_spec
from brokk_rl.contracts.task import SUCCESS
from brokk_rl.modes.evaluate import evaluate_policies
from brokk_rl.policy_folder import (
    CONTRACT,
    describe_policy,
    find_resumed,
    list_checkpoints,
    write_policy,
)
from brokk_rl.rl.export import NOT_DEPLOYABLE, export_onnx
from brokk_rl.rl.group import TrainingGroup
from brokk_rl.rl.logger import PROGRESS, Tracking, draw_curves
from brokk_rl.rl.loop import ControlLoop, SimulatedPlant
from brokk_rl.rl.policy import ClassicalPolicy, PolicySpec, TrainedPolicy, load_initial_weights
from brokk_rl.rl.runner import TrainingRunner
from brokk_rl.rl.settings import Evaluation, TrainingConfig
from brokk_rl.session import Session, read_record, write_json
from brokk_rl.spec import name_spec, spec

log = logging.getLogger(__name__)

TRACKED = ("*.png", "*.mp4", "policy.*", "evaluation.json", "resolved.yaml")
"""Files of the run folder that a tracker gets at the end."""
DESCRIBED = ("commit", "choices", "fingerprint")
"""Fields of `session.json` that a tracker shows, beside the whole configuration."""


@spec
class Train(SimulatedPlant):
    """Trains a policy for a task through an actuator model, then evaluates and exports it.

    A training goes on from the newest checkpoint in its own folder, if there is one.

    Attributes:
        session: Folder, seed, device.
        machine: The machine.
        sim: Physics.
        task: The task.
        actuator: How commands become motion.
        effect: Effects around the actuator model, by name.
        event: Changes of the simulated machine, by name.
        follower: Who stands between policy and machine.
        rl: How to train.
        tracking: Where figures go beside the run folder.
        evaluation: How to evaluate at the end.
        policy: A checkpoint: training goes on from it. A folder: it begins with the network of that
            policy. `null`: it begins with a fresh network.
    """

    session: Session
    rl: TrainingConfig
    tracking: Tracking
    evaluation: Evaluation
    policy: TrainedPolicy | None

    together: ClassVar[bool] = True
    """Several processes that `torchrun` starts train one policy."""

    def run(self) -> float | None:
        """Train.

        Returns:
            The strict success of the trained policy; `None` in all processes but the first.
        """
        device = self.session.torch_device()
        log.info("training on %s: %s of %s", device, name_spec(self.task), self.machine.name)
        self.session.seed_all()
        stream = self.session.stream("starts")
        loop = self.build(device, self.rl.num_envs, self.rl.num_starts, stream)
        if self.rl.near_starts:
            loop.bring_near(self.rl.near_starts, stream)
        folder = self.session.folder
        loop.capture(self.rl.fuse)
        group = TrainingGroup(device)
        is_first = group.rank.first
        _log_setup(loop, group)
        self.session.seed_all()  # capturing has drawn random numbers
        with contextlib.ExitStack() as stack:
            with self._explain_interruption(), group:
                runner = TrainingRunner(loop, self.rl, folder, group)
                self._begin(runner)
                if is_first:
                    write_json(folder / CONTRACT, self._describe_policy(loop))
                    step = runner.current_learning_iteration
                    record = read_record(folder) or {}
                    run = {name: record.get(name) for name in DESCRIBED}
                    run["config"] = describe_spec(self)
                    tracker = self.tracking.open(folder, run, step)
                    runner.logger.writer = stack.enter_context(contextlib.closing(tracker))
                runner.run()
            if not is_first:
                return None
            results = self._finish(runner)
            files = [path for name in TRACKED for path in sorted(folder.glob(name))]
            figures = pd.json_normalize(results["policies"], sep="/").select_dtypes("number")
            runner.logger.writer.report(figures.add_prefix("evaluation/").iloc[0].to_dict(), files)
        log.info("policy, curves and evaluation are in %s", folder)
        return float(results["success_strict"]["mean"])

    def _begin(self, runner: TrainingRunner) -> None:
        """Load the checkpoint from which training goes on, or the network with which it begins."""
        checkpoint = find_resumed(self.policy and self.policy.path, self.session.folder)
        if checkpoint is not None:
            runner.load(str(checkpoint))
            book = runner.logger
            text = "going on from %s, its learning rate and exploration: %d control steps, %.0f s"
            log.info(text, checkpoint, book.env_steps, book.seconds)
            return
        if distributed.read_rank().first:  # a run that was stopped before its first checkpoint
            (self.session.folder / PROGRESS).unlink(missing_ok=True)
        if self.policy is not None:
            load_initial_weights(runner.alg.actor, self.policy.path, self.machine)

    @contextlib.contextmanager
    def _explain_interruption(self) -> Iterator[None]:
        """Say after Ctrl-C which checkpoint remains, and the command that goes on."""
        try:
            yield
        except KeyboardInterrupt:
            folder = self.session.folder
            if found := list_checkpoints(folder):
                text = "%s remains; go on with: brokk mode=train policy=%s session.out=%s"
                log.warning(text, found[-1], folder, folder)
            else:
                log.warning("no checkpoint was written yet: begin again, in another folder")
            raise

    def _describe_policy(self, loop: ControlLoop) -> dict[str, Any]:
        """Return the contract of the policy that is trained; see `brokk_rl.policy_folder`."""
        network = self.rl.describe_network()
        contract = describe_policy(
            network, loop.task, loop.description, self.machine, actuator=self.actuator
        )
        contract["trained"] = {"seed": self.session.seed, "device": str(loop.device)}
        contract["trained"]["follower"] = describe_spec(self.follower)
        return contract

    def _finish(self, runner: TrainingRunner) -> dict[str, Any]:
        """Write policy and curves, evaluate, export; return the content of `evaluation.json`."""
        folder = self.session.folder
        loop = runner.env
        actor = runner.alg.get_policy()
        contract = self._describe_policy(loop)
        book = runner.logger
        contract["trained"] |= {"env_steps": book.env_steps, "seconds": book.seconds}
        write_policy(folder, contract, actor.state_dict())
        answers = runner.record_answers()
        policies: dict[str, PolicySpec] = {
            "trained": TrainedPolicy(path=str(folder), task=None),
            "classical": ClassicalPolicy(task=None),
        }
        results = evaluate_policies(self, self.evaluation, self.session, policies)
        line = None
        words = loop.task.figures
        if controller := results["policies"].get("classical"):
            line = controller[SUCCESS]["mean"]
            gain = describe_gain(results["policies"]["trained"][SUCCESS], controller[SUCCESS])
            log.info("%s: %s", words[SUCCESS].title, gain)
        picture = folder / "learning_curves.png"
        draw_curves(folder / PROGRESS, picture, words, book.first_episodes, line)
        task = self.task.build(self.machine, 1, torch.device("cpu"))
        if "deployable" in task.offers:
            export_onnx(folder, actor, task, self.machine, contract, answers)
        else:
            text = "the task (%s) cannot be deployed, so there is no policy.onnx; %s"
            log.warning(text, type(self.task).__name__, NOT_DEPLOYABLE)
        return results


def describe_gain(trained: Mapping[str, Any], controller: Mapping[str, Any]) -> str:
    """Return whether a rate is above the controller's for sure: their intervals lie apart."""
    if trained["ci95"][0] > controller["ci95"][1]:
        return f"better than the controller by {trained['mean'] - controller['mean']:.3f}"
    return "no gain over the controller shown"


def _log_setup(loop: ControlLoop, group: TrainingGroup) -> None:
    """Log number of environments, device, world and whether CUDA graphs run."""
    processes = f", in each of {group.rank.count} processes" if group.together else ""
    log.info(
        "%d environments on %s, %s; CUDA graphs: %s",
        loop.num_envs,
        f"{loop.device}{processes}",
        type(loop.world).__name__,
        "active" if loop.graph_active else "not used (they need sim=warp on a GPU)",
    )
