"""Specs of training and evaluation.

This module needs no torch, so that a bad value is refused before torch is loaded.
"""

from __future__ import annotations

import copy
from typing import Any

from brokk_rl.bounds import require_number, require_range
from brokk_rl.errors import ConfigError
from brokk_rl.spec import spec

SETTLED_PART = 0.9
"""Part of `desired_kl` that is gone at the end of the budget; chosen by hand, see
`TrainingConfig.settling`."""
CAPPED = "brokk_rl.rl.ppo:CappedGaussian"
"""The distribution whose cap `Exploration` moves."""
RUNNER_BOUNDS: dict[str, dict[str, Any]] = {
    "num_steps_per_env": {"least": 1, "whole": True},
    "algorithm.num_learning_epochs": {"least": 1, "whole": True},
    "algorithm.num_mini_batches": {"least": 1, "whole": True},
    "algorithm.clip_param": {"above": 0},
    "algorithm.gamma": {"above": 0, "most": 1},
    "algorithm.lam": {"least": 0, "most": 1},
    "algorithm.value_loss_coef": {"least": 0},
    "algorithm.entropy_coef": {"least": 0},
    "algorithm.learning_rate": {"above": 0},
    "algorithm.max_grad_norm": {"above": 0},
    "algorithm.desired_kl": {"above": 0},
    "actor.distribution_cfg.init_std": {"above": 0},
}
"""Bounds of rsl-rl's numbers, which it does not check itself: outside of them it divides by zero,
climbs instead of descends, or trains nothing."""

REFUSED_CLASSES = {
    "RNNModel": "recurrent networks are neither exported nor deployed; task.memory gives a history",
    "CNNModel": "observations are vectors, not pictures",
    "Distillation": "train with PPO",
    "StudentTeacher": "train with PPO",
}
"""Classes of rsl-rl that would fail after the whole budget, and the reason or another way."""


@spec
class TrainingBudget:
    """When training ends: with the first of these that is spent; `null` for no bound.

    Attributes:
        max_env_steps: Control steps over all environments.
        max_seconds: Seconds of training, those before a resume included.
    """

    max_env_steps: int | None
    max_seconds: float | None

    def check(self) -> None:
        if self.max_env_steps is None and self.max_seconds is None:
            raise ConfigError(
                "rl.budget: give max_env_steps, max_seconds or both; "
                "training without an end is not possible"
            )
        if self.max_env_steps is not None:
            require_number("rl.budget.max_env_steps", self.max_env_steps, least=1)
        if self.max_seconds is not None:
            require_number("rl.budget.max_seconds", self.max_seconds, above=0)

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

    cap: tuple[float, float]
    over: tuple[float, float]

    def check(self) -> None:
        for value in self.cap:
            require_number("rl.exploration.cap", value, above=0)
        require_range("rl.exploration.over", self.over, least=0)
        require_number("rl.exploration.over", self.over[1], most=1)

    def cap_at(self, share_spent: float) -> float:
        """Return the cap when this share of the budget is spent."""
        (first, last), (begin, end) = self.cap, self.over
        done = float(share_spent >= end)
        if end > begin:
            done = min(1.0, max(0.0, (share_spent - begin) / (end - begin)))
        return first * (last / first) ** done


@spec
class Teacher:
    """A trained policy that a training follows at its beginning.

    Attributes:
        folder: Its bundle, as `policy.folder`; its task must act as the one that is trained.
        weight: Weight of the mean squared distance between the actions of both at the beginning.
        until: Share of the budget at which the weight has fallen to 0, linearly.
    """

    folder: str
    weight: float
    until: float

    def check(self) -> None:
        require_number("rl.teacher.weight", self.weight, above=0)
        require_number("rl.teacher.until", self.until, above=0, most=1)

    def weight_at(self, share_spent: float) -> float:
        """Return the weight when this share of the budget is spent."""
        return self.weight * max(0.0, 1.0 - share_spent / self.until)


@spec
class NearStarts:
    """Starts of a training that begin near the target.

    Attributes:
        share: Part of the starts that are moved there, the tool upright above its target.
        height_m: Heights above the target, (lowest, highest).
    """

    share: float
    height_m: tuple[float, float]

    def check(self) -> None:
        require_number("rl.near_starts.share", self.share, above=0, most=1)
        require_range("rl.near_starts.height_m", self.height_m)


FAULT_STEPS = 100
"""Control steps that a training on a CPU keeps of each world: 5 s at 20 Hz."""


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
        output_gain: Factor on the initial weights of the actor's last layer; 1 leaves them. With a
            small one a residual policy begins as the classical controller.
        exploration: Schedule of the cap of the exploration noise; `null` for that of the
            distribution. The actor's distribution must be
            `brokk_rl.rl.ppo:CappedGaussian`.
        symmetry: Learn from each step and its left-right mirror image, at twice the arithmetic of an
            update. The machine has to be symmetric.
        teacher: Policy to follow at the beginning; `null` to learn from rewards alone.
        near_starts: Starts near the target, in training only; `null` for those of the task.
        max_fault_rate: Share of control steps that may end in a diverged or overflowing world
            before the run stops with an error.
        fault_steps: Control steps kept of each world; those of worlds that diverge are written into
            `faults` of the run folder. 0 records nothing; `None`: 100 on a CPU, 0 on a GPU, where
            100 slow the control step by 8 % (`benchmarks/h100/recorder.json`).
        fuse: Let `torch.compile` fuse the small operations around the physics, and on a GPU those of
            PPO, for half a minute of compiling and a C++ compiler. On a CPU, whose physics takes
            less than half of a control step of few worlds, it gains most.
        tf32: Multiply matrices of captured training with ten bits of mantissa (TF32) on a GPU; false:
            all of float32. `runner.algorithm.use_mixed_precision` takes bfloat16, with seven bits.
        random_episode_lengths: Put the first episodes out of step, so that not all worlds reset at
            once.
        runner: rsl-rl's own configuration (`obs_groups`, `algorithm`, `actor`, `critic`,
            `num_steps_per_env`, …), handed on as it is.
    """

    num_envs: int | None
    num_starts: int
    budget: TrainingBudget
    save_interval: int
    keep_checkpoints: int
    settling: float
    output_gain: float
    exploration: Exploration | None
    symmetry: bool
    teacher: Teacher | None
    near_starts: NearStarts | None
    max_fault_rate: float
    fault_steps: int | None
    fuse: bool
    tf32: bool
    random_episode_lengths: bool
    runner: dict[str, Any]

    def count_fault_steps(self, device_type: str) -> int:
        """Return how many control steps of each world a training on `cpu` or `cuda` keeps."""
        if self.fault_steps is None:
            return FAULT_STEPS if device_type == "cpu" else 0
        return self.fault_steps

    def check(self) -> None:
        counts = ("num_starts", "save_interval", "keep_checkpoints")
        for name in counts if self.num_envs is None else ("num_envs", *counts):
            require_number(f"rl.{name}", getattr(self, name), least=1)
        for name in ("settling", "max_fault_rate"):
            require_number(f"rl.{name}", getattr(self, name), least=0, most=1)
        if self.fault_steps is not None:
            require_number("rl.fault_steps", self.fault_steps, least=0)
        require_number("rl.output_gain", self.output_gain, above=0)
        self._check_runner()
        distribution = self.runner.get("actor", {}).get("distribution_cfg") or {}
        if self.exploration and distribution.get("class_name") != CAPPED:
            raise ConfigError(
                f"rl.exploration: expected the distribution {CAPPED} "
                "(rl.runner.actor.distribution_cfg.class_name), got "
                f"{distribution.get('class_name')}"
            )

    def _check_runner(self) -> None:
        """Refuse numbers that rsl-rl would take without a word, and parts of it that fail later."""
        for name in ("algorithm", "actor", "critic"):
            class_name = str(self.runner.get(name, {}).get("class_name", ""))
            if reason := REFUSED_CLASSES.get(class_name.replace(":", ".").rpartition(".")[2]):
                raise ConfigError(
                    f"rl.runner.{name}.class_name: {class_name} of rsl-rl is not supported: {reason}"
                )
        if self.runner.get("algorithm", {}).get("rnd_cfg") is not None:
            raise ConfigError(
                "rl.runner.algorithm.rnd_cfg: random network distillation is not supported; "
                "more exploration comes from rl.runner.actor.distribution_cfg.std_range"
            )
        if self.runner.get("algorithm", {}).get("symmetry_cfg") is not None:
            raise ConfigError(
                "rl.runner.algorithm.symmetry_cfg: rsl-rl's own is not supported; rl.symmetry=true "
                "learns from each step and its mirror image"
            )
        for path, bounds in RUNNER_BOUNDS.items():
            value: Any = self.runner
            for part in path.split("."):
                value = value.get(part) if isinstance(value, dict) else None
            if value is not None:  # rsl-rl has a default of its own
                require_number(f"rl.runner.{path}", value, **bounds)
        for name in ("actor", "critic"):
            network = self.runner.get(name, {})
            for width in network.get("hidden_dims", ()):
                require_number(f"rl.runner.{name}.hidden_dims", width, least=1, whole=True)
            if spread := (network.get("distribution_cfg") or {}).get("std_range"):
                require_range(f"rl.runner.{name}.distribution_cfg.std_range", tuple(spread), 0)

    def divergence(self, share_spent: float) -> float | None:
        """Return the `desired_kl` of updates when this share of the budget is spent."""
        desired = self.runner["algorithm"].get("desired_kl")
        if desired is None or share_spent <= 1.0 - self.settling:
            return desired
        return desired * (
            1.0 - SETTLED_PART * min(1.0, (share_spent - 1.0 + self.settling) / self.settling)
        )

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

    episodes: int
    seed: int
    num_recorded: int
    video: bool

    def check(self) -> None:
        require_number("evaluation.episodes", self.episodes, least=1)
        require_number("evaluation.seed", self.seed, least=0)
        require_number("evaluation.num_recorded", self.num_recorded, least=1)


def _drop_nulls(value: Any) -> Any:
    if isinstance(value, dict):
        kept = {}
        for key, item in value.items():
            if item is not None:
                kept[key] = _drop_nulls(item)
        return kept
    return value
