"""Machines that differ: each effect is there in its share of the environments, and does there what it does alone."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from composed import MACHINE, option
from motion import draw_commands, make_recording, roll

from actuators.effects.composition import Library
from actuators.identify import dead_time
from brokk_rl.errors import ConfigError
from brokk_rl.history import History

CPU = torch.device("cpu")
EFFECTS = """
dead_time dead_band stiction saturation rate_limit frame_loss delay_jitter flow_gain asymmetry lag thermal_drift load_dependence
flow_sharing compliance creep backlash encoder_bias sensor_noise quantisation
""".split()  # noqa: SIM905


def fixed(name: str, **changes: float) -> Any:
    """Returns an effect of the library at its typical size."""
    spec = option("effect", "library").effects[name]
    return replace(spec, **{key: number.typical for key, number in spec.numbers.items()} | changes)


def library(share: float | dict[str, float], *specs: Any) -> Library:
    return Library(share=share, effects={spec.name(): spec for spec in specs})


def test_all_together_are_one_around_the_other() -> None:
    chance = ("frame_loss", "delay_jitter", "sensor_noise")
    specs = [fixed(name) for name in EFFECTS if name not in chance]
    u = draw_commands(MACHINE, 100, 3, 1)
    stacked, together = (option("actuator", "lag").build(MACHINE, 3, CPU) for _ in range(2))
    for spec in specs:
        stacked = spec.wrap(stacked, MACHINE, 3, CPU)
    together = library(1.0, *specs).wrap(together, MACHINE, 3, CPU)
    found, expected = (roll(model, MACHINE, u) for model in (together, stacked))
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-6)
    torch.testing.assert_close(together.measure(u[7]), stacked.measure(u[7]), rtol=0, atol=1e-6)
    assert together.sides == {"command", "speed", "joints", "measurement"}


def test_where_no_effect_is_there_nothing_changes() -> None:
    plain, inner = (option("actuator", "mlp").build(MACHINE, 3, CPU) for _ in range(2))
    model = replace(option("effect", "library"), share=0.0).wrap(inner, MACHINE, 3, CPU)
    u = draw_commands(MACHINE, 60, 3, 1)
    assert torch.equal(roll(model, MACHINE, u), roll(plain, MACHINE, u))
    assert torch.equal(model.measure(u[0]), u[0])


def test_each_effect_is_there_in_its_share_of_environments_independently_of_the_others() -> None:
    shipped = option("effect", "library")
    model = shipped.wrap(option("actuator", "ideal").build(MACHINE, 6000, CPU), MACHINE, 6000, CPU)
    there = {}
    for name, spec in shipped.effects.items():
        off = []
        for key, number in spec.numbers.items():
            if number.none is not None:
                off.append((model.parameters[f"{name}.{key}"] == number.none).all(1))
        there[name] = ~torch.stack(off).all(0)
    assert there.pop("dead_time").all()
    shares = torch.stack(list(there.values())).float()
    assert shares.mean(1).tolist() == pytest.approx([0.15] * len(there), abs=0.015)
    assert torch.corrcoef(shares).fill_diagonal_(0).abs().max() < 0.06
    gain = model.parameters["flow_gain.gain"][there["flow_gain"]]
    assert 0.85 <= gain.min() < 0.87 and 1.13 < gain.max() <= 1.15, "its range is drawn there"
    before = there["flow_gain"]
    model.reset(torch.arange(6000) < 3000)
    after = (model.parameters["flow_gain.gain"] != 1.0).all(1)
    assert torch.equal(after[3000:], before[3000:])
    assert (after[:3000] != before[:3000]).any(), "another machine"


def test_a_step_and_a_reset_ask_the_host_nothing_and_have_fixed_shapes() -> None:
    """Both would break the trace; a CUDA graph can hold what is left."""
    u = draw_commands(MACHINE, 20, 4, 1)
    torch.manual_seed(0)
    models = []
    for _ in range(2):
        inner = option("actuator", "lag").build(MACHINE, 4, CPU)
        models.append(option("effect", "library").wrap(inner, MACHINE, 4, CPU))
    plain, traced = models
    step = torch.compile(traced.step, backend="eager", fullgraph=True, dynamic=False)
    reset = torch.compile(traced.reset, backend="eager", fullgraph=True, dynamic=False)
    history = History(q=torch.zeros(4, 13, 5), u=torch.zeros(4, 13, 5))
    with torch.no_grad():
        for index, command in enumerate(u):
            history.push_u(command)
            assert torch.equal(plain.step(history), step(history))
            mask = torch.arange(4) == index % 8
            plain.reset(mask)
            reset(mask)
    assert all(torch.equal(value, plain.state[name]) for name, value in traced.state.items())


@pytest.mark.parametrize("shift_s", [-0.05, -0.02, 0.03, 0.05])
def test_the_dead_time_of_a_learned_model_moves_by_what_is_asked(shift_s: float) -> None:
    """Measured as from recordings of the machine; its resolution is 0.01 s."""
    found = []
    for added in (0.0, shift_s):
        model = option("actuator", "mlp").build(MACHINE, 4, CPU)
        model = library(1.0, fixed("dead_time", dead_time_s=added)).wrap(model, MACHINE, 4, CPU)
        levels = torch.rand(150, 4, 5, generator=torch.Generator().manual_seed(0)) * 1.4 - 0.7
        u = levels.repeat_interleave(8, 0) * (torch.arange(5) == 0)
        rows = zip(u.unbind(1), roll(model, MACHINE, u)[:-1].unbind(1), strict=True)
        recordings = [make_recording(MACHINE, one.numpy(), q.numpy()) for one, q in rows]
        delay = dead_time.estimate_dead_times(recordings, MACHINE, np.random.default_rng(0))["q1"]
        found.append(delay.value_s)
    assert found[1] - found[0] == pytest.approx(shift_s, abs=0.0101)


BESIDE = {"effects": {"link_length": option("effect", "link_length")}, "share": 0.1}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"share": 1.5}, "expected 0 to 1, got 1.5"),
        ({"share": {"backslash": 0.1, "other": 0.2}}, "did you mean 'backlash'"),
        (BESIDE, "acts on kinematics; put it beside the library"),
    ],
)
def test_what_makes_no_sense_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        replace(option("effect", "library"), **changes)
