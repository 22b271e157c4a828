"""Effects that some motions could tell, before anything is diagnosed.

Each effect is simulated along the motions at several sizes. Half the squared length of what it
changes, over the error that a simulator and the sensors have anyway, is the gain in log likelihood
that a diagnosis would find. An effect is told where the gain exceeds what a diagnosis asks for.
Axes: `W` windows, `I` increments, `J` joints, `E` all increments, `S` sizes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from actuators.recordings.inspection import estimate_step
from actuators.recordings.preview import EffectLimit, LookalikePair, PreviewCallback, PreviewResult
from actuators.scales import choose_horizon_s
from brokk_rl.contracts.actuator import Actuator
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.spec import Count, name_spec, spec
from diagnosis import effect_library
from diagnosis.effect_library import EffectType
from diagnosis.engine.decide import JOINT_NATS, LEAST_NATS
from diagnosis.rivals import INCREMENT_SAMPLES, to_increments
from diagnosis.sensors import MIN_ADDED_SCATTER, estimate_sensor_noise
from diagnosis.simulator_runs import SimulatorRuns, cut_simulator_runs

SIZES = (0.25, 0.5, 1.0, 2.0)
"""Sizes over the typical one that are simulated; the gain grows about with their square in between."""
LEAST_SIZE = 0.12
"""Smaller sizes, over the typical one, lie within what a machine repeats from day to day."""
QUANTISATION_FACTOR = 12.0**-0.5
"""Root mean square of a rounding error, over the step."""
GAIN_FAULT = 0.01
"""Deviation of the speed of a simulator from day to day, either way."""
RIVAL_DEVIATION = 4.0
"""Standard deviation of the size of an effect in the place of another, over the typical one."""
ALIKE_SHARE = 0.9
"""Two effects look alike where so much of each is explained by the other."""


@spec
class ExpectedError:
    """Error that a simulator is expected to have on a machine without the effects.

    Attributes:
        sensor: Standard deviation of an increment (a quarter of a second at 20 Hz), over the way at
            full speed.
        change: The same over the change of speed between neighbouring increments.
        wander: Relative standard deviation of the speed.
        reading: Noise of a position, over the travel, where no recordings show it.
    """

    sensor: float
    change: float
    wander: float
    reading: float

    def expect_deviation(
        self, paths: np.ndarray, way: np.ndarray, reading: np.ndarray
    ) -> np.ndarray:
        """Return the deviation of each increment of free runs, `(W, I, J)`, but for a wandering speed.

        Args:
            paths: Increments without any effect, `(W, I, J)`, rad or m.
            way: Way in an increment at full speed, `(J,)`.
            reading: Noise of a position, `(J,)`.
        """
        changed = np.diff(paths, axis=1, prepend=paths[:, :1])
        variance = np.square(self.sensor * way) + np.square(self.change * changed)
        return np.sqrt(variance + 2.0 * np.square(reading))

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
    """Foretells from simulated effects which of them a diagnosis of some motions could tell.

    Attributes:
        actuator: Simulator along whose motion effects are simulated.
        effects: Names of effects; `null`: all that are registered.
        error: Expected error of the simulator and the sensors.
        num_windows: Free runs that are simulated of the motions, evenly spread; more motions of the
            same making tell as much each.
    """

    actuator: Actuator
    effects: tuple[str, ...] | None
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
        reading = self.error.reading * (machine.upper - machine.lower)
        if are_measured:
            reading = self.error.measure_reading(motions, machine)
        runs = cut_simulator_runs(self.actuator, motions, machine, 0)
        seconds = len(runs.row) * choose_horizon_s(machine)
        most = min(self.num_windows, len(runs.row))
        runs = runs.select(np.unique(np.linspace(0, len(runs.row) - 1, most).round().astype(int)))
        view = MotionView(runs, self.error, reading, seconds)
        shown, limits = [], []
        for number, kind in enumerate(kinds):
            tell(f"simulating {kind.name}", number / len(kinds))
            if not _is_seen_in_motion(kind):
                limits += _list_other_limits(machine, kind, reading)
                continue
            own = view.simulate(kind)
            shown += own
            for one in own:
                limits += _list_limits(machine, one, view)
        assumed = {
            "simulator": name_spec(self.actuator),
            "price": {"joint": JOINT_NATS, "name": LEAST_NATS},
            "noise": {
                name: {"reading": float(one)}
                for name, one in zip(machine.joint_names, reading, strict=True)
            },
            "noise_is_measured": are_measured,
        }
        pairs = tuple(list_lookalikes(machine, shown, view, limits))
        return PreviewResult(seconds / 60.0, tuple(limits), pairs, assumed)


@dataclass(frozen=True, eq=False)
class NumberChange:
    """Change that one number of an effect makes.

    Attributes:
        kind: The effect.
        number: Its number; empty where one size stands for all numbers.
        sizes: Sizes over the typical one, `(S,)`.
        rows: Changes over the expected error, `(S, E, J)`.
    """

    kind: EffectType
    number: str
    sizes: np.ndarray
    rows: np.ndarray


class MotionView:
    """Free runs along the motions, and how much changes of them stand out.

    Args:
        runs: Some of the motions' free runs.
        error: Expected error of the simulator.
        reading: Noise of a position, rad or m, `(J,)`.
        seconds: Length of all motions.
    """

    def __init__(
        self, runs: SimulatorRuns, error: ExpectedError, reading: np.ndarray, seconds: float
    ) -> None:
        machine = runs.simulator.machine
        self._runs = runs
        self.start = runs.cut.q[:, runs.cut.num_before - 1]
        self.plain = to_increments(runs.simulator.plain_runs, self.start)
        way = machine.max_speed * INCREMENT_SAMPLES * machine.period_s
        self.deviation = error.expect_deviation(self.plain, way, reading)
        self.times = seconds / (len(runs.row) * choose_horizon_s(machine))
        """Length of the motions over that of the simulated free runs."""
        scaled = self.plain / self.deviation
        windows = np.eye(len(runs.row))
        wander = error.wander * windows[:, :, None, None] * scaled
        faults = [GAIN_FAULT * np.maximum(scaled, 0.0), GAIN_FAULT * np.minimum(scaled, 0.0)]
        columns = np.concatenate([np.stack(faults), wander])
        self._faults = columns.reshape(len(columns), -1, machine.num_joints)

    def simulate(self, kind: EffectType) -> list[NumberChange]:
        """Return what each number of an effect changes at each of `SIZES` within its bounds."""
        forms = [(name,) for name in kind.fitted] if kind.target.smooth else [kind.fitted]
        found = []
        for form in forms:
            values: dict[str, np.ndarray] = {}
            for name in kind.fitted:
                step = np.array(SIZES)[:, None] * kind.size(name) * (name in form)
                values[name] = kind.clipped(name, kind.numbers[name].none + step)
            for name in kind.shaping:
                values[name] = np.repeat(kind.typical(name)[None], len(SIZES), 0)
            paths = self._runs.simulator.simulate([(kind, values)], len(SIZES))
            changed = (to_increments(paths, self.start) - self.plain) / self.deviation
            rows = changed.reshape(len(SIZES), -1, changed.shape[-1])
            number = form[0] if kind.target.smooth else ""
            found.append(NumberChange(kind, number, np.array(SIZES), rows))
        return found

    def measure(self, joint: int, rows: np.ndarray, beside: np.ndarray | None = None) -> np.ndarray:
        """Return the gain of changes `(S, E)` of a joint, nats, `(S,)`.

        What faults of the simulator explain, within their prior, is no gain; nor what the changes
        `beside` `(S, E)` of another effect explain.
        """
        columns = self._faults[..., joint]
        precision = np.ones(len(columns))
        if beside is not None:
            columns = np.concatenate([columns, beside])
            precision = np.append(precision, np.full(len(beside), RIVAL_DEVIATION**-2.0))
        normal = self.times * columns @ columns.T + np.diag(precision)
        cross = self.times * columns @ rows.T
        whole = self.times * np.square(rows).sum(1)
        return 0.5 * np.maximum(whole - (cross * np.linalg.solve(normal, cross)).sum(0), 0.0)


def _list_limits(machine: Machine, one: NumberChange, view: MotionView) -> Iterator[EffectLimit]:
    """Yield the smallest sizes of a number that free runs show."""
    is_shared = bool(effect_library.list_shared_effects([one.kind]))
    every = list(range(machine.num_joints))
    for group in [every] if is_shared else [[j] for j in every]:
        gains = np.sum([view.measure(j, one.rows[..., j]) for j in group], 0)
        size = find_smallest_size(gains, LEAST_NATS + JOINT_NATS, one.sizes)
        yield _describe_limit(machine, one.kind, one.number, group, size, "motion")


def find_smallest_size(gains: np.ndarray, price: float, sizes: np.ndarray) -> float | None:
    """Return the smallest size at which the gain exceeds the price; `None` for none that was tried.

    Args:
        gains: Gain at each of the rising `sizes`, nats, `(S,)`; below the first it falls with the square.
        price: What a diagnosis asks for, nats.
        sizes: Sizes over the typical one, `(S,)`.
    """
    tried = np.geomspace(LEAST_SIZE, sizes[-1], 200)
    over_square = np.interp(np.log(tried), np.log(sizes), gains / sizes**2)
    told = over_square * tried**2 > price
    return float(tried[int(np.argmax(told))]) if told.any() else None


def list_lookalikes(
    machine: Machine, shown: Sequence[NumberChange], view: MotionView, limits: Sequence[EffectLimit]
) -> Iterator[LookalikePair]:
    """Yield pairs of effects that are told, and of which each explains the other on some joints."""
    told = {(one.effect, name) for one in limits if one.is_told for name in one.joints}
    typical = SIZES.index(1.0)
    for first, second in combinations(shown, 2):
        if first.kind is second.kind:
            continue
        joints = []
        for j, name in enumerate(machine.joint_names):
            if (first.kind.name, name) not in told or (second.kind.name, name) not in told:
                continue
            one, other = first.rows[..., j], second.rows[..., j]
            alike = _is_explained(view, j, one[typical], other)
            if alike and _is_explained(view, j, other[typical], one):
                joints.append(name)
        if joints:
            yield LookalikePair((first.kind.name, second.kind.name), tuple(joints))


def _is_explained(view: MotionView, joint: int, row: np.ndarray, others: np.ndarray) -> bool:
    """Return whether the changes `(S, E)` of another effect explain most of one `(E,)`."""
    whole = float(view.measure(joint, row[None])[0])
    left = float(view.measure(joint, row[None], others)[0])
    return left < (1.0 - ALIKE_SHARE) * whole


def _list_other_limits(
    machine: Machine, kind: EffectType, reading: np.ndarray
) -> Iterator[EffectLimit]:
    """Yield the limits of effects that the scatter of sensors shows, and effects that no motion shows."""
    every = list(range(machine.num_joints))
    for name in kind.fitted:
        if kind.target.side == "measurement":
            factor = 1.0 if kind.target.stochastic else QUANTISATION_FACTOR
            for j in every:
                least = MIN_ADDED_SCATTER * float(reading[j]) / factor
                size = least / abs(kind.size_on(name, j))
                yield _describe_limit(machine, kind, name, [j], size, "scatter")
        else:
            place = "frames" if kind.target.side == "command" else "tool points"
            yield _describe_limit(machine, kind, name, every, None, place)


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
    """Return whether free runs show the effect."""
    target = kind.target
    is_of_sensor = target.side == "measurement" and not target.smooth
    return not (target.stochastic or target.side == "kinematics" or is_of_sensor)
