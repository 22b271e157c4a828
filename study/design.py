"""Plan of the trials: sequences drawn by lot, holes and starts in Latin squares, practice before.

A participant does a few trials in each of two periods, one with guidance and one without. Which
comes first is drawn, in pairs of participants, so that at no time one sequence is two ahead. Within
a period every hole and every start occurs once, and over participants each stands at every place of
the period equally often: neither a hard hole nor practice favours a condition.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Interval

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.spec import Index, Positive, spec

CONDITIONS = ("guided", "unguided")
PERIODS = (1, 2)


@spec
class Hole:
    """A borehole of the study, measured in the machine's base frame.

    Attributes:
        center_in_base_m: Centre of its rim.
        radius_m: Its radius.
    """

    center_in_base_m: tuple[float, float, float]
    radius_m: Positive


@spec
class Success:
    """When the chisel counts as inserted, as in the project's strict criterion.

    Attributes:
        depth_m: Depth of the tip below the rim.
        clearance_m: Distance from the hole's axis within which the tip is inside: radius of the
            hole less that of the chisel.
    """

    depth_m: Positive
    clearance_m: Positive


@spec
class Design:
    """Design of a study.

    Attributes:
        num_participants: Participants to invite.
        holes: Boreholes by name, one trial each in each period.
        starts: Joint positions from which trials begin, by name, as many as holes; rad or m.
        practice_trials: Trials before the first period that do not count, half of them with
            guidance, until two in a row succeed.
        limit_s: Time after which a trial ends; a trial without insertion counts with this time.
        success: When the tool is in.
        primary: The one measure that decides, named beforehand.
        alpha: Level of the tests.
    """

    num_participants: Annotated[int, Ge(2)]
    holes: dict[str, Hole]
    starts: dict[str, tuple[float, ...]]
    practice_trials: Index
    limit_s: Positive
    success: Success
    primary: str
    alpha: Annotated[float, Interval(gt=0, lt=1)]

    def check(self) -> None:
        if len(self.holes) != len(self.starts) or len(self.holes) < 2:
            raise ConfigError(
                "starts: expected as many starts as holes, 2 or more, "
                f"got {len(self.holes)} holes and {len(self.starts)} starts"
            )

    def check_machine(self, machine: Machine) -> None:
        """Raise a `ConfigError` that names the start which the machine cannot take."""
        lower, upper = machine.lower, machine.upper
        for name, q in self.starts.items():
            if len(q) != len(lower) or (q < lower).any() or (q > upper).any():
                raise ConfigError(
                    f"study.design.starts.{name}: expected {len(lower)} positions from {lower} to {upper}, got {q}"
                )


@dataclass(frozen=True)
class Trial:
    """One trial to be done: a row of the plan.

    Attributes:
        participant: Pseudonym.
        period: 1 or 2; 0 for practice.
        condition: `guided` or `unguided`.
        number: Within the period, from 1.
        hole: Name of the hole.
        start: Name of the start.
    """

    participant: str
    period: int
    condition: str
    number: int
    hole: str
    start: str

    @property
    def key(self) -> tuple[str, int, int]:
        """Participant, period and number, which no other trial has."""
        return self.participant, self.period, self.number

    @property
    def name(self) -> str:
        """Name of its files."""
        return f"{self.participant}_{self.period}_{self.number:02d}"


def draw_sequences(
    num_participants: int, generator: np.random.Generator
) -> dict[str, tuple[str, str]]:
    """Return the two conditions of each participant in order, drawn in blocks of two."""
    drawn: list[tuple[str, str]] = []
    for _ in range(math.ceil(num_participants / 2)):
        pair = [CONDITIONS, CONDITIONS[::-1]]
        # The second of a pair gets the other sequence.
        drawn += pair if generator.integers(2) else pair[::-1]
    width = max(2, len(str(num_participants)))
    found = {}
    for number in range(num_participants):
        found[f"P{number + 1:0{width}d}"] = drawn[number]
    return found


def make_latin_squares(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return two Latin squares, `(K, K)` each: row `i` is an order of holes and one of starts.

    In each, every entry stands once in every row and column. For odd `K` they are orthogonal: every
    pair of hole and start occurs once over the rows. For even `K` pairs repeat.
    """
    row, place = np.mgrid[:size, :size]
    # Sum and difference tell row and place apart where 2 divides nothing of the size.
    return (row + place) % size, (row - place) % size


def plan_trials(design: Design, generator: np.random.Generator) -> list[Trial]:
    """Return every trial in the order in which it is to be done, practice first."""
    num = len(design.holes)
    hole_square, start_square = make_latin_squares(num)
    # Which name stands for which letter of the squares; holes are drawn first.
    holes = np.array(list(design.holes))
    starts = np.array(list(design.starts))
    drawn_holes = holes[generator.permutation(num)]
    drawn_starts = starts[generator.permutation(num)]
    sequences = draw_sequences(design.num_participants, generator)
    found = []
    for index, (participant, conditions) in enumerate(sequences.items()):
        rows = []
        for number in range(design.practice_trials):
            # Practice goes through the holes in another order for each participant.
            place = (index + number) % num
            start = starts[(place + 1) % num]
            rows.append((0, CONDITIONS[number % 2], number, holes[place], start))
        for period, condition in zip(PERIODS, conditions, strict=True):
            # Both of a pair have the same rows, one with each sequence; the second period has
            # another row than the first.
            row = (index // 2 + (period - 1) * (num // 2)) % num
            for number in range(num):
                hole = drawn_holes[hole_square[row, number]]
                start = drawn_starts[start_square[row, number]]
                rows.append((period, condition, number, hole, start))
        for period, condition, number, hole, start in rows:
            found.append(Trial(participant, period, condition, number + 1, str(hole), str(start)))
    return found


def format_plan(
    design: Design, machine: Machine, seed: int, planned: list[Trial]
) -> dict[str, Any]:
    """Return the plan as plain data for `plan.json`."""
    # Participants in the order of the plan, each with the conditions of both periods.
    participants: dict[str, list[str]] = {}
    for trial in planned:
        if trial.period and trial.number == 1:
            participants.setdefault(trial.participant, []).append(trial.condition)
    return {
        "schema": 2,
        "machine": machine.name,
        "fingerprint": machine.fingerprint(),
        "seed": seed,
        "design": asdict(design),
        "participants": participants,
        "trials": [asdict(trial) for trial in planned],
    }
