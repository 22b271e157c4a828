"""A valve curve with a learned residual: what it adds, where it fades, and when it is left out."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from composed import option
from hydra.utils import instantiate

from actuators import open_loop
from actuators.identify.hybrid_fit import HybridFit, select_shares, select_unlike
from actuators.models import checkpoint
from actuators.models.hybrid import BOUND, HybridActuator, ResidualInputs, compute_residual
from brokk_rl.checks import check_actuator
from brokk_rl.errors import CheckpointError, ConfigError, RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording

CPU = torch.device("cpu")
COLUMNS = 7 + 3 + 1 + 5 * 5
"""Features of the residual on a machine with five joints."""


def make_tensors(leaf: float = 0.1, apart: float = 0.0, limit: float = 1.0) -> dict:
    """Returns two members of one tree a joint that answer `leaf ± apart` everywhere."""
    leaves = torch.tensor([leaf + apart, leaf - apart]).view(2, 1, 1, 1).expand(2, 5, 1, 2)
    return {
        "feature": torch.zeros(2, 5, 1, 1, dtype=torch.int32), "threshold": torch.zeros(2, 5, 1, 1),
        "leaf": leaves.clone(), "offset": torch.zeros(2, 5), "limit": torch.full((5,), limit),
        "low": torch.full((5, COLUMNS), -1.0), "high": torch.full((5, COLUMNS), 1.0), "share": torch.ones(5),
    }  # fmt: skip


def make_recordings(machine: Machine, num_runs: int = 4, samples: int = 900) -> list[Recording]:
    """Returns runs of a plant whose second joint is a fifth slower while the first is commanded."""
    found = []
    for n in range(num_runs):
        generator = np.random.default_rng(n)
        u = np.repeat(generator.uniform(-1.0, 1.0, (samples // 15, 5)), 15, 0)
        middle, half = (
            0.5 * (machine.lower + machine.upper),
            0.5 * (machine.upper - machine.lower),
        )
        q = np.zeros((samples, 5))
        q[0] = middle
        for k in range(samples - 1):
            acting = u[max(0, k - 11)].copy()
            u[k] = np.where(np.abs(q[k] - middle) > 0.7 * half, -np.sign(q[k] - middle), u[k])
            speed = 0.4 * machine.max_speed * acting
            speed[1] *= 0.8 if abs(acting[0]) > 0.3 else 1.0
            q[k + 1] = np.clip(q[k] + speed * 0.05, machine.lower, machine.upper)
        found.append(
            Recording(
                machine=machine.name, joints=machine.joint_names, units=("rad",) * 5, rate_hz=20.0,
                t_s=np.arange(samples) * 0.05, u=u.astype(np.float32), q=q.astype(np.float32),
                metadata={"run": f"run {n}"},
            )
        )  # fmt: skip
    return found


def tiny() -> HybridFit:
    fit = option("fit", "hybrid")
    curve = dataclasses.replace(
        fit.valve.actuator,
        knots=(0.0, 0.1, 1.0),
        curve_extend=(0.0, 0.1, 1.0),
        curve_retract=(0.0, 0.1, 1.0),
    )
    valve = dataclasses.replace(fit.valve, actuator=curve, sweeps=2, iterations=1)
    boosting = dataclasses.replace(fit.boosting, trees=20, depth=3)
    return dataclasses.replace(fit, valve=valve, members=2, boosting=boosting)


def test_the_residual_is_the_mean_of_the_members_where_they_agree() -> None:
    residual, spread = compute_residual(
        torch.zeros(5, 3, COLUMNS), torch.ones(3, 5), make_tensors()
    )
    torch.testing.assert_close(residual, torch.full((3, 5), 0.1))
    torch.testing.assert_close(spread, torch.zeros(3, 5))


def test_half_the_residual_is_left_at_the_limit_of_the_spread() -> None:
    tensors = make_tensors(leaf=0.1, apart=0.04, limit=0.04)
    residual, spread = compute_residual(torch.zeros(5, 1, COLUMNS), torch.ones(1, 5), tensors)
    torch.testing.assert_close(spread, torch.full((1, 5), 0.04))
    torch.testing.assert_close(residual, torch.full((1, 5), 0.05))


@pytest.mark.parametrize(
    ("value", "left"), [(1.0, 1.0), (1.1, 0.5), (1.2, 0.0), (9.0, 0.0), (-9.0, 0.0)]
)
def test_it_is_gone_outside_the_training_data(value: float, left: float) -> None:
    # a tenth of the range of 2 outside it, 0.2, ends the residual
    inputs = torch.zeros(5, 1, COLUMNS)
    inputs[:, :, 4] = value
    residual, _ = compute_residual(inputs, torch.ones(1, 5), make_tensors())
    torch.testing.assert_close(residual, torch.full((1, 5), 0.1 * left), atol=1e-6, rtol=0.0)


def test_a_joint_that_the_curve_keeps_at_rest_stays_and_no_residual_is_beyond_its_bound() -> None:
    step = torch.tensor([[0.0, 0.025, 0.05, 0.5, -0.5]])
    residual, _ = compute_residual(torch.zeros(5, 1, COLUMNS), step, make_tensors(leaf=9.0))
    torch.testing.assert_close(residual[0], BOUND * torch.tensor([0.0, 0.5, 1.0, 1.0, 1.0]))


def test_inputs_count_back_from_the_dead_time(machine: Machine) -> None:
    # 0.2 s at 20 Hz are 4 samples: the joint's own commands of 3 to 9 samples ago
    inputs = ResidualInputs(machine, torch.full((5,), 0.2), CPU)
    u = torch.arange(13.0)[None, :, None] + torch.arange(5.0) * 100
    q = torch.zeros(1, 13, 5)
    found = inputs.build(u, q, torch.full((1, 5), 0.5))
    assert found.shape == (5, 1, COLUMNS)
    assert found.shape[2] == len(inputs)
    assert found[1, 0, :7].tolist() == [109.0, 108.0, 107.0, 106.0, 105.0, 104.0, 103.0]
    assert found[1, 0, 7:11].tolist() == [0.0, 0.0, 0.0, 0.5]
    # commands of all joints 4, 6 and 9 samples ago
    assert found[1, 0, 11:16].tolist() == [8.0, 108.0, 208.0, 308.0, 408.0]


def test_a_share_has_to_be_worse_on_neither_kind() -> None:
    # joint 0 wins on both with all of it, joint 1 wins on its own kind only, joint 2 with half
    alike = np.array([[4.0, 4.0, 4.0], [3.5, 3.0, 3.0], [3.0, 2.0, 3.5]])
    unlike = np.array([[5.0, 5.0, 5.0], [4.8, 5.1, 4.0], [4.5, 6.0, 4.5]])
    assert select_shares(alike, unlike) == [1.0, 0.0, 0.5]


def test_the_run_of_another_kind_is_found(machine: Machine) -> None:
    runs = make_recordings(machine, 5, 300)
    runs[2] = dataclasses.replace(runs[2], u=0.1 * runs[2].u)  # pyright: ignore
    assert select_unlike(runs, machine)[0].run == "run 2"


@pytest.mark.slow
def test_a_coupling_that_the_curve_lacks_is_learned(machine: Machine, tmp_path: Path) -> None:
    runs = make_recordings(machine)
    unseen = make_recordings(machine, 5)[4:]
    fitted = tiny().fit(machine, runs[:3], runs[3:], tmp_path, 0, CPU)
    check_actuator(fitted, machine)
    cut = open_loop.cut_windows(unseen, machine, 5.0, 1.0)
    errors = []
    for actuator in (fitted, fitted.curve):
        error = open_loop.roll_out(actuator, machine, cut, CPU) - cut.measured
        errors.append(np.sqrt(np.mean(np.square(error[:, -1, 1]))))
    assert errors[0] < errors[1]
    used = instantiate(yaml.safe_load((tmp_path / "hybrid.yaml").read_text()), _convert_="all")
    torch.testing.assert_close(
        torch.as_tensor(open_loop.roll_out(used, machine, cut, CPU)),
        torch.as_tensor(open_loop.roll_out(fitted, machine, cut, CPU)),
    )


def test_a_residual_that_cannot_be_judged_is_left_out(
    machine: Machine, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    runs = make_recordings(machine, 2)
    fitted = tiny().fit(machine, runs, [], tmp_path, 0, CPU)
    assert "no residual, it cannot be judged" in caplog.text
    cut = open_loop.cut_windows(runs, machine, 2.0, 5.0)
    found, curve = (
        open_loop.roll_out(actuator, machine, cut, CPU) for actuator in (fitted, fitted.curve)
    )
    np.testing.assert_allclose(found, curve, atol=1e-6)


def test_too_little_data_and_bad_settings_are_refused(machine: Machine, tmp_path: Path) -> None:
    short = make_recordings(machine, 2, 30)
    with pytest.raises(RecordingError, match="too little data"):
        tiny().fit(machine, short, [], tmp_path, 0, CPU)
    with pytest.raises(ConfigError, match="members"):
        dataclasses.replace(tiny(), members=1)


def test_a_checkpoint_with_a_tensor_of_another_shape_is_refused(
    machine: Machine, tmp_path: Path
) -> None:
    path = tmp_path / "residual.safetensors"
    tensors = make_tensors() | {"limit": torch.ones(4)}
    checkpoint.write_checkpoint(path, "hybrid", machine, tensors, {})
    actuator = HybridActuator(curve=option("actuator", "valve"), checkpoint=str(path))
    with pytest.raises(CheckpointError, match="'limit' of shape"):
        actuator.build(machine, 2, CPU)
