"""Fits on a GPU: the captured update is the update, and the result is that of a CPU."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from composed import option

from actuators.identify import network_fit
from actuators.identify.network_fit import FreeRunOptimizer
from actuators.identify.training_data import TrainingWindows
from actuators.models import checkpoint
from actuators.models.network import JointNetworks
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.rl.execution import capture_graph

pytestmark = pytest.mark.gpu


def recording(machine: Machine, seed: int) -> Recording:
    """Returns two minutes of joints that follow their commands after 0.5 s."""
    generator = np.random.default_rng(seed)
    u = np.repeat(generator.uniform(-1.0, 1.0, (120, machine.num_joints)), 20, 0)
    q = machine.home + 0.005 * np.cumsum(
        np.vstack([np.zeros((10, machine.num_joints)), u])[: len(u)], 0
    )
    q = q + 3e-4 * generator.standard_normal(q.shape)
    return Recording(
        machine=machine.name, joints=machine.joint_names, units=("rad",) * machine.num_joints, rate_hz=20.0,
        t_s=np.arange(len(u)) * 0.05, u=u.astype(np.float32), q=q.astype(np.float32),
    )  # fmt: skip


@pytest.mark.parametrize("horizon", [1, 20])
def test_a_captured_update_is_the_update(
    horizon: int, machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    def as_it_is(step: Callable[[], None], device: torch.device, gradients: bool = False) -> Any:
        return SimpleNamespace(replay=torch.enable_grad()(step))

    found = []
    for captured in (True, False):
        with monkeypatch.context() as patch:
            if not captured:
                patch.setattr(network_fit, capture_graph.__name__, as_it_is)
            networks = JointNetworks(5, 13, 32, torch.Generator().manual_seed(0))
            networks.increment_scale.fill_(0.01)
            at_work = FreeRunOptimizer(networks.cuda(), machine, 3)
            update = at_work.updater(
                TrainingWindows([recording(machine, 0)], machine, horizon, torch.device("cuda")),
                32,
                0.2,
            )
            assert all(
                (value == 0).all()
                for name, value in at_work.state().items()
                if name.startswith("adam")
            )
            for number in range(10):
                at_work.steer(number, 0.003, 0.9)
                update()
            found.append({name: value.clone() for name, value in at_work.state().items()})
    for name, value in found[0].items():
        torch.testing.assert_close(
            value,
            found[1][name],
            atol=2e-5,
            rtol=2e-3,
            msg=lambda text, name=name: f"{name}: {text}",
        )
    assert not torch.equal(found[0]["networks.weight.0"], found[0]["averaged.weight.0"])


def test_a_fit_on_the_gpu_is_as_good_as_on_the_cpu(machine: Machine, tmp_path: Path) -> None:
    config = dataclasses.replace(
        option("fit", "mlp"),
        one_step_updates=200,
        one_step_batch=256,
        horizons_s=(0.5, 1.0),
        updates=100,
        batch=32,
        validate_every=50,
    )
    train, validation = [recording(machine, seed) for seed in range(3)], [recording(machine, 9)]
    error = []
    for device in ("cpu", "cuda"):
        config.fit(machine, train, validation, tmp_path / device, 0, torch.device(device))
        _, header = checkpoint.read_checkpoint(
            tmp_path / device / "mlp.safetensors", "mlp", machine
        )
        error.append(np.array(list(header["fit"]["validation_rmse"].values())))
    assert error[1] == pytest.approx(error[0], rel=0.25)
