"""A planned run takes the same positions as steps do, for every effect that can be planned."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from composed import MACHINE, option
from motion import run_planned, step_through

from actuators.effects.effect import EffectSpec
from actuators.models.joint_weight import build_joint_weight
from brokk_rl.kinematics import Gravity
from brokk_rl.machine import Machine

CPU = torch.device("cpu")
NUM_ENVS, STEPS = 6, 50
PLANNED = [
    "asymmetry", "backlash", "clock_offset", "compliance", "creep", "dead_band", "dead_time", "flow_gain",
    "flow_sharing", "frame_loss", "lag", "load_dependence", "rate_limit", "saturation", "stiction", "thermal_drift",
]  # fmt: skip


@cache
def bases(machine: Machine) -> dict[str, Any]:
    """Returns a lag, and a valve with play, pump and pose."""
    rng = np.random.default_rng(0)
    knots = (0.0, 0.1, 0.3, 1.0)
    names, size = machine.joint_names, machine.num_joints + 2

    def rows() -> dict[str, tuple[float, ...]]:
        return {name: tuple(0.1 * rng.standard_normal(size)) for name in names}

    valve = replace(
        option("actuator", "valve"), dead_time_s=0.13, play=0.04, spool_s=0.05, speed_s=0.08, demand=0.7, knots=knots,
        curve_extend=(0.0, 0.02, 0.3, 1.0), curve_retract=(0.0, 0.05, 0.2, 0.8), pose_extend=rows(), pose_retract=rows(),
    )  # fmt: skip
    return {"lag": replace(option("actuator", "lag"), dead_time_s=0.13), "valve": valve}


def effect(name: str, size: float) -> EffectSpec:
    """Returns an effect at a multiple of its typical size."""
    spec = option("effect", name)
    values = {}
    for key, number in spec.numbers.items():
        none = number.typical if number.none is None else number.none
        values[key] = none if number.masses is False else none + size * (number.typical - none)
    return replace(spec, **values)


def build(base: str, effects: list[tuple[str, float]]) -> Any:
    torch.manual_seed(0)
    model: Any = bases(MACHINE)[base].build(MACHINE, NUM_ENVS, CPU)
    for name, size in effects:
        model = effect(name, size).wrap(model, MACHINE, NUM_ENVS, CPU)
    model.reset(torch.ones(NUM_ENVS, dtype=torch.bool))
    return model


def draw_motion() -> tuple[torch.Tensor, torch.Tensor]:
    """Returns commands `(T, N, J)` that hold for five periods, and positions `(T + 1, N, J)` of which the first are known."""
    generator, size = torch.Generator().manual_seed(1), MACHINE.num_history
    drawn = torch.rand(STEPS // 5 + 4, NUM_ENVS, MACHINE.num_joints, generator=generator) * 3 - 1.5
    u = (drawn.clamp(-1, 1) * (drawn.abs() > 0.06)).repeat_interleave(5, 0)[: size + STEPS]
    middle = torch.as_tensor((MACHINE.lower + MACHINE.upper) / 2, dtype=torch.float32)
    q = torch.zeros(len(u) + 1, NUM_ENVS, MACHINE.num_joints) + middle
    drift = torch.rand(NUM_ENVS, MACHINE.num_joints, generator=generator) - 0.5
    q[:size] += 0.002 * torch.arange(size)[:, None, None] * drift
    # One environment begins just before its stops, so that it runs into them.
    q[:size, 0] += torch.as_tensor(MACHINE.upper, dtype=torch.float32) - q[size - 1, 0] - 1e-4
    return u, q


def compare(base: str, effects: list[tuple[str, float]]) -> None:
    u, q = draw_motion()
    with torch.inference_mode():
        stepped = step_through(build(base, effects), u, q, MACHINE.num_history)
        planned = run_planned(build(base, effects), u, q, MACHINE.num_history)
        plain = run_planned(build(base, []), u, q, MACHINE.num_history)
    assert (stepped - planned).abs().max() < 1e-5
    moved = stepped[MACHINE.num_history :]
    assert (moved - moved[0]).abs().max() > 0.01, "the test moves nothing"
    if effects:
        assert (planned - plain).abs().max() > 1e-4, "the effect does nothing here"


@pytest.mark.parametrize("base", ["lag", "valve"])
def test_a_planned_model_moves_as_its_steps_do(base: str) -> None:
    compare(base, [])


@pytest.mark.parametrize("name", PLANNED)
@pytest.mark.parametrize("base", ["lag", "valve"])
def test_a_planned_effect_moves_as_its_steps_do(base: str, name: str) -> None:
    # Frames are lost seldom, and a pump shows where joints ask for more than it has.
    compare(base, [(name, {"frame_loss": 10.0, "flow_sharing": 3.0}.get(name, 1.0))])


def test_planned_effects_inside_each_other_move_as_their_steps_do() -> None:
    compare("valve", [("flow_sharing", 1.0), ("lag", 0.5), ("stiction", 1.0), ("dead_time", 0.4)])  # fmt: skip
    compare("lag", [("backlash", 2.0), ("dead_band", 2.0), ("saturation", 1.5)])


def test_a_clock_ahead_shows_no_command_before_it_is_given() -> None:
    """-0.25 s at a dead time of 0.15 s: as in steps, the newest command acts at once."""
    u, q = draw_motion()
    base = replace(bases(MACHINE)["lag"], dead_time_s=0.15)
    found = []
    for run in (step_through, run_planned):
        inner = base.build(MACHINE, NUM_ENVS, CPU)
        model = effect("clock_offset", -5.0).wrap(inner, MACHINE, NUM_ENVS, CPU)
        model.reset(torch.ones(NUM_ENVS, dtype=torch.bool))
        with torch.inference_mode():
            found.append(run(model, u, q, MACHINE.num_history))
    assert (found[0] - found[1]).abs().max() < 1e-5
    assert (found[0] - q).abs().max() > 0.01


def test_effects_that_draw_together_and_the_library_are_stepped() -> None:
    for name in ("library", "delay_jitter"):
        inner = bases(MACHINE)["lag"].build(MACHINE, NUM_ENVS, CPU)
        model = option("effect", name).wrap(inner, MACHINE, NUM_ENVS, CPU)
        assert model.plan_run(torch.zeros(20, NUM_ENVS, MACHINE.num_joints), 13) is None


def test_the_weight_of_a_planar_arm_is_that_of_its_mechanics() -> None:
    weight = build_joint_weight(MACHINE, CPU)
    generator = torch.Generator().manual_seed(7)
    share = torch.rand(100, MACHINE.num_joints, generator=generator).numpy()
    q = torch.tensor(MACHINE.lower + share * (MACHINE.upper - MACHINE.lower)).float()
    force = torch.tensor([body.yield_force.value for body in MACHINE.bodies])
    truth = Gravity(MACHINE, CPU).load(q) / force
    assert weight.is_planar
    assert truth.abs().max() > 0.1
    torch.testing.assert_close(weight.weigh(q), truth, atol=2e-5, rtol=0.0)


def test_effects_around_a_model_that_is_stepped_are_stepped_too() -> None:
    """A servo that follows at once plans nothing, so that nothing around it asks for its delay."""
    model: Any = option("actuator", "ideal").build(MACHINE, NUM_ENVS, CPU)
    for name in ("clock_offset", "dead_time"):
        model = effect(name, 1.0).wrap(model, MACHINE, NUM_ENVS, CPU)
        model.reset(torch.ones(NUM_ENVS, dtype=torch.bool))
        assert not model.is_plannable
        assert model.plan_run(draw_motion()[0], MACHINE.num_history) is None
