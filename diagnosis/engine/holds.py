"""Commands that were held: lost frames and jitter, as a hidden delay common to all joints.

Viterbi's algorithm finds the likeliest course of the delay. The commands are replaced by those that
were in force, and judged by the same measure as every other row, less the prior of the course.
Axes: `T` samples, `K` delays, `M` models of the course.
"""

# pyright: reportIndexIssue=false, reportOperatorIssue=false, reportArgumentType=false
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false
# The kernel is compiled by Warp; a type checker reads it as ordinary Python.

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import warp as wp
from scipy.ndimage import uniform_filter1d

from diagnosis.engine.baseline import JointBaseline
from diagnosis.engine.evidence import FieldJoint, RowEvidence
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
TEMPERS = (1.0, 0.5)
"""Powers of the likelihood under which a course is sought; the samples depend on each other."""
IMPOSSIBLE = -1e9
"""Log chance of what cannot be."""
LEAST_NATS = 5.0


@dataclass(frozen=True)
class HeldCourse:
    """A found course.

    Attributes:
        course: Its model.
        delays: Additional delay of each sample of the field, in samples, `(T,)`.
        gain: What it earns on the field less its prior, nats.
        price: The same on the reference, at the length of the field, nats.
        weights: Share of each sample in what is seen of the delays, `(T,)`.
    """

    course: Course
    delays: np.ndarray
    gain: float
    price: float
    weights: np.ndarray

    @property
    def share(self) -> float:
        """Share of the samples that are delayed."""
        return float((self.delays > 0).mean())


@wp.kernel(enable_backward=False)
def find_courses(
    likelihood: wp.array2d[wp.float64],
    laws: wp.array3d[wp.float64],
    score: wp.array3d[wp.float64],
    back: wp.array3d[wp.int32],
    course: wp.array2d[wp.int32],
):
    """Find the likeliest course under each law by Viterbi's algorithm, `(M, T)`."""
    m = wp.tid()
    samples = likelihood.shape[0]
    delays = likelihood.shape[1]
    for k in range(samples):
        for d in range(delays):
            best = score[m, 0, 0] + laws[m, 0, d]
            source = wp.int32(0)
            for before in range(1, delays):
                tried = score[m, 0, before] + laws[m, before, d]
                if tried > best:
                    best = tried
                    source = before
            score[m, 1, d] = best + likelihood[k, d]
            back[m, k, d] = source
        for d in range(delays):
            score[m, 0, d] = score[m, 1, d]
    state = wp.int32(0)
    for d in range(1, delays):
        if score[m, 0, d] > score[m, 0, state]:
            state = d
    for i in range(samples):
        k = samples - 1 - i
        course[m, k] = state
        state = back[m, k, state]


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


def _search_courses(
    side: Side, bases: Sequence[JointBaseline], numbers: Sequence[np.ndarray]
) -> list[tuple[Course, np.ndarray, np.ndarray]]:
    """Return the likeliest course under each law and temper, in samples, and its law."""
    found = []
    for parts in sorted({course.parts for course in side.model.courses}):
        courses = [course for course in side.model.courses if course.parts == parts]
        bank = _build_bank(side, bases, numbers, parts)
        laws = [build_law(course, bank.shape[1]) for course in courses]
        for place, states in enumerate(follow_courses(bank, laws)):
            delays = states / parts
            law = laws[place // len(TEMPERS)]
            for _ in range(0 if side.model.integrates else TARGET_ROUNDS):
                bank = _build_target_bank(side, bases, numbers, parts, delays)
                delays = follow_courses(bank, [law])[0] / parts
            found.append((courses[place // len(TEMPERS)], delays, law))
    return found


def follow_courses(bank: np.ndarray, laws: Sequence[np.ndarray]) -> np.ndarray:
    """Return the likeliest states under each law and temper from log likelihoods `(T, K)`, `(M, T)`."""
    num_samples, num_delays = bank.shape
    # A law over a temper is the same as the likelihood to the power of it.
    models = np.array([law / temper for law in laws for temper in TEMPERS])
    with wp.ScopedDevice(DEVICE):
        found = wp.zeros((len(models), num_samples), dtype=wp.int32)
        inputs = [
            wp.array(bank, dtype=wp.float64),
            wp.array(models, dtype=wp.float64),
            wp.zeros((len(models), 2, num_delays), dtype=wp.float64),
            wp.empty((len(models), num_samples, num_delays), dtype=wp.int32),
        ]
        wp.launch(find_courses, dim=len(models), inputs=inputs, outputs=[found])
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
        variance = float(np.mean(np.clip(left, *np.quantile(left, (0.01, 0.99))) ** 2))
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


def _price_course(delays: np.ndarray, law: np.ndarray, parts: int, usual: float) -> float:
    """Return the log prior of a course, against a log chance `usual` of each sample that is not late.

    Each sample of a servo's error counts, and a machine whose frames come in time never has a late one.
    A valve's errors add up, so that far fewer of its increments are independent: there the course is
    held against no delay under the same law.
    """
    states = np.rint(delays * parts).astype(int)
    return float((law[states[:-1], states[1:]] - usual).sum())


class HeldCommands:
    """The search for held commands on the field, priced by the same on the reference.

    Args:
        evidence: The table.
    """

    def __init__(self, evidence: RowEvidence) -> None:
        self._evidence = evidence

    def find(self, joints: Sequence[FieldJoint]) -> dict[str, HeldCourse]:
        """Return the best course of each effect beside the numbers of the joints, where one earns anything."""
        side, reference = joints[0].side, self._evidence.reference
        found: dict[str, HeldCourse] = {}
        for course, gain, delays in self._search(joints):
            if gain < LEAST_NATS:
                continue
            price = self._prices.get(course, 0.0) * side.num_samples / reference.num_samples
            best = found.get(course.effect)
            if best is None or gain - price > best.gain - best.price:
                found[course.effect] = HeldCourse(course, delays, gain, price, _weigh_samples(side))
        return found

    @cached_property
    def _prices(self) -> dict[Course, float]:
        """Gain of each course on the reference, nats."""
        evidence = self._evidence
        healthy = [base.numbers for base in evidence.bases]
        found: dict[Course, float] = {}
        for course, gain, _ in self._search(evidence.view_field(healthy, evidence.reference)):
            found[course] = max(gain, found.get(course, 0.0))
        return found

    def _search(self, joints: Sequence[FieldJoint]) -> Iterator[tuple[Course, float, np.ndarray]]:
        """Yield courses with their gain in all and their delays."""
        side = joints[0].side
        numbers = [joint.numbers for joint in joints]
        for course, delays, law in _search_courses(side, self._evidence.bases, numbers):
            if not delays.any():
                continue
            held = hold_commands(side, delays)
            usual = law[0, 0] if side.model.integrates else 0.0
            gain = _price_course(delays, law, course.parts, usual)
            for joint in joints:
                path = held.simulate(joint.joint, joint.numbers)[0]
                left = joint.residual - (joint.measure(path).astype(float) - joint.increments)
                count = joint.count * (1.0 if side.model.integrates else joint.measure.interval)
                squares = joint.projection.measure_squares(left)
                gain += float(compute_gain(squares, joint.squares, count)[0])
            yield course, gain, delays
