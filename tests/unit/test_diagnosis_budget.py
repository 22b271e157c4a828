"""Millimetres at the tool, errors of geometry, stages and probes, against what was planted or worked out by hand."""

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
from diagnosis.probes import probe_residuals
from diagnosis.stages import (
    TARGET_COLUMNS,
    StageEvidence,
    TipErrorBudget,
    assess_perception,
    attribute_to_stages,
    estimate_sensor_noise,
    measure_tip_error,
    select_stage,
)
from diagnosis.where import locate_gap

PERIOD_S, DELAY = 0.05, 11
DEAD_TIME_S = np.full(5, DELAY * PERIOD_S)


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


def scaled(joint: int, factor: float):
    return lambda speed, _: speed * np.where(np.arange(5) == joint, factor, 1.0)


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
    assert found.joint_rms_m["q1"] == pytest.approx(0.01 * np.hypot(x, y), rel=1e-3)
    assert found.joint_part["q1"] == pytest.approx(1.0) and found.joint_rms_m["q3"] == 0.0


def test_joints_share_the_tip_error_and_those_that_cancel_count_below_zero(
    machine: Machine,
) -> None:
    still = replace(recording(machine, 0), q=np.tile(machine.home, (1800, 1)))
    quiet = runs(machine, [still])
    error = np.array([0.0, 0.010, -0.004, 0.0, 0.0])
    found = measure_tip_error(replace(quiet, simulated=quiet.simulated + error), machine)
    assert sum(found.joint_part.values()) == pytest.approx(1.0)
    assert found.joint_part["q3"] < 0.0 < 1.0 < found.joint_part["q2"]
    plain = TipErrorBudget(found, None, None, {"kinematics": 0.002}).plain()
    assert plain["before"]["tip_rms_mm"] == pytest.approx(1e3 * found.tip_rms_m)
    assert plain["after"] is None and plain["stages_mm"] == {"kinematics": 2.0}


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


def extending(speed: np.ndarray, _: Recording) -> np.ndarray:
    """q5 is simulated 9 % too fast extending and too slow retracting."""
    return speed * np.where(np.arange(5) == 4, np.where(speed > 0, 1.2, 1.0) / 1.1, 1.0)


def alone(speed: np.ndarray, r: Recording) -> np.ndarray:
    """q1 is simulated 25 % too fast while others move."""
    others = np.abs(np.roll(r.u, DELAY, 0)[:, 1:]).max(1) > 0
    return speed * np.where((np.arange(5) == 0) & others[:, None], 1.25, 1.0)


def early(speed: np.ndarray, _: Recording) -> np.ndarray:
    """q3 is simulated 0.1 s too early."""
    return np.where(np.arange(5) == 2, np.roll(speed, -2, 0), speed)


@pytest.mark.parametrize(
    ("effect", "joint", "value", "change"),
    [
        ("flow_gain", "q4", 0.2 / 1.2, scaled(3, 1.2)),
        ("dead_time", "q3", 0.10, early),
        ("asymmetry", "q5", 0.09, extending),
        ("flow_sharing", "q1", 0.2, alone),
    ],
)
def test_the_probe_of_what_was_planted_stands_out(
    machine: Machine, effect: str, joint: str, value: float, change
) -> None:
    field = [recording(machine, seed) for seed in range(3)]
    reference = [recording(machine, seed) for seed in range(10, 16)]
    rng = np.random.default_rng(0)

    def shaken(run: WindowedRuns) -> WindowedRuns:
        return replace(
            run, simulated=run.simulated + 1e-4 * rng.standard_normal(run.simulated.shape).cumsum(1)
        )

    found = probe_residuals(
        shaken(runs(machine, field, change)), shaken(runs(machine, reference)), machine, DEAD_TIME_S
    )
    assert found[0].joint == joint
    (probe,) = (probe for probe in found if (probe.effect, probe.joint) == (effect, joint))
    assert probe.is_clear and probe.value == pytest.approx(value, rel=0.15)
    assert probe.text.startswith(joint)


def test_the_stage_is_where_the_error_was_planted(machine: Machine) -> None:
    field = [recording(machine, seed) for seed in range(4)]
    reference = runs(machine, [recording(machine, seed) for seed in range(10, 18)])
    rng = np.random.default_rng(0)

    def found(run: WindowedRuns) -> tuple[str | None, dict[str, float | None]]:
        mine, other = (
            replace(
                r, simulated=r.simulated + 1e-4 * rng.standard_normal(r.simulated.shape).cumsum(1)
            )
            for r in (run, reference)
        )
        location = locate_gap(mine, other, machine, DEAD_TIME_S, np.random.default_rng(0))
        known = StageEvidence(
            location,
            probe_residuals(mine, other, machine, DEAD_TIME_S),
            TipErrorBudget(measure_tip_error(mine, machine), None, None, {}),
            None,
            None,
        )
        rows = attribute_to_stages(known, mine, other, machine)
        return select_stage(rows, location.has_gap), {row.stage: row.part for row in rows}

    gain, parts = found(runs(machine, field, scaled(3, 1.2)))
    assert gain == "actuation" and sum(part or 0.0 for part in parts.values()) == pytest.approx(1.0)
    assert found(runs(machine, field, lambda v, _: np.roll(v, -3, 0)))[0] == "timing"
    noisy = [replace(r, q=r.q + 0.004 * rng.standard_normal(r.q.shape)) for r in field]
    quiet = runs(machine, field)
    start = np.stack(
        [
            noisy[s].q[k - 1] - field[s].q[k - 1]
            for s, k in zip(quiet.source, quiet.row, strict=True)
        ]
    )[:, None]
    assert (
        found(replace(quiet, recordings=noisy, simulated=quiet.simulated + start))[0] == "sensing"
    )
    assert found(runs(machine, field))[0] is None


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


def test_a_biased_encoder_is_a_matter_of_kinematics_only_where_tool_points_were_measured(
    machine: Machine,
) -> None:
    sound = runs(machine, [recording(machine, 0), recording(machine, 1)])
    location = locate_gap(sound, None, machine, DEAD_TIME_S, np.random.default_rng(0))

    def stage(bias_rad: float) -> tuple[str | None, float | None]:
        shapes = []
        for bias in (bias_rad, 0.0):
            moved = recording(machine, 0)
            tip = (
                Kinematics(machine)
                .pose(torch.as_tensor(moved.q, dtype=torch.float32))
                .tip_in_base_m.numpy()
            )
            tip = tip + 0.002 * np.random.default_rng(0).standard_normal(tip.shape)
            biased = replace(
                moved,
                q=moved.q + bias * (np.arange(5) == 2),
                extra=dict(zip(TOOL_COLUMNS, tip.T, strict=True)),
            )
            shapes.append(compare_tool_points([biased], machine))
        found = attribute_to_stages(
            StageEvidence(location, [], None, shapes[0], shapes[1]), sound, None, machine
        )
        return select_stage(found, False), next(
            row.rms_m for row in found if row.stage == "kinematics"
        )

    assert stage(0.0) == (None, 0.0)
    name, rms_m = stage(0.02)
    assert name == "kinematics" and rms_m is not None and 0.02 < rms_m < 0.1


def test_starts_that_vary_and_stops_that_ring_are_seen_on_the_joint_that_does(
    machine: Machine,
) -> None:
    rng = np.random.default_rng(0)

    def shaken(r: Recording) -> Recording:
        u, q = r.u.astype(float), r.q + 2e-4 * rng.standard_normal(r.q.shape)
        moved = np.zeros_like(q)
        edge, late = np.flatnonzero(np.diff(u[:, 0])) + 1, 0
        for begin, end in zip(edge, [*edge[1:], len(u)], strict=True):
            late = int(rng.integers(0, 5))
            moved[min(begin + DELAY + late, len(u)) : min(end + DELAY, len(u)), 0] = (
                0.2 * u[begin, 0] * machine.max_speed[0] * PERIOD_S
            )
        q[:, 0] = machine.home[0] + np.cumsum(moved[:, 0]) + 2e-4 * rng.standard_normal(len(u))
        for stop in np.flatnonzero((np.diff(np.abs(u[:, 3]) > 0) > 0) & (u[:-1, 3] != 0)):
            tail = np.arange(len(u) - stop - 1 - DELAY)
            q[stop + 1 + DELAY :, 3] += 0.01 * np.exp(-tail / 8.0) * np.sin(tail * 1.2)
        return replace(r, q=q)

    field = [recording(machine, seed) for seed in range(4)]
    rows = probe_residuals(
        replace(runs(machine, field), recordings=[shaken(r) for r in field]),
        runs(
            machine,
            [
                replace(r, q=r.q + 2e-4 * rng.standard_normal(r.q.shape))
                for r in map(recording, [machine] * 6, range(10, 16))
            ],
        ),
        machine,
        DEAD_TIME_S,
    )
    for effect, joint in (("delay_jitter", "q1"), ("compliance", "q4")):
        first = max((row for row in rows if row.effect == effect), key=lambda row: row.z)
        assert first.joint == joint and first.is_clear, first
