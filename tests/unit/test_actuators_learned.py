"""The batched network against plain ones, its behaviour at rest, and checkpoints that must not be loaded."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest
import torch
from composed import MACHINE, option
from motion import rest
from safetensors.torch import load_file, save_file
from torch import nn

from actuators.models import checkpoint
from actuators.models.network import JointNetworks, Mlp, load_networks
from brokk_rl.errors import CheckpointError
from brokk_rl.history import History
from brokk_rl.machine import Machine

CPU = torch.device("cpu")


def bounds() -> tuple[torch.Tensor, torch.Tensor]:
    return torch.tensor(MACHINE.lower).float(), torch.tensor(MACHINE.upper).float()


def networks(seed: int = 0) -> JointNetworks:
    return JointNetworks(5, 13, 32, torch.Generator().manual_seed(seed))


def written(path: Path, machine: Machine, **tensors: torch.Tensor) -> Path:
    made = networks()
    weights = {**made.state_dict(), **tensors}
    checkpoint.write_checkpoint(path, "mlp", machine, weights, {"width": 32})
    return path


def test_one_batched_network_is_five_networks() -> None:
    batched = networks()
    inputs = torch.randn(5, 7, 26)
    together = batched(inputs)
    for joint in range(5):
        alone = nn.Sequential(
            nn.Linear(26, 32), nn.ReLU(), nn.Linear(32, 32), nn.ReLU(), nn.Linear(32, 1)
        )
        with torch.no_grad():
            for layer, weight, bias in zip(alone[::2], batched.weight, batched.bias, strict=True):
                layer.weight.copy_(weight[joint].T)
                layer.bias.copy_(bias[joint, 0])
        expected = alone(inputs[joint])[:, 0]
        torch.testing.assert_close(together[joint], expected, atol=1e-6, rtol=1e-5)


def test_inputs_are_commands_increments_and_the_newest_position() -> None:
    made = networks()
    made.increment_scale.fill_(0.01)
    made.position_center.fill_(0.5)
    made.position_scale.fill_(2.0)
    made.command_scale.fill_(0.5)
    q = 0.1 + 0.01 * torch.arange(13.0).expand(5, 1, 13)
    u = torch.full((5, 1, 13), 0.25)
    expected = torch.tensor([0.5] * 13 + [1.0] * 12 + [(0.1 + 0.12 - 0.5) / 2.0]).expand(5, 1, 26)
    torch.testing.assert_close(made.inputs(u, q), expected)


def test_a_free_run_in_one_go_is_step_by_step(tmp_path: Path) -> None:
    made = networks(3)
    made.increment_scale.fill_(0.01)
    lower, upper = bounds()
    generator = torch.Generator().manual_seed(1)
    u = torch.rand(5, 4, 12 + 30, generator=generator) * 2.0 - 1.0
    q = (0.03 * torch.rand(5, 4, 13, generator=generator)).cumsum(2) - 0.3
    path = made.roll_out(u, q, lower, upper)
    path_there = written(tmp_path / "a.safetensors", MACHINE, **made.state_dict())
    model = Mlp(checkpoint=str(path_there)).build(MACHINE, 4, CPU)
    before = u[..., :13].roll(1, 2)
    history = History(q=q.permute(1, 2, 0).clone(), u=before.permute(1, 2, 0).clone())
    for k in range(30):
        history.push_u(u[..., 12 + k].T)
        history.push_q(model.step(history))
        torch.testing.assert_close(history.q[:, -1].T, path[..., k], atol=2e-5, rtol=0)


def test_increments_below_the_noise_are_none() -> None:
    made = networks()
    made.quiet.fill_(0.001)
    output = torch.tensor([[-0.004, -0.0005, 0.0, 0.001, 0.003]]).expand(5, 5)
    expected = torch.tensor([-0.003, 0.0, 0.0, 0.0, 0.002])
    torch.testing.assert_close(made.increment(output)[0], expected)


def test_the_shipped_machine_at_rest_stays_at_rest() -> None:
    actuator, num_envs = option("actuator", "mlp"), 64
    generator = torch.Generator().manual_seed(0)
    lower, upper = bounds()
    q = lower + (upper - lower) * torch.rand(num_envs, 5, generator=generator)
    # Half of the smallest dead band of the plant; close to it the fit is a few mrad worse.
    for level in (0.0, 0.03, -0.03):
        model = actuator.build(MACHINE, num_envs, CPU)
        history = rest(MACHINE, q, num_envs)
        for _ in range(200):  # 10 s
            history.push_u(torch.full((num_envs, 5), level))
            history.push_q(model.step(history))
        assert (history.q[:, -1] - q).abs().max() < 0.002, f"command {level}"


def test_a_missing_checkpoint_names_what_ships() -> None:
    with pytest.raises(CheckpointError, match=r"nowhere\..*brokk170\..*mode=identify"):
        load_networks("nowhere.safetensors", MACHINE)


@pytest.mark.parametrize("keep", [0, 5, 200, -100])
def test_a_truncated_checkpoint_is_refused(tmp_path: Path, keep: int) -> None:
    path = written(tmp_path / "a.safetensors", MACHINE)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(CheckpointError, match=r"a\.safetensors: corrupt, truncated, or no"):
        load_networks(str(path), MACHINE)


def test_nan_weights_are_refused(tmp_path: Path) -> None:
    quiet = torch.tensor([0.0, 0.0, float("nan"), 0.0, 0.0])
    path = written(tmp_path / "a.safetensors", MACHINE, quiet=quiet)
    with pytest.raises(CheckpointError, match=r"tensor 'quiet' holds NaN"):
        load_networks(str(path), MACHINE)


def test_a_checkpoint_of_another_machine_names_what_differs(tmp_path: Path) -> None:
    other = dataclasses.replace(MACHINE, name="brokk400", period_s=0.06)
    with pytest.raises(CheckpointError, match="made for another machine: name, control differ"):
        load_networks(str(written(tmp_path / "a.safetensors", other)), MACHINE)


def test_tensors_of_another_network_are_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "a.safetensors", MACHINE)
    tensors = load_file(path)
    made = checkpoint.read_checkpoint(str(path), "mlp", MACHINE)[1]
    header = {"brokk": json.dumps(made | {"width": 16})}
    save_file(tensors, path, metadata=header)
    with pytest.raises(CheckpointError, match="do not fit the network"):
        load_networks(str(path), MACHINE)
