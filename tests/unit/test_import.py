"""mode=import guesses the columns of a log, says how sure it is, and leaves the unsure to a person."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
from conftest import Done
from log_import import delay, import_log, make_draft, try_draft, write_csv

from actuators.recordings.guess import Guess
from actuators.recordings.log_draft import MACHINE_TEMPLATE, MAP_TEMPLATE
from actuators.recordings.name_evidence import read_column_name

pytestmark = pytest.mark.usefixtures("empty_folder")
RATE_HZ = 50.0
LAG = 6


def read_guesses(*options: str) -> dict[str, Guess]:
    draft = make_draft("log.input=a.csv", *options)
    return {guess.subject: guess for guess in draft.list_guesses()}


def draft_file(template: str, *options: str) -> dict[str, Any]:
    return yaml.safe_load(make_draft("log.input=a.csv", *options).format(template))


def make_targets(num: int = 1500) -> np.ndarray:
    """Returns targets of three joints that move on their own, `(T, 3)` rad."""
    t_s = np.arange(num)[:, None] / RATE_HZ
    return 0.4 * np.sin(t_s * [0.9, 1.7, 2.6]) + 0.2 * np.sin(t_s * [2.3, 0.6, 1.1])


def make_valve(levels: list[float], back: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns times, commands that are held for half a second, and the positions that they move to."""
    commands = np.repeat(np.random.default_rng(0).choice(levels, 60), 25)
    t_s = np.arange(len(commands)) / RATE_HZ
    return t_s, commands, np.cumsum(delay(commands, 4) - back) / RATE_HZ * 0.1


def write_servo_log(path: Path, swapped: bool = False) -> None:
    targets = make_targets()
    positions = delay(targets, LAG)[:, [1, 0, 2]] if swapped else delay(targets, LAG)
    columns = {"time_ms": np.arange(len(targets)) * 1000.0 / RATE_HZ}
    for j, name in enumerate(("hip", "knee", "foot")):
        columns[f"{name}_target"] = targets[:, j]
        columns[f"{name}_pos_rad"] = positions[:, j]
        columns[f"{name}_torque"] = np.sin(targets[:, j])
    write_csv(path, columns)


def test_servo_logs_go_from_the_file_to_recordings_in_two_commands(
    brokk: Callable[..., Done],
) -> None:
    write_servo_log(Path("logs/a.csv"))
    done = brokk("mode=import", "log.input=logs", "log.name=leg", "session.out=leg")
    assert done.code == 0, done.err
    content = json.loads((Path("leg") / "import.json").read_text())["guesses"]
    guesses = {guess["subject"]: guess for guess in content}
    assert {guess["sureness"] for guess in guesses.values()} <= {"sure", "likely"}
    assert guesses["knee: columns"]["value"] == "knee_target → knee_pos_rad"
    assert guesses["knee: command"]["value"] == "a target of the position"
    assert guesses["time"]["sureness"] == "sure"
    assert (Path("leg") / "import.png").stat().st_size > 1000
    options = ("machine=@leg/machine.yaml", "import=@leg/column_map.yaml", "convert.input=logs")
    done = brokk("mode=convert", *options, "session.out=out")
    assert done.code == 0, done.err
    drafted = yaml.safe_load(Path("leg/machine.yaml").read_text())
    assert [joint["name"] for joint in drafted["joints"]] == ["hip", "knee", "foot"]
    assert drafted["period_s"] == pytest.approx(1 / RATE_HZ)
    assert drafted["dead_time_s"] == pytest.approx(LAG / RATE_HZ, abs=0.021)
    (path,) = Path("out/recordings").iterdir()
    table = pq.read_table(path)
    # the command is the target itself: -1 and 1 are the ends of the travel
    assert {joint["command"] for joint in drafted["joints"]} == {"position"}
    low, high = (drafted["joints"][1][end]["value"] for end in ("lower", "upper"))
    target = low + (high - low) * (table["u_knee"].to_numpy() + 1.0) / 2.0
    np.testing.assert_allclose(target, make_targets()[:, 1], atol=1e-6)


def test_columns_that_share_no_names_are_paired_by_their_numbers() -> None:
    rows = make_targets()
    commands, speeds = np.tanh(3 * rows), np.cumsum(delay(np.tanh(3 * rows), LAG), 0) / RATE_HZ
    columns = {"t": np.arange(len(rows)) / RATE_HZ}
    for j in range(3):
        columns[f"valve{j}"] = commands[:, j]
    for j, k in enumerate((1, 2, 0)):
        columns[f"angle_{'abc'[j]}_deg"] = 57.3 * speeds[:, k]
    write_csv(Path("a.csv"), columns)
    guesses = read_guesses()
    for j, k in enumerate((1, 2, 0)):
        guess = guesses[f"{'abc'[j]}: columns"]
        assert guess.value == f"valve{k} → angle_{'abc'[j]}_deg"
        assert guess.sureness == "likely"


def test_columns_whose_numbers_contradict_their_names_are_left_to_a_person() -> None:
    write_servo_log(Path("a.csv"), swapped=True)
    assert "guesses are unsure: fill in ???" in try_draft("log.input=a.csv").out
    guesses = read_guesses()
    assert {guesses[f"{name}: columns"].sureness for name in ("hip", "knee")} == {"unsure"}
    assert draft_file(MAP_TEMPLATE)["joints"]["hip"]["command"] == "???"


def test_a_unit_that_nothing_tells_is_left_to_a_person_or_given(brokk: Callable[..., Done]) -> None:
    targets = make_targets()
    columns = {"t_s": np.arange(len(targets)) / RATE_HZ, "u": targets[:, 0]}
    columns["q"] = 100 + 60 * np.cumsum(targets[:, 0]) / RATE_HZ
    write_csv(Path("a.csv"), columns)
    assert read_guesses()["joint: unit"].sureness == "unsure"
    (joint,) = draft_file(MACHINE_TEMPLATE)["joints"]
    assert {joint[name]["value"] for name in ("lower", "upper", "max_speed")} == {"???"}
    counts = draft_file(MAP_TEMPLATE, "log.position_unit=0.5 cm")
    assert counts["joints"]["joint"]["position"]["scale"] == 0.005
    assert read_guesses("log.position_unit=cm")["joint: unit"].sureness == "sure"
    assert draft_file(MACHINE_TEMPLATE, "log.position_unit=cm")["joints"][0]["kind"] == "slide"
    assert read_guesses("log.position_unit={joint: mm}")["joint: unit"].value == "mm"
    done = brokk(
        "mode=import", "log.input=a.csv", "log.position_unit=furlong", "session.out=three", code=2
    )
    assert done.code == 2 and "unknown unit 'furlong'" in done.err


@pytest.mark.parametrize("sign", [1, -1])
def test_valve_commands_get_neutral_full_and_sign_from_the_logs(sign: int) -> None:
    t_s, levels, q = make_valve([0.0, 0.0, 0.6, -0.5, 1.0, -1.0])
    pwm = 7.5 + 2.5 * sign * levels
    write_csv(Path("a.csv"), {"Time": 12.0 + t_s, "Boom Cmd": pwm, "Boom Ms": q})
    command = draft_file(MAP_TEMPLATE)["joints"]["boom"]["command"]
    expected = {"neutral": 7.5, "full_plus": 7.5 + 2.5 * sign, "full_minus": 7.5 - 2.5 * sign}
    assert {key: command[key] for key in expected} == pytest.approx(expected)


def test_joints_that_are_never_commanded_are_left_out_and_said() -> None:
    targets = make_targets()
    columns = {"t": np.arange(len(targets)) / RATE_HZ}
    columns |= {"target_a": targets[:, 0], "q_a": delay(targets, LAG)[:, 0]}
    columns |= dict.fromkeys(("target_b", "q_b"), np.full(len(targets), 0.5))
    write_csv(Path("a.csv"), columns)
    assert "b is left out: its command never changes" in try_draft("log.input=a.csv").out
    assert list(draft_file(MAP_TEMPLATE)["joints"]) == ["a"]


def test_columns_that_no_name_tells_are_given_with_the_torque_that_they_set(
    brokk: Callable[..., Done],
) -> None:
    t_s = np.arange(500) / RATE_HZ
    volts = 5.0 * np.sin(2.0 * t_s) + np.where(t_s > 5, 3.0, 0.0)
    q = np.cumsum(np.cumsum(volts)) / RATE_HZ**2 / 10.0
    write_csv(Path("a.csv"), {"t": t_s, "q": q, "vir": volts})
    refused = try_draft("log.input=a.csv").err
    assert "no column is named like commands" in refused and "vir" in refused
    assert "log.joints={boom" in refused
    refused = try_draft("log.input=a.csv", "log.joints={slide: [vir, qm]}").err
    assert "'qm' is missing" in refused and "did you mean 'q'?" in refused
    given = ("log.joints={slide: [vir, q]}", "log.command=torque", "log.position_unit=m")
    done = brokk("mode=import", "log.input=a.csv", *given, "session.out=draft")
    assert done.code == 0, done.err
    options = (
        "machine=@draft/machine.yaml",
        "import=@draft/column_map.yaml",
        "convert.input=a.csv",
    )
    done = brokk("mode=convert", *options, "session.out=out", code=2)
    assert done.code == 2 and "max_force.value has no value: fill in ???" in done.err
    machine = Path("draft/machine.yaml")
    machine.write_text(machine.read_text().replace('value: "???"', "value: 40.0"))
    done = brokk("mode=convert", *options, "session.out=out")
    assert done.code == 0, done.err
    assert "actuator=force actuator.mass_kg=" in done.out
    (path,) = Path("out/recordings").iterdir()
    u = pq.read_table(path)["u_slide"].to_numpy()
    np.testing.assert_allclose(u, volts[: len(u)] / np.abs(volts).max(), atol=1e-4)


@pytest.mark.parametrize(
    ("table", "column", "expected"),
    [
        ("", "Boom Cmd", ("command", "unknown", None, "boom")),
        ("", "action[shoulder_pan.pos]", ("command", "position", None, "shoulder_pan")),
        ("control", "positions[3]", ("command", "position", None, "3")),
        ("/joint_states", "position[left_knee]", ("measured", "position", None, "left_knee")),
        ("", "u_q2", ("command", "unknown", None, "q2")),
        ("", "enc_u_rad", ("measured", "position", "rad", "")),
        ("", "AxisSetPos2[deg]", ("command", "position", "deg", "2")),
        ("", "cmd_left_rad_s", ("command", "velocity", None, "left")),
        ("", "A3_soll", ("command", "position", None, "a3")),
        ("", "jointVelocity_mm", (None, "velocity", "mm", "")),
    ],
)
def test_names_are_read_as_words(table: str, column: str, expected: tuple[str | None, ...]) -> None:
    name = read_column_name(table, column)
    assert (name.role, name.quantity, name.unit, name.joint) == expected


def test_rows_that_lack_a_number_are_left_out_and_counted(caplog: pytest.LogCaptureFixture) -> None:
    targets = make_targets()
    positions = delay(targets, LAG)[:, 0].copy()
    positions[[7, 900]] = np.nan
    columns = {"t": np.arange(len(targets)) / RATE_HZ, "hip_cmd": targets[:, 0]}
    write_csv(Path("a.csv"), columns | {"hip_pos_rad": positions})
    _, (recording,) = import_log("log.input=a.csv", "log.damaged=skip")
    assert "column 'hip_pos_rad': 2 of 1500 rows lack a number and are left out" in caplog.text
    np.testing.assert_allclose(recording["q_hip_rad"], delay(targets, LAG)[:, 0], atol=2e-3)


def test_actions_that_are_scaled_and_added_to_a_pose_are_targets_in_another_unit() -> None:
    targets = make_targets()
    actions = (targets - [0.1, 0.8, -1.5]) / 0.25
    elapsed = (np.arange(len(targets)) * 1e9 / RATE_HZ).astype("timedelta64[ns]")
    stamps = np.datetime64("2026-11-27", "ns") + elapsed
    np.savez("a.npz", time=stamps, actions=actions, dof_pos=delay(targets, LAG))
    draft = make_draft("log.input=a.npz")
    guesses = {guess.subject: guess for guess in draft.list_guesses()}
    assert guesses["joint_1: command"].value == "a target of the position"
    assert guesses["joint_1: unit of targets"].value == "0.25 × target + 0.8"
    text = draft.format(MAP_TEMPLATE)
    assert text.count('scale: "???", full_speed: null, offset: "???"') == 3


def test_a_position_that_leads_its_target_is_left_to_a_person() -> None:
    targets = make_targets()
    columns = {"t": np.arange(len(targets)) / RATE_HZ}
    columns |= {"hip_target": delay(targets, LAG)[:, 0], "hip_pos_rad": targets[:, 0]}
    write_csv(Path("a.csv"), columns)
    guess = read_guesses()["hip: columns"]
    assert guess.sureness == "unsure"
    assert "the position leads it by 0.12 s: columns swapped, or clocks apart?" in guess.reason


def test_files_of_one_run_in_a_folder_keep_their_clocks_and_a_given_offset() -> None:
    targets = make_targets()
    t_s = np.arange(len(targets)) / RATE_HZ
    for run in ("one", "two"):
        goals = {"stamp": t_s[::5], "hip.goal": targets[::5, 0]}  # slower than the states
        write_csv(Path(f"logs/{run}/goals.csv"), goals)
        states = {"stamp": t_s + 3600.0, "hip.pos_rad": delay(targets, LAG)[:, 0]}
        write_csv(Path(f"logs/{run}/states.csv"), states)
    offset = "log.clock_offset_s={states: -3600}"
    assert f"if they began together, give '{offset}'" in try_draft("log.input=logs").err
    _, recordings = import_log("log.input=logs", offset)
    found = recordings[0]["q_hip_rad"]
    np.testing.assert_allclose(found, delay(targets, LAG)[: len(found), 0], atol=1e-5)


def test_speeds_in_rad_per_second_count_alike_both_ways() -> None:
    generator = np.random.default_rng(0)
    speeds = np.repeat(generator.uniform(-3.0, 5.0, 60), 25)
    columns = {"t_s": np.arange(len(speeds)) / RATE_HZ, "cmd_left_rad_s": speeds}
    columns["ticks_left"] = np.cumsum(delay(speeds, 4)) / RATE_HZ / 0.00153
    write_csv(Path("a.csv"), columns)
    unit = "log.position_unit=0.00153 rad"
    full = speeds.max()
    command = draft_file(MAP_TEMPLATE, unit)["joints"]["left"]["command"]
    assert [command["full_plus"], command["full_minus"]] == pytest.approx([full, -full])
    (joint,) = draft_file(MACHINE_TEMPLATE, unit)["joints"]
    assert joint["max_speed"]["value"] == pytest.approx(full, rel=1e-4)
