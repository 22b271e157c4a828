"""The plants of an exam: `N` runs of machines of one make, side by side, behind a `Link`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.signal import lfilter

from brokk_rl.machine import Machine
from brokk_rl.signals import Command
from brokk_rl.spec import spec
from exam.case_distribution import PlantRun
from exam.plants import out_of_library_faults, plant_parameters
from exam.plants.electronics import CommandBus, Encoders
from exam.plants.family import DrawnPlants, PlantLink
from exam.plants.faults import FAULTS, apply_faults
from exam.plants.linkage import Arm, Boom
from exam.plants.out_of_library_faults import OutOfLibraryFaults
from exam.plants.plant_parameters import PlantParameters
from exam.plants.power_stages import CompensatedValves, ThrottleValves, TwoChamberCylinders
from exam.plants.valve import SpoolValve

POWER_STAGES = {
    "chambers": TwoChamberCylinders,
    "compensated": CompensatedValves,
    "throttled": ThrottleValves,
}
MOVING = 0.01
"""Speed, of full speed, from which a joint moves; chosen by hand."""
DROOP_S = 1.5
"""Time in which the supply drops and recovers, s; chosen by hand."""
WARM_S = 900.0
"""Time constant of the tank's temperature, s; chosen by hand: a quarter of an hour."""


class ExamPlant(PlantLink):
    """A `Link` to simulated machines of one make.

    Args:
        machine: Geometry, masses, limits.
        make: See `plant_parameters.MAKES`.
        parameters: Of each run's machine; `outside_severity` is that of its outside fault.
        runs: The runs.
        steps: Control periods of the longest run.
    """

    def __init__(
        self,
        machine: Machine,
        make: str,
        parameters: Sequence[PlantParameters],
        runs: Sequence[PlantRun],
        steps: int,
    ) -> None:
        chance = []
        for run, one in zip(runs, parameters, strict=True):
            chance.append(_RunNoise(run.chance, one, steps, machine))
        super().__init__(machine, parameters, runs, chance)
        n, count, joints = self._n, len(runs), machine.num_joints
        self._wander, self._noise = self._stack_chance("wander"), self._stack_chance("noise")
        self._luck = self._stack_chance("luck")
        self._line, self._valve = CommandBus(n, machine.period_s), SpoolValve(n)
        self._power = POWER_STAGES[make](n, machine)
        self._outside_faults = OutOfLibraryFaults(
            machine, self._kinds, n["outside_severity"], self._luck[:, :, 2]
        )
        self._arm, self._encoders = Arm(machine, n), Encoders(n, machine.period_s)
        self._q = np.tile(machine.home, (count, 1))
        self._boom = Boom(n, self._q, np.full((count, 1), make != "chambers"))
        self._true, self._earlier = self._q.copy(), self._q.copy()
        self._flow, self._droop = np.zeros((count, joints)), np.zeros((count, 1))
        self._starving = make == "compensated"
        self._power.begin(self._arm.load(self._true))

    @property
    def q(self) -> np.ndarray:
        """True positions of the links, `(N, J)`."""
        return self._true

    def _measure(self) -> np.ndarray:
        shown = self._outside_faults.shown(self._true), self._outside_faults.shown(self._earlier)
        return self._encoders.read(*shown, self._noise[self._k])

    def _find_arm(self) -> Arm:
        return self._arm

    def send(self, command: Command) -> Command:
        """Move on by one control period with these commands, `(N, J)`."""
        machine, n, k = self._machine, self._n, self._k
        power, dt_s = self._power, self._power.dt_s
        t_s, run_s = k * machine.period_s, self._elapsed_s + k * machine.period_s
        u = self._outside_faults.command(np.asarray(command.u, dtype=float))
        luck = self._luck[k]
        self._line.send(u, t_s, luck[:, :1], luck[:, 1:2], self._outside_faults.later_s(u, run_s))
        tempo, load = self._tempo(k, run_s), self._arm.load(self._true)
        self._earlier = self._true
        for i in range(round(machine.period_s / dt_s)):
            moving = np.abs(power.speed) > MOVING
            opening = self._valve.step(
                self._line.at(t_s + i * dt_s), dt_s, self._outside_faults.bend, moving, load
            )
            self._flow = self._shared(opening, load)
            speed = power.step(self._flow * tempo, load) * machine.max_speed
            lever = 1.0 + n["lever"] * np.sin(
                np.pi * (self._q - machine.lower) / (machine.upper - machine.lower)
                + n["lever_phase"]
            )
            moved = self._q + dt_s * speed * lever
            self._q = np.clip(moved, machine.lower, machine.upper)
            power.stopped(self._q != moved)
            self._true = self._boom.step(
                self._q, np.where(self._q == moved, speed * lever, 0.0), dt_s
            )
        self._k += 1
        return command

    def _tempo(self, k: int, run_s: np.ndarray) -> np.ndarray:
        """Return a factor on all flows, `(N, J)`: oil, supply, chance, outside faults."""
        n = self._n
        work = np.minimum((np.abs(self._flow) * n["demand"]).sum(1, keepdims=True), 1.0)
        self._droop += (work - self._droop) * self._machine.period_s / DROOP_S
        warm = 1.0 + n["warm_up"] * (1.0 - np.exp(-run_s / WARM_S))[:, None]
        drifted = 1.0 + n["drift"] * (1.0 - np.exp(-run_s[:, None] / n["drift_s"]))
        tempo = (1.0 + self._wander[k]) * warm * drifted * (1.0 - n["droop"] * self._droop)
        return np.maximum(tempo * self._outside_faults.tempo(k, self._true, self._flow), 0.0)

    def _shared(self, opening: np.ndarray, load: np.ndarray) -> np.ndarray:
        """Return the flows that the pump can give of those asked for, `(N, J)`."""
        asked = np.abs(opening) * self._n["demand"]
        total = asked.sum(1, keepdims=True)
        if not (total > 1.0).any():
            return opening
        if not self._starving:
            return opening / np.maximum(total, 1.0)
        # oil takes the easiest way: the heaviest load gets the least
        heavy = asked * np.exp(-2.0 * np.sign(opening) * load)
        given = np.maximum(
            asked
            - np.maximum(total - 1.0, 0.0) * heavy / np.maximum(heavy.sum(1, keepdims=True), 1e-9),
            0.0,
        )
        return opening * given / np.maximum(asked, 1e-9)


class _RunNoise:
    """Random numbers of one run, drawn beforehand: a run does not depend on its neighbours."""

    def __init__(self, seed: int, one: PlantParameters, steps: int, machine: Machine) -> None:
        generator = np.random.default_rng(seed)
        shape = (steps + 1, machine.num_joints)
        keep = np.exp(-machine.period_s / one["wander_s"])
        white, first = (
            generator.standard_normal(shape),
            generator.standard_normal(machine.num_joints),
        )
        # first-order noise of unit variance from its first value on
        wander = []
        for j, a in enumerate(keep.tolist()):
            gain = [np.sqrt(1.0 - a * a)]
            wander.append(lfilter(gain, [1.0, -a], white[:, j], zi=[a * first[j]])[0])
        self.wander = (np.stack(wander, 1) * one["wander"]).astype(np.float32)
        self.noise = generator.standard_normal(shape, dtype=np.float32)
        self.luck = generator.random((steps + 1, 3), dtype=np.float32)
        self.tool = generator.standard_normal((steps + 1, 4), dtype=np.float32)


@spec
class HydraulicPlants(DrawnPlants):
    """Hydraulic arms of three makes (chambers, compensated, throttled), each machine unique.

    Attributes:
        roughness: By name, how much hysteresis, waviness, wandering, droop and warm-up a machine
            has; calibrated numbers.
        outside_not_on: Joints on which nothing of an outside fault would be seen.
    """

    roughness: dict[str, float]
    outside_not_on: dict[str, tuple[str, ...]]

    table = FAULTS
    causes = out_of_library_faults.KINDS

    def draw(
        self, machine: Machine, run: PlantRun, roughness: float
    ) -> tuple[str, PlantParameters]:
        """Return make and parameters of a run's machine, with its faults."""
        make, numbers = plant_parameters.draw_plant(machine, run.seed, roughness)
        return make, apply_faults(numbers, run.faults)

    link = staticmethod(ExamPlant)
