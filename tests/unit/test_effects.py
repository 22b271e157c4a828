"""What holds for every effect: neutral at its `none`, drawn as configured, composed in order, restored exactly, open to fits."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from composed import MACHINE, option
from motion import draw_commands, roll

from brokk_rl.checks import NUM_ENVS, check_actuator_model
from brokk_rl.errors import ConfigError

CPU = torch.device("cpu")
FIXED = """
dead_time delay_jitter frame_loss dead_band flow_gain asymmetry saturation rate_limit lag stiction backlash
load_dependence flow_sharing creep thermal_drift compliance quantisation sensor_noise encoder_bias encoder_scale
link_length base_tilt clock_offset extrinsics
""".split()  # noqa: SIM905


def effect(name: str, **changes: Any) -> Any:
    """Returns an effect at its typical size with some fields changed."""
    spec = option("effect", name)
    return replace(spec, **{key: number.typical for key, number in spec.numbers.items()} | changes)


def neutral(name: str) -> Any:
    numbers = option("effect", name).numbers
    return effect(
        name, **{key: number.none for key, number in numbers.items() if number.none is not None}
    )


def places(model: Any, q: torch.Tensor) -> torch.Tensor:
    """Returns where the point (1, 1, 1) of the tool is, and where the camera sees that point, `(N, 6)`."""
    point_m = torch.ones(len(q), 3)
    return torch.cat((model.tool(point_m, q), model.target(point_m)), 1)


def wrap(*specs: Any, actuator: str = "ideal", num: int = 1) -> Any:
    """Returns an actuator model with effects around it, the first one nearest to it."""
    model = option("actuator", actuator).build(MACHINE, num, CPU)
    for spec in specs:
        model = spec.wrap(model, MACHINE, num, CPU)
    return model


@pytest.mark.parametrize("name", FIXED)
def test_an_effect_says_what_a_diagnosis_must_know(name: str) -> None:
    spec = option("effect", name)
    assert spec.name() == name
    assert any(number.none is not None for number in spec.numbers.values())
    for number in spec.numbers.values():
        assert number.bounds[0] <= number.typical <= number.bounds[1]
        assert number.none is None or number.bounds[0] <= number.none <= number.bounds[1]
        assert number.typical != number.none
    assert set(wrap(spec).parameters) == set(spec.numbers)


@pytest.mark.parametrize("name", FIXED)
@pytest.mark.parametrize("actuator", ["lag", "mlp"])
@pytest.mark.parametrize("moving", [False, True])
def test_the_neutral_value_changes_nothing(name: str, actuator: str, moving: bool) -> None:
    u = draw_commands(MACHINE, 25, 2, seed=3)
    plain, model = (wrap(*one, actuator=actuator, num=2) for one in ([], [neutral(name)]))
    path = roll(model, MACHINE, u, moving=moving)
    assert torch.equal(path, roll(plain, MACHINE, u, moving=moving))
    assert torch.equal(model.measure(path[-1]), path[-1])
    assert torch.equal(model.truth(path[-1]), path[-1])
    assert torch.equal(model.misplacement(path[-1]), torch.zeros(2, 3))
    assert torch.equal(places(model, path[-1]), torch.ones(2, 6))


@pytest.mark.parametrize("name", FIXED)
def test_the_typical_value_changes_something(name: str) -> None:
    u = draw_commands(MACHINE, 60, 2)
    # Seldom seen at their typical size.
    seldom = {"frame_loss": {"probability": 0.5}, "stiction": {"start": 0.5}}
    model = wrap(effect(name, **seldom.get(name, {})), num=2)
    expected, path = (roll(one, MACHINE, u) for one in (wrap(num=2), model))
    seen = model.measure(path[-1])
    moved = [
        (path - expected).abs().amax(),
        (seen - path[-1]).abs().amax(),
        (places(model, path[-1]) - 1.0).abs().amax(),
    ]
    acting = {"measurement": 1, "kinematics": 2}.get(model.effects[""].side, 0)
    assert [float(size) > 1e-5 for size in moved] == [place == acting for place in range(3)]


@pytest.mark.parametrize(
    "name", [name for name in FIXED if name not in ("base_tilt", "extrinsics")]
)
def test_only_the_named_joints_have_it(name: str) -> None:
    model = wrap(effect(name, joints=["q3"]), num=3)
    for key, number in model.effects[""].numbers.items():
        elsewhere = number.typical if number.none is None else number.none
        expected = torch.full((3, MACHINE.num_joints), elsewhere)
        # a machine with masses has no pose term
        expected[:, 2] = number.typical if number.is_on(MACHINE) else number.none
        assert torch.equal(model.parameters[key], expected)


@pytest.mark.parametrize("name", FIXED)
def test_ranges_are_drawn_anew_at_each_reset_for_each_environment(name: str) -> None:
    spec = option("effect", name)
    ranges = {}
    for key, number in spec.numbers.items():
        if number.is_on(MACHINE):
            ranges[key] = (number.typical, float(np.clip(2.0 * number.typical, *number.bounds)))
    model = wrap(replace(spec, **ranges), num=400)
    before = {key: value.clone() for key, value in model.parameters.items()}
    mask = torch.arange(400) < 200
    model.reset(mask)
    for key, (low, high) in ranges.items():
        value = model.parameters[key]
        assert low <= value.min() and value.max() <= high
        assert torch.equal(value[200:], before[key][200:])
        if low < high:
            assert (value[:200] != before[key][:200]).float().mean() > 0.99
            assert value.mean().item() == pytest.approx((low + high) / 2, abs=0.15 * (high - low))
            # As of a uniform distribution.
            assert value.std().item() == pytest.approx((high - low) / math.sqrt(12), rel=0.2)
            assert len(value.unique()) > 0.99 * value.numel()


def test_a_table_gives_values_and_ranges_joint_by_joint() -> None:
    spec = effect("backlash", gap_rad={"q2": [0.01, 0.02], "q3": 0.05, "other": 0})
    value = wrap(spec, num=50).parameters["gap_rad"]
    assert value[:, 1].min() >= 0.01 and value[:, 1].max() <= 0.02 and value[:, 1].std() > 0.001
    assert torch.equal(value[:, [0, 2, 3, 4]], torch.tensor([0.0, 0.05, 0.0, 0.0]).expand(50, 4))


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("backlash", {"gap_rad": -0.1}, r"gap_rad: expected 0 to 0\.237 rad, got -0\.1"),
        ("backlash", {"gap_rad": [0.1, 0.05]}, r"effect\.backlash\.gap_rad: .*low <= high"),
        ("backlash", {"joints": ["q33"]}, r"joints: 'q33' is no joint.*did you mean 'q3'"),
        ("dead_band", {"extend": 0.9}, r"effect\.dead_band\.extend: expected 0 to 0\.85, got"),
        ("flow_gain", {"gain": {"q1": 1.1}}, r"effect\.flow_gain\.gain: no value for q2"),
        ("base_tilt", {"roll_rad": {"q1": 0.1, "other": 0}}, "roll_rad: .*joints do not differ"),
        ("lag", {"time_constant_s": "slow"}, r"Lag\.time_constant_s"),
    ],
)
def test_what_makes_no_sense_is_refused(name: str, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        wrap(effect(name, **changes))


def test_all_effects_together_make_an_actuator_model() -> None:
    names = [name for name in FIXED if name not in ("sensor_noise", "quantisation")]
    specs = [option("effect", name) for name in names]
    model = wrap(*specs, actuator="lag", num=NUM_ENVS)
    check_actuator_model(model, MACHINE, CPU)
    assert model.sides == {"command", "speed", "joints", "measurement", "kinematics"}


@pytest.mark.parametrize("name", [*FIXED, "library"])
def test_a_run_goes_on_exactly_from_its_state(name: str) -> None:
    torch.manual_seed(0)
    model = wrap(option("effect", name), actuator="lag", num=2)
    u = draw_commands(MACHINE, 30, 2)
    roll(model, MACHINE, u)
    model.measure(u[0])
    kept = {key: value.clone() for key, value in model.state.items()}
    on, seen = roll(model, MACHINE, u), model.measure(u[0])
    torch.manual_seed(1)
    other = wrap(option("effect", name), actuator="lag", num=2)
    for key, value in other.state.items():
        value.copy_(kept[key])
    assert torch.equal(roll(other, MACHINE, u), on)
    assert torch.equal(other.measure(u[0]), seen)


def test_the_first_effect_is_nearest_to_the_machine() -> None:
    band, cut = effect("dead_band", extend=0.2, retract=0.2), effect("saturation", level=0.6)
    full = torch.ones(1, 1, 5)
    half, play = effect("flow_gain", gain=0.5), effect("backlash", gap_rad=0.02)
    # cut first: (0.6 - 0.2) / 0.8 = 0.5 of 0.02 rad; band first leaves a full command, of which 0.6
    # remain; a gain of a half before a play of 0.02, half of it open, uses up 0.01 of 0.01; behind
    # it 0.5 of 0.02 - 0.01
    for first, second, moved in (
        (band, cut, 0.01), (cut, band, 0.012), (half, play, 0.0), (play, half, 0.005)
    ):  # fmt: skip
        path = roll(wrap(first, second), MACHINE, full)
        assert (path[1] - path[0])[0, 0].item() == pytest.approx(moved, abs=1e-7)
    biased, coarse = effect("encoder_bias", bias_rad=0.006), effect("quantisation", step_rad=0.01)
    q = torch.full((1, 5), 0.1)
    for first, second, shown in ((biased, coarse, 0.11), (coarse, biased, 0.106)):
        seen = wrap(first, second).measure(q)
        assert seen[0, 0].item() == pytest.approx(shown, abs=1e-6)
