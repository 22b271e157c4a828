"""Effects that some motions could tell, before anything is diagnosed.

The response of each joint to each effect of the library is simulated along the motions and divided
by the error that a simulator and the machine's sensors have anyway. Its squared length is the Fisher
information about the size of the effect. An effect is told where the expected gain in log likelihood
exceeds the penalty that the search puts on it. What small faults of the simulator explain is removed
first.
Axes: `J` joints, `E` entries (whitened increments), `S` sizes, `R` responses.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from actuators import open_loop
from actuators.open_loop import FreeRunWindows
from actuators.recordings.inspection import estimate_step
from actuators.recordings.preview import EffectLimit, LookalikePair, PreviewCallback, PreviewResult
from actuators.scales import choose_horizon_s
from brokk_rl.contracts.actuator import Actuator
from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.spec import Count, name_spec, spec
from diagnosis import effect_library
from diagnosis.case import estimate_running_s
from diagnosis.decision import SAME_NATS, SAME_SHARE
from diagnosis.effect_library import EffectSimulator, EffectType
from diagnosis.error_covariance import T_FREEDOM, ErrorCovariance
from diagnosis.request import Penalties
from diagnosis.residuals import INCREMENT_SAMPLES, Residuals, build_rays
from diagnosis.responses import SIZE_PRIOR
from diagnosis.search import MIN_SIZE
from diagnosis.sensors import MIN_ADDED_SCATTER, estimate_sensor_noise

SIZES = (0.25, 0.5, 1.0, 2.0)
"""Sizes over the typical one that are simulated; in between the information is interpolated. Powers of
two: typical sizes of effects with the same form differ by such (a delay of commands, an offset of
clocks). Chosen by hand for ten seconds on one core."""
TRIED_SIZES = np.geomspace(0.02, 4.0, 240)
"""Sizes over the typical one among which the smallest is sought; steps of 2 %."""
QUANTISATION_FACTOR = 12.0**-0.5
"""Root mean square of a rounding error, over the step."""
INFORMATION_SHARE = (T_FREEDOM + 1.0) / (T_FREEDOM + 3.0)
"""Fisher information of the t distribution about its place, over that of a normal one: 3/4."""
RIVAL_SIGMA = 4.0
"""Prior standard deviation of the size of an effect in the place of another, over the typical one: all
that the search tries."""


@spec
class ExpectedError:
    """Error that a simulator is expected to have on a machine without the effects.

    Attributes:
        sensor: Standard deviation of an increment (a quarter of a second at 20 Hz), over the way at
            full speed.
        change: The same over the change of speed between neighbouring increments.
        wander: Relative standard deviation of the speed.
        memory: Increments over which a wandering speed forgets.
        reading: Noise of a position, over the travel, where no recordings show it.
    """

    sensor: float
    change: float
    wander: float
    memory: float
    reading: float

    def expect_noise(
        self, machine: Machine, reading: np.ndarray | None = None
    ) -> list[ErrorCovariance]:
        """Return the noise of each joint; `reading`: measured noise of positions, rad or m, `(J,)`."""
        if reading is None:
            reading = self.reading * (machine.upper - machine.lower)
        way = machine.max_speed * INCREMENT_SAMPLES * machine.period_s
        return [
            ErrorCovariance(
                self.sensor * float(one), self.change, self.wander, self.memory, float(r)
            )
            for one, r in zip(way, reading, strict=True)
        ]

    def measure_reading(self, recordings: Sequence[Recording], machine: Machine) -> np.ndarray:
        """Return the noise of the positions in recordings, rad or m, `(J,)`; the expected one where they show none.

        A coarse sensor repeats its readings: its noise is that of rounding.
        """
        noise = estimate_sensor_noise(recordings)
        for j in range(machine.num_joints):
            step = estimate_step(np.concatenate([one.q[:, j] for one in recordings]))
            if np.isfinite(step):
                noise[j] = max(noise[j], QUANTISATION_FACTOR * step)
        return np.where(noise > 0.0, noise, self.reading * (machine.upper - machine.lower))


@spec
class TellableEffects:
    """Foretells from responses which effects a diagnosis of some motions could tell.

    Attributes:
        actuator: Simulator along whose motion effects are simulated.
        effects: Names of effects; `null`: all that are registered.
        prices: Penalties of the search.
        error: Expected error of the simulator and the sensors.
        num_windows: Free runs that are simulated of the motions, evenly spread; more motions of the
            same making hold as much information each.
    """

    actuator: Actuator
    effects: tuple[str, ...] | None
    prices: Penalties
    error: ExpectedError
    num_windows: Count

    def assess(
        self,
        motions: Sequence[Recording],
        machine: Machine,
        tell: PreviewCallback,
        are_measured: bool,
    ) -> PreviewResult:
        """Return which effects these motions could tell; see `actuators.recordings.preview`."""
        tell("cutting the motions", 0.0)
        kinds = effect_library.load_effects(machine, self.effects)
        reading = self.error.measure_reading(motions, machine) if are_measured else None
        noise = self.error.expect_noise(machine, reading)
        cut, running_s, seconds = cut_motions(motions, machine, self.num_windows)
        residuals = self._hold(machine, cut, running_s, noise)
        times = seconds / (len(cut.q) * choose_horizon_s(machine))
        shown = []
        for number, kind in enumerate(kinds):
            tell(f"simulating {kind.name}", number / len(kinds))
            if _is_seen_in_motion(kind):
                shown += simulate_responses(residuals, kind)
        known = ResponseInformation(residuals.faults, times)
        limits = list(self._list_limits(machine, shown, known))
        for kind in kinds:
            if not _is_seen_in_motion(kind):
                limits += _list_other_limits(machine, kind, noise)
        return PreviewResult(
            minutes=seconds / 60.0,
            limits=tuple(limits),
            pairs=tuple(list_lookalikes(machine, shown, known, limits)),
            assumed={
                "simulator": name_spec(self.actuator),
                "price": {"joint": self.prices.joint, "name": self.prices.name},
                "noise": {
                    name: vars(one) for name, one in zip(machine.joint_names, noise, strict=True)
                },
                "noise_is_measured": are_measured,
            },
        )

    def _hold(
        self,
        machine: Machine,
        cut: FreeRunWindows,
        running_s: np.ndarray,
        noise: Sequence[ErrorCovariance],
    ) -> Residuals:
        simulator = EffectSimulator(self.actuator, machine, cut, running_s, 0)
        return Residuals(simulator, noise, np.ones((len(cut.q), machine.num_joints), dtype=bool))

    def _list_limits(
        self, machine: Machine, shown: Sequence[NumberResponse], known: ResponseInformation
    ) -> Iterator[EffectLimit]:
        """Yield the limits of effects that free runs show."""
        for one in shown:
            is_shared = bool(effect_library.list_shared_effects([one.kind]))
            price = self.prices.name + (0.0 if is_shared else self.prices.joint)
            every = list(range(machine.num_joints))
            alike = [other for other in shown if other.kind is one.kind]
            for group in [every] if is_shared else [[j] for j in every]:
                gains = sum(known.expect_gains(j, one, alike) for j in group)
                size = find_smallest_size(np.asarray(gains), price, one.sizes[-1])
                if size is not None and not is_shared:
                    size = max(size, MIN_SIZE)
                yield _describe_limit(machine, one.kind, one.number, group, size, "motion")


@dataclass(frozen=True, eq=False)
class NumberResponse:
    """Response of the joints to one number of an effect.

    Attributes:
        kind: The effect.
        number: Its number; empty where one size stands for all numbers.
        sizes: Sizes over the typical one, `(S,)`.
        rows: Whitened responses, `(J, S, E)`.
    """

    kind: EffectType
    number: str
    sizes: np.ndarray
    rows: np.ndarray

    def at_typical(self, joint: int) -> np.ndarray:
        """Return the response at the size nearest to the typical one, `(E,)`."""
        return self.rows[joint, int(np.argmin(np.abs(self.sizes - 1.0)))]


def simulate_responses(residuals: Residuals, kind: EffectType) -> list[NumberResponse]:
    """Return the whitened responses to each number of an effect."""
    found = []
    for ray in build_rays(kind, SIZES):
        tried = ray.sizes[ray.sizes > 0.0]
        one = replace(ray, sizes=np.concatenate([[0.0], tried]))
        found.append(NumberResponse(kind, ray.name, tried, residuals.response(one)[:, 1:]))
    return found


@dataclass(frozen=True, eq=False)
class ResponseInformation:
    """Information about sizes beside the faults of the simulator.

    Attributes:
        faults: Responses to the faults of each joint at one prior sigma, `(J, R, E)`.
        times: Length of the motions over that of the simulated free runs.
    """

    faults: np.ndarray
    times: float

    def measure(
        self, joint: int, rows: np.ndarray, beside: Sequence[np.ndarray] = ()
    ) -> np.ndarray:
        """Return the information about the lengths of responses `(R, E)`, `(R,)`.

        Faults have a prior of one standard deviation each, the responses `beside` one of
        `RIVAL_SIGMA`.
        """
        share = INFORMATION_SHARE * self.times
        known = np.concatenate([self.faults[joint], *beside])
        precision = np.ones(len(known))
        precision[self.faults.shape[1] :] = RIVAL_SIGMA**-2.0
        cross = share * known @ rows.T
        inner = share * known @ known.T + np.diag(precision)
        explained = (cross * np.linalg.solve(inner, cross)).sum(0)
        return np.maximum(share * (rows**2).sum(1) - explained, 0.0)

    def expect_gains(
        self, joint: int, one: NumberResponse, alike: Sequence[NumberResponse]
    ) -> np.ndarray:
        """Return the expected gain of each of `TRIED_SIZES` before penalties, nats.

        It is the logarithm of a Bayes factor by Laplace's approximation: half the squared length of
        the response, less the prior of the size and Occam's factor of all numbers `alike`.
        """
        unit = self._interpolate(joint, one)
        occam = sum(np.log1p(self._interpolate(joint, other)) for other in alike)
        return 0.5 * (unit - SIZE_PRIOR**-2.0) * TRIED_SIZES**2 - 0.5 * occam

    def _interpolate(self, joint: int, one: NumberResponse) -> np.ndarray:
        """Return the information over the squared size at each of `TRIED_SIZES`."""
        known = self.measure(joint, one.rows[joint]) / one.sizes**2
        return np.interp(np.log(TRIED_SIZES), np.log(one.sizes), known)

    def is_explained(
        self, joint: int, numbers: Sequence[NumberResponse], others: Sequence[NumberResponse]
    ) -> bool:
        """Return whether another effect explains all numbers of an effect at their typical sizes.

        The same limits make two effects equivalent in the answer of a diagnosis. Numbers that show
        nothing are not explained.
        """
        beside = [other.rows[joint] for other in others]
        for one in numbers:
            row = one.at_typical(joint)[None]
            own = float(self.measure(joint, row)[0])
            left = float(self.measure(joint, row, beside)[0])
            is_alike = left < (1.0 - SAME_SHARE) * own or 0.5 * left < SAME_NATS
            if 0.5 * own < SAME_NATS or not is_alike:
                return False
        return True


def find_smallest_size(gains: np.ndarray, price: float, largest: float) -> float | None:
    """Return the smallest of `TRIED_SIZES` from which the gain exceeds the price; `None` for none up to `largest`."""
    told = (gains > price) & (largest + 1e-9 >= TRIED_SIZES)
    return float(TRIED_SIZES[int(np.argmax(told))]) if told.any() else None


def _list_other_limits(
    machine: Machine, kind: EffectType, noise: Sequence[ErrorCovariance]
) -> Iterator[EffectLimit]:
    """Yield the limits of effects that the scatter of sensors shows, and effects that no motion shows."""
    every = list(range(machine.num_joints))
    for name in kind.fitted:
        if kind.target.side == "measurement":
            factor = 1.0 if kind.target.stochastic else QUANTISATION_FACTOR
            for j in every:
                least = MIN_ADDED_SCATTER * noise[j].reading / factor
                size = least / abs(kind.size_on(name, j))
                yield _describe_limit(machine, kind, name, [j], size, "scatter")
        else:
            place = "frames" if kind.target.side == "command" else "tool points"
            yield _describe_limit(machine, kind, name, every, None, place)


def cut_motions(
    motions: Sequence[Recording], machine: Machine, most: int
) -> tuple[FreeRunWindows, np.ndarray, float]:
    """Return at most so many free runs, evenly spread, their running times, and the time of all, s.

    Raises:
        RecordingError: no motion is long enough for a free run.
    """
    horizon_s, before = choose_horizon_s(machine), open_loop.count_samples_before(machine)
    steps = round(horizon_s / machine.period_s)
    cuts, running = [], []
    for motion, begun_s in zip(motions, estimate_running_s(motions), strict=True):
        if motion.num_samples >= before + steps:
            cut = open_loop.cut_windows([motion], machine, horizon_s, horizon_s)
            cuts.append(cut)
            running.append(begun_s + motion.t_s[before + steps * np.arange(len(cut.q))])
    if not cuts:
        raise RecordingError(
            f"too little data: no motion is long enough for a free run of {horizon_s:g} s"
        )
    cut, running_s = open_loop.join_windows(cuts), np.concatenate(running)
    seconds = len(cut.q) * horizon_s
    kept = np.unique(np.linspace(0, len(cut.q) - 1, min(most, len(cut.q))).round().astype(int))
    some = replace(cut, u=cut.u[kept], q=cut.q[kept], run=cut.run[kept])
    return some, running_s[kept], seconds


def list_lookalikes(
    machine: Machine,
    shown: Sequence[NumberResponse],
    known: ResponseInformation,
    limits: Sequence[EffectLimit],
) -> Iterator[LookalikePair]:
    """Yield pairs of effects that are told, and of which each explains the other on some joints."""
    numbers: dict[str, list[NumberResponse]] = {}
    for one in shown:
        numbers.setdefault(one.kind.name, []).append(one)
    told: list[set[str]] = []
    for name in machine.joint_names:
        mine = [one for one in limits if name in one.joints and one.shows_in == "motion"]
        told.append({one.effect for one in mine} - {one.effect for one in mine if not one.is_told})
    for first, second in combinations(sorted(set().union(*told)), 2):
        one, other = numbers[first], numbers[second]
        joints = []
        for j, names in enumerate(told):
            if not names.issuperset((first, second)):
                continue
            if known.is_explained(j, one, other) and known.is_explained(j, other, one):
                joints.append(machine.joint_names[j])
        if joints:
            yield LookalikePair((first, second), tuple(joints))


def _describe_limit(
    machine: Machine,
    kind: EffectType,
    number: str,
    joints: Sequence[int],
    size: float | None,
    shows_in: str,
) -> EffectLimit:
    """Return a limit with its sizes in SI units; those of several joints are their mean."""
    number = number or kind.fitted[0]
    typical = float(np.mean([abs(kind.size_on(number, j)) for j in joints]))
    return EffectLimit(
        effect=kind.name,
        number=number,
        joints=tuple(machine.joint_names[j] for j in joints),
        unit=_name_unit(machine, kind.numbers[number].unit, joints),
        typical=typical,
        smallest=None if size is None else size * typical,
        shows_in=shows_in,
    )


def _name_unit(machine: Machine, unit: str, joints: Sequence[int]) -> str:
    if len({machine.joints[j].unit for j in joints}) > 1:
        return unit
    return unit.replace("rad", machine.joints[joints[0]].unit)


def _is_seen_in_motion(kind: EffectType) -> bool:
    """Return whether free runs show the effect; see `diagnosis.detection`."""
    target = kind.target
    return not (
        target.stochastic
        or target.side == "kinematics"
        or (target.side == "measurement" and not target.smooth)
    )
