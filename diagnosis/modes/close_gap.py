"""`brokk mode=close_gap`: success of a policy before and after retraining with effects."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

from brokk_rl.console_table import print_table, print_text
from brokk_rl.contracts.actuator import Actuator, Effect, Follower
from brokk_rl.contracts.task import Task
from brokk_rl.contracts.world import Simulator
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.modes.compare import EVALUATION
from brokk_rl.modes.evaluate import evaluate_policies
from brokk_rl.modes.train import Train
from brokk_rl.policy_folder import CONTRACT
from brokk_rl.rl.logger import Tracking
from brokk_rl.rl.loop import SimulatedPlant
from brokk_rl.rl.policy import PolicySpec, TrainedPolicy
from brokk_rl.rl.settings import Evaluation, TrainingConfig
from brokk_rl.session import Session, write_json
from brokk_rl.spec import name_spec, spec
from diagnosis import retraining

log = logging.getLogger(__name__)

RETRAINED = "retrained"


@spec
class StandIn:
    """Stand-in of the machine: an actuator with effects that the simulator does not know.

    Attributes:
        actuator: Its actuator.
        effect: Effects by name, the first nearest to the machine.
    """

    actuator: Actuator
    effect: dict[str, Effect]


@spec
class CloseGap:
    """Evaluate a policy before and after retraining with the diagnosed effects.

    Attributes:
        session: Folder, seed, device.
        machine: The machine.
        sim: Physics.
        task: The task.
        actuator: The simulator's actuator, as it was.
        effect: Its effects, as it was.
        found: Effects that the diagnosis found; the repaired simulator has them too.
        randomisation: Effects around these while training, so that the policy does not rely on
            exact numbers.
        stand_in: The machine.
        follower: Who stands between policy and machine.
        policy: The policy as it was.
        panel: Policies beside it, by name, to compare with.
        warm: Retrain from the network of `policy`; false: from a fresh one.
        rl: How to train.
        tracking: Where figures of the training go beside the run folder.
        evaluation: How to evaluate.
        resume: Run folder of an interrupted run to go on with; the same as `session.out`.
        asked: Keys of the task that were given on the command line; policies act by the tasks that
            they were trained in, and what contradicts these is refused.
    """

    session: Session
    machine: Machine
    sim: Simulator
    task: Task
    actuator: Actuator
    effect: dict[str, Effect]
    found: dict[str, Effect]
    randomisation: dict[str, Effect]
    stand_in: StandIn
    follower: Follower
    policy: TrainedPolicy
    panel: dict[str, PolicySpec]
    warm: bool
    rl: TrainingConfig
    tracking: Tracking
    evaluation: Evaluation
    resume: str | None

    def check(self) -> None:
        if not self.found:
            raise ConfigError(
                "close_gap: there is no effect to retrain with; give 'effect@found=[@<effects.yaml of mode=diagnose>]'. "
                "A diagnosis that says none or unknown leaves nothing to repair."
            )
        for name in (retraining.BEFORE, retraining.AFTER):
            if name in self.panel:
                raise ConfigError(f"panel.{name}: this name is taken; give another")
        for one, other in (("effect", self.effect), ("randomisation", self.randomisation)):
            if both := sorted(set(other) & set(self.found)):
                raise ConfigError(
                    f"close_gap: {', '.join(both)} stands in '{one}' and in 'found'; rename it in one of them"
                )
        if self.resume is not None and Path(self.resume).resolve() != self.session.folder.resolve():
            raise ConfigError(
                f"resume={self.resume}: an interrupted run goes on in its folder; add session.out={self.resume}"
            )

    def run(self) -> float:
        """Write `close_gap.json`, `.html`, `.png`; return the success of the retrained policy.

        Below the run folder lie `retrained/` (as `mode=train` leaves it) and an `evaluation.json`
        for each plant.
        """
        folder = self.session.folder
        policies: dict[str, PolicySpec] = {
            retraining.BEFORE: self.policy,
            retraining.AFTER: TrainedPolicy(path=str(self._retrained()), task=None),
            **self.panel,
        }
        plants = self._plants()
        evaluations = {
            name: self._evaluated(name, plant, policies) for name, plant in plants.items()
        }
        trained = json.loads((folder / RETRAINED / CONTRACT).read_text())["trained"]
        found = retraining.compare_policies(evaluations) | {
            "plants": {name: _describe_plant(plant) for name, plant in plants.items()},
            "retraining": {
                "began with": self.policy.path if self.warm else "a fresh network",
                "trained with": _describe_plant(self._training_plant()),
                "control steps": trained["env_steps"],
                "seconds": trained["seconds"],
                "device": trained["device"],
                "seed": self.session.seed,
            },
        }
        write_json(folder / retraining.COMPARISON_FILE, found)
        retraining.write_report(found, folder)
        _show(found, folder)
        return float(found["achieved"]["mean"])

    def _plants(self) -> dict[str, SimulatedPlant]:
        known = SimulatedPlant(
            machine=self.machine,
            sim=self.sim,
            task=self.task,
            actuator=self.actuator,
            effect=self.effect,
            event={},
            follower=self.follower,
        )
        return {
            "simulator": known,
            "repaired": replace(known, effect=self.effect | self.found),
            "machine": replace(known, actuator=self.stand_in.actuator, effect=self.stand_in.effect),
        }

    def _training_plant(self) -> SimulatedPlant:
        known = self._plants()["repaired"]
        return replace(known, effect=self.effect | self.randomisation | self.found)

    def _retrained(self) -> Path:
        """Return the folder of the retrained policy; train it unless that is done."""
        place = self.session.folder / RETRAINED
        if (place / EVALUATION).exists():
            return place
        place.mkdir(exist_ok=True)
        plant = self._training_plant()
        log.info("retraining with %s", ", ".join(self.found))
        Train(
            session=replace(self.session, out=str(place)), machine=self.machine, sim=self.sim, task=plant.task,
            actuator=plant.actuator, effect=plant.effect, event={}, follower=self.follower, rl=self.rl, tracking=self.tracking,
            evaluation=self.evaluation, policy=self.policy if self.warm else None,
        ).run()  # fmt: skip
        return place

    def _evaluated(
        self, name: str, plant: SimulatedPlant, policies: dict[str, PolicySpec]
    ) -> dict[str, Any]:
        """Return `evaluation.json` on a plant; one that an interrupted run has written is kept."""
        place = self.session.folder / name
        if (place / EVALUATION).exists():
            return json.loads((place / EVALUATION).read_text())
        place.mkdir(exist_ok=True)
        log.info("on the %s", retraining.PLANT_NAMES[name])
        return evaluate_policies(
            plant, self.evaluation, replace(self.session, out=str(place)), policies
        )


def _describe_plant(plant: SimulatedPlant) -> str:
    return " + ".join([name_spec(plant.actuator), *plant.effect])


def _show(found: dict[str, Any], folder: Path) -> None:
    rows = []
    for policy, shares in found["success"].items():
        name = retraining.POLICY_NAMES.get(policy, policy)
        rates = (retraining.format_rate(shares[plant]) for plant in retraining.PLANTS)
        rows.append([name, *rates])
    print_text(retraining.write_headline(found)[0], "bold")
    plants = (retraining.PLANT_NAMES[plant] for plant in retraining.PLANTS)
    print_table(["strict success", *plants], rows)
    print_text(f"report: {folder / retraining.REPORT_FILE}")
