"""Frames that come late or get lost: hidden delays of single commands, estimated from the residuals.

The response to one period of delay is simulated for each change of a command. A frame carries the
commands of all joints, so one delay a frame explains the residuals of all of them. On the reference
all frames arrive in time; there the delays show their own estimation error. The distribution of the
delays separates lost frames (whole periods, seldom) from jitter (parts of periods, always).
Axes: `W` windows, `K` steps, `I` increments, `J` joints, `D` changes of a command, `C` candidates.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from scipy import stats

from diagnosis.answer import Estimate
from diagnosis.effect_library import DetectedEffect, EffectType, EffectValues, estimate_interval
from diagnosis.error_covariance import compute_loss
from diagnosis.residuals import INCREMENT_SAMPLES, Residuals, to_increments
from diagnosis.responses import fit_sizes
from diagnosis.search import find_weighted_median

# Chosen by hand; not searched.
MIN_COMMAND_CHANGE = 0.06
"""Smaller changes of a command tell nothing about when it arrived."""
DELAY_PRIOR = 1.5
"""Prior standard deviation of a delay, periods."""
MIN_TELLING = 0.3
"""A delay of one period that changes no error over the noise by more tells nothing."""
TIMING_ERROR = 0.1
"""Delays that differ by so few periods are the same: a simulator's own timing is no better."""
MAX_DELAY_ERROR = 0.4
"""Largest standard error, in periods, of a delay that counts."""
MIN_DELAYS = 20
"""Fewer delays tell nothing about how they scatter."""
JITTER_SIZES = np.geomspace(0.2, 30.0, 16)
DRAWS_PER_WINDOW = 3
"""Times that the chances of each window are drawn."""
MAX_DRAWN = 300
"""Delays drawn by which those seen are judged."""
MAX_EXTRA_MEAN = 2.0
"""The mean of delays by chance is off by so much of itself at most; what joints are late by beyond
is an effect of its own."""
SCALES, FREEDOMS = np.linspace(0.7, 1.5, 9), (3.0, 5.0, 7.0, 10.0)
"""Among which the distribution of the errors of delays is found."""
REFERENCE_PENALTY = 1.5
"""Penalty of the gain on the reference, over that gain."""
MIN_SCATTER_RATIO = 1.1
"""Scatter of the delays, over that of reference recordings, below which nothing is looked for.
It was 1.2 before; no comparison is recorded."""


@dataclass(frozen=True)
class FrameDelays:
    """Hidden delays of frames that could be measured, less their mean.

    Attributes:
        value: In periods, `(D,)`.
        error: Their standard errors, `(D,)`.
        joint: Number of the joint that tells most of each, `(D,)`.
    """

    value: np.ndarray
    error: np.ndarray
    joint: np.ndarray

    def of(self, joint: int) -> FrameDelays:
        """Return those of one joint."""
        mine = self.joint == joint
        return FrameDelays(self.value[mine], self.error[mine], self.joint[mine])


@dataclass(frozen=True)
class DelayErrorModel:
    """Error of measured delays where all frames arrive in time: a t distribution.

    Attributes:
        scale: Their errors over the standard errors.
        freedom: Degrees of freedom: how seldom they err by much.
    """

    scale: float
    freedom: float

    @classmethod
    def of(cls, known: Sequence[FrameDelays]) -> DelayErrorModel:
        """Return the most likely one for the delays of recordings in which no frame is late."""

        def total(one: DelayErrorModel) -> float:
            return sum(float(one.log(seen.value, seen.error).sum()) for seen in known)

        return max((cls(*pair) for pair in product(SCALES, FREEDOMS)), key=total)

    def log(self, off: np.ndarray, error: np.ndarray) -> np.ndarray:
        """Return the log density of errors `off` of delays with these standard errors."""
        width = np.hypot(self.scale * error, TIMING_ERROR)
        return stats.t.logpdf(off / width, self.freedom) - np.log(width)

    def gain(self, seen: FrameDelays, drawn: np.ndarray) -> float:
        """Return the log likelihood of the delays seen, where true ones are like those `drawn`, over that without any."""
        if not len(seen.value):
            return 0.0
        among = np.exp(self.log(seen.value[:, None] - drawn[None], seen.error[:, None])).mean(1)
        return float((np.log(among + 1e-12) - self.log(seen.value, seen.error)).sum())

    def gain_by_shift(self, seen: FrameDelays) -> float:
        """Return the log likelihood gain of another common delay, without late frames.

        Where the simulated motion is wrong, a few sure delays can pull the mean away from most others.
        Frames that are late by chance would explain that as well.
        """
        shifted = seen.value - np.median(seen.value)
        away = self.log(seen.value, seen.error)
        return max(0.0, float((self.log(shifted, seen.error) - away).sum()))


@dataclass(frozen=True)
class CommandChanges:
    """The changes of commands in some windows, and the responses to one period of delay."""

    residuals: Residuals

    @cached_property
    def _frame_samples(self) -> int:
        """Samples that count as one frame.

        Targets of position servos move a little with each frame, so that an increment shows only the
        mean delay of its frames. Other commands change in jumps.
        """
        machine = self.residuals.simulator.machine
        return INCREMENT_SAMPLES if machine.interface == "position" else 1

    @cached_property
    def _ranks(self) -> np.ndarray:
        """Which of a joint's changes in a window a frame is, from 1 on; 0 where its command stays, `(W, F, J)`."""
        cut, size = self.residuals.simulator.cut, self._frame_samples
        first = cut.num_before - cut.num_history  # changes before are over when the free run begins
        change = np.abs(np.diff(cut.u, axis=1))
        change[:, :first] = 0.0
        frames = np.add.reduceat(change, np.arange(0, change.shape[1], size), axis=1)
        jump = frames > MIN_COMMAND_CHANGE
        return np.cumsum(jump, 1) * jump

    @cached_property
    def responses(self) -> np.ndarray:
        """Increments that change where the n-th change of each joint's command in a window comes late, `(C, W, I, J)`."""
        cut, windows = self.residuals.simulator.cut, len(self.residuals.simulator.cut.u)
        count = int(self._ranks.max(initial=0))
        if not count:
            return np.zeros((0, *self.residuals.increments.shape))
        # One simulation shifts the n-th change of all joints; each joint is read for its own.
        number = np.arange(1, count + 1)[:, None, None, None]
        rank = np.repeat(self._ranks, self._frame_samples, 1)[:, : cut.u.shape[1] - 1]
        late = np.where(rank == number, cut.u[:, :-1], cut.u[:, 1:])
        u = np.concatenate([np.repeat(cut.u[None, :, :1], count, 0), late], 2)
        rows = np.tile(np.arange(windows), count)
        many = replace(cut, u=u.reshape(-1, *u.shape[2:]), q=cut.q[rows], run=cut.run[rows])
        simulator = replace(
            self.residuals.simulator, cut=many, running_s=self.residuals.simulator.running_s[rows]
        )
        paths = simulator.simulate([])[0].reshape(count, windows, *self.residuals.base.shape[1:])
        return to_increments(paths, self.residuals.start) - self.residuals.increments

    @cached_property
    def _told(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Per window: whitened response to one period of delay of each frame that changes a command, `(J I, D)`.

        With the number of the joint that tells most of each, `(D,)`.
        """
        assert self.residuals.noise is not None, "noise is known by now"
        found, joints = [], self.residuals.increments.shape[2]
        for w, ranks in enumerate(self._ranks):
            frames = np.flatnonzero(ranks.any(1))
            columns = np.zeros((joints, self.residuals.increments.shape[1], len(frames)))
            for j, whiteners in enumerate(self._whiteners if len(frames) else ()):
                rank = ranks[frames, j]
                columns[j][:, rank > 0] = (
                    whiteners[w]
                    @ self.responses[rank[rank > 0] - 1, w, :, j].T
                    * self.residuals.valid_mask[w, j]
                )
            telling = np.abs(columns).max((0, 1)) > MIN_TELLING
            columns = columns[..., telling]
            found.append(
                (
                    columns.reshape(joints * columns.shape[1], telling.sum()),
                    np.square(columns).sum(1).argmax(0),
                )
            )
        return found

    @cached_property
    def _whiteners(self) -> list[np.ndarray]:
        assert self.residuals.noise is not None, "noise is known by now"
        return [
            noise.whitener(self.residuals.increments[..., j])
            for j, noise in enumerate(self.residuals.noise)
        ]

    @cached_property
    def _every(self) -> list[tuple[np.ndarray, np.ndarray]]:
        return self._solved(None)

    def _solved(self, without: int | None) -> list[tuple[np.ndarray, np.ndarray]]:
        """Per window: matrix from errors over the noise to delays, and their standard errors."""
        found, steps = [], self.residuals.increments.shape[1]
        for x, _ in self._told:
            counted = x * np.repeat(np.arange(len(x) // steps) != without, steps)[:, None]
            inverse = np.linalg.inv(counted.T @ counted + np.eye(x.shape[1]) / DELAY_PRIOR**2)
            found.append((inverse @ counted.T, np.sqrt(np.diag(inverse))))
        return found

    def delays(self, error: np.ndarray, without: int | None = None) -> FrameDelays:
        """Return the delays that explain errors `(W, I, J)` (measured less simulated increments) best.

        The mean delay of a single joint is subtracted first; `without`: a joint whose errors do not
        count.
        """
        whitened = [(w @ error[..., j, None])[..., 0] for j, w in enumerate(self._whiteners)]
        z = np.stack(whitened, 1)  # (W, J, I)
        always = np.stack([x.sum(1).reshape(z.shape[1:]) for x, _ in self._told])
        share = (always * z).sum((0, 2)) / (np.square(always).sum((0, 2)) + DELAY_PRIOR**-2)
        z = z - share[:, None] * always
        value, deviation, joint = [], [], []
        solutions = self._every if without is None else self._solved(without)
        for row, (matrix, errors), (_, most) in zip(z, solutions, self._told, strict=True):
            sure = errors < MAX_DELAY_ERROR
            value.append((matrix @ row.ravel())[sure])
            deviation.append(errors[sure])
            joint.append(most[sure])
        value, deviation = np.concatenate(value), np.concatenate(deviation)
        # A common delay is a dead time, which the simulator or another effect has.
        if len(value):
            value = value - np.average(value, weights=deviation**-2)
        return FrameDelays(value, deviation, np.concatenate(joint))

    def spread(self, error: np.ndarray) -> np.ndarray:
        """Return the response to each change at a delay of one standard deviation of those seen, `(W, C, I, J)`."""
        seen = self.delays(error)
        by = np.sqrt(max(0.0, float(np.mean(np.square(seen.value) - np.square(seen.error)))))
        return by * self.responses.swapaxes(0, 1)


def detect_timing_effect(
    changes: CommandChanges,
    error: np.ndarray,
    left_out: Sequence[Residuals],
    kinds: Sequence[EffectType],
    price: float,
    name_price: float,
) -> DetectedEffect | None:
    """Return the effect on the arrival of commands that the scatter of hidden delays shows, if any.

    Args:
        changes: Of the commands in the field.
        error: Measured less simulated increments with the other effects, `(W, I, J)`.
        left_out: The simulator against parts of the reference that it was not fitted to.
        kinds: The library.
        price: Penalty beside that from the gain on the reference, nats.
        name_price: Penalty of the effect as such, nats.
    """
    kinds = [kind for kind in kinds if kind.target.stochastic and kind.target.side == "command"]
    others = [CommandChanges(one) for one in left_out]
    seen, known = changes.delays(error), [one.delays(one.residuals.error) for one in others]
    if (
        not kinds
        or len(seen.value) < MIN_DELAYS
        or sum(len(one.value) for one in known) < MIN_DELAYS
    ):
        return None
    usual = DelayErrorModel.of(known)
    if _compute_scatter(seen.value / seen.error) < MIN_SCATTER_RATIO * _compute_scatter(
        np.concatenate([one.value / one.error for one in known])
    ):
        return None
    gains, earned, shapes = {}, {}, {}
    for kind in kinds:
        drawn, shapes[kind.name] = [], {}
        for shape in _list_shapes(kind):
            tried = [_subsample_delays(one) for one in _draw_delays(changes, kind, shape)]
            if not drawn or _compute_best(usual, seen, tried) > _compute_best(usual, seen, drawn):
                drawn, shapes[kind.name] = tried, shape
        gains[kind.name] = np.array([usual.gain(seen, one) for one in drawn])
        best = drawn[int(np.argmax(gains[kind.name]))]
        by_joint: dict[int, float] = {}
        for j in np.unique(seen.joint):
            if len(seen.of(j).value) >= MIN_DELAYS:
                by_joint[int(j)] = usual.gain(seen.of(j), best)
        rest = seen
        if len(by_joint) > 1:
            rest = changes.delays(error, max(by_joint, key=by_joint.__getitem__))
        if min(by_joint.values(), default=0.0) < -price or usual.gain(rest, best) < price:
            gains[kind.name] = gains[kind.name] * 0.0  # frames are late for all joints or for none
        # Gains grow with the number of delays.
        known_gains = []
        for one in known:
            share = len(seen.value) / max(1, len(one.value))
            known_gains.append(usual.gain(one, best) * share)
        earned[kind.name] = max(0.0, *known_gains)
    worth, by_shift = {}, usual.gain_by_shift(seen)
    for name, gain in gains.items():
        own = float(gain.max()) - by_shift
        worth[name] = own - price - REFERENCE_PENALTY * earned[name] - name_price
    best = max(kinds, key=lambda kind: worth[kind.name])
    if worth[best.name] <= 0:
        return None
    ends = np.array(estimate_interval(JITTER_SIZES, gains[best.name]))
    machine = changes.residuals.simulator.machine
    parameters = {}
    for name in best.fitted:
        values = best.clipped(name, best.numbers[name].none + best.size(name) * ends[:, None])
        for joint, row in zip(machine.joint_names, values.T.tolist(), strict=True):
            mean, low, high = row
            parameters.setdefault(name, {})[joint] = Estimate(mean, (low, high))
    for name, value in shapes[best.name].items():
        tried = Estimate(value, (value, value))
        parameters[name] = dict.fromkeys(machine.joint_names, tried)
    rest = {name: float(gain.max()) for name, gain in gains.items() if name != best.name}
    every = np.ones(machine.num_joints, dtype=bool)
    return DetectedEffect(
        best,
        every,
        parameters,
        worth[best.name],
        float(gains[best.name].max()),
        _compute_explained_share(seen, usual.scale),
        rest,
    )


def add_mean_delay(
    residuals: Residuals, found: DetectedEffect, steady: Sequence[tuple[EffectType, EffectValues]]
) -> Residuals:
    """Return the residuals with the mean response of the found effect, and the mean delay that joints share beyond it.

    The scatter of delays does not give their mean. Frames that may not overtake each other wait
    twice as long as others with the same scatter. A late frame delays all joints alike, so the
    delay of a single joint is left to another effect.

    Args:
        residuals: The simulator against the field.
        found: The effect.
        steady: Other effects that are there.
    """
    count, simulator = (
        4 * DRAWS_PER_WINDOW,
        replace(residuals.simulator, fixed=[*residuals.simulator.fixed, *steady]),
    )
    mean = (
        simulator.simulate([(found.kind, found.values(count))], count).mean(0)
        - simulator.simulate([])[0]
    )
    u = residuals.simulator.cut.u
    late = replace(residuals.simulator.cut, u=np.concatenate([u[:, :1], u[:, :-1]], 1))
    later = replace(residuals.simulator, cut=late).simulate([])[0] - residuals.base
    known = replace(residuals, mean=mean)
    moved, usual = (
        known.whiten(to_increments(one, np.zeros_like(residuals.start))[None])[:, 0]
        for one in (later, mean)
    )
    told = np.square(moved).sum(1)
    own = find_weighted_median((moved * usual).sum(1) / np.maximum(told, 1e-9), told)
    tried = [known]
    # Where errors hardly add up, faults of the simulator's numbers look like a delay: it is fitted
    # beside them and alone.
    for faults in (known.faults, known.faults[:, :0]):
        shares = []
        for z, mine, line in zip(known.z, faults, moved, strict=True):
            lines = np.concatenate([mine, DELAY_PRIOR * line[None]])
            shares.append(fit_sizes(z, [], faults=lines)[-1] * DELAY_PRIOR)
        more = find_weighted_median(np.array(shares), told)
        if abs(more) <= MAX_EXTRA_MEAN * abs(own):
            tried.append(replace(residuals, mean=mean + more * later))
    return min(tried, key=lambda one: float(compute_loss(one.z)))


def _list_shapes(kind: EffectType) -> list[dict[str, float]]:
    """Return the values that are tried of the numbers that only shape an effect."""
    found: list[dict[str, float]] = [{}]
    for name in kind.shaping:
        number = kind.numbers[name]
        found = [one | {name: value} for one in found for value in number.trials]
    return found


def _compute_best(usual: DelayErrorModel, seen: FrameDelays, drawn: Sequence[np.ndarray]) -> float:
    """Return the largest gain of the delays drawn at any size."""
    return max(usual.gain(seen, one) for one in drawn)


def _draw_delays(
    changes: CommandChanges, kind: EffectType, shape: Mapping[str, float]
) -> list[np.ndarray]:
    """Return hidden delays that an effect of each size makes, without errors of measurement, each `(D,)`."""
    residuals, joints = changes.residuals, changes.residuals.increments.shape[2]
    sizes = np.repeat(JITTER_SIZES, DRAWS_PER_WINDOW)[:, None]
    values = {}
    for name in kind.fitted:
        value = kind.clipped(name, kind.numbers[name].none + sizes * kind.size(name))
        values[name] = np.broadcast_to(value, (len(sizes), joints)).copy()
    for name, value in shape.items():
        values[name] = np.full((len(sizes), joints), value)
    paths = residuals.simulator.simulate([(kind, values)], len(sizes))
    moved = to_increments(paths, residuals.start) - residuals.increments
    found = [changes.delays(one).value for one in moved]
    # Draws of one size lie in a row.
    starts = range(0, len(found), DRAWS_PER_WINDOW)
    return [np.concatenate(found[start : start + DRAWS_PER_WINDOW]) for start in starts]


def _compute_scatter(values: np.ndarray) -> float:
    """Return the root mean square, outliers cut."""
    return float(np.sqrt(np.mean(np.minimum(np.square(values), 25.0))))


def _subsample_delays(drawn: np.ndarray) -> np.ndarray:
    """Return delays that are distributed alike, at most `MAX_DRAWN`."""
    return np.sort(drawn)[np.linspace(0, len(drawn) - 1, min(MAX_DRAWN, len(drawn))).astype(int)]


def _compute_explained_share(seen: FrameDelays, scale: float) -> float:
    """Return the share of the scatter of the delays that is more than their errors."""
    return float(
        np.clip(
            1.0 - np.mean((scale * seen.error) ** 2) / max(np.mean(seen.value**2), 1e-12), 0.0, 1.0
        )
    )
