"""Sizes of effects follow from the machine's own joints, and option files of before keep their meaning."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from composed import MACHINE, names, option
from motion import rest

from actuators.effects.load import Creep, LoadDependence
from actuators.scales import choose_horizon_s, measure_time_scale
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from diagnosis import effect_library

CPU = torch.device("cpu")
MACHINES = names("machine")
# A typical size of an effect is small against the joint that has it, and not nothing.
VALVE = {
    "asymmetry", "backlash", "compliance", "creep", "dead_band", "flow_gain", "flow_sharing", "load_dependence",
    "stiction", "thermal_drift",
}  # fmt: skip
ABSENT = {
    "speed": set(),
    # A loop around the joint's own encoder hides a wrong reading of it; its play is that of gears.
    "position": VALVE - {"backlash"} | {"saturation", "encoder_bias"},
    # Mass, friction and weight of such a joint belong to the model of its drive; no effect is its play.
    "torque": VALVE,
}
"""Effects of the library that a joint cannot have, by what its command sets."""


def stretched(joint: int, by: float) -> Machine:
    """Returns the machine with one joint of another travel and speed."""
    joints = list(MACHINE.joints)
    one = joints[joint]
    joints[joint] = replace(
        one,
        lower=replace(one.lower, value=by * one.lower.value),
        upper=replace(one.upper, value=by * one.upper.value),
        max_speed=replace(one.max_speed, value=by * one.max_speed.value),
        home=by * one.home,
    )
    return replace(MACHINE, joints=tuple(joints))


def typical(machine: Machine, name: str, number: str) -> np.ndarray:
    (kind,) = effect_library.load_effects(machine, [name])
    return kind.typical(number)


IDEAL = {"speed": "ideal", "position": "servo", "torque": "force"}
"""Actuator that does at once what a command says, for each command interface."""


@pytest.mark.parametrize("name", MACHINES)
def test_the_library_is_drawn_on_every_machine_with_sizes_that_fit_its_joints(name: str) -> None:
    machine, library = option("machine", name), replace(option("effect", "library"), share=1.0)
    inner = option("actuator", IDEAL[machine.interface]).build(machine, 500, CPU)
    model = library.wrap(inner, machine, 500, CPU)
    drawn = {key: value.abs().amax(0).numpy() for key, value in model.parameters.items()}
    assert {key.split(".")[0] for key in drawn} == set(library.effects) - ABSENT[machine.interface]
    travel, speed = machine.upper - machine.lower, machine.max_speed
    # Friction of a small servo holds targets of some degrees, more than the play of a cylinder's pins.
    most = {"backlash.gap_rad": 0.02 if machine.interface == "position" else 0.01}
    for key in ("backlash.gap_rad", "quantisation.step_rad", "sensor_noise.sigma_rad"):
        if key in drawn:
            assert (drawn[key] > 1e-4 * travel).all(), key
            assert (drawn[key] < most.get(key, 0.01) * travel).all(), key
    if "encoder_bias.bias_rad" in drawn:
        assert (drawn["encoder_bias.bias_rad"] < 0.001 * travel).all()
    if "creep.sink_rad_s" in drawn:
        moved = drawn["creep.sink_rad_s"] + drawn["creep.drift_rad_s"]
        assert (moved < 0.02 * speed).all() and (moved > 0.004 * speed).all()
    for key in ("lag.time_constant_s", "dead_time.dead_time_s", "delay_jitter.jitter_s"):
        assert (drawn[key] > 0.2 * machine.period_s).all(), key
        assert (drawn[key] < 4.0 * max(machine.period_s, machine.dead_time_s)).all(), key
    history = rest(machine, num=500)
    history.u.fill_(1.0)
    with torch.no_grad():
        assert torch.isfinite(model.step(history)).all()


@pytest.mark.parametrize("name", MACHINES)
def test_a_diagnosis_has_what_a_load_does_to_the_joints_of_every_machine(name: str) -> None:
    """Joints of valves creep and change their speed, servos sag; a load on a drive is in its model."""
    machine = option("machine", name)
    kinds = {kind.name: kind for kind in effect_library.load_effects(machine)}
    found = {
        one: set(kinds[one].fitted) for one in ("creep", "load_dependence", "sag") if one in kinds
    }
    if machine.interface == "speed" and machine.has_bodies:
        expected = {"creep": {"sink_rad_s"}, "load_dependence": {"sensitivity"}}
    elif machine.interface == "speed":
        expected = {"creep": {"drift_rad_s"}, "load_dependence": {"pose_cos", "pose_sin"}}
    elif machine.interface == "position":
        expected = {"sag": {"load_rad"} if machine.has_bodies else {"sag_rad", "sag_slope"}}
    else:
        expected = {}
    assert found == expected
    for kind in kinds.values():
        for number in kind.fitted:
            low, high = kind.limits(number)
            assert (low <= kind.typical(number)).all() and (kind.typical(number) <= high).all()


def test_sizes_grow_with_the_joint_that_they_are_on_and_no_other() -> None:
    half = stretched(2, 0.5)
    for name, number in (("backlash", "gap_rad"), ("creep", "sink_rad_s")):
        ratio = typical(half, name, number) / typical(MACHINE, name, number)
        assert ratio == pytest.approx([1.0, 1.0, 0.5, 1.0, 1.0])
    assert typical(half, "dead_band", "extend") == pytest.approx([0.06] * 5)


def test_times_follow_the_longer_of_control_period_and_dead_time() -> None:
    quick = replace(MACHINE, period_s=0.01, dead_time_s=0.055)
    assert measure_time_scale(quick) == pytest.approx(0.2)
    assert typical(quick, "rate_limit", "stroke_s") == pytest.approx([0.08] * 5)
    assert choose_horizon_s(quick) == pytest.approx(1.0)
    assert choose_horizon_s(replace(MACHINE, dead_time_s=0.6)) == 5.0, "no free run is longer"


def test_a_range_over_the_typical_size_is_mirrored_about_the_neutral_value() -> None:
    spec = replace(option("effect", "saturation"), level=(0.0, 2.0, "typical"))
    model = spec.wrap(option("actuator", "ideal").build(MACHINE, 2000, CPU), MACHINE, 2000, CPU)
    level = model.parameters["level"]
    assert level.min().item() == pytest.approx(0.5, abs=0.01), "two typical sizes below 1"
    assert level.max().item() == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(
    "spec", [Creep(joints="all", sink_rad_s=0.002), LoadDependence(joints="all", sensitivity=0.5)]
)
def test_a_weight_on_a_machine_without_masses_is_still_refused(spec: Any) -> None:
    small = option("machine", "mini_excavator")
    with pytest.raises(ConfigError, match=r"known by its joints only .add joints\[\].body"):
        spec.wrap(option("actuator", "ideal").build(small, 1, CPU), small, 1, CPU)


def test_a_pose_on_a_machine_with_masses_is_refused() -> None:
    spec = LoadDependence(joints="all", sensitivity=0.0, pose_sin=0.2)
    with pytest.raises(ConfigError, match=r"has known masses.*give the other numbers"):
        spec.wrap(option("actuator", "ideal").build(MACHINE, 1, CPU), MACHINE, 1, CPU)


def test_the_pose_term_is_a_line_over_a_cylinder_and_a_harmonic_of_an_angle() -> None:
    """A joint that extends bears the weight; sqrt(1 - 0.19) is 0.9."""
    small = option("machine", "mini_excavator")
    at = np.stack([small.lower, (small.lower + small.upper) / 2, small.upper])
    history = rest(small, at, 3)
    history.u.fill_(-1.0)  # in the sense of the weight: faster
    full = torch.as_tensor(small.max_speed * small.period_s, dtype=torch.float32)
    history.q[0] += 2.0 * full  # an effect never moves a joint through a stop
    build = option("actuator", "ideal").build
    spec = LoadDependence(joints="all", sensitivity=0.0, pose_sin=0.19)
    with torch.no_grad():
        moved = spec.wrap(build(small, 3, CPU), small, 3, CPU).step(history) - history.q[:, -1]
    speed = (moved / -full).numpy()
    assert speed[1] == pytest.approx([1.0] * 4, abs=1e-4), "nothing in mid-travel"
    assert speed[2, :3] == pytest.approx([0.9] * 3, abs=1e-3), "a cylinder at its end"
    sine = np.sin(1.19)  # half of the swing's travel of 2.38 rad
    assert speed[2, 3] == pytest.approx(np.sqrt(1.0 - 0.19 * sine), abs=1e-3)
    assert (speed[0, :3] > 1.08).all()
