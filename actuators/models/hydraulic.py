"""Hydraulic plant: valves, one pump, cylinders, friction, weight and oil temperature.

Equations, per joint, with time step `substep_s` (symplectic Euler; friction implicit, so that it
can never drive a joint):

    u        command of `transport_s` ago, exact to the fraction of a sample
    pilot    play operator of width `hysteresis` on u
    spool    second order, `spool_hz`, `spool_damping`; slower in cold oil
    opening  spool beyond the overlap of its side, progressive notch s (1 - c + c |s|)
    flow     opening * min(1, pump / sum of flows over joints) * sqrt(1 - sign(opening) force /
    supply) speed    flow * max_speed * (1 extending | `retract_ratio` retracting) * (1 +
    `thermal_gain` (oil - reference)) force'   stiffness * (flow speed - joint speed) - leak
    joint'   inertia * joint speed' = force + weight(q) - Coulomb, Stribeck and viscous friction

Reduced, and why: the two chamber pressures are one load force, and the oil's stiffness does not
depend on the piston's position (at 20 Hz only the first mode of the joint is visible, and the
machine's YAML knows one stiffness); inertia is constant, `stiffness / (2 pi mode_hz)^2` (coupling
through the arm's inertia is small against the 5 to 10 Hz of the oil column); pressure compensation
is imperfect in one number, `load_sensitivity`; supply pressure is constant and the pump is limited
by flow. Contact reaches the plant through the measured position only: a blocked joint keeps
pushing, and the simulator's drive yields.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

import torch
from annotated_types import Interval

from actuators.models.joint_model import ParametricModel
from actuators.models.parameters import (
    NonNegativePerJoint,
    NumberBounds,
    PerJoint,
    PositivePerJoint,
    SharePerJoint,
    open_valve,
    select_commands_in_force,
)
from brokk_rl.errors import ConfigError
from brokk_rl.history import History
from brokk_rl.kinematics import Gravity
from brokk_rl.machine import Machine
from brokk_rl.spec import Positive, spec

OverlapPerJoint = Annotated[PerJoint, NumberBounds("0 to 0.9", 0.0, 0.9)]


@spec
class OilNumbers:
    """Numbers of every hydraulic plant: valve spools, flow, inertia and friction.

    Attributes:
        transport_s: Pure delay of radio, bus and pilot stage. Spool and oil add to it until the
            joint moves.
        hysteresis: Width of the play between command and spool, of full command.
        spool_hz: Natural frequency of the spool in oil at the reference temperature.
        spool_damping: Damping ratio of the spool.
        overlap_extend: Spool stroke up to which no oil flows in the positive direction, of full
            stroke.
        overlap_retract: The same for the negative direction.
        notch: Progressiveness `c` of the flow curve: 0 linear, 1 quadratic.
        speed_scale: Speed at full command without load, extending, over the machine's `max_speed`.
        flow_share: Flow at full opening over the flow of the pump.
        supply_ratio: Force at supply pressure over the machine's `yield_force`.
        mode_hz: First mode of the joint on its closed cylinder in mid-travel; with the machine's
            `stiffness` this gives the inertia.
        coulomb: Friction force in motion over the supply force.
        breakaway: Friction force at the onset of motion over the supply force, at least `coulomb`.
        stribeck_speed: Speed, of full speed, at which break-away friction has fallen to a third of
            its excess.
        viscous: Friction force proportional to speed, at full speed, over the supply force.
        substep_s: Own time step; the control period is divided into the nearest whole number of
            them.
    """

    transport_s: NonNegativePerJoint
    hysteresis: SharePerJoint
    spool_hz: PositivePerJoint
    spool_damping: PositivePerJoint
    overlap_extend: OverlapPerJoint
    overlap_retract: OverlapPerJoint
    notch: SharePerJoint
    speed_scale: PositivePerJoint
    flow_share: PositivePerJoint
    supply_ratio: PositivePerJoint
    mode_hz: PositivePerJoint
    coulomb: NonNegativePerJoint
    breakaway: NonNegativePerJoint
    stribeck_speed: PositivePerJoint
    viscous: NonNegativePerJoint
    substep_s: Annotated[float, Interval(gt=0, le=0.01)]


@spec
class Hydraulic(OilNumbers):
    """Valve spools, shared pump, oil compliance, friction, load, leak and oil temperature.

    Attributes:
        retract_ratio: Retracting speed over extending speed at equal flow: bore area over rod-side
            area, 1 for a motor.
        load_sensitivity: 0 ideal pressure compensator (speed free of load), 1 none.
        leak_hz: Rate at which a held force bleeds off through the closed valve.
        oil_start_c: Oil temperature after a reset.
        oil_ambient_c: Temperature to which resting oil cools.
        oil_rise_c: Rise above that at full pump flow, after a long time.
        oil_time_s: Time constant of warming and cooling.
        oil_reference_c: Temperature at which speeds and spool frequencies hold.
        thermal_gain: Relative change of speed and spool frequency per kelvin.
    """

    retract_ratio: PositivePerJoint
    load_sensitivity: SharePerJoint
    leak_hz: NonNegativePerJoint
    oil_start_c: float
    oil_ambient_c: float
    oil_rise_c: float
    oil_time_s: Positive
    oil_reference_c: float
    thermal_gain: float

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> HydraulicModel:
        """Return a model for `num_envs` environments on `device`.

        Raises:
            ConfigError: a number makes no sense, or the delay does not fit the machine's history.
        """
        return HydraulicModel(self, machine, num_envs, device)


class OilModel(ParametricModel):
    """Base of hydraulic plants: numbers, weight, stiffness, substeps.

    Args:
        config: The spec.
        machine: A machine with known masses.
        num_envs: Number of environments, `N`.
        device: Where the tensors live.
    """

    DELAY = "transport_s"
    INTERFACE = ("speed", "hydraulics set speeds")

    def __init__(
        self, config: OilNumbers, machine: Machine, num_envs: int, device: torch.device
    ) -> None:
        super().__init__(config, machine, num_envs, device)
        if (self.parameters["breakaway"] < self.parameters["coulomb"]).any():
            raise ConfigError(
                "actuator.breakaway: expected at least actuator.coulomb (friction at rest is no smaller than in motion)"
            )
        self._config: Any = config  # of its own class
        self._num_substeps = max(1, round(machine.period_s / config.substep_s))
        self._dt_s = machine.period_s / self._num_substeps
        self._gravity = Gravity(machine, device)
        stiffness = [body.stiffness.value for body in machine.bodies]
        yield_force = [body.yield_force.value for body in machine.bodies]
        self._stiffness = torch.tensor(stiffness, dtype=torch.float32, device=device)
        self._yield_force = torch.tensor(yield_force, dtype=torch.float32, device=device)

    def _read_commands(self, u: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the two commands of the coming period, and the part of it in which the first acts."""
        return select_commands_in_force(u, self.delay_s / self.plant.period_s)

    def _read_trailing(self, u: torch.Tensor) -> torch.Tensor:
        """Return where spools are that follow commands `u`: they trail by 2 damping / omega."""
        p = self.parameters
        trail_s = p["spool_damping"] / (math.pi * p["spool_hz"])
        trailing, _, _ = select_commands_in_force(u, (self.delay_s + trail_s) / self.plant.period_s)
        return trailing


class HydraulicModel(OilModel):
    """The plant at work in `N` environments; see the module for its equations.

    Spool is of full stroke, speed in rad/s, force in Nm, each `(N, J)`; `oil_c` `(N,)`.
    """

    STATES = ("pilot", "spool", "spool_rate", "speed", "force")

    def __init__(
        self, config: Hydraulic, machine: Machine, num_envs: int, device: torch.device
    ) -> None:
        super().__init__(config, machine, num_envs, device)
        self._state["oil_c"] = torch.zeros(num_envs, device=device)
        self.reset(self._fresh.clone())

    def reset(self, mask: torch.Tensor) -> None:
        """Let the environments of `mask`, `(N,)` bool, start from their history."""
        self._state["oil_c"].masked_fill_(mask, self._config.oil_start_c)
        super().reset(mask)

    def step(self, history: History) -> torch.Tensor:
        """Return the joint positions one control period later, shape `(N, J)`."""
        state, p, config = self._state, self.parameters, self._config
        q, dt = history.q[:, -1], self._dt_s
        weight = self._gravity.load(q)
        warm = 1.0 + config.thermal_gain * (state["oil_c"] - config.oil_reference_c)[:, None]
        earlier, later, part = self._read_commands(history.u)
        supply = p["supply_ratio"] * self._yield_force
        inertia = self._stiffness / (2.0 * math.pi * p["mode_hz"]) ** 2
        pull = (
            dt * (2.0 * math.pi * p["spool_hz"] * warm) ** 2,
            dt * 2.0 * p["spool_damping"] * 2.0 * math.pi * p["spool_hz"] * warm,
        )
        extend_speed = p["speed_scale"] * self.plant.max_speed * warm
        retract_speed = extend_speed * p["retract_ratio"]
        play = 0.5 * p["hysteresis"]
        excess = p["breakaway"] - p["coulomb"]
        knee = p["stribeck_speed"] * self.plant.max_speed
        viscous = p["viscous"] / self.plant.max_speed
        # Below 1 % of full speed friction grows with speed: no stick-slip chatter at this time step.
        still = 0.01 * self.plant.max_speed
        rub = dt * supply / inertia

        def rubbing(speed: torch.Tensor) -> torch.Tensor:
            """Friction force over supply force and speed."""
            fast = speed.abs()
            return (p["coulomb"] + excess * torch.exp(-fast / knee)) / (fast + still) + viscous

        # a free run may begin in the middle of a motion, which the history shows
        measured = (q - history.q[:, -2]) / self.plant.period_s
        begun = {
            "pilot": earlier,
            "spool": self._read_trailing(history.u),
            "spool_rate": torch.zeros_like(q),
            "speed": measured,
            "force": supply * rubbing(measured) * measured - weight,
        }
        pilot, spool, spool_rate, speed, force = self.recall(begun).values()
        demand = torch.zeros_like(q)
        for i in range(self._num_substeps):
            # Smooth in the delay.
            u = torch.lerp(later, earlier, (part * self._num_substeps - i).clamp(0.0, 1.0))
            pilot = pilot.clamp(u - play, u + play)
            spool_rate = spool_rate + pull[0] * (pilot - spool) - pull[1] * spool_rate
            spool = (spool + dt * spool_rate).clamp(-1.0, 1.0)
            opening = open_valve(spool, p["overlap_extend"], p["overlap_retract"])
            opening = opening * (1.0 - p["notch"] + p["notch"] * opening.abs())
            demand = opening.abs() * p["flow_share"]
            opening = opening / demand.sum(1, keepdim=True).clamp(min=1.0)
            head = 1.0 - p["load_sensitivity"] * opening.sign() * force / supply
            head = head.clamp(0.0, 2.0).sqrt()
            flow_speed = opening * head * torch.where(opening > 0, extend_speed, retract_speed)
            force = force + dt * (self._stiffness * (flow_speed - speed) - p["leak_hz"] * force)
            force = force.clamp(-supply, supply)  # relief valves
            speed = (speed + dt * (force + weight) / inertia) / (1.0 + rub * rubbing(speed))
            moved = q + dt * speed
            q = self.plant.hold(moved)
            speed = speed.masked_fill(q != moved, 0.0)

        values = (pilot, spool, spool_rate, speed, force)
        self.keep(dict(zip(self.STATES, values, strict=True)))
        work = demand.sum(1).clamp(max=1.0)
        settled_c = config.oil_ambient_c + config.oil_rise_c * work
        state["oil_c"].add_(
            (settled_c - state["oil_c"])
            * (1.0 - math.exp(-self.plant.period_s / config.oil_time_s))
        )
        return q
