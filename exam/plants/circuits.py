"""Arms on the three hydraulic circuits of the project: a load-sensing pump, flow sharing, or an open centre.

The circuits are those of `actuators.models.circuit`, which no model of the diagnosis contains. Each
machine has numbers of its own, and an effect or a cause changes these numbers while it runs.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from actuators.models.circuit import CircuitModel, HydraulicCircuit
from actuators.models.parameters import expand_per_joint
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.spec import NonNegative, spec
from exam.plants.changes import PlantParameters
from exam.plants.family import DrawnPlants, PlantBatch, share
from exam.plants.hydraulics import SPOOL_STEP
from exam.plants.linkage import Arm
from exam.plants.valve_arm import ValveArm
from exam.plants.valve_faults import CAUSES, CHANGES, NEUTRAL, OutsideCauses

STEP_S = 0.005
"""Time step, s: the longest that the circuits allow, so that each of theirs is one."""
AJAR_LOAD = 0.4
"""Weight over the yield force under which a valve that stays ajar leaks as `OutsideCauses` says."""
SOFT_FRICTION = 0.4
"""Dry friction of a soft joint over its usual one: full friction would end the ringing after one swing."""
NARROWED = 0.4
"""Turn of either end of a triangle over that of a mounting that moved; the lever arm varies less then."""
STRANGE = ("stiction", "load_dependence")
"""Effects that no number of a circuit makes as the library means them."""
OF_CIRCUITS = {name: change for name, change in CHANGES.items() if name not in STRANGE}
"""Change of the numbers by effect."""


class SteppedCircuit(CircuitModel):
    """A circuit in steps so short that a command and the weight of the arm hold for many of them.

    To compute both anew, and the state of a free run, would take half of the time of a step.
    """

    def take_weight(self, weight: torch.Tensor) -> None:
        """Take the weight on each joint, `(N, J)`, Nm or N, for the coming steps."""
        self._gravity: Any = SimpleNamespace(load=lambda q: weight)

    def _read_commands(self, u: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        return u[:, -1], u[:, -1], torch.zeros(())

    def _begin(self, *now: Any) -> dict[str, torch.Tensor]:
        return super()._begin(*now) if self._fresh.any() else self._state


class CircuitValves:
    """A circuit as the hydraulics of an arm.

    Args:
        numbers: The machine's, `(N, J)`: those of the circuit, and those that only effects change.
        machine: Limits, masses, yield forces, stiffness.
        causes: What it has outside the library.
        circuit: Which circuit.
    """

    def __init__(
        self,
        numbers: PlantParameters,
        machine: Machine,
        causes: OutsideCauses,
        circuit: HydraulicCircuit,
    ) -> None:
        self._n, self._causes, shape = numbers, causes, numbers["stop"].shape
        self._arm = Arm(machine, numbers)
        self._yield_force = np.array([body.yield_force.value for body in machine.bodies])
        torque = numbers["supply_ratio"] * self._yield_force
        stiffness = np.array([body.stiffness.value for body in machine.bodies])
        soft_hz = 1.0 / np.hypot(1.0 / numbers["mode_hz"], numbers["soft_s"])
        damping = numbers["soft_damping"] * stiffness * machine.max_speed
        ringing = damping / (np.pi * soft_hz * torque)
        is_soft, viscous = numbers["soft_s"] > 0, numbers["viscous"]
        # a spool trails by twice its damping over its frequency
        trail_s = numbers["spool_damping"] / (np.pi * numbers["spool_hz"]) + numbers["pilot_s"]
        is_linked = numbers["linkage_lower_rad"] < numbers["linkage_upper_rad"]
        narrowed_rad = NARROWED * causes.mounting_rad * is_linked
        changed = numbers | {
            "linkage_lower_rad": numbers["linkage_lower_rad"] + narrowed_rad,
            "linkage_upper_rad": numbers["linkage_upper_rad"] - narrowed_rad,
            "mode_hz": soft_hz,
            "viscous": np.where(is_soft, np.minimum(ringing, viscous), viscous),
            "coulomb": numbers["coulomb"] * np.where(is_soft, SOFT_FRICTION, 1.0),
            "spool_hz": numbers["spool_damping"] / (np.pi * trail_s),
            "flow_share": numbers["demand"],
            "transport_s": np.zeros(shape),  # the bus has it
        }
        self._sinking = numbers["supply_ratio"] / machine.max_speed * numbers["sink_rad_s"]
        self._ajar = numbers["supply_ratio"] / AJAR_LOAD
        stepped = replace(machine, period_s=STEP_S, dead_time_s=0.0, num_history=2)
        at_once = replace(circuit, transport_s=0.0, outrigger_nm_rad=0.0)
        self._model = SteppedCircuit(at_once, stepped, shape[0], torch.device("cpu"))
        for name in self._model.parameters:
            self._set(name, changed[name])
        history = torch.zeros(shape[0], 2, shape[1])
        self._history = History(history, history.clone())
        home = torch.as_tensor(np.tile(machine.home, (shape[0], 1)), dtype=torch.float32)
        self._history.reset(torch.ones(shape[0], dtype=torch.bool), home)
        self._ramp, self._moved = np.zeros(shape), np.zeros(shape, dtype=bool)
        stroke_s = numbers["stroke_s"]
        self._reach = np.where(stroke_s > 0, STEP_S / np.maximum(stroke_s, STEP_S), np.inf)

    def _set(self, name: str, value: np.ndarray) -> None:
        self._model.parameters[name].copy_(torch.as_tensor(value))

    def take_pose(self, q: np.ndarray, link: np.ndarray) -> None:
        """Take the weight of the links, `(N, J)`; the circuit follows its own motion."""
        weight = self._arm.load(link) * self._yield_force
        self._model.take_weight(torch.as_tensor(weight, dtype=torch.float32))

    def open(self, u: np.ndarray) -> np.ndarray:
        """Return which valves are open, `(N, J)`; commands `u` act in the next step."""
        n = self._n
        self._ramp = self._ramp + np.clip(u - self._ramp, -self._reach, self._reach)
        driven = np.clip(self._ramp, -n["stop"], n["stop"])
        self._history.push_u(torch.as_tensor(driven, dtype=torch.float32))
        self._spool = self._model.state["spool"].numpy().astype(float)
        overlap = np.where(self._spool > 0, n["overlap_extend"], n["overlap_retract"])
        self._is_open = np.abs(self._spool) > overlap
        return self._is_open

    @torch.inference_mode()
    def move(self, flow: np.ndarray) -> np.ndarray:
        """Return the speeds after a step, rad/s or m/s, `(N, J)`.

        Args:
            flow: Factor on the flows at the same opening, `(N, J)`.
        """
        n, causes = self._n, self._causes
        edge = np.where(self._spool > 0, n["extend"], n["retract"])
        self._set("speed_scale", n["speed_scale"] * edge * flow)
        self._set("hysteresis", n["hysteresis"] + 2.0 * causes.stick(self._moved))
        self._set("leak", n["leak"] + self._sinking + self._ajar * causes.leak(self._is_open))
        before = self._history.q[:, -1].clone()
        q = self._model.step(self._history)
        self._moved = np.abs(self._model.state["spool"].numpy() - self._spool) > SPOOL_STEP
        self._history.push_q(q)
        return (q - before).numpy().astype(float) / STEP_S

    def stop(self, where: np.ndarray, q: np.ndarray) -> None:
        """Hold joints at their stops `q`; both `(N, J)`, `where` bool."""
        if where.any():
            held, last = torch.as_tensor(q, dtype=torch.float32), self._history.q[:, -1]
            last.copy_(torch.where(torch.as_tensor(where), held, last))


@spec
class CircuitPlants(DrawnPlants):
    """Arms on circuits of `conf/actuator`, each machine unique.

    Attributes:
        circuits: Circuit of each make.
        spread: By number of a circuit, largest relative distance of a machine's from it, by joint.
    """

    circuits: dict[str, HydraulicCircuit]
    spread: dict[str, NonNegative]

    makes = ("load_sensing", "open_center", "post_compensated")
    stream = "circuits"
    table = OF_CIRCUITS
    causes = tuple(cause for cause in CAUSES if cause != "back_flow")  # circuits have load checks

    def complete(
        self, drawn: PlantParameters, machine: Machine, make: str, chance: np.random.Generator
    ) -> PlantParameters:
        """Return the numbers of the circuit, and what only an effect changes."""
        one_tank = {"warm_change": drawn["warm_change"][0], "extend": 1.0, "retract": 1.0}
        found, circuit = share(NEUTRAL | one_tank, machine), self.circuits[make]
        for name, spread in self.spread.items():
            typical = expand_per_joint(getattr(circuit, name), machine, name)
            away = spread * chance.uniform(-1.0, 1.0, machine.num_joints)
            found[name] = typical * (1.0 + away)
        found["rod_area"] = np.minimum(found["rod_area"], 1.0)
        found["breakaway"] = np.maximum(found["breakaway"], found["coulomb"])
        is_slide = np.array([joint.kind == "slide" for joint in machine.joints])
        for name in ("linkage_lower_rad", "linkage_upper_rad"):
            found[name] = np.where(is_slide, 0.5 * np.pi, found[name])
        return found | {"demand": found["flow_share"]}

    def link(self, batch: PlantBatch) -> ValveArm:
        """Return the link to runs on one circuit."""
        return ValveArm(batch, STEP_S, partial(CircuitValves, circuit=self.circuits[batch.make]))
