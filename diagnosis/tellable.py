"""Effects that some motions could tell, before anything is diagnosed.

The response of each joint to each effect of the library is simulated along the motions and divided
by the error that a simulator and the machine's sensors have anyway. Its squared length is the Fisher
information about the size of the effect. An effect is told where the expected gain in log likelihood
exceeds the penalty that the search puts on it. What small faults of the simulator explain is removed
first.
Axes: `J` joints, `W` windows, `E` entries (whitened increments), `M` rows of responses.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from actuators import open_loop
from actuators.open_loop import FreeRunWindows
from actuators.recordings.inspection import estimate_step
from actuators.recordings.preview import EffectLimit, LookalikePair, PreviewCallback, PreviewResult
from actuators.scales import choose_horizon_s
from brokk_rl.contracts.actuator import Actuator, Excitation
from brokk_rl.errors import ConfigError, RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording, make_motion
from brokk_rl.spec import Count, Positive, name_spec, spec
from diagnosis import effect_library
from diagnosis.case import estimate_running_s
from diagnosis.effect_library import EffectSimulator, EffectType
from diagnosis.error_covariance import ErrorCovariance
from diagnosis.late_frames import find_smallest_lateness
from diagnosis.request import Penalties
from diagnosis.residuals import INCREMENT_SAMPLES, Residuals
from diagnosis.response_table import (
    ResponseTable,
    compare_pair,
    find_needed_minutes,
    find_separating_minutes,
    find_smallest_size,
    find_soonest,
    multiply_rows,
    simulate_responses,
)
from diagnosis.search import MIN_SIZE
from diagnosis.sensors import MIN_ADDED_SCATTER, estimate_sensor_noise

SIZES, COMPARED_SIZES = (0.25, 0.5, 1.0, 2.0), (0.5, 1.0, 2.0)
"""Sizes over the typical one that are simulated along the motions and along each excitation; in
between the information is interpolated. Powers of two: typical sizes of effects with the same form
differ by such (a delay of commands, an offset of clocks). Chosen by hand for 20 s on one core."""
QUANTISATION_FACTOR = 12.0**-0.5
"""Root mean square of a rounding error, over the step."""

MIN_STOP_MARGIN = 0.05
"""Least distance from a stop that programs keep, over the travel: effects at the stops themselves are
no purpose of an excitation. Chosen by hand."""


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
        excitations: Excitations that are compared, by name.
        num_windows: Free runs that are simulated of the motions, evenly spread; more motions of the
            same making hold as much information each.
        num_compared: The same of each excitation.
        compared_s: Length of the programs of each excitation from which these are taken.
    """

    actuator: Actuator
    effects: tuple[str, ...] | None
    prices: Penalties
    error: ExpectedError
    excitations: dict[str, Excitation]
    num_windows: Count
    num_compared: Count
    compared_s: Positive

    def assess(
        self,
        motions: Sequence[Recording],
        machine: Machine,
        generator: np.random.Generator,
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
        moving = [kind for kind in kinds if _is_seen_in_motion(kind)]
        columns, rows, sizes = simulate_responses(
            residuals, moving, SIZES, lambda doing, done: tell(doing, 0.05 + 0.5 * done)
        )
        used_s = len(cut.q) * choose_horizon_s(machine)
        table = ResponseTable(
            multiply_rows(columns), residuals.faults.shape[1], rows, sizes, used_s
        ).scale_to(seconds)
        compared = self._compare_excitations(machine, moving, noise, generator, tell)
        tell("effects and pairs", 0.95)
        limits = list(self._list_limits(machine, moving, table, compared))
        for kind in kinds:
            if not _is_seen_in_motion(kind):
                limits += self._list_other_limits(machine, kind, residuals, noise, seconds / used_s)
        return PreviewResult(
            minutes=seconds / 60.0,
            limits=tuple(limits),
            pairs=tuple(list_lookalikes(machine, table, compared, limits)),
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

    def _compare_excitations(
        self,
        machine: Machine,
        kinds: Sequence[EffectType],
        noise: Sequence[ErrorCovariance],
        generator: np.random.Generator,
        tell: PreviewCallback,
    ) -> dict[str, ResponseTable]:
        """Return the responses at typical sizes along each excitation."""
        cuts = {}
        for name, excitation in self.excitations.items():
            if motions := simulate_programs(excitation, machine, self.compared_s, generator):
                cut, _, _ = cut_motions(motions, machine, self.num_compared)
                cuts[name] = replace(cut, run=np.full(len(cut.q), name))
        if not cuts:
            return {}
        joined = open_loop.join_windows(list(cuts.values()))
        residuals = self._hold(machine, joined, np.zeros(len(joined.q)), noise)
        columns, rows, sizes = simulate_responses(
            residuals,
            kinds,
            COMPARED_SIZES,
            lambda doing, done: tell(f"{doing}, excitations", 0.55 + 0.4 * done),
        )
        found, steps = {}, residuals.increments.shape[1]
        for name in cuts:
            entries = np.repeat(joined.run == name, steps)
            seconds = entries.sum() / steps * choose_horizon_s(machine)
            found[name] = ResponseTable(
                multiply_rows(columns[..., entries]),
                residuals.faults.shape[1],
                rows,
                sizes,
                seconds,
            )
        return found

    def _list_limits(
        self,
        machine: Machine,
        kinds: Sequence[EffectType],
        table: ResponseTable,
        compared: Mapping[str, ResponseTable],
    ) -> Iterator[EffectLimit]:
        """Yield the limits of effects that free runs show."""
        for kind in kinds:
            is_shared = bool(effect_library.list_shared_effects([kind]))
            price = self.prices.name + (0.0 if is_shared else self.prices.joint)
            groups = [list(range(machine.num_joints))] if is_shared else []
            groups = groups or [[j] for j in range(machine.num_joints)]
            for key in table.list_keys(kind.name):
                for group in groups:
                    gains = sum(table.expect_gains(j, key) for j in group)
                    size = find_smallest_size(np.asarray(gains), price, table.sizes[key][-1])
                    if size is not None and not is_shared:
                        size = max(size, MIN_SIZE)
                    best = find_soonest(
                        {
                            name: find_needed_minutes(one, group, key, price)
                            for name, one in compared.items()
                        }
                    )
                    yield _describe_limit(machine, kind, key[1], group, size, "motion", *best)

    def _list_other_limits(
        self,
        machine: Machine,
        kind: EffectType,
        residuals: Residuals,
        noise: Sequence[ErrorCovariance],
        times: float,
    ) -> Iterator[EffectLimit]:
        """Yield the limits of effects that sensors, frames or tool points show."""
        every, price = list(range(machine.num_joints)), self.prices.joint + self.prices.name
        for name in kind.fitted:
            if kind.target.side == "measurement":
                factor = QUANTISATION_FACTOR if not kind.target.stochastic else 1.0
                for j in every:
                    least = MIN_ADDED_SCATTER * noise[j].reading / factor
                    size = least / abs(kind.size_on(name, j))
                    yield _describe_limit(machine, kind, name, [j], size, "scatter")
            elif kind.target.side == "command":
                size = find_smallest_lateness(residuals, kind, name, price, times)
                yield _describe_limit(machine, kind, name, every, size, "frames")
            else:
                yield _describe_limit(machine, kind, name, every, None, "tool points")


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


def simulate_programs(
    excitation: Excitation, machine: Machine, seconds: float, generator: np.random.Generator
) -> list[Recording]:
    """Return the programs of an excitation as a nominal machine would follow them; none where none fits."""
    try:
        segments = excitation.segments(machine, seconds, generator, [])
    except ConfigError:  # not a single segment fits
        return []
    before, late = (
        open_loop.count_samples_before(machine),
        round(machine.dead_time_s / machine.period_s),
    )
    found = []
    for number, segment in enumerate(segments):
        u, full = np.pad(segment.u, ((before, 0), (0, 0))), machine.max_speed * machine.period_s
        margin = max(segment.stop_margin, MIN_STOP_MARGIN) * (machine.upper - machine.lower)
        low, high = machine.lower + margin, machine.upper - margin
        # A joint that comes near its stop waits there until its program turns around.
        heading = segment.start.astype(float)
        for k in range(len(u)):
            ahead = heading + u[k] * full
            u[k] *= ~((ahead > high) & (u[k] > 0.0) | (ahead < low) & (u[k] < 0.0))
            heading = heading + u[k] * full
        moved = np.pad(u, ((late + 1, 0), (0, 0)))[: len(u)] * full
        q = segment.start + np.cumsum(moved, 0)
        t_s = np.arange(len(u)) * machine.period_s
        found.append(make_motion(machine, f"{number}", t_s, u, q))
    return found


def list_lookalikes(
    machine: Machine,
    table: ResponseTable,
    compared: Mapping[str, ResponseTable],
    limits: Sequence[EffectLimit],
) -> Iterator[LookalikePair]:
    """Yield pairs of effects that are told, and of which each explains the other on some joints."""
    told: list[set[str]] = []
    for name in machine.joint_names:
        mine = [one for one in limits if name in one.joints and one.shows_in == "motion"]
        told.append({one.effect for one in mine} - {one.effect for one in mine if not one.is_told})
    for pair in combinations(sorted(set().union(*told)), 2):
        joints = []
        for j, names in enumerate(told):
            if names.issuperset(pair) and compare_pair(table, j, pair) == "alike":
                joints.append(j)
        if joints:
            needed = {
                name: find_separating_minutes(one, joints, pair) for name, one in compared.items()
            }
            names = tuple(machine.joint_names[j] for j in joints)
            yield LookalikePair((pair[0], pair[1]), names, *find_soonest(needed))


def _describe_limit(
    machine: Machine,
    kind: EffectType,
    number: str,
    joints: Sequence[int],
    size: float | None,
    shows_in: str,
    excitation: str | None = None,
    minutes: float | None = None,
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
        excitation=excitation,
        minutes=minutes,
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
