"""A whole study by simulated operators: the plan's trials on a simulated machine, questionnaires made up; all marked."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from brokk_rl import record
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.session import Session
from brokk_rl.spec import name_spec, spec
from study import study_folder as folders
from study import tlx
from study.design import Design, Trial
from study.measures import measure
from study.trial_contract import Operator, OperatorModel, OperatorView, TrialBatch, TrialGround

NOTICE = "simulated operators: no person took part, and nothing here is evidence about people"


@spec
class Nowhere:
    """No simulator: studies are planned, done by people and reported, as on the machine's own computer."""

    def run(
        self, machine: Machine, session: Session, trials: TrialBatch, operators: OperatorModel
    ) -> list[Recording]:
        """Is never called, since the study refuses before; see `study.trial_contract.TrialGround`."""
        raise NotImplementedError


def simulate(
    folder: Path,
    design: Design,
    planned: list[Trial],
    machine: Machine,
    session: Session,
    ground: TrialGround,
    guided: Operator,
    unguided: Operator,
) -> None:
    """Do every trial that counts, and writes recordings, trials and questionnaires into a study's folder.

    Args:
        folder: The study's folder, with its plan.
        design: The design of the plan.
        planned: Its trials; practice is left out, since these operators do not learn.
        machine: The machine.
        session: Gives the seed.
        ground: Where the trials are done.
        guided: Operators with advice.
        unguided: The same persons without.
    """
    # Practice has period 0.
    todo = [trial for trial in planned if trial.period]
    # A dictionary keeps the order of the plan, in which a set would not.
    names = list(dict.fromkeys(trial.participant for trial in todo))
    persons = np.array([names.index(trial.participant) for trial in todo])
    is_guided = np.array([trial.condition == "guided" for trial in todo])
    batch = _build_batch(design, todo, is_guided)
    # The seed is that of the study: the same persons take part in both conditions.
    operators = Divided(
        machine, persons, is_guided, guided, unguided, session.stream("study operators")
    )
    # The load of each period, from which the questionnaire is made up.
    loads: dict[tuple[str, int], list[float]] = {}
    for trial, recording in zip(todo, ground.run(machine, session, batch, operators), strict=True):
        path = folder / folders.RECORDINGS / f"{trial.name}.parquet"
        record.write_recording(recording, path)
        found = measure(
            recording, machine, design.holes[trial.hole], design.success, design.limit_s
        )
        facts: dict[str, Any] = {
            **asdict(trial),
            "hole": {"name": trial.hole, **asdict(design.holes[trial.hole])},
            "limit_s": design.limit_s,
            "outcome": "inserted" if found["success"] else "time limit",
            "recording": f"{folders.RECORDINGS}/{path.name}",
            "simulated": True,
            "operator": name_spec(guided if trial.condition == "guided" else unguided),
        }
        folders.write_trial(folder, trial.name, facts)
        # Time and effort together: a made-up workload only has to vary with both. Chosen by hand;
        # not searched.
        loads.setdefault((trial.participant, trial.period), []).append(
            found["time_s"] / design.limit_s + 0.1 * found["control_effort"]
        )
    generator = session.generator("study questionnaires")
    # Persons differ in how high they rate altogether: 10 points. Chosen by hand; not searched.
    own = {name: generator.normal(0.0, 10.0) for name in names}
    for (participant, period), load in loads.items():
        answers = answer_questionnaire(float(np.mean(load)), own[participant], generator)
        folders.write_questionnaire(folder, participant, period, {**answers, "simulated": True})


def _build_batch(design: Design, todo: list[Trial], is_guided: np.ndarray) -> TrialBatch:
    """Return starts, holes and limits of trials."""
    return TrialBatch(
        q=np.array([design.starts[trial.start] for trial in todo]),
        rim_in_base_m=np.array([design.holes[trial.hole].center_in_base_m for trial in todo]),
        radius_m=np.array([design.holes[trial.hole].radius_m for trial in todo]),
        guided=is_guided,
        limit_s=design.limit_s,
        depth_m=design.success.depth_m,
        clearance_m=design.success.clearance_m,
    )


def answer_questionnaire(
    load: float, habit: float, generator: np.random.Generator
) -> dict[str, Any]:
    """Return a questionnaire as made up from how long and busy the trials were; it has the form of answers, no more."""
    # A middle of 25 to 85 points leaves room for the habit at both ends. Chosen by hand; not
    # searched.
    middle = 25.0 + 60.0 * load + habit
    ratings = {}
    for scale in tlx.SCALES:
        # Ratings have steps of 5 points, as on the form (Hart and Staveland, 1988).
        ratings[scale] = int(
            np.clip(tlx.STEP * round((middle + generator.normal(0.0, 8.0)) / tlx.STEP), 0, 100)
        )
    chosen = []
    for pair in tlx.list_pairs(generator):
        chosen.append({"pair": list(pair), "chosen": pair[int(generator.integers(2))]})
    return {"ratings": ratings, "pairs": chosen, "note": NOTICE}


class Divided:
    """Operators of two kinds, each in the trials of their condition.

    Args:
        machine: The machine.
        persons: Number of the person in each trial, `(N,)`.
        is_guided: In which trials advice is shown, `(N,)` bool.
        guided: Operators with advice.
        unguided: Operators without.
        seed: Who the persons are.
    """

    def __init__(
        self,
        machine: Machine,
        persons: np.ndarray,
        is_guided: np.ndarray,
        guided: Operator,
        unguided: Operator,
        seed: int,
    ) -> None:
        self._shape = (len(persons), machine.num_joints)
        self._parts: list[tuple[np.ndarray, OperatorModel]] = []
        # A study may have one condition only; an operator without trials is not built.
        for chosen, operator in ((is_guided, guided), (~is_guided, unguided)):
            rows = np.flatnonzero(chosen)
            if len(rows):
                self._parts.append((rows, operator.build(machine, persons[rows], seed)))

    def step(self, view: OperatorView) -> np.ndarray:
        """See `study.trial_contract.OperatorModel`."""
        given = np.zeros(self._shape)
        for rows, model in self._parts:
            given[rows] = model.step(
                OperatorView(view.q[rows], view.rim_in_base_m[rows], view.advice[rows])
            )
        return given
