"""Hydraulic circuits against worked numbers and a stiff solution of the same equations."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch
from composed import MACHINE, option
from motion import rest, roll
from scipy.integrate import solve_ivp

from actuators.models.circuit import (
    DEAD_VOLUME,
    LAMINAR,
    CircuitModel,
    HydraulicCircuit,
    compute_cylinder_length,
)
from brokk_rl.errors import ConfigError
from brokk_rl.kinematics import GRAVITY_M_S2, Gravity
from brokk_rl.machine import Machine

CPU = torch.device("cpu")
CIRCUITS = ("load_sensing", "post_compensated", "open_center")
Q3 = 2


def circuit(name: str = "load_sensing", **changes: Any) -> HydraulicCircuit:
    return dataclasses.replace(option("actuator", name), **changes)


def frictionless(name: str = "load_sensing", **changes: Any) -> HydraulicCircuit:
    """A circuit whose equations are smooth but for its valves: what a stiff solver can integrate."""
    smooth = {"coulomb": 0.0, "breakaway": 0.0, "hysteresis": 0.0, "transport_s": 0.0}
    return circuit(name, **(smooth | {"viscous": 0.2} | changes))


class Run:
    """A free run of one environment from rest; rows of `q` and of the states after each period."""

    def __init__(
        self,
        config: HydraulicCircuit,
        levels: dict[str, float],
        periods: int,
        blocked: tuple[str, ...] = (),
    ) -> None:
        self.model = CircuitModel(config, MACHINE, 1, CPU)
        history = rest(MACHINE)
        at = history.q[:, -1].clone()
        u = torch.zeros(1, MACHINE.num_joints)
        for name, level in levels.items():
            u[0, MACHINE.joint_names.index(name)] = level
        held = [MACHINE.joint_names.index(name) for name in blocked]
        path = [at[0].numpy().astype(float)]
        self.state: list[dict[str, np.ndarray]] = []
        for _ in range(periods):
            history.push_u(u)
            q_next = self.model.step(history).clone()
            q_next[:, held] = at[:, held]
            history.push_q(q_next)
            path.append(q_next[0].numpy().astype(float))
            self.state.append({k: v[0].numpy().copy() for k, v in self.model.state.items()})
        self.q = np.array(path)

    def get(self, name: str, joint: int = 0) -> np.ndarray:
        """Return a state over time."""
        return np.array([row[name][joint] for row in self.state])

    def speed(self, joint: int, periods: int, machine: Machine) -> float:
        """Return the mean speed over the last periods, of full speed."""
        moved = self.q[-1, joint] - self.q[-1 - periods, joint]
        return moved / (periods * machine.period_s * machine.max_speed[joint])


def solve_one_joint(
    config: HydraulicCircuit, joint: int, u: float, t_s: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return position and supply of one joint that moves alone in the positive direction.

    Written from the equations, with scipy's stiff solver; the linkage follows the joint.
    """
    name = MACHINE.joint_names[joint]

    def number(field: str) -> float:
        value = getattr(config, field)
        return float(value.get(name, value.get("other")) if isinstance(value, dict) else value)

    body, full = MACHINE.bodies[joint], MACHINE.max_speed[joint]
    k, torque = body.stiffness.value, number("supply_ratio") * body.yield_force.value
    inertia = k / (2 * np.pi * number("mode_hz")) ** 2
    alpha, omega = number("rod_area"), 2 * np.pi * number("spool_hz")
    lower, upper = MACHINE.lower[joint], MACHINE.upper[joint]
    low, high = number("linkage_lower_rad"), number("linkage_upper_rad")
    r, share = number("linkage_sides"), number("flow_share") / number("speed_scale")
    gravity, home = Gravity(MACHINE, CPU), np.array(MACHINE.home)
    setting = number("counterbalance_setting")

    def length(angle: float) -> float:
        return math.sqrt(1 + r * r - 2 * r * math.cos(angle))

    def arm(angle: float) -> float:
        return r * math.sin(angle) / length(angle)

    def slopes(_: float, y: np.ndarray) -> list[float]:
        q, w, bore, rod, spool, rate, poppet, supply = y
        at = home.copy()
        at[joint] = q
        load = float(gravity.load(torch.tensor(at[None], dtype=torch.float32))[0, joint]) / torque
        angle = low + (q - lower) / (upper - lower) * (high - low)
        lever = arm(angle) / arm(0.5 * (low + high))
        stroke = (length(angle) - length(low)) / (length(high) - length(low))
        o = number("overlap_extend")
        area = max(spool - o, 0.0) / (1 - o)
        area = area * (1 - number("notch") + number("notch") * area)
        drop = max(supply - bore, 0.0)
        if config.compensation != "none":
            drop = min(drop, config.margin)
        flow = number("speed_scale") * area * drop / math.sqrt((drop + LAMINAR) * config.margin)
        edge = number("speed_scale") * area * alpha / math.sqrt(number("outlet"))
        wanted = number("counterbalance_ratio") * bore + rod - setting
        wanted = min(max(wanted / number("counterbalance_range"), 0.0), 1.0) * (area > 0)
        if setting > 0:
            edge *= poppet / math.sqrt(poppet**2 + area**2 + 1e-9)
        out = edge * max(rod, 0.0) / math.sqrt(max(rod, 0.0) + LAMINAR)
        column = k * full / (torque * (1 + alpha)) * (DEAD_VOLUME + 0.5)
        d_bore = column / (DEAD_VOLUME + stroke) * (flow - number("leak") * bore - lever * w)
        d_rod = column / alpha / (DEAD_VOLUME + 1 - stroke)
        d_rod *= -out - number("leak") * rod + alpha * lever * w
        d_w = torque / (inertia * full)
        d_w *= lever * (bore - alpha * rod) + load - number("viscous") * w
        spare = min(1.0, config.power / supply) - share * flow
        if config.compensation == "none":
            left = max(1 - abs(spool) / config.bypass_stroke, 0.0) ** 2
            d_supply = spare - left / math.sqrt(config.standby) * supply / math.sqrt(
                supply + LAMINAR
            )
            d_supply /= config.line
        else:
            aim = min(max((bore if area > 0 else 0.0) + config.margin, config.standby), 1.0)
            d_supply = min((aim - supply) / config.pump_s, spare / config.line)
        # chambers draw oil from the return line below 0; relief valves open above 1
        d_bore, d_rod, d_supply = (
            0.0 if (p <= 0 and rate_p < 0) or (p >= 1 and rate_p > 0) else rate_p
            for p, rate_p in ((bore, d_bore), (rod, d_rod), (supply, d_supply))
        )
        d_rate = omega * (omega * (u - spool) - 2 * number("spool_damping") * rate)
        d_poppet = (wanted - poppet) / number("counterbalance_s")
        return [full * w, d_w, d_bore, d_rod, rate, d_rate, d_poppet, d_supply]

    start = CircuitModel(config, MACHINE, 1, CPU)
    history = rest(MACHINE)
    lever, _ = start._follow_linkage(history.q[:, -1])
    force = start.parameters["supply_ratio"] * start._yield_force
    begun = start._begin(history, torch.zeros(1, MACHINE.num_joints), lever, force)
    bore, rod = (float(begun[name][0, joint]) for name in ("bore", "rod"))
    first = [home[joint], 0.0, bore, rod, 0.0, 0.0, 0.0, config.standby]
    span, how = (0, t_s[-1]), {"rtol": 1e-5, "atol": 1e-7, "max_step": 0.002}
    found = solve_ivp(slopes, span, first, "LSODA", t_s, **how)
    return found.y[0], found.y[7]


@pytest.mark.parametrize("name", CIRCUITS)
@pytest.mark.parametrize("u", [0.4, 1.0])
def test_a_moving_joint_agrees_with_a_stiff_solver(name: str, u: float) -> None:
    config, periods = frictionless(name), 24
    t_s = np.arange(periods + 1) * MACHINE.period_s
    q, supply = solve_one_joint(config, Q3, u, t_s)
    travelled = abs(q[-1] - q[0])
    assert travelled > 0.03
    fine = Run(dataclasses.replace(config, substep_s=0.00125), {"q3": u}, periods)
    np.testing.assert_allclose(fine.q[:, Q3], q, atol=0.015 * travelled)
    assert fine.get("supply")[-1] == pytest.approx(supply[-1], abs=0.01)
    shipped = Run(config, {"q3": u}, periods)
    np.testing.assert_allclose(shipped.q[:, Q3], q, atol=0.06 * travelled)


def test_the_lever_arm_is_the_slope_of_the_cylinders_length() -> None:
    model = circuit().build(MACHINE, 1, CPU)
    low, high = MACHINE.lower[Q3], MACHINE.upper[Q3]
    steps = torch.linspace(0.0, 1.0, 401)
    q = torch.tensor(MACHINE.home, dtype=torch.float32).repeat(401, 1)
    q[:, Q3] = low + steps * (high - low)
    model.parameters = {k: v.expand(401, -1) for k, v in model.parameters.items()}
    lever, stroke = (value[:, Q3].numpy() for value in model._follow_linkage(q))
    # the work of a cylinder: force times d(length) = torque times d(angle)
    slope = np.gradient(stroke)
    np.testing.assert_allclose(lever[1:-1] / lever[200], slope[1:-1] / slope[200], rtol=2e-2)
    assert stroke[0] == pytest.approx(0.0, abs=1e-6)
    assert stroke[-1] == pytest.approx(1.0, abs=1e-6)
    # a triangle with sides 1 and 0.3: sin(a) / length at 0.35 and at the middle, 1.475 rad
    assert lever[0] == pytest.approx((0.34290 / 0.72537) / (0.99541 / 1.01646), rel=1e-3)
    assert float(compute_cylinder_length(torch.tensor(math.pi / 2), torch.tensor(0.75))) == 1.25


def test_compensated_speed_is_free_of_the_load_and_a_throttles_is_not() -> None:
    # q3 lifts: upwards is negative; alone, so that the pump has oil to spare
    def lift(name: str, scale: float) -> float:
        plain = {"outlet": 0.01, "counterbalance_setting": 0.0, "margin": 0.08, "power": 1.0}
        plain |= {"linkage_lower_rad": 1.57, "linkage_upper_rad": 1.57, "bypass_stroke": 0.3}
        config = frictionless(name, **plain, supply_ratio=scale)
        return -Run(config, {"q3": -0.6}, 30).speed(Q3, 10, MACHINE)

    # twice the cylinder carries the same weight at half the pressure
    assert lift("load_sensing", 1.5) == pytest.approx(lift("load_sensing", 3.0), rel=0.02)
    assert lift("open_center", 1.5) < 0.97 * lift("open_center", 3.0)


def test_a_saturated_pump_slows_all_joints_alike_only_behind_post_compensators() -> None:
    # q1 has no load; q3 lifts: a pre-compensated valve loses the heavy joint first
    def share(name: str) -> tuple[float, float]:
        config = circuit(name, flow_share=0.9, power=2.0)
        both = Run(config, {"q1": 1.0, "q3": -1.0}, 40)
        q1, q3 = (Run(config, one, 40) for one in ({"q1": 1.0}, {"q3": -1.0}))
        light = both.speed(0, 10, MACHINE) / q1.speed(0, 10, MACHINE)
        return light, both.speed(Q3, 10, MACHINE) / q3.speed(Q3, 10, MACHINE)

    light, heavy = share("post_compensated")
    assert light < 0.8
    assert heavy == pytest.approx(light, abs=0.12)
    light, heavy = share("load_sensing")
    assert heavy < light - 0.2


def test_pump_stays_within_its_power() -> None:
    lifting = {"q3": -1.0, "q4": -1.0, "q5": -1.0}
    limited, free = (Run(circuit(power=one), lifting, 40) for one in (0.15, 2.0))
    model = limited.model
    used = []
    for row in limited.state[20:]:
        # oil that left the pump is that which moved the rods (alpha of the bore's)
        p = {name: value[0].numpy() for name, value in model.parameters.items()}
        q = torch.tensor(limited.q[20], dtype=torch.float32)[None]
        lever = model._follow_linkage(q)[0][0].numpy()
        taken = p["flow_share"] / p["speed_scale"] * p["rod_area"] * lever * np.abs(row["speed"])
        used.append(float(row["supply"][0] * taken.sum()))
    assert np.mean(used) < 0.15 * 1.15
    assert abs(limited.speed(Q3, 10, MACHINE)) < 0.8 * abs(free.speed(Q3, 10, MACHINE))


@pytest.mark.parametrize("name", CIRCUITS)
def test_closed_valves_hold_the_arm_but_for_the_leak(name: str) -> None:
    config = circuit(name)
    run = Run(config, {}, 100)
    sunk = np.abs(run.q[-1] - run.q[20]) / (MACHINE.max_speed * 80 * MACHINE.period_s)
    assert isinstance(config.leak, float)
    assert (sunk <= config.leak * 3.0).all()
    leaking = Run(circuit(name, leak=0.05), {}, 100)
    assert leaking.q[-1, Q3] - leaking.q[20, Q3] > 0.002


@pytest.mark.parametrize("name", CIRCUITS)
def test_contact_raises_the_pressure_and_slows_the_others(name: str) -> None:
    config = circuit(name, power=0.3) if name != "open_center" else circuit(name)
    levels, periods = {"q3": 0.8, "q5": 0.8}, 40
    free = Run(config, levels, periods)
    blocked = Run(config, levels, periods, blocked=("q3",))
    assert blocked.get("bore", Q3)[-1] > free.get("bore", Q3)[-1] + 0.2
    # the plant presses with more than the drive's yield force
    body = MACHINE.bodies[Q3]
    assert -blocked.get("pressed", Q3)[-1] * body.stiffness.value > body.yield_force.value
    if name != "open_center":
        assert blocked.get("supply")[-1] > free.get("supply")[-1] + 0.1
        assert blocked.speed(4, 10, MACHINE) < free.speed(4, 10, MACHINE) + 0.02


def test_effects_around_a_circuit_are_not_taken_for_contact() -> None:
    effect = dataclasses.replace(option("effect", "flow_gain"), gain=0.8)
    inner = circuit().build(MACHINE, 1, CPU)
    model = effect.wrap(inner, MACHINE, 1, CPU)
    u = torch.zeros(30, 1, MACHINE.num_joints)
    u[..., Q3] = -0.7
    roll(model, MACHINE, u)
    assert float(inner.state["pressed"].abs().max()) < 1e-5


def test_outriggers_tilt_the_machine_by_the_moment_of_its_arm() -> None:
    stiffness = 2.0e6
    model = circuit(outrigger_nm_rad=stiffness).build(MACHINE, 1, CPU)
    # the arm stretched straight ahead: every centre of mass lies on one line at its link's height
    q = torch.zeros(1, MACHINE.num_joints)
    x_m, moment_nm = 0.0, 0.0
    for body in MACHINE.bodies:
        x_m += body.origin_m[0].value
        moment_nm += body.mass_kg.value * GRAVITY_M_S2 * (x_m + body.com_m[0])
    overturn = Gravity(MACHINE, CPU).overturn(q)[0].numpy()
    np.testing.assert_allclose(overturn, [0.0, moment_nm, 0.0], rtol=1e-5, atol=1e-2)
    home = torch.tensor(np.array(MACHINE.home)[None]).float()
    home_nm = float(Gravity(MACHINE, CPU).overturn(home)[0, 1])
    tilt_rad = (moment_nm - home_nm) / stiffness
    reach_m = x_m + MACHINE.tip_m[0]
    height_m = sum(body.origin_m[2].value for body in MACHINE.bodies)
    # the front goes down and, as the tip is above the ground, forward
    expected = [tilt_rad * height_m, 0.0, -tilt_rad * reach_m]
    np.testing.assert_allclose(model.misplacement(q)[0].numpy(), expected, rtol=1e-4, atol=1e-6)
    assert 0.001 < tilt_rad < 0.012
    assert model.sides == {"kinematics"}
    rigid = circuit(outrigger_nm_rad=0.0).build(MACHINE, 1, CPU)
    assert rigid.sides == frozenset()
    assert float(rigid.misplacement(q).abs().max()) == 0.0
    assert float(model.misplacement(home).abs().max()) == pytest.approx(0.0, abs=1e-7)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("substep_s", 0.02), ("margin", 0.0), ("compensation", "both"), ("outrigger_nm_rad", float("nan")),
        ("linkage_lower_rad", 0.0), ("rod_area", 1.5), ("breakaway", 0.0), ("transport_s", 0.9),
    ],
)  # fmt: skip
def test_numbers_that_make_no_sense_are_refused(name: str, value: Any) -> None:
    with pytest.raises(ConfigError, match=name):
        circuit(**{name: value}).build(MACHINE, 1, CPU)
