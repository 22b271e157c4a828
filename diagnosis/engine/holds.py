"""Commands that were held: lost frames and jitter, as a hidden delay common to all joints.

Viterbi's algorithm finds the likeliest course of the delay. The commands are replaced by those that
were in force, and judged by the same measure as every other row, less the prior of the course.
Axes: `T` samples, `K` delays, `M` laws.
"""

# pyright: reportIndexIssue=false, reportOperatorIssue=false, reportArgumentType=false
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false
# The kernel is compiled by Warp; a type checker reads it as ordinary Python.

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import warp as wp
from scipy.ndimage import uniform_filter1d

from diagnosis.engine.baseline import JointBaseline
from diagnosis.engine.evidence import FieldJoint
from diagnosis.engine.joint_model import Course
from diagnosis.engine.measure import Scale, measure_motion
from diagnosis.engine.nuisance import compute_gain
from diagnosis.engine.side import DEVICE, Side

LONGEST_S = 0.9
LONGEST_TARGET_S = 0.2
"""Longest delay that a course reaches, and the same of targets, which come at a higher rate."""
SLOW_S = 0.5
"""Errors that change over a longer time than this come from no held target."""
PULSE_S = 0.6
"""Time after which a servo has answered."""
PULSE_UNITS = 0.01
TARGET_ROUNDS = 2
"""Rounds in which the course is sought again beside what it explains already."""
MAX_SQUARE = 16.0
LATENT_UNITS_S = 0.004
"""Speed that no joint shows: its step is below the noise of the encoder."""
TEMPER = 0.5
"""Power of the likelihood under which a course is sought; the samples depend on each other. Of seven opened cases of three
makes three earn 127 to 216 nats less with 1.0, of 50 to 744, and four 25 to 411 more, of 69 to 4,433."""
LAW_TEMPER = 0.1
"""The same for the choice between lost frames and jitter: of 14 opened cases of four makes it tells 13, as 0.05 does; 0.2
tells 11, and 0.5 nine."""
IMPOSSIBLE = -1e9
"""Log chance of what cannot be."""


@dataclass(frozen=True)
class HeldCourse:
    """A found course.

    Attributes:
        course: Its model.
        delays: Additional delay of each sample of the field, in samples, `(T,)`.
        gains: What it earns on each joint of the field, nats.
        prior: Log prior of the course, nats, 0 at most.
        weights: Share of each sample in what is seen of the delays, `(T,)`.
    """

    course: Course
    delays: np.ndarray
    gains: tuple[float, ...]
    prior: float
    weights: np.ndarray


@wp.kernel(enable_backward=False)
def find_course(
    likelihood: wp.array2d[wp.float64],
    law: wp.array2d[wp.float64],
    score: wp.array2d[wp.float64],
    back: wp.array2d[wp.int32],
    course: wp.array[wp.int32],
):
    """Find the likeliest course by Viterbi's algorithm, `(T,)`."""
    samples = likelihood.shape[0]
    delays = likelihood.shape[1]
    for k in range(samples):
        for d in range(delays):
            best = score[0, 0] + law[0, d]
            source = wp.int32(0)
            for before in range(1, delays):
                tried = score[0, before] + law[before, d]
                if tried > best:
                    best = tried
                    source = before
            score[1, d] = best + likelihood[k, d]
            back[k, d] = source
        for d in range(delays):
            score[0, d] = score[1, d]
    state = wp.int32(0)
    for d in range(1, delays):
        if score[0, d] > score[0, state]:
            state = d
    for i in range(samples):
        k = samples - 1 - i
        course[k] = state
        state = back[k, state]


def build_law(course: Course, num_delays: int) -> np.ndarray:
    """Return the log chance that a delay (first axis) is followed by another one (second), `(K, K)`."""
    stays = np.full(num_delays, course.lasts)
    stays[0] = 1.0 - course.begins
    steps = np.arange(num_delays)
    if course.is_loss:
        chance = np.zeros((num_delays, num_delays))
        chance[steps[1:], 0] = 1.0 - course.lasts
        chance[steps[1:-1], steps[2:]] = course.lasts
        chance[0, :2] = (1.0 - course.begins, course.begins)
    else:
        # No frame overtakes another: a delay grows by one sample a sample at most.
        in_order = (steps <= steps[:, None] + course.parts) & (steps != steps[:, None])
        chance = (1.0 - stays[:, None]) * in_order / in_order.sum(1, keepdims=True)
        np.fill_diagonal(chance, stays)
    return np.where(chance > 0.0, np.log(np.maximum(chance, 1e-300)), IMPOSSIBLE)


@dataclass(frozen=True)
class _Law:
    """A law with the log likelihoods `(T, K)` that it is held against, its log chances `(K, K)` and its evidence, nats.

    The evidence is that of all courses together, against no delay, under `TEMPER` and under `LAW_TEMPER`.
    """

    course: Course
    bank: np.ndarray
    chances: np.ndarray
    evidence: np.ndarray


def _list_laws(
    side: Side, bases: Sequence[JointBaseline], numbers: Sequence[np.ndarray]
) -> list[_Law]:
    """Return all laws with their evidence on a side."""
    found = []
    for parts in sorted({course.parts for course in side.model.courses}):
        courses = [course for course in side.model.courses if course.parts == parts]
        bank = _build_bank(side, bases, numbers, parts)
        chances = [build_law(course, bank.shape[1]) for course in courses]
        every = weigh_laws(bank, chances, (TEMPER, LAW_TEMPER))
        for course, law, evidence in zip(courses, chances, every, strict=True):
            found.append(_Law(course, bank, law, evidence))
    return found


def _follow_law(
    side: Side, bases: Sequence[JointBaseline], numbers: Sequence[np.ndarray], law: _Law
) -> tuple[np.ndarray, float]:
    """Return the likeliest course, in samples, `(T,)`, and its log prior.

    The prior is what the evidence leaves of the likelihood: that of one course alone, and what it
    shares with all others that are nearly the same. It never adds to what the course itself earns:
    a crane whose frames came in time would have 130 nats for nothing.
    """
    states = follow_courses(law.bank, law.chances)
    likelihood = law.bank[np.arange(side.num_samples), states] - law.bank[:, 0]
    prior = min(float(law.evidence[0] - TEMPER * likelihood.sum()), 0.0)
    delays = states / law.course.parts
    for _ in range(0 if side.model.integrates else TARGET_ROUNDS):
        bank = _build_target_bank(side, bases, numbers, law.course.parts, delays)
        delays = follow_courses(bank, law.chances) / law.course.parts
    return delays, prior


def weigh_laws(
    bank: np.ndarray, laws: Sequence[np.ndarray], tempers: Sequence[float]
) -> np.ndarray:
    """Return the log evidence of each law over all courses, against no delay, `(M, tempers)`.

    It is the forward pass of a hidden Markov model. Jitter has many courses that are nearly as likely as its
    likeliest one, and lost frames have few, so that the likeliest courses alone do not tell the two apart.

    Args:
        bank: Log likelihood of each delay at each sample, `(T, K)`; no delay but 0 is possible at the first one.
        laws: Log chance that a delay (first axis) is followed by another one (second), `(K, K)` each.
        tempers: Powers of the likelihood.
    """
    chances = np.exp(np.array(laws))[:, None]
    likelihood = np.multiply.outer(tempers, bank - bank[:, :1])
    highest = likelihood.max(2)
    factors = np.exp(likelihood - highest[..., None]).transpose(1, 0, 2)[:, :, None]
    state = np.repeat(factors[None, 0], len(laws), 0)
    evidence = np.repeat(highest.sum(1)[None], len(laws), 0)
    for factor in factors[1:]:
        state = (state @ chances) * factor
        total = np.maximum(state.sum(3, keepdims=True), np.finfo(float).tiny)
        state /= total
        evidence += np.log(total[..., 0, 0])
    return evidence


def follow_courses(bank: np.ndarray, law: np.ndarray) -> np.ndarray:
    """Return the likeliest states `(T,)` of a law `(K, K)` from log likelihoods `(T, K)` to the power of `TEMPER`."""
    num_samples, num_delays = bank.shape
    with wp.ScopedDevice(DEVICE):
        found = wp.zeros(num_samples, dtype=wp.int32)
        inputs = [
            wp.array(TEMPER * bank, dtype=wp.float64),
            wp.array(law, dtype=wp.float64),
            wp.zeros((2, num_delays), dtype=wp.float64),
            wp.empty((num_samples, num_delays), dtype=wp.int32),
        ]
        wp.launch(find_course, dim=1, inputs=inputs, outputs=[found])
    return found.numpy()


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
    for begin in side.starts:
        bank[begin : begin + num_delays] = 0.0
    bank[side.starts, 1:] = IMPOSSIBLE
    return bank


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
    for begin in side.starts:
        bank[begin : begin + side.count(side.model.settling_s)] = 0.0
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


def _weigh_course(joints: Sequence[FieldJoint], delays: np.ndarray) -> tuple[float, ...]:
    """Return what a course earns on each joint in the measure of all rows, nats."""
    side = joints[0].side
    held = hold_commands(side, delays)
    gains = []
    for joint in joints:
        path = held.simulate(joint.joint, joint.numbers)[0]
        left = joint.residual - (joint.measure(path).astype(float) - joint.increments)
        count = joint.count * (1.0 if side.model.integrates else joint.measure.interval)
        squares = joint.projection.measure_squares(left)
        gains.append(float(compute_gain(squares, joint.squares, count)[0]))
    return tuple(gains)


def find_hold(joints: Sequence[FieldJoint], bases: Sequence[JointBaseline]) -> HeldCourse | None:
    """Return the best course of the effect with the likeliest law, where it earns anything."""
    side = joints[0].side
    numbers = [joint.numbers for joint in joints]
    laws = _list_laws(side, bases, numbers)
    effect = max(laws, key=lambda law: law.evidence[-1]).course.effect
    best, most = None, 0.0
    for law in laws:
        if law.course.effect != effect:
            continue
        delays, prior = _follow_law(side, bases, numbers, law)
        gains = _weigh_course(joints, delays)
        if sum(gains) + prior > most:
            most = sum(gains) + prior
            best = HeldCourse(law.course, delays, gains, prior, _weigh_samples(side))
    return best
