"""Hydraulic circuits: chambers, linkages, counterbalance valves, pump limits and outriggers.

`actuator=load_sensing`, `post_compensated` and `open_center` are parameter sets of these equations.
No number of them was fitted to, or chosen by, results of a policy.

Pressures are over the relief pressure, flows over that of the bore at full speed, torques over the
cylinder's at relief pressure and mid-travel. Per joint, with the step `substep_s`:

    u, pilot, spool   as in `actuators.models.hydraulic`
    area              spool beyond the overlap of its side, progressive notch a (1 - c + c a)
    lever             arm of a cylinder that is a side of a triangle, over that in mid-travel
    drop              pre   min(margin, supply - inlet)          keeps the speed free of the load
                      post  min(margin, supply - highest inlet)  all joints slow down alike
                      none  supply - inlet
    inlet flow        area sqrt(drop / margin), no backward flow (load check)
    outlet flow       outlet edge and counterbalance valve in series, sqrt(outlet pressure)
    counterbalance    opens by ratio * inlet + outlet - setting, lagged
    bore', rod'       softness of each oil column (flow in - flow out - lever speed) - leak
    inertia speed'    lever (bore - rod area * rod) + weight + contact - friction
    supply'           towards highest inlet + `margin`, no faster than the spare flow fills the line
    spare flow        min(1, power / supply) - flows of all joints (- bypass of an open centre)

Pressures and speed of a step are solved together (linearly implicit Euler); dry friction bounds the
momentum, so that it never drives a joint.

Contact: the simulator's drive reports by the motion that did not happen. The oil is compressed by
that motion, and the drive's deflection times its stiffness is a load on the joint, which grows as a
blocked joint pushes on. So pressure rises until the pump or the relief valve gives in.

Outriggers: the machine tilts by the moment of the arm's weight over `outrigger_nm_rad`. The hole
was surveyed with the arm at home; the tool is displaced by the difference of the tilts.

Reduced, and why: inertia is constant (its coupling is slow against the oil's 5 to 10 Hz); oil is
warm; rocking of the base is quasi-static (seconds against a tilt of a fraction of a second); the
contact force does not tilt the machine (the actuator does not know it).
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

import torch
from annotated_types import Ge, Interval

from actuators.models.hydraulic import OilModel, OilNumbers
from actuators.models.parameters import (
    NonNegativePerJoint,
    NumberBounds,
    PerJoint,
    PositivePerJoint,
    open_valve,
)
from brokk_rl.history import History
from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine
from brokk_rl.spec import Positive, spec

RatioPerJoint = Annotated[PerJoint, NumberBounds("0.05 to 1", 0.05, 1.0)]
# at 0 and pi the cylinder has no lever arm
LinkagePerJoint = Annotated[PerJoint, NumberBounds("0.15 to 2.99", 0.15, math.pi - 0.15)]
LAMINAR = 1e-4
"""Drop, of relief pressure, below which an orifice is laminar: it gives the flow a finite slope."""
DEAD_VOLUME = 0.1
"""Oil of a chamber at the end of its stroke, of its volume; typical of hoses and ports."""
PRELOAD = 0.05
"""Pressure of the unloaded chamber at rest, of relief: what return line and valves keep."""

LOOSE = 0.1
"""Deflection of the drive, of that at its yield force, up to which a joint counts as free: its servo
trails by as much (1 mrad) when the arm speeds up at 1.5 rad/s². From twice that on it is in contact."""


@spec
class HydraulicCircuit(OilNumbers):
    """Valves, pump, cylinders on linkages, counterbalance valves and outriggers.

    Attributes:
        compensation: `pre` a pressure compensator before each valve; `post` behind it, so that a
            saturated pump slows all joints alike; `none` plain throttles behind a pump of constant
            flow, whose centre is open.
        rod_area: Area of the rod side over that of the bore, 1 for a motor.
        linkage_lower_rad: Angle of the triangle between the sides at the joint's lower limit.
        linkage_upper_rad: The same at the upper limit; equal for a lever arm that stays.
        linkage_sides: Shorter over longer side of the triangle.
        leak: Speed at which a joint sinks under relief pressure, of full speed.
        outlet: Pressure over the outlet edge at full speed.
        counterbalance_setting: Pressure at which a load alone opens the valve; 0: no such valve.
        counterbalance_ratio: Pilot ratio.
        counterbalance_range: Pressure over which it opens fully.
        counterbalance_s: Time constant of its poppet.
        margin: Supply above the highest load, and the drop that a compensator keeps; with
            `compensation: none` the drop at which a valve gives its nominal flow.
        standby: Pressure of the idle pump.
        pump_s: Time constant of the pump's pressure controller.
        line: Pump flow that the line stores per relief pressure, s.
        power: Power limit over full flow at relief pressure.
        bypass_stroke: Stroke at which an open centre is closed, of full stroke.
        outrigger_nm_rad: Stiffness of the stand on its outriggers; 0: rigid.
    """

    compensation: Literal["pre", "post", "none"]
    rod_area: RatioPerJoint
    linkage_lower_rad: LinkagePerJoint
    linkage_upper_rad: LinkagePerJoint
    linkage_sides: RatioPerJoint
    leak: NonNegativePerJoint
    outlet: PositivePerJoint
    counterbalance_setting: NonNegativePerJoint
    counterbalance_ratio: NonNegativePerJoint
    counterbalance_range: PositivePerJoint
    counterbalance_s: PositivePerJoint
    margin: Positive
    standby: Positive
    pump_s: Positive
    line: Positive
    power: Positive
    bypass_stroke: Positive
    outrigger_nm_rad: Annotated[float, Ge(0)]
    substep_s: Annotated[float, Interval(gt=0, le=0.005)]

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> CircuitModel:
        """Return a model for `num_envs` environments on `device`.

        Raises:
            ConfigError: a number makes no sense, or the delay does not fit the machine's history.
        """
        return CircuitModel(self, machine, num_envs, device)


class CircuitModel(OilModel):
    """The circuit at work in `N` environments; see the module for its equations.

    State of each joint: `speed` over full speed, pressures over relief, `poppet` opening of the
    counterbalance valve, `promised` motion of the last step and `pressed` deflection of the drive, rad
    or m; `supply` `(N, 1)`, of relief pressure.
    """

    STATES = (
        "pilot", "spool", "spool_rate", "speed", "bore", "rod", "poppet", "promised", "pressed",
    )  # fmt: skip

    def __init__(
        self, config: HydraulicCircuit, machine: Machine, num_envs: int, device: torch.device
    ) -> None:
        super().__init__(config, machine, num_envs, device)
        self._state["supply"] = torch.zeros(num_envs, 1, device=device)
        self._kinematics = Kinematics(machine, device) if config.outrigger_nm_rad else None
        home = torch.as_tensor(machine.home, dtype=torch.float32, device=device)
        self._home_moment_nm = self._gravity.overturn(home[None])
        self.reset(self._fresh.clone())

    @property
    def sides(self) -> frozenset[str]:
        """`kinematics` where the machine tilts on its outriggers."""
        return frozenset({"kinematics"} if self._kinematics else ())

    def reset(self, mask: torch.Tensor) -> None:
        """Let the environments of `mask`, `(N,)` bool, start from their history."""
        self._state["supply"].masked_fill_(mask[:, None], self._config.standby)
        super().reset(mask)

    def tool(self, point_m: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
        """Return the true place of the tool that the drawing has at `point_m`, `(N, 3)`."""
        if self._kinematics is None:
            return point_m
        tilt = (self._gravity.overturn(q) - self._home_moment_nm) / self._config.outrigger_nm_rad
        return point_m + torch.linalg.cross(tilt, point_m, dim=-1)

    def misplacement(self, q: torch.Tensor) -> torch.Tensor:
        """Return the error of a surveyed target near the tool at `q`, `(N, 3)` in m."""
        if self._kinematics is None:
            return torch.zeros_like(q[:, :3])
        tip_m = self._kinematics.pose(q).tip_in_base_m
        return self.tool(tip_m, q) - tip_m

    def step(self, history: History) -> torch.Tensor:
        """Return the joint positions one control period later, shape `(N, J)`."""
        state, p, config = self._state, self.parameters, self._config
        q, dt = history.q[:, -1], self._dt_s
        earlier, later, part = self._read_commands(history.u)
        torque = p["supply_ratio"] * self._yield_force
        lever, stroke = self._follow_linkage(q)
        inertia = self._stiffness / (2.0 * math.pi * p["mode_hz"]) ** 2
        push = dt * torque / (inertia * self.plant.max_speed)
        alpha = p["rod_area"]
        column = self._stiffness * self.plant.max_speed / (torque * (1.0 + alpha))
        soft_bore = column * (DEAD_VOLUME + 0.5) / (DEAD_VOLUME + stroke)
        soft_rod = column / alpha * (DEAD_VOLUME + 0.5) / (DEAD_VOLUME + 1.0 - stroke)

        moved = q - history.q[:, -2]
        fresh = self._fresh.clone()[:, None]
        now = self.recall(self._begin(history, moved, lever, torque))
        pilot, spool, spool_rate, speed = (
            now[name] for name in ("pilot", "spool", "spool_rate", "speed")
        )
        # what the simulator's drive could not do has compressed the oil
        missed = torch.where(fresh, torch.zeros_like(q), moved - state["promised"])
        blocked = torch.where(state["promised"].abs() > 1e-9, -missed / state["promised"], 0.0)
        blocked = blocked.clamp(0.0, 1.0)
        # the drive lets go at its yield force, an obstacle does not
        yielding = self._yield_force / self._stiffness
        most = torch.where(blocked > 0.5, 2.0 * torque / self._stiffness, yielding)
        pressed = (now["pressed"] + missed).clamp(-most, most)
        blocked = blocked * (pressed.abs() / yielding / LOOSE - 1.0).clamp(0.0, 1.0)
        speed = speed * (1.0 - blocked)
        shift = lever * missed / self.plant.max_speed
        bore = (now["bore"] - soft_bore * shift).clamp(0.0, 1.0)
        rod = (now["rod"] + soft_rod * alpha * shift).clamp(0.0, 1.0)
        weight = self._gravity.load(q)
        supply, poppet = now["supply"], now["poppet"]

        omega = 2.0 * math.pi * p["spool_hz"]
        play = 0.5 * p["hysteresis"]
        excess = p["breakaway"] - p["coulomb"]
        has_valve = p["counterbalance_setting"] > 0
        lag = 1.0 - torch.exp(-dt / p["counterbalance_s"])
        begin_q = q
        for i in range(self._num_substeps):
            u = torch.lerp(later, earlier, (part * self._num_substeps - i).clamp(0.0, 1.0))
            pilot = pilot.clamp(u - play, u + play)
            spool_rate = spool_rate + dt * omega * (
                omega * (pilot - spool) - 2.0 * p["spool_damping"] * spool_rate
            )
            spool = (spool + dt * spool_rate).clamp(-1.0, 1.0)
            opening = open_valve(spool, p["overlap_extend"], p["overlap_retract"])
            area = opening.abs()
            area = area * (1.0 - p["notch"] + p["notch"] * area)
            extends, is_open = opening > 0, area > 0
            inlet = torch.where(extends, bore, rod)
            outlet = torch.where(extends, rod, bore)

            # inlet edge
            highest = torch.where(is_open, inlet, torch.zeros_like(inlet)).amax(1, keepdim=True)
            felt = highest if config.compensation == "post" else inlet
            head = (supply - felt).clamp(min=0.0)
            most = head if config.compensation == "none" else head.clamp(max=config.margin)
            root = torch.sqrt((most + LAMINAR) * config.margin)
            flow = p["speed_scale"] * area
            slope = 0.5 * flow / root * (most > 0) * (head <= most)
            flow = flow * most / root
            # outlet edge and counterbalance valve
            ratio = torch.where(extends, alpha, 1.0 / alpha)
            edge = p["speed_scale"] * area * ratio / torch.sqrt(p["outlet"])
            wanted = p["counterbalance_ratio"] * inlet + outlet - p["counterbalance_setting"]
            wanted = (wanted / p["counterbalance_range"]).clamp(0.0, 1.0) * is_open
            poppet = poppet + lag * (wanted - poppet)
            series = poppet / torch.sqrt(poppet * poppet + area * area + 1e-9)
            edge = torch.where(has_valve, edge * series, edge)
            drained = torch.sqrt(outlet + LAMINAR)
            out_slope = edge / drained
            out_flow = out_slope * outlet

            # chambers and joint, solved together
            in_slope = slope if config.compensation != "post" else torch.zeros_like(slope)
            k_bore = dt * soft_bore
            k_rod = dt * soft_rod
            k_bore = k_bore / (1.0 + k_bore * (torch.where(extends, in_slope, out_slope)))
            k_rod = k_rod / (1.0 + k_rod * (torch.where(extends, out_slope, in_slope)))
            bore = bore + k_bore * (torch.where(extends, flow, -out_flow) - p["leak"] * bore)
            rod = rod + k_rod * (torch.where(extends, -out_flow, flow) - p["leak"] * rod)
            bent = (pressed - blocked * (q - begin_q)).clamp(-most, most)
            load = (weight + self._stiffness * bent) / torque
            momentum = speed + push * (lever * (bore - alpha * rod) + load)
            rub = push * (p["coulomb"] + excess * torch.exp(-speed.abs() / p["stribeck_speed"]))
            spring = push * lever * lever * (k_bore + alpha * alpha * k_rod)
            left = momentum.sign() * (momentum.abs() - rub).clamp(min=0.0)
            speed = left / (1.0 + spring + push * p["viscous"])
            bore = (bore - k_bore * lever * speed).clamp(0.0, 1.0)
            rod = (rod + k_rod * alpha * lever * speed).clamp(0.0, 1.0)
            went = q + dt * self.plant.max_speed * speed
            q = self.plant.hold(went)
            speed = speed.masked_fill(q != went, 0.0)
            supply = self._feed(supply, highest, flow, slope, spool, dt)

        promised = q - begin_q
        values = (pilot, spool, spool_rate, speed, bore, rod, poppet, promised, pressed)
        self.keep({**dict(zip(self.STATES, values, strict=True)), "supply": supply})
        return q

    def _feed(
        self,
        supply: torch.Tensor,
        highest: torch.Tensor,
        flow: torch.Tensor,
        slope: torch.Tensor,
        spool: torch.Tensor,
        dt: float,
    ) -> torch.Tensor:
        """Return the supply pressure after a substep, `(N, 1)`."""
        config = self._config
        share = self.parameters["flow_share"] / self.parameters["speed_scale"]
        spare = (config.power / supply.clamp(min=1e-3)).clamp(max=1.0)
        spare = spare - (share * flow).sum(1, keepdim=True)
        stiff = (share * slope).sum(1, keepdim=True)
        if config.compensation == "none":
            left = (1.0 - spool.abs() / config.bypass_stroke).clamp(min=0.0)
            bypass = left.square().prod(1, keepdim=True) / math.sqrt(config.standby)
            root = torch.sqrt(supply + LAMINAR)
            change = dt * (spare - bypass * supply / root)
            return (supply + change / (config.line + dt * (stiff + bypass / root))).clamp(0.0, 1.0)
        wanted = (highest + config.margin).clamp(config.standby, 1.0)
        rise = (wanted - supply) * (1.0 - math.exp(-dt / config.pump_s))
        filled = dt * spare / (config.line + dt * stiff)
        return (supply + torch.minimum(rise, filled)).clamp(0.0, 1.0)

    def _follow_linkage(self, q: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return lever arm over that in mid-travel and stroke from 0 to 1, each `(N, J)`."""
        p = self.parameters
        low, high, sides = p["linkage_lower_rad"], p["linkage_upper_rad"], p["linkage_sides"]
        share = (q - self.plant.lower) / (self.plant.upper - self.plant.lower)
        length = compute_cylinder_length(low + share * (high - low), sides)
        lever = torch.sin(low + share * (high - low)) / length
        middle = 0.5 * (low + high)
        lever = lever * compute_cylinder_length(middle, sides) / torch.sin(middle)
        shortest = compute_cylinder_length(low, sides)
        travel = compute_cylinder_length(high, sides) - shortest
        is_still = travel.abs() < 1e-6
        stroke = (length - shortest) / torch.where(is_still, torch.ones_like(travel), travel)
        return lever, torch.where(is_still, torch.full_like(stroke, 0.5), stroke).clamp(0.0, 1.0)

    def _begin(
        self, history: History, moved: torch.Tensor, lever: torch.Tensor, torque: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        """Return the state of a free run that begins in the middle of a motion."""
        p, config = self.parameters, self._config
        in_force, _, _ = self._read_commands(history.u)
        trailing = self._read_trailing(history.u)
        speed = moved / (self.plant.period_s * self.plant.max_speed)
        needed = p["coulomb"] * (speed / 0.01).clamp(-1.0, 1.0) + p["viscous"] * speed
        needed = (needed - self._gravity.load(history.q[:, -1]) / torque) / lever
        bore = (needed.clamp(min=0.0) + PRELOAD).clamp(max=1.0)
        rod = ((bore - needed) / p["rod_area"]).clamp(0.0, 1.0)
        zero = torch.zeros_like(moved)
        opening = open_valve(trailing, p["overlap_extend"], p["overlap_retract"])
        inlet = torch.where(opening > 0, bore, rod) * (opening != 0)
        highest = inlet.amax(1, keepdim=True)
        supply = torch.where(highest > 0, highest + config.margin, config.standby).clamp(max=1.0)
        return {
            "pilot": in_force,
            "spool": trailing,
            "spool_rate": zero,
            "speed": speed,
            "bore": bore,
            "rod": rod,
            "poppet": torch.where(opening != 0, torch.ones_like(zero), zero),
            "promised": moved,
            "pressed": zero,
            "supply": supply,
        }


def compute_cylinder_length(angle_rad: torch.Tensor, sides: torch.Tensor) -> torch.Tensor:
    """Return the third side of a triangle over its longer side (law of cosines).

    Args:
        angle_rad: Angle between the two other sides.
        sides: Their ratio, shorter over longer.
    """
    return torch.sqrt(1.0 + sides * sides - 2.0 * sides * torch.cos(angle_rad))
