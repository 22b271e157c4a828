"""`brokk mode=evaluate`: how good is a policy, beside what else could be used, from the same starts."""

from __future__ import annotations

import logging
from typing import Any, Protocol

import torch
from rich.console import Console
from rich.table import Table

from brokk_rl.contracts.actuator import Actuator, Effect, Follower
from brokk_rl.contracts.task import Policy, Task
from brokk_rl.contracts.world import Simulator
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.rl.evaluation import RecordedEpisode, evaluate_policy
from brokk_rl.rl.vec_env import ControlLoop, ControlLoopConfig
from brokk_rl.session import Session, write_json
from brokk_rl.sim.video import render_video
from brokk_rl.spec import name_spec, spec

log = logging.getLogger(__name__)


class PolicySpec(Protocol):
    """A spec in `conf/policy`."""

    def build(self, loop: ControlLoop, seed: int) -> Policy:
        """Returns the policy for the control loop."""
        ...


@spec
class Evaluation:
    """How to evaluate.

    Attributes:
        episodes: Number of episodes, one from each start.
        seed: Seed of starts and noise; the same for every policy and run, so that results can be
            compared.
        num_recorded: Episodes recorded, of which the video shows one.
        video: Whether to render a video.
    """

    episodes: int
    seed: int
    num_recorded: int
    video: bool

    def check(self) -> None:
        if not 1 <= self.num_recorded <= self.episodes:
            raise ConfigError(
                f"evaluation: expected 1 <= num_recorded <= episodes, got {self.num_recorded} and {self.episodes}"
            )


@spec
class Evaluate:
    """Evaluates a policy and its rivals on the same starts.

    Attributes:
        session: Folder, seed, device.
        machine: The machine.
        sim: Physics.
        task: What to do.
        actuator: How commands become motion.
        effect: Effects around the actuator model, by name.
        follower: Who stands between policy and machine.
        policy: The policy in question.
        rivals: Policies beside it, by name.
        evaluation: How to evaluate.
    """

    session: Session
    machine: Machine
    sim: Simulator
    task: Task
    actuator: Actuator
    effect: dict[str, Effect]
    follower: Follower
    policy: PolicySpec
    rivals: dict[str, PolicySpec]
    evaluation: Evaluation

    def run(self) -> float:
        """Evaluates; returns the strict success of the policy."""
        plant = ControlLoopConfig(
            machine=self.machine,
            sim=self.sim,
            task=self.task,
            actuator=self.actuator,
            effects=self.effect,
            follower=self.follower,
        )
        policies = {
            type(self.policy).__name__.removesuffix("Policy").lower(): self.policy
        } | self.rivals
        results, _ = evaluate_policies(plant, self.evaluation, self.session, policies)
        return float(results["success_strict"]["mean"])


def evaluate_policies(
    plant: ControlLoopConfig,
    evaluation: Evaluation,
    session: Session,
    policies: dict[str, PolicySpec],
) -> tuple[dict[str, Any], torch.Tensor]:
    """Evaluates policies from the same starts with the same noise, and writes `evaluation.json` and `insertion.mp4`.

    Args:
        plant: What to evaluate on.
        evaluation: How.
        session: Where to write, and on which device.
        policies: By name; the first is the one in question and stands at the top of
            `evaluation.json`.

    Returns:
        The content of `evaluation.json`, and observation vectors `(B, O)` that the first policy
        met.
    """
    device = session.torch_device()
    torch.manual_seed(evaluation.seed)  # from which effects and followers draw, too
    loop = plant.build(device, evaluation.episodes, evaluation.episodes, evaluation.seed)
    loop.capture()
    starts = {key: value.clone() for key, value in loop.starts.items()}
    fresh = loop.state_dict()
    table: dict[str, Any] = {}
    recorded: dict[str, list[RecordedEpisode]] = {}
    seen: dict[str, torch.Tensor] = {}
    for name, policy in policies.items():
        log.info("evaluating %s over %d episodes", name, evaluation.episodes)
        loop.load_state_dict(fresh)  # every policy meets the same machines and persons
        acting = policy.build(loop, session.seed)
        table[name], recorded[name], seen[name] = evaluate_policy(
            loop, acting, starts, evaluation.seed, evaluation.num_recorded
        )
    first = next(iter(policies))
    results = {
        **table[first],
        "seed": evaluation.seed,
        "actuator": name_spec(plant.actuator),
        "follower": name_spec(plant.follower),
        "policy": first,
        "policies": table,
    }
    write_json(session.folder / "evaluation.json", results)
    _print(table)
    if evaluation.video:
        shown = next(
            (episode for episode in recorded[first] if episode.success), recorded[first][0]
        )
        path = render_video(plant.machine, shown, session.folder / "insertion.mp4")
        log.info("video of one episode: %s", path)
    return results, seen[first]


def _print(table: dict[str, Any]) -> None:
    view = Table(
        "policy",
        "strict success",
        "95 %",
        "paper's success",
        "time to insert",
        "lateral error",
        "peak force",
        "valve travel",
    )
    for name, row in table.items():
        strict, time = row["success_strict"], row["time_to_insert_s"]["median"]
        view.add_row(
            name,
            f"{strict['mean']:.3f}",
            f"{strict['ci95'][0]:.3f} to {strict['ci95'][1]:.3f}",
            f"{row['success_paper']['mean']:.3f}",
            "-" if time is None else f"{time:.1f} s",
            f"{1000 * row['lateral_error_m']:.1f} mm",
            f"{row['peak_force_n']:.0f} N",
            f"{row['valve_travel']:.2f} /s",
        )
    Console().print(view)
