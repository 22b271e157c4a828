"""`brokk mode=evaluate`: evaluates a policy beside its rivals, all from the same starts."""

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
from brokk_rl.rl.evaluation import PolicyEvaluation, evaluate_policy
from brokk_rl.rl.vec_env import ControlLoop, ControlLoopConfig
from brokk_rl.session import Session, write_json
from brokk_rl.sim.video import render_video
from brokk_rl.spec import name_spec, spec

log = logging.getLogger(__name__)


class PolicySpec(Protocol):
    """A spec in `conf/policy`: builds a policy."""

    def build(self, loop: ControlLoop, seed: int) -> Policy:
        """Return the policy for the control loop."""
        ...


@spec
class Evaluation:
    """Number of episodes, their seed, and how many to record and show.

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
                "evaluation: expected 1 <= num_recorded <= episodes, "
                f"got {self.num_recorded} and {self.episodes}"
            )


@spec
class Evaluate:
    """Evaluates a policy and its rivals on the same starts.

    Attributes:
        session: Folder, seed, device.
        machine: The machine.
        sim: Physics.
        task: The task.
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
        """Evaluate; return the strict success of the policy."""
        config = ControlLoopConfig(
            machine=self.machine,
            sim=self.sim,
            task=self.task,
            actuator=self.actuator,
            effects=self.effect,
            follower=self.follower,
        )
        policies = {name_spec(self.policy): self.policy} | self.rivals
        results, _ = evaluate_policies(config, self.evaluation, self.session, policies)
        return float(results["success_strict"]["mean"])


def evaluate_policies(
    config: ControlLoopConfig,
    evaluation: Evaluation,
    session: Session,
    policies: dict[str, PolicySpec],
) -> tuple[dict[str, Any], torch.Tensor]:
    """Evaluate policies from the same starts with the same noise.

    Writes `evaluation.json` and `insertion.mp4`.

    Args:
        config: The control loop.
        evaluation: How to evaluate.
        session: Where to write, and on which device.
        policies: By name; the first is the one in question and stands at the top of
            `evaluation.json`.

    Returns:
        The content of `evaluation.json`, and observation vectors `(B, O)` of the first policy.
    """
    device = session.torch_device()
    torch.manual_seed(evaluation.seed)  # effects and followers draw from it, too
    loop = config.build(device, evaluation.episodes, evaluation.episodes, evaluation.seed)
    loop.capture()
    starts = {key: value.clone() for key, value in loop.starts.items()}
    fresh = loop.state_dict()
    evaluated: dict[str, PolicyEvaluation] = {}
    for name, policy in policies.items():
        log.info("evaluating %s over %d episodes", name, evaluation.episodes)
        loop.load_state_dict(fresh)  # every policy meets the same machines and persons
        evaluated[name] = evaluate_policy(
            loop, policy.build(loop, session.seed), starts, evaluation.seed, evaluation.num_recorded
        )
    table = {name: result.summary for name, result in evaluated.items()}
    first = next(iter(policies))
    results = {
        **table[first],
        "seed": evaluation.seed,
        "actuator": name_spec(config.actuator),
        "follower": name_spec(config.follower),
        "policy": first,
        "policies": table,
    }
    write_json(session.folder / "evaluation.json", results)
    _print_table(table)
    if evaluation.video:
        recorded = evaluated[first].episodes
        shown = next((episode for episode in recorded if episode.success), recorded[0])
        path = render_video(config.machine, shown, session.folder / "insertion.mp4")
        log.info("video of one episode: %s", path)
    return results, evaluated[first].observations


def _print_table(table: dict[str, dict[str, Any]]) -> None:
    """Print one row per policy; a figure that the task does not record is a dash."""
    columns = (
        ("strict success", lambda row: f"{row['success_strict']['mean']:.3f}"),
        ("95 %", lambda row: "{:.3f} to {:.3f}".format(*row["success_strict"]["ci95"])),
        ("paper's success", lambda row: f"{row['success_paper']['mean']:.3f}"),
        ("time to insert", lambda row: f"{row['time_to_insert_s']['median']:.1f} s"),
        ("lateral error", lambda row: f"{1000 * row['lateral_error_m']:.1f} mm"),
        ("peak force", lambda row: f"{row['peak_force_n']:.0f} N"),
        ("valve travel", lambda row: f"{row['valve_travel']:.2f} /s"),
    )
    view = Table("policy", *(title for title, _ in columns))
    for name, row in table.items():
        cells = []
        for _, write in columns:
            try:
                cells.append(write(row))
            except (KeyError, TypeError):  # not recorded, or no episode with success
                cells.append("-")
        view.add_row(name, *cells)
    Console().print(view)
