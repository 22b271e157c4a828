"""Each kind of finding is planted in a sound recording and found where it was put; a sound recording has none."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pyarrow.parquet as pq
import pytest
from composed import option
from motion import make_recording

from actuators.identify.request import Identification
from actuators.modes.inspect import InspectionRequest
from actuators.recordings.inspection import RecordingFinding, _RecordingScan, inspect_recording
from brokk_rl import record
from brokk_rl.commands import scale_targets
from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording

PERIOD_S = 0.05
DELAY = 11
"""Periods of dead time."""
NOISE = 0.0003


def sound(machine: Machine, seconds: float = 60.0) -> Recording:
    """Returns a recording of q3 going to and fro at half speed with rests, all joints with the noise of their sensors."""
    steps = round(seconds / PERIOD_S)
    u = np.zeros((steps, 5))
    u[:, 2] = np.repeat([0.0, 0.5, 0.0, -0.5], 80)[np.arange(steps) % 320]
    moved = np.zeros((steps, 5))
    moved[DELAY:] = u[:-DELAY] * machine.max_speed * PERIOD_S
    noise = NOISE * np.random.default_rng(0).standard_normal((steps, 5))
    q = machine.home + np.cumsum(moved, 0) + noise
    told = {"run": "sound", "created": "2026-11-20T10:00:00.000+00:00"}
    return make_recording(machine, u, q, metadata=told)


def found(recording: Recording, machine: Machine) -> list[RecordingFinding]:
    return inspect_recording(recording, machine).findings


def test_its_figures_are_those_it_was_made_with(machine: Machine) -> None:
    seen = inspect_recording(sound(machine), machine)
    assert seen.timing["rate_hz"] == pytest.approx(20.0)
    assert seen.timing["jitter_s"] == pytest.approx(0.0, abs=1e-9)
    joint = seen.joints["q3"]
    assert joint["commanded"] == pytest.approx(0.5, abs=0.05)
    assert joint["fastest"] == pytest.approx(0.5 * machine.max_speed[2], rel=0.03)
    assert joint["noise"] == pytest.approx(NOISE, rel=0.1)
    assert joint["step"] is None
    assert seen.joints["q1"]["commanded"] == 0.0


def test_the_step_of_a_coarse_sensor_is_found_and_is_no_freeze(machine: Machine) -> None:
    whole = sound(machine)
    rests = whole.q.copy()
    rests[:, 2] = 0.15 * np.clip(np.arange(len(rests)) * PERIOD_S - 20.5, 0.0, 2.0) ** 2
    for q, step in ((whole.q, 0.004), (rests, 0.006)):
        coarse = replace(whole, q=np.round(q / step) * step)
        seen = inspect_recording(coarse, machine)
        assert seen.joints["q3"]["step"] == pytest.approx(step, rel=0.01)
        assert "frozen sensor" not in [finding.kind for finding in seen.findings]
    assert inspect_recording(replace(whole, q=rests), machine).joints["q3"]["step"] is None


Arrays = tuple[np.ndarray, np.ndarray, Machine]


def ignore_command(arrays: Arrays) -> None:
    arrays[0][200:280, 3] = 0.8


def press_at_stop(arrays: Arrays) -> None:
    u, q, machine = arrays
    u[200:280, 3] = 0.8
    q[:, 3] = np.minimum(q[:, 3] + machine.upper[3] - machine.home[3], machine.upper[3])


def sink(arrays: Arrays) -> None:
    arrays[1][:, 1] += 0.002 * PERIOD_S * np.arange(len(arrays[1]))


def freeze_moving(arrays: Arrays) -> None:
    arrays[1][120:126, 2] = arrays[1][119, 2]


def freeze_resting(arrays: Arrays) -> None:
    arrays[1][500:520, 0] = arrays[1][499, 0]


def coarsen(arrays: Arrays) -> None:
    _, q, machine = arrays
    q[:] = np.round((q - machine.home) / 0.004) * 0.004 + machine.home


def lose_frames(arrays: Arrays) -> None:
    for row in (110, 111):
        arrays[1][row] = arrays[1][row - 1]


def leave_limits(arrays: Arrays) -> None:
    _, q, machine = arrays
    q[:, 4] += machine.upper[4] + 0.05 - machine.home[4]


def command_together(arrays: Arrays) -> None:
    arrays[0][100:120, 1] = 0.2  # q2 while q3 is commanded


@pytest.mark.parametrize(
    ("change", "expected", "text"),
    [
        (lambda arrays: None, [], ""),
        # told from where the joint should long have moved: dead time and 0.3 s later
        (ignore_command, [("command without motion", "q4", 217, 63)], "commanded +0.80, does not move"),
        (press_at_stop, [], ""),
        (sink, [("motion without command", "q2", 17, 1183)], "+0.002 rad/s"),
        (freeze_moving, [("frozen sensor", "q3", 119, 7)], "7 equal samples, then a jump of 0.04"),  # 7 periods at 0.13 rad/s
        (freeze_resting, [("frozen sensor", "q1", 499, 21)], "21 equal samples of a sensor with noise"),
        (coarsen, [], ""),
        (lose_frames, [("frozen sensor", "q3", 109, 3), ("lost frames", None, 110, 2)], ""),
        (leave_limits, [("beyond limit", "q5", 0, 1200)], "up to 0.05"),
        (command_together, [("exclusive joint", "q2", 100, 20)], "together with another joint"),
    ],
)  # fmt: skip
def test_what_is_planted_is_found_where_it_was_put_and_nothing_else(
    machine: Machine, change: Callable[[Arrays], None], expected: list[tuple[Any, ...]], text: str
) -> None:
    whole = sound(machine)
    u, q = whole.u.copy(), whole.q.copy()
    change((u, q, machine))
    findings = found(replace(whole, u=u, q=q), machine)
    assert [(f.kind, f.joint, f.row, f.num_rows) for f in findings] == expected
    assert all(text in finding.text for finding in findings)


def test_a_servo_that_follows_a_slow_target_is_no_finding_one_that_leaves_it_is() -> None:
    arm = option("machine", "so101")
    t_s = arm.period_s * np.arange(1000)
    q = np.tile(arm.home, (len(t_s), 1))
    # a hundredth of full speed for ten seconds, then a hold
    q[:, 2] += 0.01 * arm.max_speed[2] * np.minimum(t_s, 10.0)
    u = scale_targets(q, arm)
    q += NOISE * np.random.default_rng(0).standard_normal(q.shape)
    follows = make_recording(arm, u, q)
    assert found(follows, arm) == []
    q[700:, 2] -= 0.05 * np.minimum(np.arange(300) / 20, 1.0)  # the arm is pushed away
    (finding,) = found(replace(follows, q=q.astype(np.float32)), arm)
    assert (finding.kind, finding.joint) == ("motion without command", "elbow")


@pytest.mark.parametrize(
    ("period_s", "kept", "is_found"), [(0.02, 1.0, False), (5.0, 1.0, False), (0.02, 0.0, True)]
)
def test_a_servo_that_sags_or_is_slow_obeys_and_one_that_is_off_does_not(
    period_s: float, kept: float, is_found: bool
) -> None:
    arm = option("machine", "so101")
    t_s = period_s * np.arange(1500)
    travel = arm.upper[2] - arm.lower[2]
    # targets that wander, with steps; the joint sags by 0.15 of its travel and answers late
    wave = 0.3 * np.sin(0.01 * np.arange(1500)) + 0.1 * np.sign(np.sin(0.03 * np.arange(1500)))
    late = np.convolve(wave, np.ones(3) / 3.0)[: len(wave)]
    late[500:1000] = kept * late[500:1000] + (1.0 - kept) * late[500]
    targets = np.tile(arm.home, (len(t_s), 1))
    q = targets.copy()
    targets[:, 2], q[:, 2] = arm.home[2] + travel * wave, arm.home[2] + travel * (late - 0.15)
    q += NOISE * np.random.default_rng(0).standard_normal(q.shape)
    log = make_recording(arm, scale_targets(targets, arm), q, rate_hz=1.0 / period_s, t_s=t_s)
    named = [one for one in found(log, arm) if one.kind == "does not obey"]
    assert bool(named) == is_found
    assert all(one.joint == "elbow" and one.row >= 495 for one in named)


def test_inspect_from_the_command_lists_every_breach_and_fails_at_none_in_one_look_at_each_file(
    brokk: Callable[..., object], machine: Machine, tmp_path: Path
) -> None:
    record.write_recording(sound(machine), tmp_path / "a.parquet")
    record.write_recording(replace(sound(machine), metadata={}), tmp_path / "b.parquet")
    table = pq.read_table(tmp_path / "b.parquet")
    u = table.column("u_q2").to_numpy().copy()
    u[[5, 6, 90]] = 1.5
    table = table.set_column(table.column_names.index("u_q2"), "u_q2", [u]).drop_columns("q_q5_rad")
    pq.write_table(table, tmp_path / "b.parquet")
    (tmp_path / "c.parquet").write_bytes((tmp_path / "a.parquet").read_bytes()[:-300])
    real = _RecordingScan.find_all
    with patch.object(_RecordingScan, "find_all", autospec=True, side_effect=real) as look:
        done = brokk("mode=inspect", "inspect.recordings=*.parquet", "session.out=out")
    assert done.code == 0, done.err
    assert look.call_count == 2  # the third file is truncated
    for told in (
        "b.parquet: column 'q_q5_rad' is missing", "b.parquet: row 5, column 'u_q2': command 1.5 lies outside [-1, 1] (2 such rows",
        "b.parquet: row 90, column 'u_q2'", "c.parquet: truncated",
    ):  # fmt: skip
        assert told in done.out, told
    result = json.loads(Path("out/inspection.json").read_text())
    assert [len(entry["breaches"]) for entry in result["recordings"]] == [0, 3, 1]
    assert result["recordings"][0]["findings"] == []
    assert result["recordings"][0]["run"] == "sound"
    assert result["joints"]["q3"]["noise"] == pytest.approx(NOISE, rel=0.1)
    page = Path("out/inspection.html").read_text()
    assert "2 break the format" in page
    for name in ("a", "b"):
        assert Path(f"out/{name}.png").stat().st_size > 1000


IDENTIFICATION = {"test": None, "folds": None, "hold_out": 6, "stride_s": 2.0}


@pytest.mark.parametrize(
    ("kind", "numbers"), [(InspectionRequest, {"pictures": 0}), (Identification, IDENTIFICATION)]
)
def test_recordings_that_match_nothing_are_refused_before_anything_is_loaded(
    kind: Callable[..., object], numbers: dict[str, Any]
) -> None:
    with pytest.raises(RecordingError, match="no recording matches nowhere"):
        kind(recordings="nowhere/*.parquet", **numbers)
