"""Arms of position servos, simulated by MuJoCo C: `N` runs side by side, and their plant family.

The library's servo is a linear loop of second order behind play and sag. Here a firmware loop on a
quantised reading drives motors with back EMF against friction, and weight comes from the arm's masses.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from brokk_rl.commands import find_rest
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Dimension, Machine
from brokk_rl.spec import spec
from diagnosis.mjcf.plant import MjcfPlant
from exam.plants import servo_faults
from exam.plants.changes import PlantParameters
from exam.plants.electronics import CommandBus
from exam.plants.family import DrawnPlants, PlantBatch, PlantLink, share
from exam.plants.servo_drive import FRICTIONS, STEP_S, PositionLoop, TargetFilter
from exam.plants.servo_faults import CAUSES, ServoCauses

ARM = Path(__file__).parent / "so101_arm.xml"
WANDER_S = 8.0
"""Correlation time of the slow change of friction, s; chosen by hand."""
COGS = 40.0
"""Cycles of the torque ripple over a turn of the joint; chosen by hand."""


def restrict_to_torques(machine: Machine) -> Machine:
    """Return the machine with joints that take 1 Nm a command, once a time step."""
    unit = Dimension(value=1.0, source="unit of the torque", confidence="high")
    joints = [replace(joint, command="torque", max_force=unit) for joint in machine.joints]
    return replace(machine, period_s=STEP_S, dead_time_s=0.0, joints=tuple(joints))


class ServoArm(PlantLink):
    """A `Link` to simulated arms of one make.

    Args:
        batch: The runs and their arms.
    """

    def __init__(self, batch: PlantBatch) -> None:
        machine = batch.machine
        chance = [draw_chance(run.chance, machine, batch.steps) for run in batch.runs]
        super().__init__(batch, chance)
        n = self._n
        self._plant = MjcfPlant(ARM, restrict_to_torques(machine))
        self._causes = ServoCauses(machine, batch.place_causes(CAUSES))
        q = np.tile(machine.home, (len(batch.runs), 1))
        self._state = self._plant.start(q, np.zeros_like(q))
        self._bus = CommandBus(n)
        # the servos held their pose before; a second is more than any delay
        rest = find_rest(q, machine)
        luck = np.ones((len(q), 1))
        self._bus.send(rest, -1.0 - float(n["jitter_s"].max()), luck, 0.0 * luck, 0.0 * rest)
        self._bus.at(0.0)
        self._targets = TargetFilter(n, machine, q.copy())
        self._loop = PositionLoop(n)
        self._friction = FRICTIONS[batch.make](n)
        self._changes = dict(self._friction.changes)
        if n["added_armature"].any():
            self._changes["armature"] = n["added_armature"]
        self._sigma = np.hypot(n["noise_rad"], n["extra_noise_rad"])
        self._middle = (machine.upper + machine.lower) / 2
        self._duty, self._through = np.zeros_like(q), np.zeros_like(q)

    @property
    def q(self) -> np.ndarray:
        """True positions of the joints, `(N, J)`."""
        return self._plant.read(self._state)[0]

    def _move(self, u: np.ndarray, t_s: float) -> None:
        luck = self._chance["luck"][self._k]
        later_s = self._causes.delay_s(self._elapsed_s + t_s)
        self._bus.send(self._causes.command(u), t_s, luck[:, :1], luck[:, 1:], later_s)
        for i in range(round(self._machine.period_s / STEP_S)):
            self._step(t_s + i * STEP_S)

    def _step(self, t_s: float) -> None:
        n, causes, loop = self._n, self._causes, self._loop
        q, speed = self._plant.read(self._state)
        reading = self._measure()
        target = causes.target(self._targets.step(self._bus.at(t_s)), reading)
        cap = np.minimum(n["duty_cap"], causes.cap(self._duty))
        self._duty = loop.step(target, reading, speed, cap)
        motor = causes.weaken(loop.torque(self._duty, speed))
        # the weight goes through the gear: the motor's torque of the step before stands for it
        loaded = n["load_friction"] * np.abs(self._through)
        self._through = motor
        wander = n["coulomb_n_m"] * n["wander"] * self._chance["wander"][self._k]
        extra_n_m = np.maximum(loaded + wander, 0.0) + causes.friction_n_m(q)
        lost = self._friction.torque(speed, extra_n_m)
        lost = lost + (n["viscous"] + n["added_viscous"]) * speed
        cogging = n["cogging_n_m"] * np.sin(COGS * q + n["cogging_phase"])
        pull = n["pull_n_m"] * np.cos(q - self._middle)
        torque = motor - lost + cogging + pull
        self._state = self._plant.run(self._state, torque[:, None], self._changes)[:, 0]

    def _measure(self) -> np.ndarray:
        step = self._n["step_rad"]
        return np.round((self.q + self._sigma * self._chance["noise"][self._k]) / step) * step


def draw_chance(seed: int, machine: Machine, steps: int) -> dict[str, np.ndarray]:
    """Return the random numbers of one run: normal `noise` and `wander`, `(T, J)`, and uniform `luck`, `(T, 2)`."""
    generator = np.random.default_rng([seed, 5])
    shape = (steps + 1, machine.num_joints)
    noise = generator.standard_normal(shape)
    keep = float(np.exp(-machine.period_s / WANDER_S))
    white = generator.standard_normal(shape) * np.sqrt(1.0 - keep * keep)
    white[0] /= np.sqrt(1.0 - keep * keep)
    wander = np.asarray(lfilter([1.0], [1.0, -keep], white, axis=0))
    return {"noise": noise, "wander": wander, "luck": generator.random((steps + 1, 2))}


@spec
class ServoPlants(DrawnPlants):
    """Tabletop arms of position servos in two makes of friction, each arm unique."""

    makes = tuple(FRICTIONS)
    stream = "servos"
    table = servo_faults.FAULTS
    causes = CAUSES

    def complete(
        self, drawn: PlantParameters, machine: Machine, make: str, chance: np.random.Generator
    ) -> PlantParameters:
        """Return supply, bus and firmware, and what only a fault changes.

        Raises:
            ConfigError: the machine is not commanded by position.
        """
        if machine.interface != "position":
            raise ConfigError(
                f"exam_plants=servos: machine '{machine.name}' is commanded by {machine.interface}; expected a machine of "
                "position servos, e.g. machine=so101"
            )
        phase = chance.uniform(0.0, 2.0 * np.pi, machine.num_joints)
        arm = servo_faults.NEUTRAL | {
            "supply_drop": drawn["supply_drop"][0],
            "transport_s": chance.uniform(*self.shared["transport_s"]),
            # time steps between two of the firmware's loop
            "ticks": float(chance.integers(1, 4)),
        }
        # as `diagnosis.mjcf.plant` counts: an error of 5 % of the travel, and full speed
        full_n_m = 0.05 * drawn["stiffness"] * (machine.upper - machine.lower)
        by_joint = {"cogging_phase": phase, "full_n_m": full_n_m, "full_rad_s": machine.max_speed}
        return share(arm, machine) | by_joint

    def link(self, batch: PlantBatch) -> ServoArm:
        """Return the link to arms of one make."""
        return ServoArm(batch)
