"""Schedule of a run: the excitations share its time."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from brokk_rl.contracts.actuator import Excitation, Segment
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine

NUM_TRIES = 6
"""How often the length of the programs is fitted to the room that the ways between them leave; the
longest that fits is taken."""


def check_order(options: object, smaller: str, larger: str) -> None:
    """Raise a `ConfigError` where one field of a spec is above another one."""
    least, most = getattr(options, smaller), getattr(options, larger)
    if least > most:
        raise ConfigError(f"{smaller}: expected {larger}={most} or less, got {least}")


APPROACH_LEVEL = 0.6
"""Largest command on the way to the start pose of a segment; chosen by hand."""
APPROACH_LEAST = 0.2
"""Smallest command on that way: above any dead band."""
APPROACH_SETTLE_S = 1.0
"""The command falls with the way that is left as if it were to take this time; longer than the dead time."""
ARRIVED = 0.015
"""A joint this close to its start, as a part of its travel, has arrived."""
REST_S = 1.5
"""Rest before a program begins; longer than the dead time, so that each program begins at rest."""


def estimate_approach_s(machine: Machine, start: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the nominal time from `start` to `target`, each `(…, J)`, with the rest, s."""
    way = np.abs(target - start)
    far = way > ARRIVED * (machine.upper - machine.lower)
    going_s = way / (APPROACH_LEVEL * machine.max_speed)
    slowing_s = APPROACH_SETTLE_S * np.log(1.0 + going_s / APPROACH_SETTLE_S)
    each_s = np.where(far, going_s + slowing_s + machine.dead_time_s, 0.0)
    first_s = each_s[..., ~machine.is_exclusive].max(-1, initial=0.0)
    then_s = each_s[..., machine.is_exclusive].max(-1, initial=0.0)
    return first_s + then_s + REST_S


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
            ways_s = estimate_approach_s(machine, np.stack([machine.home, *starts[:-1]]), starts)
            steps = sum(len(segment.u) for segment in segments)
            needed_s = float(ways_s.sum()) + steps * machine.period_s
            fill_s = needed_s if needed_s <= run_s else run_s - needed_s
            tries.append((fill_s, len(tries), tuple(segments)))
            programs_s *= run_s / needed_s
        runs.append(max(tries)[-1])
    return ExcitationPlan(runs=tuple(runs), run_s=run_s, names=tuple(excitations))
