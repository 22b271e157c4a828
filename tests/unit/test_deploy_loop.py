"""The parts of the loop without its processes: what they share, what the policy remembers, what is shown, and which bundle is
refused."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import subprocess
import sys
import time
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from composed import MACHINE, option
from conftest import Note
from hypothesis import given, settings
from hypothesis import strategies as st

from brokk_rl.errors import CheckpointError, ConfigError
from brokk_rl.kinematics import Kinematics
from brokk_rl.sim.scene import make_nominal_scenes
from deploy.bus.can_bus import CanBus
from deploy.guidance import AXES, LeverDisplay, LeverMap
from deploy.policy.bundle import PolicyBundle
from deploy.runtime.process import CycleTimer
from deploy.runtime.process_group import BusAndPolicySettings
from deploy.runtime.shared_memory import Pipe, Slot
from deploy.runtime.target import FileTarget
from tasks.settings import find_tool_direction

SHIPPED = "tasks:policies/borehole_insertion"
FIELDS = np.dtype([("a", float), ("b", float, (3,))])


def test_a_slot_gives_the_newest_record_whole() -> None:
    slot = Slot("test", FIELDS)
    assert slot.read() is None
    for number in range(1, 6):
        record = slot.new()
        record["a"], record["b"] = number, number
        slot.write(record)
        found = slot.read()
        assert found is not None and found["a"] == number and (found["b"] == number).all()
    slot.memory.close()


def test_a_writer_killed_in_the_middle_leaves_the_record_before_it() -> None:
    slot = Slot("test", FIELDS)
    for number in (1.0, 2.0):
        record = slot.new()
        record["a"] = number
        slot.write(record)
    at = 8 + slot._stride * (3 % 2)
    # the third record was begun, its number never written
    slot.memory.bytes[at : at + 8] = b"torn ..."
    found = slot.read()
    assert found is not None and found["a"] == 2.0
    slot.memory.close()


@settings(max_examples=50, deadline=None)
@given(st.lists(st.lists(st.binary(max_size=40), max_size=5), max_size=20))
def test_a_pipe_keeps_order_and_drops_only_what_finds_no_room(rounds: list[list[bytes]]) -> None:
    pipe, dropped = Pipe("test", 128), 0
    for batch in rounds:
        kept = [one for one in batch if pipe.put(one)]
        dropped += len(batch) - len(kept)
        assert list(pipe.take()) == kept and pipe.waiting == 0
    assert pipe.dropped == dropped
    pipe.memory.close()


def test_a_deadline_that_was_missed_is_skipped_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [100.0]
    monkeypatch.setattr("deploy.runtime.process.time.monotonic", lambda: clock[0])
    pace = CycleTimer(0.05)
    for now_s, skipped, next_s in ((100.05, 0, 100.10), (100.11, 0, 100.15), (100.27, 2, 100.30)):
        clock[0] = now_s
        assert pace.begin() == skipped
        assert pace.next_s == pytest.approx(next_s)
    report = pace.report()
    assert report["cycles"] == 3
    assert report["missed"] == 2
    assert report["late_max_s"] == pytest.approx(0.12)


def test_levers_are_those_of_the_paper() -> None:
    levers = LeverMap(MACHINE)
    angles, button = levers.levers(np.array([0.1, 0.0, 0.3, 0.4, 0.5]))
    # Left q4, q1; right q3, q5.
    assert angles == pytest.approx([0.35 * 0.4, 0.35 * 0.1, 0.35 * 0.3, 0.35 * 0.5]) and not button
    angles, button = levers.levers(np.array([0.0, -0.6, 0.0, 0.0, 0.0]))
    # q2 on the right lever, with the button.
    assert angles == pytest.approx([0.0, 0.0, -0.21, 0.0]) and button


def test_hands_that_follow_exactly_give_the_command() -> None:
    levers, generator = LeverMap(MACHINE), np.random.default_rng(0)
    for alone in (True, False) * 20:
        command = np.where(MACHINE.is_exclusive == alone, generator.uniform(-1, 1, 5), 0.0)
        assert levers.command(*levers.levers(command)) == pytest.approx(command)


def test_what_is_shown_changes_no_faster_than_a_hand_and_passes_neutral_before_the_button() -> None:
    display = LeverDisplay(option("guidance", "machine"), MACHINE)
    before, shown = np.zeros(4), []
    for u in [np.array([0, 0, 1.0, 0, 0])] * 6 + [np.array([0, 1.0, 0, 0, 0])] * 12:
        one = display.show(u, MACHINE.period_s)
        assert np.abs(one.angles_rad - before).max() <= 2.0 * MACHINE.period_s + 1e-12
        before = one.angles_rad
        shown.append((round(one.angles_rad[2], 3), one.button_right))
    assert shown[3] == (0.35, False) and shown[-1] == (0.35, True)
    first = next(k for k, (_, button) in enumerate(shown) if button)
    assert shown[first - 1] == (0.0, False)


def test_a_small_command_is_shown_as_neutral() -> None:
    display = LeverDisplay(option("guidance", "machine"), MACHINE)
    assert not display.show(np.array([0.02, 0, -0.02, 0, 0]), 1.0).angles_rad.any()


def test_levers_that_do_not_do_are_refused() -> None:
    with pytest.raises(ConfigError, match="no lever for q5"):
        LeverMap(replace(MACHINE, levers=MACHINE.levers[:-1]))
    both = tuple(replace(lever, side="left", axis="psi") for lever in MACHINE.levers)
    with pytest.raises(ConfigError, match="share"):
        LeverMap(replace(MACHINE, levers=both))
    assert len(AXES) == 4


def test_commands_that_come_too_seldom_for_the_guard_are_refused_before_anything_starts() -> None:
    asked = BusAndPolicySettings(
        wire=CanBus(interface="virtual", channel="none", bitrate=None, port=None, hops=None),
        dbc="deploy:dbc/example_gateway.dbc",
        limits=option("guard", "default"),
        guidance=option("guidance", "machine"),
        policy=SHIPPED,
        target=option("target", "given"),
        realtime=False,
    )
    asked.check_machine(MACHINE)
    with pytest.raises(ConfigError, match=r"guard\.request_s: expected more than"):
        asked.check_machine(replace(MACHINE, period_s=0.1))


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    folder = Path(__file__).parents[2] / "tasks/policies/borehole_insertion"
    for name in ("policy.onnx", "policy.json", "golden.json"):
        shutil.copy(folder / name, tmp_path / name)
    return tmp_path


def change(folder: Path, name: str, **values: Any) -> None:
    path = folder / name
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


def test_the_shipped_policy_acts_here_as_where_it_was_made() -> None:
    bundle = PolicyBundle(SHIPPED, MACHINE)
    policy = Path(__file__).parents[2] / "tasks/policies/borehole_insertion"
    golden = json.loads((policy / "golden.json").read_text())
    found = bundle.command(np.array(golden["observation"], np.float32))
    assert np.abs(found - np.array(golden["command"])).max() < 1e-3 and np.abs(found).max() > 0.5


@pytest.mark.parametrize("name", ["borehole_insertion", "slanted", "goal_pose"])
def test_a_policy_is_done_where_its_task_says_so(copied: Path, name: str) -> None:
    task: Any = option("task", name)
    change(copied, "policy.json", stop={"success": task.describe_success()})
    bundle, generator = PolicyBundle(str(copied), MACHINE), np.random.default_rng(1)
    pose = Kinematics(MACHINE).pose(torch.tensor(MACHINE.home, dtype=torch.float32)[None])
    told, outcomes = None, set()
    for _ in range(200):
        pitch_rad = torch.tensor([math.pi / 2])
        if name != "borehole_insertion":
            pitch_rad = pose.pitch_rad + 0.1 * generator.uniform(-1.0, 1.0)
            told = float(pitch_rad)
        axis = find_tool_direction(pose.tip_in_base_m, pitch_rad).numpy()[0]
        depth_m = generator.uniform(0.05, 0.15) if name != "goal_pose" else 0.0
        off_m = generator.uniform(-0.015, 0.015, 3) - depth_m * axis
        target_m = pose.tip_in_base_m.numpy()[0] + off_m
        start = {"target_m": torch.tensor(target_m, dtype=torch.float32)[None]}
        start |= {"target_pitch_rad": pitch_rad, "scene": make_nominal_scenes(1)}
        judged = task.judge(pose.tip_in_base_m, pose.pitch_rad, torch.zeros(1), start)
        assert bundle.is_done(np.array(MACHINE.home), target_m, told) == bool(judged.reached)
        outcomes.add(bool(judged.reached))
    assert outcomes == {True, False}


def test_a_bundle_for_another_machine_joint_order_history_or_rate_is_refused(copied: Path) -> None:
    others = {
        "joints": replace(MACHINE, joints=MACHINE.joints[::-1]),
        "control": replace(MACHINE, num_history=14),
        "name": replace(MACHINE, name="other"),
    }
    for field, other in others.items():
        with pytest.raises(CheckpointError, match=field):
            PolicyBundle(str(copied), other)
    with pytest.raises(CheckpointError, match="control"):
        PolicyBundle(str(copied), replace(MACHINE, period_s=0.1, num_history=13))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"joints": ["q2", "q1", "q3", "q4", "q5"]}, "joints"),
        ({"rate_hz": 10.0}, "rate_hz"),
        ({"rate_hz": math.nan}, "rate_hz"),
        ({"exclusive": []}, "exclusive"),
        ({"schema": 9}, "schema"),
        ({"command": {"order": ["q1"], "masked": True}}, "masked commands"),
        ({"fingerprint": {}}, "another machine"),
        ({"observation": {}}, "."),
        ({"command": []}, "."),
        ({"task": [1]}, "."),
        ({"stop": None}, "."),
        ({"stop": {"success": {"largest_lateral_m": -1.0, "largest_roll_rad": 0.1}}}, "roll"),
        (
            {"stop": {"success": {"largest_lateral_m": math.nan}}},
            "a finite bound.*lateral.*got nan",
        ),
        ({"stop": {"success": {"least_depth_below_target_m": -math.inf}}}, "a finite bound.*-inf"),
    ],
    ids=str,
)
def test_a_contract_that_says_otherwise_is_refused(
    copied: Path, values: dict[str, Any], message: str
) -> None:
    change(copied, "policy.json", **values)
    with pytest.raises(CheckpointError, match=message):
        PolicyBundle(str(copied), MACHINE)


def test_a_policy_that_was_told_its_observations_otherwise_is_refused(copied: Path) -> None:
    observation = json.loads((copied / "policy.json").read_text())["observation"]
    observation["q"]["std"][0] *= 2
    change(copied, "policy.json", observation=observation)
    with pytest.raises(CheckpointError, match="'q'"):
        PolicyBundle(str(copied), MACHINE)


def test_a_bundle_that_is_mixed_damaged_or_incomplete_is_refused(copied: Path) -> None:
    golden = json.loads((copied / "golden.json").read_text())
    golden["command"][3][2] += 0.01
    (copied / "golden.json").write_text(json.dumps(golden))
    with pytest.raises(CheckpointError, match="answers"):
        PolicyBundle(str(copied), MACHINE)
    (copied / "golden.json").unlink()
    with pytest.raises(CheckpointError, match=r"golden\.json is missing"):
        PolicyBundle(str(copied), MACHINE)
    content = (copied / "policy.onnx").read_bytes()
    (copied / "policy.onnx").write_bytes(content[: len(content) // 2])
    with pytest.raises(CheckpointError, match=r"policy\.onnx cannot be read"):
        PolicyBundle(str(copied), MACHINE)
    with pytest.raises(CheckpointError, match=r"policy\.json is missing"):
        PolicyBundle("nowhere", MACHINE)


def write_network(folder: Path, kind: str) -> None:
    """Write the network as a newer onnx does, or with its weights in a file of their own."""
    network = onnx.load(folder / "policy.onnx")
    if kind == "newer format":
        network.ir_version = 99
    elif kind == "nested metadata":
        next(one for one in network.metadata_props if one.key == "brokk.task").value = "[" * 100_000
    if not kind.startswith("weights"):
        onnx.save(network, folder / "policy.onnx")
        return
    path, data = str(folder / "policy.onnx"), "policy.onnx.data"
    onnx.save(network, path, save_as_external_data=True, location=data, size_threshold=100)
    if kind == "weights left behind":
        (folder / data).unlink()


@pytest.mark.parametrize(
    "kind", ["newer format", "nested metadata", "weights left behind", "weights beside it"]
)
def test_networks_of_other_tools_work_or_are_refused(
    copied: Path, kind: str, record_property: Note
) -> None:
    write_network(copied, kind)
    runs = kind == "weights beside it"
    record_property(f"files: network with {kind}; answer", "runs" if runs else "refused")
    with nullcontext() if runs else pytest.raises(CheckpointError, match=r"policy\.onnx"):
        PolicyBundle(str(copied), MACHINE)


KINDS = ("pipe", "device", "folder", "huge", "nested", "wide", "list", "{}", "7")
NO_FILES = [("policy.json", kind) for kind in KINDS]
NO_FILES += [("golden.json", "wide"), ("golden.json", "pipe"), ("policy.onnx", "huge"), ("policy.onnx", "device")]  # fmt: skip


@pytest.mark.parametrize(("name", "kind"), NO_FILES)
def test_what_is_no_file_of_a_policy_is_refused_at_once(
    copied: Path, name: str, kind: str, record_property: Note
) -> None:
    path, begun_s = copied / name, time.monotonic()
    path.unlink()
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "folder":
        path.mkdir()
    elif kind == "huge":
        path.touch()
        os.truncate(path, 1 << 33)
    else:
        wide = '{"observation": [' + "[]," * 3_000_000 + "[]]}"
        path.write_text({"nested": "[" * 100_000, "wide": wide, "list": "[1, 2]"}.get(kind, kind))
    with pytest.raises(CheckpointError, match=f"{re.escape(name)}|the contract"):
        PolicyBundle(str(copied), MACHINE)
    refused_s = time.monotonic() - begun_s
    assert refused_s < 2.0
    record_property(f"files: {kind} in place of a policy's file; refused, s", round(refused_s, 2))


@pytest.mark.parametrize(
    "golden",
    [
        {"observation": [], "command": []},
        {"observation": "x", "command": 1},
        {"observation": [[0.0]], "command": [[0.0]]},
    ],
)
def test_golden_answers_that_are_none_are_refused(
    copied: Path, golden: dict[str, Any], record_property: Note
) -> None:
    record_property("files: golden answers that are none; answer", "refused")
    (copied / "golden.json").write_text(json.dumps(golden))
    with pytest.raises(CheckpointError, match=r"golden\.json"):
        PolicyBundle(str(copied), MACHINE)


@pytest.mark.parametrize("kind", ["pipe", "device", "nested", "large", "endless number"])
def test_a_target_file_that_is_none_is_refused_at_once(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "target.json"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "large":
        path.write_text(" " * (1 << 17))
    elif kind == "nested":
        path.write_text("[" * 60_000)
    else:
        path.write_text(f'{{"center_in_base_m": [1{"0" * 400}, 0, 0]}}')
    with pytest.raises(ConfigError, match="expected JSON with center_in_base_m"):
        FileTarget(path=str(path)).build().news([], None)


def test_a_borehole_file_is_read_when_it_changes_and_its_faults_are_named(tmp_path: Path) -> None:
    path = tmp_path / "target.json"
    target = FileTarget(path=str(path)).build()
    assert target.news([], None) is None
    path.write_text('{"center_in_base_m": [2.5, 0.1, 0.7]}')
    os.utime(path, ns=(time.time_ns() - 5 * 10**9,) * 2)
    first = target.news([], None)
    assert first.center_in_base_m.tolist() == [2.5, 0.1, 0.7]
    assert time.monotonic() - first.t_s == pytest.approx(5.0, abs=0.5)
    assert target.news([], None) is None
    path.write_text('{"center_in_base_m": [2.5, 0.1, 0.7], "std_m": NaN}')
    with pytest.raises(ConfigError, match="finite std_m"):
        target.news([], None)
    path.write_text('{"center": 1}')
    with pytest.raises(ConfigError, match="center_in_base_m"):
        target.news([], None)
    assert target.news([], None) is None  # said once


def test_a_study_and_the_link_need_no_torch_no_simulator_and_no_trainer() -> None:
    code = "import sys, deploy.link, study.modes.study; print({'torch', 'warp', 'mujoco', 'rsl_rl'} & sys.modules.keys())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
