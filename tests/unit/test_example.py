"""The example runs a policy from its folder alone: the same commands, tool point and endings."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from composed import MACHINE, option

from brokk_rl.kinematics import Kinematics
from brokk_rl.sim.scene import make_nominal_scenes

ROOT = Path(__file__).parents[2]
FILE = ROOT / "examples" / "run_policy.py"
POLICIES = ("borehole_insertion", "behind_a_person", "unidentified_machine")


@pytest.fixture(scope="module")
def example() -> Any:
    made = importlib.util.spec_from_file_location("run_policy", FILE)
    module = importlib.util.module_from_spec(made)
    made.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", POLICIES)
def test_it_gives_the_golden_answers(name: str, example: Any) -> None:
    folder = ROOT / "tasks" / "policies" / name
    assert example.compare_with_golden_answers(folder) < 1e-3
    golden = json.loads((folder / "golden.json").read_text())
    assert np.abs(golden["command"]).max() > 0.5, "answers that say something"
    policy = example.ExportedPolicy(folder)
    for i, expected in enumerate(golden["observation"]):
        one = {key: np.array(values[i]) for key, values in golden["inputs"].items()}
        found = policy.observe(one.pop("target_in_base_m"), **one)
        assert found == pytest.approx(np.array(expected), abs=1e-5)


def test_it_needs_neither_this_package_nor_torch(tmp_path: Path) -> None:
    program = (
        f"import sys; sys.argv = ['x', {str(ROOT / 'tasks/policies/borehole_insertion')!r}]\n"
        f"exec(compile(open({str(FILE)!r}).read(), 'run_policy.py', 'exec'))\n"
        "assert not {'torch', 'brokk_rl', 'hydra', 'mujoco'} & sys.modules.keys()"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert "largest difference of a command" in done.stdout


def test_its_history_fills_as_the_training_s_does(example: Any) -> None:
    policy = example.ExportedPolicy(ROOT / "tasks/policies/borehole_insertion")
    seen: list[Any] = []
    policy.observe = lambda target_m, q, u, *rest: seen.append((q, u)) or np.zeros(133)
    for i in range(15):
        policy.step(np.zeros(3), np.full(5, float(i)), np.full(5, -float(i)))
    assert (seen[0][0] == 0).all() and (seen[0][1] == 0).all()
    assert seen[2][0][:, 0].tolist() == [0.0] * 11 + [1.0, 2.0]
    assert seen[2][1][:, 0].tolist() == [0.0] * 11 + [-1.0, -2.0]
    assert seen[14][0][:, 0].tolist() == [float(i) for i in range(2, 15)]


def test_its_tool_point_is_that_of_the_kinematics(example: Any) -> None:
    policy = example.ExportedPolicy(ROOT / "tasks/policies/borehole_insertion")
    q = np.random.default_rng(0).uniform(MACHINE.lower, MACHINE.upper, (50, MACHINE.num_joints))
    pose = Kinematics(MACHINE).pose(torch.tensor(q, dtype=torch.float32))
    for row, tip_m, pitch_rad in zip(q, pose.tip_in_base_m, pose.pitch_rad, strict=True):
        found_m, found_rad = policy.locate_tip(row)
        assert found_m == pytest.approx(tip_m.numpy(), abs=1e-5)
        assert found_rad == pytest.approx(float(pitch_rad), abs=1e-5)


def test_it_ends_where_the_task_does(example: Any) -> None:
    """Random holes near the tool: success where the task's own judgement says so."""
    policy = example.ExportedPolicy(ROOT / "tasks/policies/borehole_insertion")
    task: Any = option("task", "borehole_insertion")
    q = MACHINE.home
    tip_m, _ = policy.locate_tip(q)
    generator = np.random.default_rng(1)
    outcomes = set()
    for _ in range(200):
        target_m = tip_m + generator.uniform((-0.015, -0.015, 0.05), (0.015, 0.015, 0.15))
        start = {"target_m": torch.tensor(target_m, dtype=torch.float32)[None]}
        start |= {"target_pitch_rad": torch.zeros(1), "scene": make_nominal_scenes(1)}
        tip = torch.tensor(tip_m, dtype=torch.float32)[None]
        expected = bool(task.judge(tip, torch.zeros(1), torch.zeros(1), start).reached)
        assert (policy.find_end(target_m, q, 0.0) == "success") == expected
        outcomes.add(expected)
    assert outcomes == {True, False}
    far_m = tip_m + 1.0
    assert policy.find_end(far_m, q, 19.9) is None and policy.find_end(far_m, q, 20.0) == "time"
    assert policy.find_end(far_m, MACHINE.upper - 0.009, 0.0) == "joint limit"
    assert policy.find_end(far_m, MACHINE.upper - 0.011, 0.0) is None
