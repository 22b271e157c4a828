"""`brokk mode=evaluate`: evaluates a policy beside its rivals, all from the same starts."""

from __future__ import annotations

import logging
from dataclasses import asdict, replace
from typing import Any

import torch

from brokk_rl.console_table import print_table
from brokk_rl.contracts.target import TargetSensorSpec
from brokk_rl.contracts.task import SUCCESS, Figure
from brokk_rl.policy_folder import describe_task
from brokk_rl.progress import ItemProgress
from brokk_rl.rl.evaluation import PolicyEvaluation, evaluate_policy
from brokk_rl.rl.loop import ControlLoop, SimulatedPlant, Starts
from brokk_rl.rl.policy import ClassicalPolicy, PolicySpec
from brokk_rl.rl.settings import Evaluation
from brokk_rl.session import Session, write_json
from brokk_rl.sim.simulator import find_site
from brokk_rl.sim.video import render_video
from brokk_rl.spec import name_spec, spec

log = logging.getLogger(__name__)


@spec
class Evaluate(SimulatedPlant):
    """Evaluates a policy and its rivals on the same starts.

    Attributes:
        session: Folder, seed, device.
        machine: The machine.
        sim: Physics.
        task: The task.
        actuator: How commands become motion.
        effect: Effects around the actuator model, by name.
        event: Changes of the simulated machine, by name.
        follower: Who stands between policy and machine.
        target: How the loop comes to know its target; `null`: the task draws errors.
        policy: The policy in question.
        rivals: Policies beside it, by name.
        evaluation: How to evaluate.
    """

    session: Session
    target: TargetSensorSpec | None
    policy: PolicySpec
    rivals: dict[str, PolicySpec]
    evaluation: Evaluation

    def run(self) -> float:
        """Evaluate; return the strict success of the policy."""
        policies = {name_spec(self.policy): self.policy} | self.rivals
        results = evaluate_policies(self, self.evaluation, self.session, policies, self.target)
        return float(results["success_strict"]["mean"])


def evaluate_policies(
    plant: SimulatedPlant,
    evaluation: Evaluation,
    session: Session,
    policies: dict[str, PolicySpec],
    target: TargetSensorSpec | None = None,
) -> dict[str, Any]:
    """Evaluate policies from the same starts with the same noise.

    A policy that has a task of its own acts by it, the others by `plant.task`. Writes
    `evaluation.json` and `episode.mp4`.

    Args:
        plant: Machine, physics, actuator and task.
        evaluation: How to evaluate.
        session: Where to write, and on which device.
        policies: By name; the first is the one in question and stands at the top of
            `evaluation.json`.
        target: How the loops come to know their targets; `None`: the task draws errors.

    Returns:
        The content of `evaluation.json`.
    """
    device = session.torch_device()
    tasks = {name: getattr(one, "task", None) or plant.task for name, one in policies.items()}
    descriptions = {name: describe_task(task) for name, task in tasks.items()}
    loops: dict[str, tuple[ControlLoop, dict[str, Any]]] = {}
    starts: Starts | None = None
    evaluated: dict[str, PolicyEvaluation] = {}
    figures: dict[str, Figure] = {}
    for name, policy in policies.items():
        key = descriptions[name].fingerprint()
        if key not in loops:
            # effects and followers draw from it, too
            torch.manual_seed(evaluation.seed)
            num = evaluation.episodes
            own = replace(plant, task=tasks[name])
            loop = own.build(device, num, num, evaluation.seed, starts, target)
            loop.capture()
            loops[key] = loop, loop.state_dict()
        loop, fresh = loops[key]
        is_rival = evaluated and isinstance(policy, ClassicalPolicy)
        if is_rival and "classical_action" not in loop.task.offers:
            log.info(
                "the task (%s) has no classical controller to compare with", descriptions[name].name
            )
            continue
        log.info("evaluating %s over %d episodes", name, evaluation.episodes)
        starts = starts or {key: value.clone() for key, value in loop.starts.items()}
        loop.load_state_dict(fresh)  # every policy meets the same machines and persons
        figures |= loop.task.figures
        actor = policy.build(loop, session.seed)
        with ItemProgress(f"evaluating {name}", loop.task.max_episode_steps) as progress:
            evaluated[name] = evaluate_policy(
                loop, actor, starts, evaluation.seed, evaluation.num_recorded, progress.advance
            )
    table = {name: result.summary for name, result in evaluated.items()}
    first = next(iter(policies))
    results = {
        **table[first],
        "seed": evaluation.seed,
        "actuator": name_spec(plant.actuator),
        "follower": name_spec(plant.follower),
        "policy": first,
        "task": descriptions[first].to_json(),
        "tasks": {name: descriptions[name].fingerprint() for name in evaluated},
        "figures": {name: asdict(figure) for name, figure in figures.items()},
        "policies": table,
    }
    write_json(session.folder / "evaluation.json", results)
    _print_table(table, figures)
    if evaluation.video:
        recorded = evaluated[first].episodes
        shown = next((episode for episode in recorded if episode.success), recorded[0])
        site = find_site(getattr(plant.task, "scene", None), plant.sim)
        path = render_video(plant.machine, shown, session.folder / "episode.mp4", site)
        if path:
            log.info("video of one episode: %s", path)
    return results


def _print_table(table: dict[str, dict[str, Any]], figures: dict[str, Figure]) -> None:
    """Print one row per policy; a figure that the task does not record is a dash."""
    titles = ["policy"]
    for name, figure in figures.items():
        titles += [figure.title, "95 %"] if name == SUCCESS else [figure.title]
    rows = []
    for policy, row in table.items():
        cells: list[str | None] = [policy]
        for name, figure in figures.items():
            value = row.get(name)
            if isinstance(value, dict):
                value = value["mean" if "mean" in value else "median"]
            cells.append(None if value is None else figure.word(value))
            if name == SUCCESS:
                cells.append("{:.3f} to {:.3f}".format(*row[name]["ci95"]))
        rows.append(cells)
    print_table(titles, rows)
