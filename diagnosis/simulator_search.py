"""The search for what a simulator lacks: each hypothesis is simulated around it.

An effect is put around the simulator in each form and size, and earns what it makes the errors of
free runs likelier. The best one stays, all sizes are fitted again, and the search goes on beside it.
Axes: `C` candidates, `W` windows, `J` joints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from diagnosis.effect_library import EffectType, EffectValues, list_shared_effects
from diagnosis.engine.decide import NUMBER_NATS
from diagnosis.grown_effects import GrownEffect, list_candidates
from diagnosis.simulator_runs import EffectSimulator, FreeRunLikelihood

ROUNDS = 30
"""Steps of Levenberg and Marquardt at most, by which all numbers are fitted together: those of a mass
and its friction trade against each other."""
SHARE = 0.03
"""Least share of an effect found before that a further one earns: with 0.3 a drive's friction is not named beside
its mass."""
LEAST_NATS = 22.0
"""An effect that earns less is not named. The engine asks for less; that was not tried around a simulator."""
JOINT_SHARE = 0.1
"""A joint that earns less, of what the best joint earns, does not have the effect."""
LEAST_GAIN = 0.1
"""Nats below which these steps end."""
MAX_EFFECTS = 6
NUM_FITTED, FIRST_ROUNDS = 3, 5
"""Best effects that are fitted, and by how many steps, before one is chosen: the sizes that are tried lie far apart."""
MAX_WINDOWS = 32
"""Windows, evenly over the recordings, on which effects are proposed."""
UNSEEN_SIDES = frozenset({"measurement", "kinematics"})
"""Errors of sensors and of the tool are told by tool points, not by the motion of joints."""

Progress = Callable[[float], None]


class SimulatorSearch:
    """The search for effects around a simulator.

    Args:
        runs: The simulator and the field.
        reference: The same simulator and recordings that it was fitted to; `None` without any.
        kinds: The library.
    """

    def __init__(
        self, runs: EffectSimulator, reference: EffectSimulator | None, kinds: Sequence[EffectType]
    ) -> None:
        self.runs = runs
        shared = list_shared_effects(kinds)
        self.kinds = [
            kind
            for kind in kinds
            if kind.target.side not in UNSEEN_SIDES
            and not getattr(kind.target, "stochastic", False)
            # A clock that is late cannot be told from a delay by commands and positions.
            and not (kind.name in shared and kind.stage == "timing")
        ]
        self.shared = shared
        count = len(runs.row)
        self.whole = FreeRunLikelihood(runs)
        """All windows of the field."""
        self._views = []
        for one in (runs, reference):
            if one is not None:
                most = len(one.row)
                some = np.unique(np.linspace(0, most - 1, min(most, MAX_WINDOWS)).astype(int))
                self._views.append(FreeRunLikelihood(one.select(some), count / len(some)))
        self.rivals: list[GrownEffect] = []
        """All effects beside the simulator alone, the best first."""

    def run(self, tell: Progress) -> list[GrownEffect]:
        """Return the effects that the simulator lacks, the first found first."""
        found: list[GrownEffect] = []
        while len(found) < MAX_EFFECTS:
            tell(len(found) / MAX_EFFECTS)
            names = {one.kind.name for one in found}
            for view in (self.whole, *self._views):
                view.settle(found)
            proposed = [self._propose(k) for k in self.kinds if k.name not in names]
            proposed.sort(key=lambda one: -one.nats)
            if not found:
                self.rivals = proposed
            needed = max([LEAST_NATS, *(SHARE * one.nats for one in found)])
            if not proposed or proposed[0].nats < needed:
                break
            some = proposed[:NUM_FITTED]
            fitted = [self.fit([*found, one], rounds=FIRST_ROUNDS) for one in some]
            found = max(fitted, key=self._weigh)
        # A deviation that was taken beside wrong numbers explains their error, and holds them there.
        self.whole.settle(())
        found = self.fit(found)
        self.whole.settle(found)
        return self.fit(found)

    def _propose(self, kind: EffectType) -> GrownEffect:
        """Return an effect with the form and size that earns most on each joint."""
        candidates = list_candidates(kind)
        gains = self._views[0].weigh_candidates(kind, candidates)
        for reference in self._views[1:]:
            # What a candidate earns where the simulator was fitted is no finding.
            gains = gains - np.maximum(reference.weigh_candidates(kind, candidates), 0.0)
        costs = NUMBER_NATS * _count_moved(kind, candidates)
        if kind.name in self.shared or not any(kind.numbers[n].per_joint for n in kind.fitted):
            best = np.full(gains.shape[1], (gains.sum(1) - costs).argmax())
            joints = np.ones(gains.shape[1], dtype=bool)
            nats = float(gains[best[0]].sum() - costs[best[0]])
        else:
            best = (gains - costs[:, None]).argmax(0)
            nets = (gains - costs[:, None]).max(0)
            joints = (nets > 0.0) & (nets >= JOINT_SHARE * nets.max())
            nats = float(nets[joints].sum())
        values = {}
        for name, rows in candidates.items():
            values[name] = rows[best, np.arange(len(best))] if rows.shape[1] > 1 else rows[best[0]]
        return GrownEffect(kind, values, joints, nats).keep(joints)

    def _weigh(self, effects: Sequence[GrownEffect]) -> float:
        """Return the log likelihood with effects, less the price of their numbers, nats."""
        nats = float(self.whole.weigh(effects).sum())
        return nats - NUMBER_NATS * sum(one.count_numbers() for one in effects)

    def fit(
        self, effects: Sequence[GrownEffect], used: np.ndarray | None = None, rounds: int = ROUNDS
    ) -> list[GrownEffect]:
        """Return the effects with all numbers fitted together to the windows `used`, `(W,)` bool."""
        found = list(effects)
        best = float(self.whole.weigh(found, used=used).sum())
        for _ in range(rounds if found else 0):
            trials = self.whole.linearise(found, used).list_steps()
            gains = self.whole.weigh(found, trials, used).sum(1)
            top = int(np.argmax(gains))
            if gains[top] < best + LEAST_GAIN:
                break
            best = float(gains[top])
            for (place, name), rows in trials.items():
                one = found[place]
                found[place] = replace(one, values={**one.values, name: rows[top]})
        return found


def _count_moved(kind: EffectType, candidates: EffectValues) -> np.ndarray:
    """Return how many of its numbers each candidate of an effect moves, `(C,)`: at least one is free."""
    moved = [(candidates[n] != kind.numbers[n].none).any(1) for n in kind.fitted]
    return np.maximum(np.sum(moved, 0), 1)
