"""Speed curves of a machine's joints from several motions under the same commands, with a bootstrap.

The model is that of `actuators.identify.speed_data`: dead time, play, lags, a speed curve on each side,
pose and pump. The bootstrap draws blocks of the recordings, the same for all motions, so that the
difference of two curves scatters less than each.

Axes: `J` joints, `I` increments, `C` numbers of a curve (both sides), `B` draws, `P` blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from actuators.identify.speed_data import WIDTH, SpeedData
from actuators.identify.valve_fit import NUM_DYNAMICS, fit_all_dynamics
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.parallel import map_parallel
from brokk_rl.record import Recording
from brokk_rl.spec import Count, Positive, spec

# Chosen by hand; not searched.
NUM_DRAWS = 200
"""Bootstrap draws; the ends of a 95 % interval vary by 5 % of its width."""
BLOCK_S = 30.0
"""Length of the blocks that are drawn, s: the speed of a machine wanders over some seconds."""
TIME_STEP, PLAY_STEP = 0.02, 0.02
"""Finite differences of times, s, and of the play, of full command."""
PLAY = 1
"""Place of the play among the numbers of the dynamics."""
RIDGE = 1e-9
"""Least stiffness of every number, over the trace: the bend penalty leaves the straight line of a side
free that is never commanded. `SpeedData.curve` has the same."""
MIN_SIDE_BLOCKS = 4
"""Fewest blocks in which a side is commanded for its bootstrap to show its scatter: of 4 blocks a draw
misses all in 2 % of the draws, of one in 37 %."""


@dataclass(frozen=True, eq=False)
class FittedCurve:
    """Speed over the stroke of the valve of one joint, with its bootstrap.

    Attributes:
        curve: Speed at each knot but 0, positive side first, over the machine's full speed, `(C,)`.
        dynamics: Dead time (s), play (of full command), lag of the valve and lag of the speed (s).
        draws: Bootstrap of both, `(1 + B, C + 4)`; the first row is the fit itself.
        information: Information of the recordings on the curve, `(C, C)`.
        points: Stroke and speed of single increments, `(I, 2)`.
        sides: Whether each side, positive first, was commanded often enough for its numbers.
    """

    curve: np.ndarray
    dynamics: np.ndarray
    draws: np.ndarray
    information: np.ndarray
    points: np.ndarray
    sides: tuple[bool, bool]


@spec
class ValveCurveFit:
    """Fits the speed curves of the valve model.

    Attributes:
        knots: Strokes at which the curves are given, rising from 0 to 1.
        longest_lag_s: Upper bound of each lag.
        sweeps: Turns of curve, pose and pump.
        iterations: Steps of each of the two searches for dead time, play and lags.
    """

    knots: tuple[float, ...]
    longest_lag_s: Positive
    sweeps: Count
    iterations: Count

    def check(self) -> None:
        if self.knots[0] != 0.0 or self.knots[-1] != 1.0 or (np.diff(self.knots) <= 0).any():
            given = list(self.knots)
            raise ConfigError(f"knots: expected strokes that rise from 0 to 1, got {given}")

    def fit_curves(
        self,
        machine: Machine,
        recordings: Sequence[Recording],
        motions: Sequence[Sequence[np.ndarray]],
        further: Sequence[Sequence[np.ndarray]],
        generator: np.random.Generator,
    ) -> list[list[FittedCurve]]:
        """Return the curves of each joint, those of `motions` first; empty for a joint at rest.

        Args:
            machine: The machine.
            recordings: Commands and poses.
            motions: Each: motion from every sample to the next, by recording `(T, J)`, rad or m;
                NaN where it is not known.
            further: More motions, fitted with the dynamics, pose and pump of the last of `motions`.
            generator: Draws the blocks of the bootstrap, the same for all.

        Raises:
            RecordingError: no recording is long enough.
        """
        data = SpeedData(recordings, machine, np.array(self.knots))
        every = [data.replace_motion(motion) for motion in [*motions, *further]]
        blocks = _number_blocks(data, machine)
        draws = _draw_blocks(blocks, generator)
        moving = np.all([one.moves for one in every[: len(motions)]], 0)
        fits = map_parallel(lambda one: self._fit_dynamics(one, moving), every[: len(motions)])
        # Further motions are those of the last simulator with a part left out: only curves differ.
        fits += [fits[-1]] * len(further)

        def fit(j: int) -> list[FittedCurve]:
            curves = []
            for one, (dynamics, factors) in zip(every, fits, strict=True):
                curves.append(_fit_curve(one, j, dynamics[j], factors[j], blocks, draws))
            return curves

        joints = np.flatnonzero(moving).tolist()
        found: list[list[FittedCurve]] = [[] for _ in moving]
        for j, curves in zip(joints, map_parallel(fit, joints), strict=True):
            found[j] = curves
        return found

    def _fit_dynamics(
        self, data: SpeedData, moving: np.ndarray
    ) -> tuple[np.ndarray, list[list[np.ndarray]]]:
        """Return the dynamics of all joints, `(J, 4)`, and the factors of pose and pump."""
        limits = (self.longest_lag_s, self.iterations)
        joints = np.flatnonzero(moving).tolist()
        dynamics = fit_all_dynamics(data, None, None, *limits, joints)
        factors = data.factors(data.statics(dynamics, self.sweeps), dynamics)
        return fit_all_dynamics(data, factors, dynamics, *limits, joints), factors


def _number_blocks(data: SpeedData, machine: Machine) -> np.ndarray:
    """Return the number of the block of each increment, `(I,)`."""
    size = max(1, round(BLOCK_S / (WIDTH * machine.period_s)))
    found, first = [], 0
    for count in data.num_increments:
        found.append(first + np.arange(count) // size)
        first = int(found[-1][-1]) + 1 if count else first
    return np.concatenate(found)


def _draw_blocks(blocks: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Return how often each block is drawn, `(1 + B, P)`; the first row is the sample itself."""
    count = int(blocks.max()) + 1
    drawn = generator.multinomial(count, np.full(count, 1.0 / count), NUM_DRAWS)
    return np.concatenate([np.ones((1, count)), drawn])


def _fit_curve(
    data: SpeedData,
    j: int,
    dynamics: np.ndarray,
    factors: Sequence[np.ndarray],
    blocks: np.ndarray,
    draws: np.ndarray,
) -> FittedCurve:
    """Return the curve of joint `j`, drawn together with its dynamics, which are linearised."""
    features = data.features(j, dynamics, factors)
    way, weight = data.way[j], data.weights[j]
    curve = data.curve(features, way, free=weight)
    columns = [features]
    for k in range(NUM_DYNAMICS):
        step = PLAY_STEP if k == PLAY else TIME_STEP
        moved = dynamics.copy()
        moved[k] += step
        later = data.features(j, moved, factors) @ curve
        columns.append(((later - features @ curve) / step)[:, None])
    slopes = np.hstack(columns)
    left = way - features @ curve
    noise = float(np.average(left**2, weights=np.maximum(weight, 1e-9)))
    count, size = draws.shape[1], slopes.shape[1]
    normal, right = np.zeros((count, size, size)), np.zeros((count, size))
    for block in range(count):
        rows = blocks == block
        weighted = slopes[rows] * weight[rows, None]
        normal[block] = weighted.T @ slopes[rows]
        right[block] = weighted.T @ left[rows]
    pull = data.pull(noise, size)
    pull += RIDGE * np.trace(normal.sum(0) + pull) * np.eye(size)
    start = np.concatenate([curve, dynamics])
    # The pull acts on the curve itself, not on its change.
    held = pull @ np.concatenate([curve, np.zeros(NUM_DYNAMICS)])
    drawn = np.linalg.solve(
        np.tensordot(draws, normal, 1) + pull, (draws @ right - held)[..., None]
    )[..., 0]
    # The fit of the sample itself is the curve: its own small step is taken off.
    away = drawn - drawn[0]
    information = normal.sum(0)[: len(curve), : len(curve)] / noise
    sides = _find_known_sides(normal[:, : len(curve), : len(curve)])
    # A valve moves its joint one way: what a command that was never held leaves open is no speed.
    draws_of_both = start + away
    draws_of_both[:, : len(curve)] = np.maximum(draws_of_both[:, : len(curve)], 0.0)
    points = _list_points(data, j, dynamics)
    return FittedCurve(np.maximum(curve, 0.0), dynamics, draws_of_both, information, points, sides)


def _find_known_sides(normal: np.ndarray) -> tuple[bool, bool]:
    """Return whether each side is commanded in enough blocks `(P, C, C)`, the positive one first."""
    told = np.diagonal(normal, axis1=1, axis2=2).reshape(len(normal), 2, -1).sum(2)
    counts = (told > RIDGE * told.sum()).sum(0)
    return bool(counts[0] >= MIN_SIDE_BLOCKS), bool(counts[1] >= MIN_SIDE_BLOCKS)


def _list_points(data: SpeedData, j: int, dynamics: np.ndarray) -> np.ndarray:
    """Return stroke and speed over the machine's full speed of each increment that counts, `(I, 2)`."""
    full = data.machine.max_speed[j] * data.machine.period_s * WIDTH
    counts = data.weights[j] > 0
    return np.stack([data.strokes(j, dynamics)[counts], data.way[j][counts] / full], 1)
