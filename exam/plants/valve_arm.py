"""Arms with valves: `N` runs side by side behind a `Link`, and their plant family.

A machine has cylinders with two chambers, pressure-compensated meter-in, regulated meter-out, and one pump
that senses the highest load and has a limit of flow and one of power.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from brokk_rl.machine import Machine
from brokk_rl.signals import Command
from brokk_rl.spec import spec
from exam.plants.changes import PlantParameters
from exam.plants.electronics import CommandBus, RunChance, SteppedEncoders
from exam.plants.family import DrawnPlants, PlantLink, PlantRun
from exam.plants.hydraulics import OPEN, STEP_S, Linkage, PilotedSpools, SensingHydraulics
from exam.plants.linkage import Arm
from exam.plants.valve_causes import CAUSES, OutsideCauses
from exam.plants.valve_parameters import CHANGES, change_machine, draw_machine

MAKE = "sensing"
SPOOL_STEP = 1e-5
"""Movement of a spool in a step, of full stroke, that counts as one."""
VISCOSITY_RATIO = 6.0
"""Viscosity of cold over that of warm oil: ISO VG 46 at 10 and 50 degrees Celsius, ISO 3448."""


class SensingArm(PlantLink):
    """A `Link` to simulated machines with valves.

    Args:
        machine: Geometry, masses, limits.
        make: The only one.
        parameters: Of each run's machine; `outside_severity` is that of its outside cause.
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
            chance.append(RunChance(run.chance, one, steps))
        super().__init__(machine, parameters, runs, chance)
        n = self._n
        self._lost, self._queue = self._stack_chance("lost"), self._stack_chance("queue")
        self._noise, self._settling = self._stack_chance("noise"), self._stack_chance("settling")
        phase = np.array([one.phase for one in chance])
        self._causes = OutsideCauses(
            machine, self._kinds, n["outside_severity"], phase, self._stack_chance("luck")
        )
        bus = {
            "transport_s": n["transport_s"],
            "jitter_s": 0.5 * n["jitter_s"],  # mean delay of the effect, whose delays are uniform
            "loss": n["loss"],
        }
        self._bus = CommandBus(bus, machine.period_s)
        self._spools = PilotedSpools(n)
        self._hydraulics = SensingHydraulics(
            n, machine, self._causes.back_flow, self._causes.pump_lag
        )
        self._linkage = Linkage(n, machine, self._causes.mounting_rad)
        self._weight, self._encoders = Arm(machine, n), SteppedEncoders(n)
        self._q = np.tile(machine.home, (len(runs), 1))
        self._link, self._trace = self._q.copy(), [self._q.copy()]
        self._is_open = np.zeros(self._q.shape, dtype=bool)
        self._motions = np.zeros(self._q.shape, dtype=int)
        self._half_play = 0.5 * (n["play_rad"] + n["gap_rad"])
        self._num_kept = (
            1 + round(machine.period_s / STEP_S) * 12
        )  # stamps are never later than that
        self._hydraulics.hold(self._weight.load(self._link))

    @property
    def q(self) -> np.ndarray:
        """True positions of the links, `(N, J)`."""
        return self._link

    def _measure(self) -> np.ndarray:
        shown = self._encoders.read(self._stamped(), self._noise[self._k])
        return self._causes.show(self._k, shown)

    def _find_arm(self) -> Arm:
        return self._weight

    def send(self, command: Command) -> Command:
        """Move on by one control period with these commands, `(N, J)`."""
        machine, causes, hydraulics = self._machine, self._causes, self._hydraulics
        t_s, k = self._k * machine.period_s, self._k
        run_s = self._elapsed_s + t_s
        u = causes.drive(np.asarray(command.u, dtype=float), run_s)
        # below its loss a frame is lost: 0 or 1 says which
        self._bus.send(
            u, t_s, np.where(self._lost[k], -1.0, 1.0)[:, None], self._queue[k][:, None], 0.0 * u
        )
        oil, load = self._oil(run_s), self._weight.load(self._link)
        lever = self._linkage.compute_lever(self._q)
        stroke = self._linkage.compute_stroke(self._q)
        sticking = causes.stick(np.zeros_like(self._is_open))
        for i in range(round(machine.period_s / STEP_S)):
            before = self._spools.spool
            area = self._spools.step(self._bus.at(t_s + i * STEP_S), sticking, hydraulics.drop)
            sticking = causes.stick(np.abs(self._spools.spool - before) > SPOOL_STEP)
            is_open = np.abs(area) > OPEN
            self._motions += is_open & ~self._is_open
            self._is_open = is_open
            leak = causes.leak(is_open)
            y = hydraulics.step(area, lever, stroke, load, self._springs() * oil**2, leak)
            speed = causes.move_others(y * machine.max_speed)
            moved = self._q + STEP_S * speed
            self._q = np.clip(moved, causes.lower, causes.upper)
            hydraulics.stop(self._q != moved)
            self._link = np.clip(self._link, self._q - self._half_play, self._q + self._half_play)
            self._trace.append(self._link)
        del self._trace[: -self._num_kept]
        self._k += 1
        return command

    def _springs(self) -> np.ndarray:
        """Return the factor on the compensators' drops: each motion has its own rest."""
        n, drawn = self._n, self._motions % len(self._settling)
        rest = np.take_along_axis(self._settling, drawn[None], 0)[0]
        return n["spring"] * (1.0 + n["settling"] * rest) ** 2

    def _oil(self, run_s: np.ndarray) -> np.ndarray:
        """Return the factor on all flows by the oil's viscosity, `(N, J)`.

        The temperature rises with one time constant, and the logarithm of the viscosity falls with
        it (Reynolds' law), so the flow rises early and then
        slowly.
        """
        n, run_s = self._n, run_s[:, None]
        own = 1.0 + n["warm_change"] * _compute_warming(run_s / 900.0)  # s: the nuisance's tank
        return own * (1.0 + n["drift"] * _compute_warming(run_s / n["drift_s"]))

    def _stamped(self) -> np.ndarray:
        """Return the positions of the moments that the readings are stamped for, `(N, J)`."""
        late = self._n["stamp_s"]
        if not late.any():
            return self._link
        steps = np.minimum(late / STEP_S, len(self._trace) - 1.0)
        trace = np.stack(self._trace)
        place = len(trace) - 1 - np.round(steps).astype(int)
        return np.take_along_axis(trace, place[None], 0)[0]


def _compute_warming(times: np.ndarray) -> np.ndarray:
    """Return how much of the change of viscosity is over after so many time constants, 0 to 1."""
    left = np.exp(-times)
    return (VISCOSITY_RATIO - VISCOSITY_RATIO**left) / (VISCOSITY_RATIO - 1.0)


@spec
class ValvePlants(DrawnPlants):
    """Arms with a load-sensing pump, each machine unique.

    Attributes:
        roughness: By name, size of the nuisances.
        outside_not_on: Joints on which nothing of an outside cause would be seen.
    """

    roughness: dict[str, float]
    outside_not_on: dict[str, tuple[str, ...]]

    table = CHANGES
    causes = CAUSES

    def makes(self, machine: Machine, runs: Sequence[PlantRun]) -> list[str]:
        """Return the make of each run: all are of one."""
        return [MAKE] * len(runs)

    def draw(
        self, machine: Machine, run: PlantRun, roughness: float
    ) -> tuple[str, PlantParameters]:
        """Return make and parameters of a run's machine, with its effects."""
        numbers = draw_machine(machine, run.seed, roughness)
        return MAKE, change_machine(numbers, run.faults)

    link = staticmethod(SensingArm)
