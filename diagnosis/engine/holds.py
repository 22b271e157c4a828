"""Commands that were held: lost frames and jitter, as a hidden delay common to all joints.

A hidden Markov model gives the mean course of the delay under each law. The commands are replaced by
those in force under it, and judged by the same measure as every other row. A course costs the
information that it has beyond its law.
Axes: `T` samples, `K` delays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from scipy.ndimage import uniform_filter1d

from diagnosis.engine.baseline import JointBaseline
from diagnosis.engine.evidence import FieldJoint
from diagnosis.engine.hold_laws import HoldLaw, LossLaw
from diagnosis.engine.measure import Scale, measure_motion
from diagnosis.engine.nuisance import compute_gain
from diagnosis.engine.side import Side

LONGEST_S = 0.9
LONGEST_TARGET_S = 0.2
"""Longest delay that a course reaches, and the same of targets, which come at a higher rate."""
SLOW_S = 0.5
"""Errors that change over a longer time than this come from no held target."""
PULSE_S = 0.6
"""Time after which a servo has answered."""
PULSE_UNITS = 0.01
LAW_ROUNDS = 8
"""Rounds in which the law of lost frames is fitted."""
TARGET_ROUNDS = 2
"""Rounds in which the course is sought again beside what it explains already."""
MAX_SQUARE = 16.0
LATENT_UNITS_S = 0.004
"""Speed that no joint shows: its step is below the noise of the encoder."""
POWERS = (0.1, 0.25, 0.5, 1.0)
"""Powers of the likelihood under which courses are weighed: the samples depend on each other, by how much is not known.

Of 20 opened and practice machines with held commands 0.1 earns most on five, 0.25 on nine, 0.5 on four and 1.0 on two.
"""
STOP_SHARE = 0.2
"""Least share of a course's gain that is earned where it makes commands last longer, beside where it delays them.

On 43 of 46 opened and practice machines of three makes that lose or delay frames it is 0.31 to 1.6. Of 15 that do not it is
0.17 at most on 13.
"""
LEAST_CHANCE = np.finfo(float).tiny
IMPOSSIBLE = -1e9
"""Log chance of what cannot be."""
MOST_NATS = 100.0
"""No sample says more for or against a delay: with 700 all courses vanish in rounding."""


@dataclass(frozen=True)
class HeldCourse:
    """A found course.

    Attributes:
        law: Its law.
        power: Power of the likelihood under which it was found.
        delays: Additional delay of each sample of the field, in samples, `(T,)`.
        gains: What it earns on each joint of the field, nats.
        cost: Information in the course beyond its law, nats, 0 at least.
        weights: Share of each sample in what is seen of the delays, `(T,)`.
    """

    law: HoldLaw
    power: float
    delays: np.ndarray
    gains: tuple[float, ...]
    cost: float
    weights: np.ndarray

    @property
    def net(self) -> float:
        """Gain on all joints less the cost, nats."""
        return sum(self.gains) - self.cost


@dataclass(frozen=True)
class MeanCourse:
    """The course of the delay to be expected under a law.

    Attributes:
        delays: Its delays, in steps of the law, `(T,)`.
        counts: Expected number of samples with each delay, `(K,)`.
        evidence: Log evidence of the law over all courses, against no delay, nats.
        cost: Information that the commands give about the course beyond its law, nats, 0 at least.
    """

    delays: np.ndarray
    counts: np.ndarray
    evidence: float
    cost: float


def average_courses(
    bank: np.ndarray, chances: np.ndarray, powers: Sequence[float]
) -> list[list[MeanCourse]]:
    """Return the mean of all courses under each law at each power of the likelihood.

    This is the forward and backward pass of a hidden Markov model. A single course is likely by chance where
    the commands say little. The mean of all stays there at what the law lets expect, and costs nothing.

    Args:
        bank: Log likelihood of each delay at each sample, `(T, K)`; no delay but 0 is possible at the first one.
        chances: Chance under each law that a delay (second axis) is followed by another one (third), `(L, K, K)`.
        powers: Powers of the likelihood.
    """
    nats = bank - bank[:, :1]
    np.clip(nats, -MOST_NATS, MOST_NATS, out=nats, where=nats > IMPOSSIBLE)
    likelihood = nats[:, None] * np.array(powers)[:, None]
    highest = likelihood.max(2)
    factors = np.exp(likelihood - highest[:, :, None])
    posterior = np.zeros((len(bank), len(chances), len(powers), bank.shape[1]))
    posterior[0, :, :, 0] = 1.0
    totals = np.ones(posterior.shape[:3])
    for k in range(1, len(bank)):
        state = (posterior[k - 1] @ chances) * factors[k]
        totals[k] = np.maximum(state.sum(2), LEAST_CHANCE)
        posterior[k] = state / totals[k, :, :, None]
    evidence = highest.sum(0) + np.log(totals).sum(0)
    backwards = chances.swapaxes(1, 2)
    later = np.ones_like(posterior[0])
    for k in reversed(range(len(bank))):
        posterior[k] *= later
        posterior[k] /= np.maximum(posterior[k].sum(2, keepdims=True), LEAST_CHANCE)
        later = (factors[k] * later) @ backwards
        later /= np.maximum(later.max(2, keepdims=True), LEAST_CHANCE)
    delays = np.moveaxis(posterior @ np.arange(bank.shape[1]), 0, -1)
    costs = np.einsum("tlmk,tmk->lm", posterior, likelihood) - evidence
    found = []
    for law in zip(delays, posterior.sum(0), evidence.tolist(), costs.tolist(), strict=True):
        found.append([MeanCourse(*one) for one in zip(*law, strict=True)])
    return found


def _build_bank(
    side: Side, bases: Sequence[JointBaseline], numbers: Sequence[np.ndarray], parts: int
) -> np.ndarray:
    """Return the log likelihood of each additional delay at each sample of the command, `(T, K)`.

    The delays are multiples of a sample divided by `parts`.
    """
    model = side.model
    if not model.integrates:
        return _build_target_bank(side, bases, numbers, parts, np.zeros(side.num_samples))
    num_delays = side.count(LONGEST_S)
    bank = np.zeros((side.num_samples, num_delays))
    for j, (base, row) in enumerate(zip(bases, numbers, strict=True)):
        tried = np.repeat(row[None], num_delays, 0)
        tried[:, model.place["delay_s"]] += np.arange(num_delays) * side.period_s
        paths = side.simulate(j, tried).astype(float)
        motion = measure_motion(side, paths[0])
        variance = Scale(base.frame_variance).variance(motion)
        variance = variance + (LATENT_UNITS_S * side.period_s) ** 2
        steps = np.diff(paths, axis=1, append=paths[:, -1:])
        error = np.diff(side.q[:, j], append=side.q[-1, j]) - steps
        error[:, side.ends - 1] = 0.0
        likelihood = -0.5 * np.minimum(error**2 / variance, MAX_SQUARE)
        late_s = row[model.place["delay_s"]]
        late_s += sum(share * row[model.place[name]] for name, share in model.lags.items())
        late = int(late_s / side.period_s)
        share = late_s / side.period_s - late
        mixed = (1.0 - share) * likelihood[:, late:-1] + share * likelihood[:, late + 1 :]
        bank[: side.num_samples - late - 1] += mixed.T
    return _clear_starts(bank, side, num_delays)


def _build_target_bank(
    side: Side,
    bases: Sequence[JointBaseline],
    numbers: Sequence[np.ndarray],
    parts: int,
    delays: np.ndarray,
) -> np.ndarray:
    """Return the same for targets, from a course `delays` on: what is missing of them shows in the error.

    Wiener's filter takes the joint's answer to a pulse out of the error. What it leaves of the
    errors of the reference is the noise of that estimate.
    """
    held = hold_commands(side, delays)
    num_delays = parts * side.count(LONGEST_TARGET_S)
    bank = np.zeros((side.num_samples, num_delays))
    for j, (base, row) in enumerate(zip(bases, numbers, strict=True)):
        pulse = _simulate_pulse(side, j, row)
        known = _drop_slow(base.error, side)
        noise = float(np.mean(np.clip(known, *np.quantile(known, (0.01, 0.99))) ** 2))
        steps = side.u[1:, j] - side.u[:-1, j]
        ratio = noise / max(float(np.mean(steps**2)), 1e-12)
        error = _drop_slow(side.q[:, j] - held.simulate(j, row)[0], side)
        lost = side.u[:, j] - held.u[:, j] - _undo_pulse(error, pulse, ratio)
        left = _undo_pulse(known, pulse, ratio)
        clipped = np.clip(left, *np.quantile(left, (0.01, 0.99)))
        variance = max(float(np.mean(clipped**2)), 1e-12)
        for d in range(1, num_delays):
            missing = side.u[:, j] - delay_commands(side.u[:, j], np.full(len(bank), d / parts))
            bank[:, d] += (lost * missing - 0.5 * missing**2) / variance
    return _clear_starts(bank, side, side.count(side.model.settling_s))


def _clear_starts(bank: np.ndarray, side: Side, num_samples: int) -> np.ndarray:
    """Return a bank in which nothing is late at a start, and the first samples after it say nothing."""
    for begin in side.starts:
        bank[begin : begin + num_samples] = 0.0
    bank[side.starts, 1:] = IMPOSSIBLE
    return bank


def _drop_slow(error: np.ndarray, side: Side) -> np.ndarray:
    """Return an error `(T,)` without what changes slowly."""
    return error - uniform_filter1d(error, side.count(SLOW_S))


def _undo_pulse(error: np.ndarray, pulse: np.ndarray, ratio: float) -> np.ndarray:
    """Return what a filter with the answer `pulse` made an error `(T,)` of; `ratio`: noise over signal."""
    size = len(error) + len(pulse)
    answer = np.fft.rfft(pulse, size)
    shares = answer.conj() / (np.abs(answer) ** 2 + ratio)
    return np.fft.irfft(shares * np.fft.rfft(error, size), size)[: len(error)]


def _simulate_pulse(side: Side, joint: int, numbers: np.ndarray) -> np.ndarray:
    """Return how a servo without friction answers to a target that is 1 for one sample, from that sample on."""
    count = side.count(PULSE_S)
    u = np.zeros_like(side.u[: 2 * count])
    u[count, joint] = PULSE_UNITS
    zeros = np.zeros_like(u)
    smooth = numbers.copy()
    for name in ("dry", "load_dry", "hysteresis", "shortage"):
        smooth[side.model.place[name]] = 0.0
    short = replace(
        side,
        u=u,
        q=side.q[:1] + zeros,
        begins=np.zeros(len(u), dtype=int),
        time_s=np.zeros(len(u)),
        poses=side.poses[:, :1].repeat(len(u), 1),
    )
    path = short.simulate(joint, smooth)[0].astype(float)
    without = replace(short, u=zeros).simulate(joint, smooth)[0]
    return (path - without)[count:] / PULSE_UNITS


def delay_commands(u: np.ndarray, delays: np.ndarray) -> np.ndarray:
    """Return commands `(T, …)`, each later by `delays` samples `(T,)`; the mean of two within a part of one."""
    whole = np.floor(delays).astype(int)
    rows = np.arange(len(u)) - whole
    share = (delays - whole).reshape(-1, *[1] * (u.ndim - 1))
    return (1.0 - share) * u[np.maximum(rows, 0)] + share * u[np.maximum(rows - 1, 0)]


def hold_commands(side: Side, delays: np.ndarray) -> Side:
    """Return the side under the commands that were in force, each later by `delays` samples `(T,)`."""
    return side.with_commands(delay_commands(side.u, delays))


def _weigh_samples(side: Side) -> np.ndarray:
    """Return the share of each sample in the squared changes of all commands, `(T,)`: no other delay shows."""
    steps = np.diff(side.u, axis=0, prepend=side.u[:1])
    steps[side.starts] = 0.0
    squares = np.square(steps).sum(1)
    return squares / max(float(squares.sum()), 1e-12)


def _weigh_course(
    joints: Sequence[FieldJoint], law: HoldLaw, power: float, course: MeanCourse
) -> HeldCourse:
    """Return a course with what it earns on each joint in the measure of all rows."""
    side = joints[0].side
    delays = course.delays / law.parts
    gains = _weigh_commands(joints, hold_commands(side, delays))
    return HeldCourse(law, power, delays, tuple(gains), course.cost, _weigh_samples(side))


def _weigh_commands(joints: Sequence[FieldJoint], held: Side) -> list[float]:
    """Return what each joint gains under the commands of `held`, nats."""
    gains = []
    for joint in joints:
        path = held.simulate(joint.joint, joint.numbers)[0]
        left = joint.residual - (joint.measure(path).astype(float) - joint.increments)
        count = joint.count * (1.0 if held.model.integrates else joint.measure.interval)
        squares = joint.projection.measure_squares(left)
        gains.append(float(compute_gain(squares, joint.squares, count)[0]))
    return gains


def _is_late_at_stops(joints: Sequence[FieldJoint], hold: HeldCourse) -> bool:
    """Return whether the course pays where it keeps joints moving, beside what delayed starts earn.

    A radio does not know what a command does; a slow pump or a soft joint delays starts alone.
    """
    side = joints[0].side
    held = hold_commands(side, hold.delays).u
    starts = np.where(np.abs(held) > np.abs(side.u), side.u, held)
    gained = sum(hold.gains)
    return gained - sum(_weigh_commands(joints, side.with_commands(starts))) > STOP_SHARE * gained


def find_hold(joints: Sequence[FieldJoint], bases: Sequence[JointBaseline]) -> HeldCourse | None:
    """Return the course that earns most, where one earns anything: that of the likeliest law at one of the powers."""
    side = joints[0].side
    numbers = [joint.numbers for joint in joints]
    courses: list[tuple[HoldLaw, list[MeanCourse]]] = []
    banks: dict[int, np.ndarray] = {}
    for parts, some in groupby(side.model.hold_laws, lambda law: law.parts):
        laws = list(some)
        bank = banks[parts] = _build_bank(side, bases, numbers, parts)
        chances = np.stack([law.list_chances(bank.shape[1], side.period_s) for law in laws])
        courses += zip(laws, average_courses(bank, chances, POWERS), strict=True)
    best: HeldCourse | None = None
    for place, power in enumerate(POWERS):
        law, each = max(courses, key=lambda one: one[1][place].evidence)
        if each[place].evidence > 0.0:
            hold = _weigh_course(joints, law, power, each[place])
            if hold.net > (best.net if best else 0.0):
                best = hold
    if best is None or (side.model.integrates and not _is_late_at_stops(joints, best)):
        return None
    if not side.model.integrates:
        for _ in range(TARGET_ROUNDS):
            best = max(best, _seek_again(joints, bases, best), key=lambda hold: hold.net)
    if isinstance(best.law, LossLaw):
        law = fit_loss_law(banks[best.law.parts], best.law, side.period_s)
        best = replace(best, law=law)
    return best


def fit_loss_law(bank: np.ndarray, law: LossLaw, period_s: float) -> LossLaw:
    """Return the law that makes the commands likeliest, by expectation maximisation from `law` on (Baum 1970).

    A frame that is lost between equal commands leaves no trace, and counts as the law lets expect.
    """
    for _ in range(LAW_ROUNDS):
        chances = law.list_chances(bank.shape[1], period_s)
        ((course,),) = average_courses(bank, chances[None], [1.0])
        law = LossLaw.count(course.counts)
    return law


def _seek_again(
    joints: Sequence[FieldJoint], bases: Sequence[JointBaseline], hold: HeldCourse
) -> HeldCourse:
    """Return the course of targets under the same law, sought beside what `hold` explains already."""
    side = joints[0].side
    numbers = [joint.numbers for joint in joints]
    bank = _build_target_bank(side, bases, numbers, hold.law.parts, hold.delays)
    chances = hold.law.list_chances(bank.shape[1], side.period_s)
    ((course,),) = average_courses(bank, chances[None], [hold.power])
    return _weigh_course(joints, hold.law, hold.power, course)
