"""`group=@<path>`: a file is an option, and nothing more than one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from conftest import Brokk

import conf

LAG = """# A fitted actuator.
_target_: actuators.models.lag.FirstOrderLag
dead_time_s: {q1: 0.5, other: 0.45}
dead_band_extend: 0.1
dead_band_retract: 0.1
gain: 1.0
time_constant_s: 0.02
"""
EFFECTS = """stiction: {_target_: actuators.effects.command.Stiction, joints: [q3], start: 0.14, stop: 0.1}
backlash: {_target_: actuators.effects.speed.Backlash, joints: [q3], gap_rad: 0.031}
"""
BOMB = "a0: &a0 [1, 1]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 60))
MERGED = "a0: &a0 {x: 1}\n" + "".join(
    f"a{i}: &a{i}\n  <<: [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 60)
)


def composed(brokk: Brokk, *overrides: str) -> dict[str, Any]:
    """Returns what the command would run with."""
    done = brokk(*overrides, "--cfg", "job")
    return yaml.safe_load(done.out)


@pytest.mark.parametrize(
    "name", ["lag.yaml", "fits of today/lag.yaml", "../above/lag.yaml", "no_ending"]
)
def test_a_file_is_an_option_of_its_group(name: str, brokk: Brokk, tmp_path: Path) -> None:
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(LAG)
    assert composed(brokk, "mode=train", f"actuator=@{name}")["actuator"] == yaml.safe_load(LAG)
    changed = composed(brokk, "mode=train", f"actuator=@{path}", "actuator.gain=0.9")
    assert changed["actuator"]["gain"] == 0.9


def test_a_file_may_hold_several_effects_and_stand_in_a_list(brokk: Brokk, tmp_path: Path) -> None:
    (tmp_path / "found, today.yaml").write_text(EFFECTS)
    gain = "_target_: actuators.effects.speed.FlowGain\njoints: all\ngain: [0.9, 1.1]\n"
    (tmp_path / "one.yaml").write_text(gain)
    words = ("mode=train", 'effect=["@found, today.yaml", lag, @one.yaml]')
    effect = composed(brokk, *words)["effect"]
    assert list(effect) == ["stiction", "backlash", "lag", "flow_gain"]
    assert effect["backlash"]["gap_rad"] == 0.031
    assert effect["flow_gain"]["gain"] == [0.9, 1.1]
    alone = composed(brokk, "mode=train", "effect='@found, today.yaml'")["effect"]
    assert list(alone) == ["stiction", "backlash"]


def test_a_file_replaces_a_part_of_another_option(brokk: Brokk, tmp_path: Path) -> None:
    shipped = yaml.safe_load((Path(conf.__file__).parent / "actuator" / "servo.yaml").read_text())
    (tmp_path / "own.yaml").write_text(yaml.safe_dump(shipped | {"top_speed": 2.0}))
    words = ("fit=servo", "actuator@fit.actuator=@own.yaml", "identify.recordings=x")
    fit = composed(brokk, "mode=identify", *words, "session.out=x")
    assert fit["fit"]["actuator"]["top_speed"] == 2.0


def test_an_experiment_may_be_a_file(brokk: Brokk, tmp_path: Path) -> None:
    text = "defaults: [override /task: goal_pose]\nsession: {seed: 7}\n"
    (tmp_path / "mine.yaml").write_text(text)
    cfg = composed(brokk, "mode=train", "experiment=@mine.yaml")
    assert cfg["session"]["seed"] == 7
    assert "goal_pose" in cfg["task"]["_target_"]


def test_a_sweep_takes_files_beside_options(
    brokk: Brokk, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "fits").mkdir()
    (tmp_path / "fits" / "lag.yaml").write_text(LAG)
    words = ("mode=bench", "actuator=ideal,@fits/lag.yaml", "bench.num_envs=[0]")
    brokk("-m", *words, "session.out=sweep", code=2)
    for job in (0, 1):  # each was composed, and refused for its size alone
        (message,) = (one for one in caplog.messages if one.startswith(f"job {job} failed"))
        assert "num_envs[0]: expected a number greater than or equal to 1, got 0" in message
    assert [path.name for path in (tmp_path / "sweep").iterdir()] == ["multirun.yaml"]


IDEAL = "_target_: actuators.models.lag.Ideal\n"


@pytest.mark.parametrize(
    ("group", "text", "told"),
    [
        ("actuator", "_target_: os.system\n", ("'_target_: os.system' is no actuator", "actuators.models.lag.FirstOrderLag")),
        ("effect", "backlash: {_target_: os.system}\n", ("'backlash._target_: os.system' is no effect",)),
        ("effect", "a: {_target_: actuators.effects.speed.Backlash, gap_rad: {_target_: os.getcwd}}\n", ("nothing of ours",)),
        ("actuator", IDEAL + "speed_scale: ${oc.env:HOME}\n", ("without interpolations", "${oc.env:HOME}")),
        ("actuator", IDEAL + "_partial_: true\n", ("'_partial_: True'", "settings of Hydra")),
        ("actuator", "# @package _global_\n" + IDEAL, ("lies outside 'actuator'",)),
        ("experiment", "hydra: {sweep: {dir: /}}\n", ("settings of Hydra",)),
        ("actuator", "", ("expected a mapping",)),
        ("machine", BOMB, ("expected at most 20000 values",)),
        ("guard", MERGED, ("expected at most 20000 values",)),
        ("actuator", "a: " + 5000 * "[" + 5000 * "]", ("no plain YAML",)),
        ("actuator", "a: &a\n  b: *a\n", ("recursive",)),
    ],
)  # fmt: skip
def test_a_file_that_does_more_than_name_values_is_refused(
    group: str, text: str, told: tuple[str, ...], brokk: Brokk, tmp_path: Path
) -> None:
    (tmp_path / "given.yaml").write_text(text)
    done = brokk("mode=train", f"{group}=@given.yaml", code=2)
    assert done.err.startswith(f"error: {group}=@given.yaml: ")
    for part in told:
        assert part in done.err
    assert [path.name for path in tmp_path.iterdir()] == ["given.yaml"]


def test_a_value_that_begins_with_an_at_sign_is_no_file(brokk: Brokk) -> None:
    cfg = composed(brokk, "mode=identify", "identify.recordings=@home/*.parquet", "session.out=x")
    assert cfg["identify"]["recordings"] == "@home/*.parquet"


def test_a_table_in_the_place_of_a_range_is_explained(brokk: Brokk) -> None:
    table = "{q1: [0.05, 0.1], other: 0.12}"
    words = ("mode=train", "effect=[stiction]")
    done = brokk(*words, f"effect.stiction.start={table}", code=2)
    assert "effect.stiction.start" in done.err and "A list and a table do not merge" in done.err
    anew = ("~effect.stiction.start", f"+effect.stiction.start={table}")
    effect = composed(brokk, *words, *anew)
    assert effect["effect"]["stiction"]["start"] == {"q1": [0.05, 0.1], "other": 0.12}


def test_a_file_may_name_the_classes_of_its_parts(brokk: Brokk, tmp_path: Path) -> None:
    text = (Path(conf.__file__).parent / "machine" / "mini_excavator.yaml").read_text()
    named = text.replace("lower: {", "lower: {_target_: brokk_rl.machine.Dimension, ")
    assert named != text
    (tmp_path / "arm.yaml").write_text(named)
    cfg = composed(brokk, "mode=check", "machine=@arm.yaml")
    assert cfg["machine"] == composed(brokk, "mode=check", "machine=mini_excavator")["machine"]
