"""The examiner's simulation, and a program that is interrupted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from composed import MACHINE, option
from motion import make_recording
from small_exam import run_model

from brokk_rl.errors import RecordingError
from brokk_rl.record import write_recording
from exam.examiner import ExaminerSimulator, compute_closed, read_effects
from exam.generate import CASES_FOLDER, UNCHANGED_FOLDER, WITHHELD_FOLDER


def record_lag(gain: float, seed: int, seconds: float, path: Path) -> None:
    """Writes a recording of joints that lag behind random levels, at a part of their speed."""
    levels = np.random.default_rng(seed).uniform(-0.7, 0.7, (round(seconds), MACHINE.num_joints))
    u = np.repeat(levels, 20, 0).astype(np.float32)
    lag = replace(option("actuator", "lag"), gain=gain)
    q = run_model(lag.build(MACHINE, 1, torch.device("cpu")), MACHINE, u)
    write_recording(make_recording(MACHINE, u, q, f"{seed}"), path)


@pytest.fixture(scope="module")
def slow_case(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An exam of one case: all joints at 0.6 of their speed."""
    out = tmp_path_factory.mktemp("examined")
    case, hidden = out / CASES_FOLDER / "0000", out / WITHHELD_FOLDER / "0000"
    for seed in (0, 1):
        record_lag(1.0, seed, 60.0, case / "reference" / f"{seed}.parquet")
    record_lag(0.6, 2, 20.0, case / "field" / "0.parquet")
    record_lag(0.6, 3, 30.0, hidden / "0.parquet")
    record_lag(1.0, 3, 30.0, hidden / UNCHANGED_FOLDER / "0.parquet")
    return out


def test_the_examiner_believes_its_own_simulation(slow_case: Path, tmp_path: Path) -> None:
    simulator = ExaminerSimulator(slow_case, "0000", option("fit", "valve"), MACHINE)
    path = tmp_path / "effects.yaml"

    def write(gain: float) -> dict[str, Any]:
        path.write_text(
            "# @package effect\nflow_gain:\n  _target_: actuators.effects.speed.FlowGain\n"
            f"  joints: all\n  gain: {gain}\n"
        )
        return read_effects(path, MACHINE)

    nothing = simulator.examine({})
    right, half, wrong = (
        dict[str, Any](simulator.examine(write(gain))) for gain in (0.6, 0.8, 1.4)
    )
    assert nothing["after"] == nothing["before"] and nothing["closed"] == 0.0
    # an effect that changes nothing runs as none does, warm-up included
    assert simulator.examine(write(1.0))["after"] == pytest.approx(nothing["before"], rel=1e-4)
    assert nothing["before"] > 1.5 * nothing["floor"], "a joint at 0.6 of its speed is seen"
    assert right["closed"] > 0.8 > half["closed"] > 0.2
    assert wrong["closed"] < 0.0


def test_an_effects_file_brings_no_targets_of_its_own(tmp_path: Path) -> None:
    path = tmp_path / "effects.yaml"
    for text in (
        "lag: {_target_: os.system, command: ls}\n",
        "made_up: {_target_: actuators.effects.speed.Lag, joints: all, time_constant_s: 0.1}\n",
        "lag: {_target_: actuators.effects.speed.Lag, joints: all}\n",
        "[1, 2]\n",
    ):
        path.write_text(text)
        with pytest.raises(RecordingError, match="no effects of the library"):
            read_effects(path, MACHINE)
    path.write_text("# @package effect\n# none: no gap\n")
    assert read_effects(path, MACHINE) == {}


def test_the_closed_share_is_that_worked_by_hand() -> None:
    assert compute_closed(3.0, 2.0, 1.0) == pytest.approx(0.5)  # (3 - 2) / (3 - 1)
    assert compute_closed(1.04, 1.0, 1.0) is None
