"""Specs of training and evaluation.

This module needs no torch, so that a bad value is refused before torch is loaded.
"""

from __future__ import annotations

import copy
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Interval, MinLen

from brokk_rl.errors import ConfigError
from brokk_rl.spec import (
    Count,
    NonNegative,
    NonNegativeRange,
    Ordered,
    Positive,
    Range,
    Seed,
    Share,
    WorldCount,
    require_value,
    spec,
)

SETTLED_PART = 0.9
"""Part of `desired_kl` that is gone at the end of the budget; chosen by hand, see
`TrainingConfig.settling`."""
CAPPED = "brokk_rl.rl.ppo:CappedGaussian"
"""The distribution whose cap `Exploration` moves."""
PositiveShare = Annotated[float, Interval(gt=0, le=1)]
ShareBelowOne = Annotated[float, Interval(ge=0, lt=1)]
Counts = Annotated[tuple[Count, ...], MinLen(1)]
Activation = Literal[
    "elu", "selu", "relu", "crelu", "lrelu", "tanh", "sigmoid", "softplus", "gelu", "swish", "mish",
    "identity",
]  # fmt: skip
NUM_STEPS = "num_steps_per_env"
"""Control steps of a rollout; rsl-rl has no default for it."""
RUNNER_VALUES: dict[str, Any] = {
    NUM_STEPS: Count,
    "algorithm.num_learning_epochs": Count,
    "algorithm.num_mini_batches": Count,
    "algorithm.clip_param": Positive,
    "algorithm.gamma": PositiveShare,
    "algorithm.lam": Share,
    "algorithm.value_loss_coef": NonNegative,
    "algorithm.entropy_coef": NonNegative,
    "algorithm.learning_rate": Positive,
    "algorithm.max_grad_norm": Positive,
    "algorithm.desired_kl": Positive,
    "algorithm.schedule": Literal["adaptive", "fixed"],
    "algorithm.optimizer": Literal["adam", "adamw", "sgd", "rmsprop"],
    "actor.hidden_dims": Counts,
    "actor.activation": Activation,
    "actor.distribution_cfg.init_std": Positive,
    "actor.distribution_cfg.std_type": Literal["scalar", "log"],
    "actor.distribution_cfg.std_range": NonNegativeRange,
    "critic.hidden_dims": Counts,
    "critic.activation": Activation,
}
"""Allowed values of rsl-rl's own configuration. It does not check numbers itself: outside of these
it divides by zero, climbs instead of descends, or trains nothing; unknown words end it late."""

REFUSED_CLASSES = ("RNNModel", "CNNModel", "BetaDistribution", "Distillation", "StudentTeacher")
"""Classes of rsl-rl that would fail after the whole budget."""
REFUSED_PARTS = ("rnd_cfg", "symmetry_cfg")
"""Parts of rsl-rl's algorithm that are not supported; mirrored steps showed no gain."""
SUPPORTED = (
    "of rsl-rl is not supported: a policy is a feed-forward network of the machine's history with "
    "Gaussian actions, trained with PPO"
)
PRIVILEGED = "privileged"
"""Observation group of what only a simulator knows."""


@spec
class TrainingBudget:
    """When training ends: with the first of these that is spent; `null` for no bound.

    Attributes:
        max_env_steps: Control steps over all environments.
        max_seconds: Seconds of training, those before a resume included.
    """

    max_env_steps: Count | None
    max_seconds: Positive | None

    def check(self) -> None:
        if self.max_env_steps is None and self.max_seconds is None:
            raise ConfigError(
                "max_env_steps: expected a bound here, in max_seconds or in both, got none; "
                "training without an end is not possible"
            )

    def share_spent(self, env_steps: int, seconds: float) -> float:
        """Return the spent share of the budget, 1 or more when all of it is spent."""
        return max(
            env_steps / (self.max_env_steps or float("inf")),
            seconds / (self.max_seconds or float("inf")),
        )


@spec
class Exploration:
    """Schedule of the cap of the exploration noise over the budget.

    A policy that learned with much noise may need it: without noise, valves rest in their dead
    bands, and a tool rests on the rim.

    Attributes:
        cap: Largest standard deviation of the actions, (at the beginning, at the end).
        over: Shares of the budget between which it falls; in equal ratios.
    """

    cap: tuple[Positive, Positive]
    over: Annotated[tuple[Share, Share], Ordered()]

    def cap_at(self, share_spent: float) -> float:
        """Return the cap when this share of the budget is spent."""
        return float(np.exp(np.interp(share_spent, self.over, np.log(self.cap))))


@spec
class Teacher:
    """The task's example, which a training imitates.

    Along its path it shows a detour, which rewards alone would make forgotten. Beside the path, at
    the target, it shows one way of several, which may be left sooner.

    Attributes:
        weight: Weight of the mean squared distance between the actions of both at the beginning.
        until: Shares of the budget at which the weight has fallen to 0, linearly: along the path,
            and beside it.
    """

    weight: Positive
    until: tuple[PositiveShare, PositiveShare]

    def weights_at(self, share_spent: float) -> list[float]:
        """Return the weights when this share of the budget is spent, [along the path, beside it]."""
        ends = (self.weight, 0.0)
        return [float(np.interp(share_spent, (0.0, until), ends)) for until in self.until]


@spec
class NearStarts:
    """Starts of a training that begin near the target.

    Attributes:
        share: Part of the episodes that begin there, the tool upright above its target, at the
            beginning and at the end of the budget; linear between them.
        height_m: Heights above the target, (lowest, highest).
        way: Parts of the way back to the drawn arm, (least, most), on which they begin.
    """

    share: tuple[ShareBelowOne, ShareBelowOne]
    height_m: Range
    way: Annotated[tuple[Share, Share], Ordered()]

    def share_at(self, share_spent: float) -> float:
        """Return the part of the episodes when this share of the budget is spent."""
        return float(np.interp(share_spent, (0.0, 1.0), self.share))


@spec
class TrainingConfig:
    """Numbers of a training with rsl-rl's PPO.

    Attributes:
        num_envs: Environments, of each process where several train together; `null` for the number
            of the simulator's configuration.
        num_starts: Number of valid starts from which resets draw.
        budget: When training ends.
        save_interval: Iterations between checkpoints; a killed run loses no more. As often several
            processes prove that they agree.
        keep_checkpoints: Newest checkpoints kept.
        settling: Last part of the budget, over which `desired_kl` falls to a tenth: large steps
            learn fast, small ones keep it.
        exploration: Schedule of the cap of the exploration noise; `null` for that of the
            distribution. The actor's distribution must be
            `brokk_rl.rl.ppo:CappedGaussian`.
        teacher: How to imitate the task's example; `null` to learn from rewards alone.
        near_starts: Starts near the target, in training only; `null` for those of the task.
        max_fault_rate: Share of control steps that may end in a diverged or overflowing world
            before the run stops with an error.
        fuse: Let `torch.compile` fuse the small operations around the physics, and on a GPU those of
            PPO, for half a minute of compiling and a C++ compiler. On a CPU, whose physics takes
            less than half of a control step of few worlds, it gains most.
        random_episode_lengths: Put the first episodes out of step, so that not all worlds reset at
            once.
        runner: rsl-rl's own configuration (`obs_groups`, `algorithm`, `actor`, `critic`,
            `num_steps_per_env`, …), handed on as it is.
    """

    num_envs: WorldCount | None
    num_starts: Count
    budget: TrainingBudget
    save_interval: Count
    keep_checkpoints: Count
    settling: Share
    exploration: Exploration | None
    teacher: Teacher | None
    near_starts: NearStarts | None
    max_fault_rate: Share
    fuse: bool
    random_episode_lengths: bool
    runner: dict[str, Any]

    def check(self) -> None:
        for path, allowed in RUNNER_VALUES.items():
            value = self._read_runner(path)
            if value is None and path != NUM_STEPS:  # rsl-rl has a default of its own
                continue
            value = require_value(f"runner.{path}", allowed, value)
            if isinstance(value, int):  # 1e2 was given for a whole number
                above, _, name = path.rpartition(".")
                (self._read_runner(above) if above else self.runner)[name] = value
        for name in ("algorithm", "actor", "critic", "obs_groups"):
            if not isinstance(self.runner.get(name), dict):
                raise ConfigError(f"runner.{name}: expected a table, got {self.runner.get(name)}")
        for name in ("algorithm", "actor", "critic", "actor.distribution_cfg"):
            class_name = str(self._read_runner(f"{name}.class_name"))
            if class_name.replace(":", ".").rpartition(".")[2] in REFUSED_CLASSES:
                raise ConfigError(f"runner.{name}.class_name: {class_name} {SUPPORTED}")
        if PRIVILEGED in (self._read_runner("obs_groups.actor") or ()):
            raise ConfigError(
                f"runner.obs_groups.actor: the machine does not know the group {PRIVILEGED}, so such a "
                "policy cannot be exported; give it to the critic alone"
            )
        for name in REFUSED_PARTS:
            if self._read_runner(f"algorithm.{name}") is not None:
                raise ConfigError(f"runner.algorithm.{name}: this part {SUPPORTED}")
        if self.num_envs is not None:
            self._check_batches(self.num_envs)
        distribution = self._read_runner("actor.distribution_cfg.class_name")
        if self.exploration and distribution != CAPPED:
            raise ConfigError(
                f"exploration: expected the distribution {CAPPED} "
                f"(rl.runner.actor.distribution_cfg.class_name), got {distribution}"
            )

    def check_sim(self, sim: Any) -> None:
        """Refuse more mini-batches than there are steps in a rollout of all worlds of a simulator."""
        parts = (sim, *vars(sim).values())  # sim=auto holds two simulators
        worlds = [getattr(part, "num_worlds", 0) for part in parts]
        if self.num_envs is None and any(worlds):
            self._check_batches(max(worlds))

    def _check_batches(self, num_envs: int) -> None:
        num_steps = num_envs * self.runner[NUM_STEPS]
        num_batches = self._read_runner("algorithm.num_mini_batches") or 1
        if num_batches > num_steps:
            raise ConfigError(
                f"rl.runner.algorithm.num_mini_batches: expected at most {num_steps}, the steps of a "
                f"rollout of {num_envs} environments, got {num_batches}"
            )

    def _read_runner(self, path: str) -> Any:
        """Return a value of `runner`, as in `actor.hidden_dims`; `None` where it is not given."""
        value: Any = self.runner
        for part in path.split("."):
            value = value.get(part) if isinstance(value, dict) else None
        return value

    def divergence(self, share_spent: float) -> float | None:
        """Return the `desired_kl` of updates when this share of the budget is spent."""
        desired = self.runner["algorithm"].get("desired_kl")
        left = np.interp(share_spent, (1.0 - self.settling, 1.0), (1.0, 1.0 - SETTLED_PART))
        return None if desired is None else desired * float(left)

    def describe_network(self) -> dict[str, Any]:
        """Return configuration and observation groups of the actor, as plain JSON data."""
        config = self.runner_config()
        return {
            "actor": config["actor"],
            "obs_groups": {"actor": list(config["obs_groups"]["actor"])},
        }

    def runner_config(self) -> dict[str, Any]:
        """Return a copy for rsl-rl, which writes into it, without keys whose value is `null`."""
        return _drop_nulls(copy.deepcopy(self.runner)) | {
            "save_interval": 10**9,
            "check_for_nan": False,
        }


@spec
class Evaluation:
    """Number of episodes, their seed, and how many to record and show.

    Attributes:
        episodes: Number of episodes, one from each start.
        seed: Seed of starts and noise; the same for every policy and run, so that results can be
            compared.
        num_recorded: Episodes recorded, or all if there are fewer; the video shows one of them.
        video: Whether to render a video.
    """

    episodes: WorldCount
    seed: Seed
    num_recorded: Count
    video: bool


def _drop_nulls(value: Any) -> Any:
    if isinstance(value, dict):
        kept = {}
        for key, item in value.items():
            if item is not None:
                kept[key] = _drop_nulls(item)
        return kept
    return value


@spec
class BenchmarkSizes:
    """Measurements: numbers of environments and durations.

    Attributes:
        num_envs: Numbers of environments, one row each; of each process where `torchrun` starts
            several.
        seconds: Least time of each measurement.
        iterations: Training iterations timed, after one to warm up.
    """

    num_envs: Counts
    seconds: Positive
    iterations: Count
