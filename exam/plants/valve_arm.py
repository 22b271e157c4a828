"""Arms with valves: `N` runs side by side behind a `Link`, whatever their hydraulics.

Bus, oil that warms up, compensators that come to rest anew, stops, play and encoders are the same in all
makes. Hydraulics of one's own turn commands into speeds.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from brokk_rl.machine import Machine
from brokk_rl.spec import spec
from exam.plants.changes import PlantParameters
from exam.plants.electronics import CommandBus, SteppedEncoders, draw_chance
from exam.plants.family import DrawnPlants, PlantBatch, PlantLink, share
from exam.plants.hydraulics import STEP_S, SensingValves
from exam.plants.linkage import Arm
from exam.plants.valve_faults import CAUSES, CHANGES, NEUTRAL, OutsideCauses

VISCOSITY_RATIO = 6.0
"""Viscosity of cold over that of warm oil: ISO VG 46 at 10 and 50 degrees Celsius, ISO 3448."""


LATEST_STAMP_S = 0.6
"""Time by which a stamp is late at most; chosen by hand, far above any fault of a clock."""


BuildHydraulics = Callable[[PlantParameters, Machine, OutsideCauses], Any]
"""Builds hydraulics, with the methods of `SensingValves`, from numbers `(N, J)`, machine and causes."""


class ValveArm(PlantLink):
    """A `Link` to simulated machines with valves.

    Args:
        batch: The runs and their machines.
        step_s: Time step of the hydraulics.
        hydraulics: Builds them.
    """

    def __init__(self, batch: PlantBatch, step_s: float, hydraulics: BuildHydraulics) -> None:
        pairs = zip(batch.runs, batch.numbers, strict=True)
        chance = [draw_chance(run.chance, one, batch.steps) for run, one in pairs]
        super().__init__(batch, chance)
        n, machine = self._n, batch.machine
        severity = batch.place_causes(CAUSES)
        self._causes = OutsideCauses(machine, severity, self._chance, step_s)
        # mean delay of the effect, whose delays are uniform
        bus = n | {"jitter_s": 0.5 * n["jitter_s"]}
        self._bus = CommandBus(bus)
        self._hydraulics = hydraulics(n, machine, self._causes)
        self._arm, self._encoders = Arm(machine, n), SteppedEncoders(n)
        self._q = np.tile(machine.home, (len(chance), 1))
        self._link, self._trace = self._q.copy(), [self._q.copy()]
        self._is_open = np.zeros(self._q.shape, dtype=bool)
        self._motions = np.zeros(self._q.shape, dtype=int)
        self._half_play = 0.5 * (n["play_rad"] + n["gap_rad"])
        self._step_s, self._num_kept = step_s, 1 + round(LATEST_STAMP_S / step_s)

    @property
    def q(self) -> np.ndarray:
        """True positions of the links, `(N, J)`."""
        return self._link

    def _measure(self) -> np.ndarray:
        shown = self._encoders.read(self._stamped(), self._chance["noise"][self._k])
        return self._causes.show(self._k, shown)

    def _move(self, u: np.ndarray, t_s: float) -> None:
        causes, hydraulics = self._causes, self._hydraulics
        k, step_s, run_s = self._k, self._step_s, self._elapsed_s + t_s
        u = causes.drive(u, run_s)
        # below its loss a frame is lost: 0 or 1 says which
        luck = np.where(self._chance["lost"][k], -1.0, 1.0)
        self._bus.send(u, t_s, luck[:, None], self._chance["queue"][k][:, None], 0.0 * u)
        oil = self._n["flow"] * self._oil(run_s)
        hydraulics.take_pose(self._q, self._link)
        for i in range(round(self._machine.period_s / step_s)):
            is_open = hydraulics.open(self._bus.at(t_s + i * step_s))
            self._motions += is_open & ~self._is_open
            self._is_open = is_open
            speed = causes.move_others(hydraulics.move(oil * self._settle()))
            moved = self._q + step_s * speed
            self._q = np.clip(moved, causes.lower, causes.upper)
            hydraulics.stop(self._q != moved, self._q)
            self._link = np.clip(self._link, self._q - self._half_play, self._q + self._half_play)
            self._trace.append(self._link)
        del self._trace[: -self._num_kept]

    def _settle(self) -> np.ndarray:
        """Return the factor on the flows by the compensators: each motion has its own rest."""
        settling = self._chance["settling"]
        rest = np.take_along_axis(settling, self._motions[None] % len(settling), 0)[0]
        return 1.0 + self._n["settling"] * rest

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
        steps = np.minimum(late / self._step_s, len(self._trace) - 1.0)
        trace = np.stack(self._trace)
        place = len(trace) - 1 - np.round(steps).astype(int)
        return np.take_along_axis(trace, place[None], 0)[0]


def _compute_warming(times: np.ndarray) -> np.ndarray:
    """Return how much of the change of viscosity is over after so many time constants, 0 to 1."""
    left = np.exp(-times)
    return (VISCOSITY_RATIO - VISCOSITY_RATIO**left) / (VISCOSITY_RATIO - 1.0)


@spec
class ValvePlants(DrawnPlants):
    """Arms with a load-sensing pump, each machine unique."""

    makes = ("sensing",)
    # that of the first exams, whose machines can be made again
    stream = "held out"
    table = CHANGES
    causes = CAUSES

    def complete(
        self, drawn: PlantParameters, machine: Machine, make: str, chance: np.random.Generator
    ) -> PlantParameters:
        """Return bus, pump, and what only an effect changes."""
        one_tank = {"warm_change": drawn["warm_change"][0]}
        found, count = share(NEUTRAL | one_tank, machine), machine.num_joints
        transport_s = chance.uniform(*self.shared["transport_s"])
        pilot_s = chance.uniform(-0.015, 0.015, count)  # pilot lines differ in length
        found["transport_s"] = transport_s + pilot_s
        found["demand"] = chance.uniform(*self.shared["demand"], count)
        pump = {name: chance.uniform(*self.shared[name]) for name in ("power", "pump_s")}
        return found | share(pump, machine)

    def link(self, batch: PlantBatch) -> ValveArm:
        """Return the link to runs."""
        return ValveArm(batch, STEP_S, SensingValves)
