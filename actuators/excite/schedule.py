"""Schedule of a run: the excitations share its time."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge, Interval

from brokk_rl.contracts.actuator import Excitation, Segment
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.spec import Positive, spec

NUM_TRIES = 6
"""How often the length of the programs is fitted to the room that the ways between them leave; the
longest that fits is taken."""


def check_order(options: object, smaller: str, larger: str) -> None:
    """Raise a `ConfigError` where one field of a spec is above another one."""
    least, most = getattr(options, smaller), getattr(options, larger)
    if least > most:
        raise ConfigError(f"{smaller}: expected {larger}={most} or less, got {least}")


@spec
class Approach:
    """Approach to the start pose of a segment.

    Attributes:
        level: Largest command on the way.
        smallest: Smallest command, above any dead band.
        settle_s: The command falls with the way that is left as if it were to take this time;
            longer than the dead time.
        tolerance: A joint this close, as a part of its travel, has arrived.
        rest_s: Rest before the program begins; longer than the dead time, so that each program
            begins at rest.
        patience: An approach is given up after this many times its nominal duration.
    """

    level: Annotated[float, Interval(gt=0, le=1)]
    smallest: Positive
    settle_s: Positive
    tolerance: Positive
    rest_s: float
    patience: Annotated[float, Ge(1)]

    def check(self) -> None:
        check_order(self, "smallest", "level")

    def duration_s(self, machine: Machine, start: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Return the nominal time from `start` to `target`, each `(…, J)`, with the rest."""
        way = np.abs(target - start)
        far = way > self.tolerance * (machine.upper - machine.lower)
        going_s = way / (self.level * machine.max_speed)
        slowing_s = self.settle_s * np.log(1.0 + going_s / self.settle_s)
        each_s = np.where(far, going_s + slowing_s + machine.dead_time_s, 0.0)
        first_s = each_s[..., ~machine.is_exclusive].max(-1, initial=0.0)
        then_s = each_s[..., machine.is_exclusive].max(-1, initial=0.0)
        return first_s + then_s + self.rest_s


@dataclass(frozen=True)
class ExcitationPlan:
    """Segments of each run.

    Attributes:
        runs: Segments of each run, in order.
        run_s: Time of a run.
        names: Names of the excitations.
    """

    runs: tuple[tuple[Segment, ...], ...]
    run_s: float
    names: tuple[str, ...]


def plan_runs(
    excitations: Mapping[str, Excitation],
    machine: Machine,
    approach: Approach,
    num_runs: int,
    run_s: float,
    generator: np.random.Generator,
) -> ExcitationPlan:
    """Return a plan in which each run plays all excitations in order, with its own draws.

    Raises:
        ConfigError: there are no excitations, or one of them finds no room.
    """
    if not excitations:
        raise ConfigError(
            "excitation: none chosen; for example excitation=sine or excitation=[levels,ramps,holds]"
        )
    shares = {name: excitation.share for name, excitation in excitations.items()}
    for name, share in shares.items():
        if share <= 0:
            raise ConfigError(
                f"excitation.{name}: its share is {share:g}; expected more than 0, or leave it out"
            )
    parts = {name: share / sum(shares.values()) for name, share in shares.items()}
    runs = []
    for seed in generator.integers(2**63, size=num_runs):
        programs_s, tries = run_s, []
        for _ in range(NUM_TRIES):
            segments: list[Segment] = []
            draws = np.random.default_rng(int(seed))  # the same seed draws the same
            for name, excitation in excitations.items():
                segments += excitation.segments(machine, parts[name] * programs_s, draws)
            # motion within a segment is left out
            starts = np.stack([segment.start for segment in segments])
            ways_s = approach.duration_s(machine, np.stack([machine.home, *starts[:-1]]), starts)
            steps = sum(len(segment.u) for segment in segments)
            needed_s = float(ways_s.sum()) + steps * machine.period_s
            fill_s = needed_s if needed_s <= run_s else run_s - needed_s
            tries.append((fill_s, len(tries), tuple(segments)))
            programs_s *= run_s / needed_s
        runs.append(max(tries)[-1])
    return ExcitationPlan(runs=tuple(runs), run_s=run_s, names=tuple(excitations))
