"""`brokk mode=train`: trains a policy, evaluates it beside its rivals and writes its folder."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar

import pandas as pd
import torch
from scipy import stats

from brokk_rl import distributed
from brokk_rl.build import describe_spec
from brokk_rl.contracts.task import SUCCESS
from brokk_rl.modes.evaluate import evaluate_policies
from brokk_rl.policy_folder import (
    CONTRACT,
    describe_policy,
    find_resumed,
    list_checkpoints,
    read_contract,
    write_policy,
)
from brokk_rl.rl.export import NOT_DEPLOYABLE, export_onnx
from brokk_rl.rl.group import TrainingGroup
from brokk_rl.rl.logger import LEVELS, PROGRESS, Tracking, TrainingLogger, draw_curves, find_passing
from brokk_rl.rl.loop import ControlLoop, SimulatedPlant
from brokk_rl.rl.policy import ClassicalPolicy, PolicySpec, TrainedPolicy, load_initial_weights
from brokk_rl.rl.runner import TrainingRunner
from brokk_rl.rl.settings import Evaluation, TrainingConfig
from brokk_rl.session import Session, read_record, write_json
from brokk_rl.spec import name_spec, spec
from brokk_rl.statistics import CONFIDENCE

log = logging.getLogger(__name__)

TRACKED = ("*.png", "*.mp4", "policy.*", "evaluation.json", "resolved.yaml")
"""Files of the run folder that a tracker gets at the end."""


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
                    tracker = self.tracking.open(folder, self._describe_run(), step)
                    runner.logger.writer = stack.enter_context(contextlib.closing(tracker))
                runner.run()
            if not is_first:
                return None
            logger = runner.logger
            _log_success(logger)
            results = self._finish(runner)
            files = [path for name in TRACKED for path in sorted(folder.glob(name))]
            figures = pd.json_normalize(results["policies"], sep="/").select_dtypes("number")
            logger.writer.report(figures.add_prefix("evaluation/").iloc[0].to_dict(), files)
        log.info("policy, curves and evaluation are in %s", folder)
        return float(results["success_strict"]["mean"])

    def _begin(self, runner: TrainingRunner) -> None:
        """Load the checkpoint from which training goes on, or the network with which it begins."""
        checkpoint = find_resumed(self.policy and self.policy.path, self.session.folder)
        if checkpoint is not None:
            runner.load(str(checkpoint))
            book = runner.logger
            text = "going on from %s: %d control steps, %.0f s"
            log.info(text, checkpoint, book.env_steps, book.seconds)
            return
        if distributed.read_rank().first:  # a run that was stopped before its first checkpoint
            (self.session.folder / PROGRESS).unlink(missing_ok=True)
        if (beginning := self._find_beginning()) is not None:
            load_initial_weights(runner.alg.actor, beginning, self.machine)

    def _find_beginning(self) -> str | None:
        """Return the policy with whose network training begins; `None` for a fresh one."""
        if self.policy is None:
            return None
        folder = self.session.folder
        if Path(self.policy.path).resolve() != folder.resolve():
            return self.policy.path
        earlier = read_contract(folder, self.policy.path)  # it was stopped before a checkpoint
        return earlier.get("trained", {}).get("began_with")

    @contextlib.contextmanager
    def _explain_interruption(self) -> Iterator[None]:
        """Say after Ctrl-C which checkpoint remains, and the command that goes on."""
        try:
            yield
        except KeyboardInterrupt:
            folder = self.session.folder
            found = list_checkpoints(folder)
            log.warning(
                "%s; go on with: brokk mode=train policy=%s session.out=%s",
                f"{found[-1]} remains" if found else "no checkpoint was written yet",
                folder,
                folder,
            )
            raise

    def _describe_run(self) -> dict[str, Any]:
        """Return what a tracker shows of the run: its parts, commit and whole configuration."""
        record = read_record(self.session.folder) or {}
        return {
            "machine": self.machine.name,
            "task": name_spec(self.task),
            "actuator": name_spec(self.actuator),
            "effect": ", ".join(self.effect) or "none",
            "event": ", ".join(self.event) or "none",
            "follower": name_spec(self.follower),
            "seed": self.session.seed,
            "num_envs": self.rl.num_envs,
            "commit": record.get("commit") or "unknown",
            "choices": record.get("choices", {}),
            "fingerprint": self.machine.fingerprint(),
            "config": describe_spec(self),
        }

    def _describe_policy(self, loop: ControlLoop) -> dict[str, Any]:
        """Return the contract of the policy that is trained; see `brokk_rl.policy_folder`."""
        contract = describe_policy(
            self.rl.describe_network(),
            loop.task,
            loop.description,
            self.machine,
            actuator=self.actuator,
        )
        contract["trained"] = {
            "began_with": self._find_beginning(),
            "beginning": self.rl.describe_beginning(),
            "seed": self.session.seed,
            "device": str(loop.device),
            "follower": describe_spec(self.follower),
        }
        return contract

    def _finish(self, runner: TrainingRunner) -> dict[str, Any]:
        """Write policy and curves, evaluate, export; return the content of `evaluation.json`."""
        folder, loop, actor = self.session.folder, runner.env, runner.alg.get_policy()
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
        line, words = None, loop.task.figures
        if controller := results["policies"].get("classical"):
            line = controller[SUCCESS]["mean"]
            for name, figure in words.items():
                if figure.unit == "share":
                    gain = describe_gain(results["policies"]["trained"], controller, name)
                    log.info("%s %s", figure.title, gain)
        picture = folder / "learning_curves.png"
        draw_curves(folder / PROGRESS, picture, words, book.first_episodes, line)
        task = self.task.build(self.machine, 1, torch.device("cpu"))
        if "deployable" in task.offers:
            export_onnx(folder, actor, task, self.machine, contract, answers)
        else:
            name, text = type(self.task).__name__, "cannot be deployed, so there is no policy.onnx"
            log.warning("the task (%s) %s; %s", name, text, NOT_DEPLOYABLE)
        return results


def _log_success(logger: TrainingLogger) -> None:
    """Log how many seconds of training the levels of success took."""
    for level in LEVELS:
        passed = find_passing(logger.rows, level, logger.first_episodes)
        text = "not reached" if passed is None else f"after {float(passed['seconds']):.1f} s"
        log.info("success of %.2f while learning: %s", level, text)


def describe_gain(trained: Mapping[str, Any], controller: Mapping[str, Any], share: str) -> str:
    """Return whether training has gained a share over the controller, by Fisher's exact test."""
    table = []
    for row in (trained, controller):
        successes = round(row["episodes"] * row[share]["mean"])
        table.append([successes, row["episodes"] - successes])
    own, other = trained[share]["mean"], controller[share]["mean"]
    verdict = "no gain shown"
    test: Any = stats.fisher_exact(table, alternative="greater")
    if test.pvalue < 1.0 - CONFIDENCE:
        verdict = f"better than the controller by {own - other:.3f}"
    return f"{own:.3f} against the controller's {other:.3f}: {verdict}"


def _log_setup(loop: ControlLoop, group: TrainingGroup) -> None:
    """Log number of environments, device, world and whether CUDA graphs run."""
    device = str(loop.device)
    log.info(
        "%d environments on %s, %s; CUDA graphs: %s",
        loop.num_envs,
        f"{device}, in each of {group.rank.count} processes" if group.together else device,
        type(loop.world).__name__,
        "active" if loop.graph_active else "not used (they need sim=warp on a GPU)",
    )
