"""`brokk mode=exam`: makes sealed cases, has each diagnosed by a process that cannot read the labels, and marks the answers."""

from __future__ import annotations

import logging
import secrets
from typing import Literal

import numpy as np
from rich.progress import Progress

from brokk_rl.contracts import Excitation
from brokk_rl.diagnosis.exam import paper, seal
from brokk_rl.diagnosis.exam.making import Half, Workshop
from brokk_rl.diagnosis.exam.mix import Mix
from brokk_rl.diagnosis.exam.specimen import PlantFamily
from brokk_rl.errors import ConfigError, choices
from brokk_rl.machine import Machine
from brokk_rl.plan.schedule import Approach
from brokk_rl.session import Session, write_json
from brokk_rl.spec import spec

log = logging.getLogger(__name__)


@spec
class Examination:
    """What to do, and with which cases.

    Attributes:
        do: `make` cases, `run` the diagnosis on them, `score` the answers.
        mix: Which cases there are.
        plants: Machines that share no equations with what is examined.
        roughness: How much of a machine no tidy model has: a name of the family's, `mild` or `strong`.
        reference: How the machine as it is believed to be is recorded.
        field: How the machine as it is is recorded.
        approach: How start poses are taken up.
        first_sealed_seed: Seeds (`session.seed`) from here on are for exams, smaller ones for development.
        sealed: Allows a seed of an exam; its cases cannot be made again from the seed without the salt among the labels.
        salt: That salt, to make the cases of an opened exam again; `null` draws one.
    """

    do: Literal["make", "run", "score"]
    mix: Mix
    plants: PlantFamily
    roughness: str
    reference: Half
    field: Half
    approach: Approach
    first_sealed_seed: int
    sealed: bool
    salt: str | None

    def check(self) -> None:
        for name in self.mix.troubles:
            if name not in self.plants.effects:
                raise ConfigError(f"exam.mix.troubles: no plant has '{name}'; {choices(name, self.plants.effects)}")


@spec
class Exam:
    """Examines the diagnosis on cases whose cause is withheld: makes them, sits them, scores them."""

    session: Session
    machine: Machine
    excitation: dict[str, Excitation]
    exam: Examination

    def run(self) -> None:
        """Does what `exam.do` says, in the run folder."""
        getattr(self, f"_{self.exam.do}")()

    def _make(self) -> None:
        """Writes `cases/`, `labels.sealed.json` (mode 0600), `labels.sha256` and `exam.json`."""
        settings, folder = self.exam, self.session.folder
        is_exam = self.session.seed >= settings.first_sealed_seed
        if is_exam != settings.sealed:
            raise ConfigError(
                f"session.seed={self.session.seed} with exam.sealed={str(settings.sealed).lower()}: seeds from "
                f"{settings.first_sealed_seed} on are for exams and need exam.sealed=true, smaller ones are for development"
            )
        salt = settings.salt or secrets.token_hex(16)
        # cases of an exam hang on the salt too, which nobody knows before the labels are opened
        entropy = [self.session.seed, *(salt.encode() if is_exam else b"")]
        questions = settings.mix.questions(self.machine, settings.plants.ailments, np.random.default_rng(entropy))
        workshop = Workshop(self.machine, settings.plants, settings.roughness, self.excitation, settings.approach)
        total = len(questions) * (len(settings.reference.programs) + len(settings.field.programs))
        with Progress(transient=True) as progress:
            task = progress.add_task(f"{len(questions)} cases", total=total)
            labels = paper.write(
                workshop, questions, settings.reference, settings.field, self.machine, folder, lambda n: progress.advance(task, n)
            )
        facts = {
            "schema": 1,
            "seed": self.session.seed,
            "sealed": is_exam,
            "roughness": settings.roughness,
            "num_cases": len(labels),
        }
        found = seal.seal(folder, {**facts, "cases": labels}, salt)
        write_json(folder / "exam.json", {**facts, "labels_sha256": found})
        log.info("%d cases in %s, labels sealed: sha256 %s", len(labels), folder / paper.CASES, found)
