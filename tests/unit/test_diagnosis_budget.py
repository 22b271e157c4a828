"""Errors at the tool and of geometry, against what was planted or worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis.free_runs import WindowedRuns
from diagnosis.geometry import TOOL_COLUMNS, compare_tool_points
from diagnosis.sensors import estimate_sensor_noise
from diagnosis.survey import TARGET_COLUMNS, assess_kinematics, assess_perception, measure_tip_error

PERIOD_S, DELAY = 0.05, 11


def recording(
    machine: Machine, seed: int, seconds: float = 90.0, u: np.ndarray | None = None
) -> Recording:
    """Returns a recording of all joints but q2 moving at random levels."""
    rng, steps = np.random.default_rng(seed), round(seconds / PERIOD_S)
    if u is None:
        u = np.zeros((steps, 5))
        for begin in range(0, steps, 30):
            u[begin : begin + 30] = (
                rng.choice([-0.9, -0.5, -0.2, 0.0, 0.2, 0.5, 0.9], 5)
                * [1, 0, 1, 1, 1]
                * (rng.random(5) < 0.4)
            )
    moved = np.zeros((steps, 5))
    moved[DELAY:] = 0.2 * u[:-DELAY] * machine.max_speed * PERIOD_S
    q = machine.home + np.cumsum(moved, 0)
    return Recording(
        machine="brokk170", joints=machine.joint_names, units=("rad",) * 5, rate_hz=20.0,
        t_s=np.arange(steps) * PERIOD_S, u=u.astype(np.float32), q=q, metadata={"run": str(seed)},
    )  # fmt: skip


def runs(
    machine: Machine, recordings: list[Recording], change=lambda speed, r: speed
) -> WindowedRuns:
    """Returns free runs of 5 s whose simulated speed is `change` of the measured one, `(T, J)`."""
    row = np.concatenate([np.arange(40, r.num_samples - 99, 100) for r in recordings])
    source = np.concatenate(
        [np.full(len(np.arange(40, r.num_samples - 99, 100)), n) for n, r in enumerate(recordings)]
    )
    empty = WindowedRuns(recordings, source, row, np.zeros((len(row), 100, 5)))
    speed = empty.cut([change(np.diff(r.q, axis=0, prepend=r.q[:1]), r) for r in recordings])
    start = np.stack([recordings[s].q[k - 1] for s, k in zip(source, row, strict=True)])
    return replace(empty, simulated=start[:, None] + np.cumsum(speed, 1))


def test_a_slewing_error_moves_the_tip_along_its_circle(machine: Machine) -> None:
    still = replace(recording(machine, 0), q=np.tile(machine.home, (1800, 1)))
    quiet = runs(machine, [still])
    turned = replace(quiet, simulated=quiet.simulated + np.array([0.01, 0.0, 0.0, 0.0, 0.0]))
    x, y, _ = (
        Kinematics(machine)
        .pose(torch.tensor(machine.home, dtype=torch.float32))
        .tip_in_base_m.tolist()
    )
    found = measure_tip_error(turned, machine)
    # A chord.
    assert found.tip_rms_m == pytest.approx(2.0 * np.sin(0.005) * np.hypot(x, y), rel=1e-3)
    assert found.joint_part["q1"] == pytest.approx(1.0)


def test_joints_share_the_tip_error_and_those_that_cancel_count_below_zero(
    machine: Machine,
) -> None:
    still = replace(recording(machine, 0), q=np.tile(machine.home, (1800, 1)))
    quiet = runs(machine, [still])
    error = np.array([0.0, 0.010, -0.004, 0.0, 0.0])
    found = measure_tip_error(replace(quiet, simulated=quiet.simulated + error), machine)
    assert sum(found.joint_part.values()) == pytest.approx(1.0)
    assert found.joint_part["q3"] < 0.0 < 1.0 < found.joint_part["q2"]


@pytest.mark.parametrize(
    ("cause", "size", "change"),
    [
        ("encoder_bias q3", 0.02, lambda q: q + 0.02 * (np.arange(5) == 2)),
        ("encoder_scale q4", 0.03, lambda q: q * np.where(np.arange(5) == 3, 1.03, 1.0)),
    ],
)
def test_an_error_of_geometry_is_named_with_its_size(
    machine: Machine, cause: str, size: float, change
) -> None:
    moved = recording(machine, 0)
    tip = (
        Kinematics(machine)
        .pose(torch.as_tensor(moved.q, dtype=torch.float32))
        .tip_in_base_m.numpy()
    )
    tip = tip + 0.0005 * np.random.default_rng(0).standard_normal(tip.shape)
    extra = dict(zip(TOOL_COLUMNS, tip.T, strict=True))
    sound = compare_tool_points([replace(moved, extra=extra)], machine)
    assert sound is not None and sound.rms_m == pytest.approx(0.0005 * np.sqrt(3.0), rel=0.05)
    found = compare_tool_points([replace(moved, q=change(moved.q), extra=extra)], machine)
    assert (
        found is not None and found.cause == cause and found.size == pytest.approx(size, rel=0.03)
    )
    assert found.explained > 0.95
    assert compare_tool_points([moved], machine) is None


def test_the_noise_of_a_sensor_is_told_from_its_motion(machine: Machine) -> None:
    moved = recording(machine, 0)
    noisy = replace(
        moved,
        q=moved.q
        + np.array([0.0003, 0.001, 0.002, 0.0, 0.004])
        * np.random.default_rng(0).standard_normal((1800, 5)),
    )
    assert estimate_sensor_noise([noisy])[[0, 1, 2, 4]] == pytest.approx(
        [0.0003, 0.001, 0.002, 0.004], rel=0.15
    )
    assert estimate_sensor_noise([moved]).max() < 1e-6


def test_touches_are_held_against_the_estimated_hole(machine: Machine) -> None:
    still = recording(machine, 0)
    tip = (
        Kinematics(machine)
        .pose(torch.as_tensor(still.q, dtype=torch.float32))
        .tip_in_base_m.numpy()
    )
    force = np.zeros(1800)
    force[[300, 301, 302, 900, 901]] = 1000.0
    extra = dict(zip(TARGET_COLUMNS, (tip + np.array([0.03, 0.04, 0.0])).T, strict=True)) | {
        "force_n": force
    }
    found = assess_perception([replace(still, extra=extra)], machine)
    assert (
        found is not None
        and found.rms_m == pytest.approx(0.05, rel=1e-3)
        and "2 touches" in found.text
    )
    assert assess_perception([still], machine) is None


@pytest.mark.parametrize(("bias_rad", "low_m", "high_m"), [(0.0, 0.0, 0.0), (0.02, 0.02, 0.1)])
def test_a_biased_encoder_shows_at_measured_tool_points(
    machine: Machine, bias_rad: float, low_m: float, high_m: float
) -> None:
    moved, seen = recording(machine, 0), []
    pose = Kinematics(machine).pose(torch.as_tensor(moved.q, dtype=torch.float32))
    noise_m = 0.002 * np.random.default_rng(0).standard_normal((1800, 3))
    extra = dict(zip(TOOL_COLUMNS, (pose.tip_in_base_m.numpy() + noise_m).T, strict=True))
    for bias in (bias_rad, 0.0):
        shown = moved.q + bias * (np.arange(5) == 2)
        seen.append(compare_tool_points([replace(moved, q=shown, extra=extra)], machine))
    found = assess_kinematics(*seen)
    assert found is not None and found.stage == "kinematics"
    assert low_m <= found.rms_m <= high_m
