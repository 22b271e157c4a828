"""`brokk mode=train`: trains a policy, evaluates it beside its rivals and writes its bundle."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import torch
import yaml

from brokk_rl import distributed
from brokk_rl.contracts.actuator import Actuator, Effect, Follower
from brokk_rl.contracts.task import Task
from brokk_rl.contracts.world import Simulator
from brokk_rl.errors import CheckpointError, SimulationError
from brokk_rl.machine import Machine
from brokk_rl.modes.evaluate import PolicySpec, evaluate_policies
from brokk_rl.rl.export import NOT_DEPLOYABLE, export_onnx
from brokk_rl.rl.logger import PROGRESS, TrainingLogger, draw_curves, find_passing
from brokk_rl.rl.loop import ControlLoop, ControlLoopConfig
from brokk_rl.rl.policy import (
    ClassicalPolicy,
    TrainedPolicy,
    UntrainedPolicy,
    load_initial_weights,
    locate_bundle,
    read_bundle,
    write_bundle,
)
from brokk_rl.rl.runner import TrainingGroup, TrainingRunner, list_checkpoints
from brokk_rl.rl.settings import Evaluation, TrainingConfig
from brokk_rl.rl.success_sweep import LEVELS
from brokk_rl.rl.tracking import NoTracking, Tracker, Tracking
from brokk_rl.session import RESOLVED, Session, read_record
from brokk_rl.sim.events import Event
from brokk_rl.spec import name_spec, spec
from brokk_rl.task_description import apply_behaviour, read_description

log = logging.getLogger(__name__)

FAULTS = "faults"
"""Folder of recorded faults in a run folder."""
MAX_FAULT_FILES = 8
"""Faults that one process writes, 100 kB each. Chosen by hand: later ones tell little more."""

TRACKED = ("*.png", "*.mp4", "policy.*", "evaluation.json", "resolved.yaml")
"""Files of the run folder that a tracker gets at the end."""


@spec
class Train:
    """Trains a policy for a task through an actuator model, then evaluates and exports it.

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
        start_from: Policy (`policy.folder`) with whose network training begins; `null` for a fresh
            one.
        resume: Run folder, or checkpoint, from which to go on.
        asked: Keys of the task that were given on the command line, or by an experiment.
    """

    session: Session
    machine: Machine
    sim: Simulator
    task: Task
    actuator: Actuator
    effect: dict[str, Effect]
    event: dict[str, Event]
    follower: Follower
    rl: TrainingConfig
    tracking: Tracking
    evaluation: Evaluation
    start_from: str | None
    resume: str | None
    asked: tuple[str, ...]

    together: ClassVar[bool] = True
    """Several processes that `torchrun` starts train one policy."""

    def run(self) -> float | None:
        """Train.

        Returns:
            The strict success of the trained policy; `None` in all processes but the first.
        """
        checkpoint = self._find_start()
        device = self.session.torch_device()
        self.session.seed_all()
        config = ControlLoopConfig(
            machine=self.machine,
            sim=self.sim,
            task=self._choose_task(),
            actuator=self.actuator,
            effects=self.effect,
            events=self.event,
            follower=self.follower,
        )
        loop = config.build(
            device, self.rl.num_envs, self.rl.num_starts, self.session.stream("starts")
        )
        if self.rl.near_starts:
            loop.bring_near(self.rl.near_starts, self.session.stream("starts"))
        loop.record_faults(self.rl.count_fault_steps(device.type))
        loop.capture(self.rl.fuse)
        group = TrainingGroup(device)
        _log_setup(loop, group)
        self.session.seed_all()  # capturing has drawn random numbers

        tracking = self.tracking if group.rank.first else NoTracking()
        with contextlib.closing(
            tracking.open(self.session.folder, self._describe_run())
        ) as tracker:
            logger = self._open_logger(loop, group, tracker)
            with group, logger:
                runner = TrainingRunner(loop, self.rl, self.session.folder, device, logger, group)
                if checkpoint:
                    runner.load(str(checkpoint))
                    log.info(
                        "going on from %s: %d control steps, %.0f s",
                        checkpoint,
                        logger.env_steps,
                        logger.seconds,
                    )
                elif self.start_from:
                    load_initial_weights(runner.alg.actor, self.start_from, self.machine)
                runner.run()
            if not group.rank.first:
                return None
            _log_success(logger, group.rank.count * loop.num_envs * loop.task.max_episode_steps)
            facts = {
                "env_steps": logger.env_steps,
                "seconds": logger.seconds,
                "seed": self.session.seed,
                "device": str(device),
                "follower": read_follower(self.session.folder),
            }
            results = self._finish(config, runner, facts)
            files = [path for name in TRACKED for path in sorted(self.session.folder.glob(name))]
            tracker.report(flatten_figures(results["policies"], "evaluation"), files)
        log.info("run folder: %s", self.session.folder)
        return float(results["success_strict"]["mean"])

    def _describe_run(self) -> dict[str, Any]:
        """Return what a tracker shows of the run: its parts, commit and whole configuration."""
        folder = self.session.folder
        record, resolved = read_record(folder) or {}, folder / RESOLVED
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
            "config": yaml.safe_load(resolved.read_text()) if resolved.is_file() else {},
        }

    def _choose_task(self) -> Task:
        """Return the task, with the behaviour of the policy with which training begins.

        Raises:
            ConfigError: Something was asked for that the policy does not have.
        """
        if self.start_from is None:
            return self.task
        folder = locate_bundle(self.start_from)
        own = read_description(folder, read_bundle(folder, self.machine)[0])
        if own is None:
            return self.task
        return apply_behaviour(self.task, own, self.asked, f"start_from={self.start_from}")

    def _open_logger(
        self, loop: ControlLoop, group: TrainingGroup, tracker: Tracker
    ) -> TrainingLogger:
        """Return the logger of this process; only the first of several writes."""
        faults = FaultLog(loop, self.session.folder / FAULTS, f"rank{group.rank.index}_")
        return TrainingLogger(
            self.session.folder,
            tracker,
            lambda: group.pool_statistics(faults.read_statistics()),
            loop.num_envs * int(self.rl.runner["num_steps_per_env"]) * group.rank.count,
            self.rl.max_fault_rate,
            self.rl.budget.share_spent,
            quiet=not group.rank.first,
        )

    def _finish(
        self, config: ControlLoopConfig, runner: TrainingRunner, facts: dict[str, Any]
    ) -> dict[str, Any]:
        """Write bundle and curves, evaluate, export; return the content of `evaluation.json`."""
        folder, loop, actor = self.session.folder, runner.env, runner.alg.get_policy()
        network = self.rl.describe_network()
        contract = write_bundle(
            folder, actor, network, loop.task, loop.description, self.machine, facts
        )
        answers = runner.record_answers()
        draw_curves(folder / PROGRESS, folder / "learning_curves.png")
        policies: dict[str, PolicySpec] = {"trained": TrainedPolicy(folder=str(folder))}
        if "classical_action" in loop.task.offers:
            policies["classical"] = ClassicalPolicy()
        else:
            log.info(
                "the task (%s) has no classical controller to compare with",
                type(self.task).__name__,
            )
        policies["untrained"] = UntrainedPolicy(training=self.rl)
        results = evaluate_policies(config, self.evaluation, self.session, policies)
        task = config.task.build(self.machine, 1, torch.device("cpu"))
        if "deployable" in task.offers:
            export_onnx(folder, actor, task, self.machine, contract, answers)
        else:
            log.warning(NOT_DEPLOYABLE.format(task=type(self.task).__name__))
        return results

    def _find_start(self) -> Path | None:
        """Return the checkpoint to go on from.

        A run that was stopped before its first checkpoint begins anew in its folder.
        """
        if self.resume is None:
            return None
        folder = self.session.folder
        if Path(self.resume).resolve() == folder.resolve() and not list_checkpoints(folder):
            if distributed.read_rank().first:
                (folder / PROGRESS).unlink(missing_ok=True)
            return None
        return find_checkpoint(Path(self.resume), "resume")


def flatten_figures(node: Mapping[str, Any], name: str) -> dict[str, float]:
    """Return the numbers of nested tables by their path: `evaluation/trained/success_strict/mean`."""
    found: dict[str, float] = {}
    for key, value in node.items():
        if isinstance(value, Mapping):
            found |= flatten_figures(value, f"{name}/{key}")
        elif isinstance(value, (int, float)):
            found[f"{name}/{key}"] = float(value)
    return found


class FaultLog:
    """Writes the last states of the worlds that diverge in a training.

    Args:
        loop: The control loop.
        folder: For the files; made where there is a fault.
        prefix: Beginning of the file names; several processes write into one folder.
    """

    def __init__(self, loop: ControlLoop, folder: Path, prefix: str) -> None:
        self._loop, self._folder, self._prefix = loop, folder, prefix
        self._num_written = len(list(folder.glob(f"{prefix}*.npz")))

    def read_statistics(self) -> dict[str, float]:
        """Return `ControlLoop.statistics`; write the faults since the last call.

        Raises:
            SimulationError: A reward was not finite: the next update would spoil the policy.
        """
        statistics = self._loop.statistics()
        if self._loop.recorder is None or not self._loop.num_held:
            return statistics
        for fault in self._loop.recorder.fetch(MAX_FAULT_FILES - self._num_written):
            self._folder.mkdir(exist_ok=True)
            path = self._folder / f"{self._prefix}{self._num_written}.npz"
            fault.save(path)
            self._num_written += 1
            log.warning("a world diverged: %s; its last states: %s", fault.cause, path)
            if fault.is_reward:
                raise SimulationError(
                    f"{fault.cause}: expected finite rewards; change task.reward. The last states "
                    f"stand in {path}; the newest checkpoint is from before."
                )
        return statistics


def _log_success(logger: TrainingLogger, first_episodes: int) -> None:
    """Log how many seconds of training the levels of success took.

    Args:
        logger: Holds the rows of the training.
        first_episodes: Control steps of the first episodes; see `find_passing`.
    """
    for level in LEVELS:
        passed = find_passing(logger.rows, level, first_episodes)
        text = "not reached" if passed is None else f"after {float(passed['seconds']):.1f} s"
        log.info("strict success of %.2f while learning: %s", level, text)


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


def read_follower(folder: Path) -> dict[str, Any] | None:
    """Return the configured `follower` of the run in `folder`; `None` without a configuration."""
    resolved = folder / RESOLVED
    return yaml.safe_load(resolved.read_text()).get("follower") if resolved.exists() else None


def find_checkpoint(path: Path, key: str) -> Path:
    """Return `path` if it is a checkpoint, else the newest checkpoint of the run folder `path`.

    Args:
        path: A checkpoint or a run folder.
        key: Key of the configuration that gave it, for the message.

    Raises:
        CheckpointError: There is none.
    """
    if path.suffix == ".pt":
        return path
    found = list_checkpoints(path) if path.is_dir() else []
    if not found:
        raise CheckpointError(
            f"{key}={path}: there is no checkpoint (model_<iteration>.pt), nor a run folder with one"
        )
    return found[-1]
