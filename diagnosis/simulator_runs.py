"""A simulator held against recordings: free runs, and how likely their errors are.

Axes: `C` candidates, `W` windows, `K` steps, `I` intervals, `J` joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from scipy.optimize import nnls

from actuators import open_loop
from actuators.open_loop import FreeRunWindows, run_freely
from actuators.scales import choose_horizon_s, scale_time
from brokk_rl.commands import view_recordings
from brokk_rl.contracts.actuator import Actuator
from brokk_rl.errors import BrokkError
from brokk_rl.machine import Machine
from brokk_rl.parallel import map_parallel
from brokk_rl.record import Recording
from diagnosis.case import estimate_running_s
from diagnosis.effect_library import EffectType, EffectValues
from diagnosis.free_runs import WindowedRuns
from diagnosis.grown_effects import GrownEffect, NumberSlopes, NumberTrials

INTERVAL_S = 0.25
"""Time between two errors that count, on the reference of `actuators.scales`, s: as in the engine."""
MEMORIES = (0.0, 0.3, 0.6, 0.8, 0.9, 0.96)
"""Shares of an error in the next one that are tried."""
LEAST_DEVIATION = 1e-6
"""Smallest deviation of an error, over the travel: rounding of single precision."""
STEP = 0.05
"""Finite difference, of the typical size."""
NO_TRIALS: NumberTrials = {}
BATCH_ROWS = 1536
"""Free runs simulated at once: enough to keep a core busy, few enough to stay in its cache."""


@dataclass(frozen=True)
class EffectSimulator:
    """Free runs of one simulator through windows of recordings, as a function of effects.

    Attributes:
        base: The simulator.
        machine: The machine.
        recordings: The recordings, their commands as speeds.
        source: Number of the recording of each window, `(W,)`.
        row: Row of the first simulated position of each window, `(W,)`.
        cut: The windows.
        running_s: Time since the machine was started at the beginning of each window, `(W,)`.
        seed: Of the random numbers that stochastic effects draw.
    """

    base: Actuator
    machine: Machine
    recordings: Sequence[Recording]
    source: np.ndarray
    row: np.ndarray
    cut: FreeRunWindows
    running_s: np.ndarray
    seed: int

    def view(self, paths: np.ndarray) -> WindowedRuns:
        """Return free runs `(W, K, J)` beside their recordings."""
        measured = self.cut.measured
        return WindowedRuns(self.recordings, self.source, self.row, paths.astype(float), measured)

    def select(self, windows: np.ndarray) -> EffectSimulator:
        """Return the same with some of the windows."""
        cut = self.cut
        some = replace(cut, u=cut.u[windows], q=cut.q[windows], run=cut.run[windows])
        own = {name: getattr(self, name)[windows] for name in ("source", "row", "running_s")}
        return replace(self, cut=some, **own)

    def simulate(
        self, effects: Sequence[tuple[EffectType, EffectValues]], count: int = 1
    ) -> np.ndarray:
        """Return measured positions of free runs, `(C, W, K, J)`.

        Args:
            effects: Effects with the numbers of each candidate.
            count: Number of candidates, `C`.

        Raises:
            BrokkError: the model ran into NaN.
        """
        effects = sorted(effects, key=lambda one: one[0].order)
        num_batches = -(-count * len(self.cut.q) // BATCH_ROWS)
        batches = np.array_split(np.arange(count), min(count, num_batches))
        found = np.concatenate(map_parallel(lambda batch: self._run(effects, batch), batches))
        if not np.isfinite(found).all():
            names = ", ".join(kind.name for kind, _ in effects) or "no effect"
            raise BrokkError(
                f"the simulator ran into NaN in a free run with {names}; look at its fit"
            )
        return found

    def _run(
        self, effects: Sequence[tuple[EffectType, EffectValues]], candidates: np.ndarray
    ) -> np.ndarray:
        """Return the free runs of some candidates, `(C, W, K, J)`."""
        cut, windows, device = self.cut, len(self.cut.q), torch.device("cpu")
        size, before = cut.num_history, cut.num_before
        count, rows = len(candidates) * windows, np.repeat(candidates, windows)
        u = self._commands.repeat(1, len(candidates), 1)
        with torch.random.fork_rng(devices=[]):
            # Rows of other batches draw other numbers. `torch.manual_seed` would also prepare the
            # seeds of GPUs that nothing here uses, which takes longer than a step.
            torch.default_generator.manual_seed(self.seed + int(candidates[0]))
            model: Any = self.base.build(self.machine, count, device)
            for kind, values in effects:
                model = kind.wrap(model, self.machine, count, device)
                for name, value in values.items():
                    model.parameters[name].copy_(torch.as_tensor(value[rows], dtype=torch.float32))
                if kind.running:
                    early_s = (before - size) * self.machine.period_s
                    begun_s = np.tile(self.running_s, len(candidates)) - early_s
                    model.parameters[kind.running].copy_(torch.as_tensor(begun_s)[:, None])
        known = torch.as_tensor(np.tile(cut.q[:, :before], (len(candidates), 1, 1)))
        seen = run_freely(model, u, known.transpose(0, 1), size).numpy()
        return seen.swapaxes(0, 1).reshape(len(candidates), windows, *seen.shape[::2])

    @cached_property
    def plain_runs(self) -> np.ndarray:
        """Free runs without any effect, `(W, K, J)`."""
        return self.simulate([])[0]

    @cached_property
    def _commands(self) -> torch.Tensor:
        """Recorded commands of the windows, `(T, W, J)`: time comes first, so that a step reads one piece of memory."""
        u = torch.as_tensor(self.cut.u, dtype=torch.float32)
        return u.transpose(0, 1).contiguous()


def cut_simulator_runs(
    actuator: Actuator,
    recordings: Sequence[Recording],
    machine: Machine,
    seed: int,
    horizon_s: float | None = None,
    stride_s: float | None = None,
    begun_s: Sequence[float] | None = None,
) -> EffectSimulator:
    """Return `actuator` held against all whole windows of recordings.

    Args:
        actuator: The simulator.
        recordings: The recordings; those that are too short are left out.
        machine: The machine.
        seed: Of the random numbers that stochastic effects draw.
        horizon_s: Length of the windows; `None`: that of `actuators.scales`.
        stride_s: Distance between two of them; `None`: their length.
        begun_s: How long the machine had been running at the beginning of each recording; `None`: as far as
            their dates tell.

    Raises:
        RecordingError: no recording is long enough.
    """
    horizon_s = horizon_s or choose_horizon_s(machine)
    before = open_loop.count_samples_before(machine)
    stride = round((stride_s or horizon_s) / machine.period_s)
    begun_s = begun_s or estimate_running_s(recordings)
    # Each recording is a run, so that windows tell theirs.
    named = [replace(one, metadata={"run": str(k)}) for k, one in enumerate(recordings)]
    cut = open_loop.cut_windows(named, machine, horizon_s, stride * machine.period_s)
    source = cut.run.astype(int)
    row = before + stride * (np.arange(len(source)) - np.searchsorted(source, source))
    running_s = [begun_s[k] + recordings[k].t_s[at] for k, at in zip(source, row, strict=True)]
    viewed = view_recordings(recordings, machine)
    return EffectSimulator(actuator, machine, viewed, source, row, cut, np.array(running_s), seed)


class FreeRunLikelihood:
    """Log likelihood of the errors of free runs with effects, joint by joint.

    Each error keeps a share of the one before, and has a Laplace distribution whose deviation grows
    with the motion. Share and deviation are those that make the errors likeliest, for each
    candidate its own.

    Args:
        runs: The simulator in some windows.
        factor: Windows of the field for each of them.
    """

    def __init__(self, runs: EffectSimulator, factor: float = 1.0) -> None:
        self.runs, self._factor = runs, factor
        cut, machine = runs.cut, runs.machine
        steps = cut.measured.shape[1]
        every = max(1, round(scale_time(machine, INTERVAL_S) / machine.period_s))
        self._ends = np.arange(min(every, steps) - 1, steps, every)
        self._start = cut.q[:, cut.num_before - 1]
        # Errors of a speed or a force add up over a run, those of a position do not.
        self._adds_up = machine.interface != "position"
        self._floor = LEAST_DEVIATION * (machine.upper - machine.lower)
        self._measured = self._reduce(cut.measured)
        self.settle(())

    def settle(self, effects: Sequence[GrownEffect]) -> None:
        """Let the deviation of the errors be that beside effects, and new candidates be put beside these."""
        self._effects = effects
        self._deviation = self._weigh_motion(self.simulate(effects)[0])

    def simulate(
        self, effects: Sequence[GrownEffect], trials: NumberTrials = NO_TRIALS
    ) -> np.ndarray:
        """Return free runs with effects and trials of some of their numbers, `(C, W, K, J)`."""
        count = len(next(iter(trials.values()))) if trials else 1
        given = []
        for place, one in enumerate(effects):
            values = {}
            for name, value in one.values.items():
                values[name] = trials.get((place, name), np.repeat(value[None], count, 0))
            given.append((one.kind, values))
        return self.runs.simulate(given, count)

    def _reduce(self, paths: np.ndarray) -> np.ndarray:
        """Return what counts of paths `(…, W, K, J)`, `(…, W, I, J)`."""
        ends = paths[..., self._ends, :]
        if not self._adds_up:
            return ends
        return np.diff(ends, axis=-2, prepend=self._lead(ends))

    def _lead(self, ends: np.ndarray) -> np.ndarray:
        """Return the beginnings of paths `(…, W, 1, J)`."""
        return np.broadcast_to(self._start[:, None], (*ends.shape[:-2], 1, ends.shape[-1]))

    def _weigh_motion(self, paths: np.ndarray) -> np.ndarray:
        """Return the deviation of each error of simulated `paths` `(W, K, J)` over that at rest, `(W, I, J)`."""
        ends = paths[:, self._ends]
        moved = np.abs(np.diff(ends, axis=1, prepend=self._lead(ends)))
        size = np.abs(self._measured - self._reduce(paths))
        found = np.ones_like(moved)
        for j in range(paths.shape[2]):
            columns = np.stack([np.ones(size[..., j].size), moved[..., j].ravel()], 1)
            (rest, share), _ = nnls(columns, size[..., j].ravel())
            rest = max(rest, float(self._floor[j]))
            found[..., j] = 1.0 + share / rest * moved[..., j]
        return found

    def _measure_errors(
        self, effects: Sequence[GrownEffect], trials: NumberTrials, used: np.ndarray | None
    ) -> np.ndarray:
        """Return the errors of free runs over their relative deviation, `(C, W, I, J)`."""
        paths = self.simulate(effects, trials)
        errors = (self._measured - self._reduce(paths)) / self._deviation
        return errors if used is None else errors[:, used]

    def _weigh_memories(self, errors: np.ndarray) -> np.ndarray:
        """Return the log likelihood of errors with each of `MEMORIES`, nats, `(M, C, J)`."""
        count = errors.shape[1] * errors.shape[2]
        found = []
        for memory in MEMORIES:
            mean = np.abs(_subtract_memory(errors, memory)).sum((1, 2)) / count + self._floor
            # The determinant of the memory.
            fresh = 0.5 * errors.shape[1] * np.log(1.0 - memory**2)
            found.append(fresh - count * np.log(mean))
        return np.stack(found)

    def weigh(
        self,
        effects: Sequence[GrownEffect],
        trials: NumberTrials = NO_TRIALS,
        used: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the log likelihood with trials of some numbers, nats, `(C, J)`.

        Args:
            effects: The effects.
            trials: Numbers of theirs.
            used: Windows that count, `(W,)` bool; `None`: all.
        """
        return self._weigh_memories(self._measure_errors(effects, trials, used)).max(0)

    def weigh_candidates(self, kind: EffectType, candidates: EffectValues) -> np.ndarray:
        """Return what candidates of an effect earn beside those that are there, nats, `(C, J)`."""
        first = {name: rows[0] for name, rows in candidates.items()}
        every = np.ones(self.runs.machine.num_joints, dtype=bool)
        beside = [*self._effects, GrownEffect(kind, first, every, 0.0)]
        trials = {(len(self._effects), name): rows for name, rows in candidates.items()}
        return self._factor * (self.weigh(beside, trials) - self.weigh(self._effects))

    def linearise(
        self, effects: Sequence[GrownEffect], used: np.ndarray | None = None
    ) -> NumberSlopes:
        """Return the slopes of all errors over all numbers."""
        spots, steps = [], []
        for place, one in enumerate(effects):
            for name, value in one.values.items():
                # At an upper end the difference is taken downwards.
                most = one.kind.limits(name)[1]
                step = STEP * np.abs(one.kind.size(name)) * np.ones_like(value)
                spots.append((place, name))
                steps.append(np.where(value + step > most, -step, step))
        trials = {}
        for number, (place, name) in enumerate(spots):
            rows = np.repeat(effects[place].values[name][None], 1 + len(spots), 0)
            rows[1 + number] += steps[number]
            trials[place, name] = rows
        errors = self._measure_errors(effects, trials, used)
        fresh = np.empty_like(errors)
        # The memory without any step counts for all.
        for j, best in enumerate(self._weigh_memories(errors[:1]).argmax(0)[0]):
            fresh[..., j] = _subtract_memory(errors[..., j : j + 1], MEMORIES[best])[..., 0]
        fresh = fresh.reshape(len(fresh), -1, fresh.shape[-1])
        return NumberSlopes(effects, spots, steps, fresh[0], fresh[1:] - fresh[0])


def _subtract_memory(errors: np.ndarray, memory: float) -> np.ndarray:
    """Return errors `(C, W, I, J)` less what each keeps of the one before."""
    found = errors.copy()
    found[:, :, 1:] -= memory * errors[:, :, :-1]
    found[:, :, 0] *= np.sqrt(1.0 - memory**2)
    return found
