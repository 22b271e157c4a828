"""The next experiment: the excitation that best separates the rivals that the recordings leave open.

Each rival is simulated on each excitation. The distance of two simulations, over the simulator's
noise, is the expected gain of the experiment.
Axes: `C` rivals, `K` steps, `J` joints, `I` increments.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from actuators import open_loop
from brokk_rl.contracts.actuator import Actuator, Excitation
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from diagnosis.answer import NextExperiment
from diagnosis.effect_library import EffectSimulator, EffectType, EffectValues
from diagnosis.error_covariance import ErrorCovariance
from diagnosis.residuals import MAX_BLOCK_INCREMENTS, to_increments

EXPERIMENT_S = 30.0
MIN_DISTANCE = 8.0
"""Expected difference in log likelihood in `SECONDS` from which an experiment is worth the time."""
MAX_DISTANCE = 60.0
"""Differences beyond this are as good as this: the rivals are apart."""


@dataclass(frozen=True)
class RivalEffect:
    """An effect with numbers, each `(1, J)`, and how probable it is."""

    kind: EffectType
    values: EffectValues
    probability: float


def choose_experiment(
    actuator: Actuator,
    noises: Sequence[ErrorCovariance],
    rivals: Sequence[RivalEffect],
    excitations: Mapping[str, Excitation],
    machine: Machine,
    generator: np.random.Generator,
) -> NextExperiment | None:
    """Return the excitation that separates the rivals best; `None` where none does, or nothing is left to separate."""
    steps, before = round(EXPERIMENT_S / machine.period_s), open_loop.count_samples_before(machine)
    programs = {}
    for name, excitation in excitations.items() if len(rivals) > 1 else ():
        try:
            segments = excitation.segments(machine, EXPERIMENT_S, generator, [])
        except ConfigError:  # not a single segment fits
            continue
        u = np.concatenate([segment.u for segment in segments])[:steps]
        programs[name] = segments[0].start, np.pad(u, ((before - 1, steps - len(u)), (0, 0)))
    if not programs:
        return None
    u = np.stack([u for _, u in programs.values()]).astype(np.float32)
    q = np.full((len(u), before + steps, machine.num_joints), np.nan, dtype=np.float32)
    q[:, :before] = np.stack([start for start, _ in programs.values()])[:, None]
    cut = open_loop.FreeRunWindows(u, q, np.array(list(programs)), machine.num_history, before)
    apart = _compute_distances(
        EffectSimulator(actuator, machine, cut, np.zeros(len(u)), 0), noises, rivals
    )
    chance = {rival.kind.name: rival.probability for rival in rivals}
    worth = {
        pair: chance[pair[0]] * chance[pair[1]] * np.minimum(distance, MAX_DISTANCE)
        for pair, distance in apart.items()
    }
    chosen = int(np.argmax(np.sum(list(worth.values()), 0)))
    first, second = max(worth, key=lambda pair: worth[pair][chosen])
    distance = apart[first, second][chosen]
    if distance < MIN_DISTANCE:
        return None
    why = f"{EXPERIMENT_S:.0f} s of it put {first} and {second} apart by a log likelihood of {distance:.0f}"
    return NextExperiment(list(programs)[chosen], (first, second), why)


def _compute_distances(
    simulator: EffectSimulator, noises: Sequence[ErrorCovariance], rivals: Sequence[RivalEffect]
) -> dict[tuple[str, str], np.ndarray]:
    """Return the expected difference in log likelihood of each pair of rivals in each window, `(W,)`."""
    cut = simulator.cut
    at, count = cut.q[:, cut.num_before - 1], len(cut.q)
    base = to_increments(simulator.simulate([])[0], at)
    ways = {
        rival.kind.name: to_increments(simulator.simulate([(rival.kind, rival.values)])[0], at)
        for rival in rivals
    }
    found = {pair: np.zeros(count) for pair in combinations(ways, 2)}
    for j, noise in enumerate(noises):
        for first in range(0, base.shape[1], MAX_BLOCK_INCREMENTS):
            rows = slice(first, first + MAX_BLOCK_INCREMENTS)
            whitener = noise.whitener(base[:, rows, j])
            for a, b in found:
                apart = whitener @ (ways[a][:, rows, j] - ways[b][:, rows, j])[..., None]
                found[a, b] += 0.5 * np.square(apart).sum((1, 2))
    return found
