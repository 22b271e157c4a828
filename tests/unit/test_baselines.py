"""Hinge-ARX and boosting: features worked by hand, trees as scikit-learn has them."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from composed import option
from sklearn.ensemble import HistGradientBoostingRegressor

from actuators import open_loop
from actuators.identify.boosting_fit import BoostingFit, tabulate_trees
from actuators.models.hinge_arx import HingeArx, HingeArxFit, build_hinge_features
from actuators.models.trees import BoostedTrees, build_tree_features, evaluate_trees
from brokk_rl.checks import check_actuator
from brokk_rl.errors import CheckpointError, ConfigError, RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording

CPU = torch.device("cpu")


def make_recording(machine: Machine, num_samples: int = 800, band: float = 0.3) -> Recording:
    """Returns a machine that moves by 0.004 rad a period and unit of command beyond its dead band, five samples late."""
    generator = np.random.default_rng(0)
    u = np.repeat(generator.uniform(-1.0, 1.0, (num_samples // 10, 5)), 10, 0).astype(np.float32)
    opened = np.sign(u) * np.maximum(np.abs(u) - band, 0.0)
    steps = np.concatenate([np.zeros((5, 5)), 0.004 * opened[:-5]])
    middle = 0.5 * (machine.lower + machine.upper)
    q = middle + np.concatenate([np.zeros((1, 5)), np.cumsum(steps, 0)[:-1]])
    return Recording(
        machine=machine.name, joints=machine.joint_names, units=("rad",) * 5, rate_hz=20.0,
        t_s=np.arange(num_samples) * 0.05, u=u, q=q.astype(np.float32),
    )  # fmt: skip


def test_hinges_are_what_a_command_has_beyond_the_knee() -> None:
    u = torch.tensor([[[0.5], [-0.25]]])  # one environment, two samples, one joint
    q = torch.tensor([[[1.0], [1.5]]])
    found = build_hinge_features(u, q, torch.tensor([0.0, 0.2]))
    # knee 0 and 0.2 forth, then back, each over both samples; then the one increment
    expected = [0.5, 0.0, 0.3, 0.0, 0.0, 0.25, 0.0, 0.05, 0.5]
    torch.testing.assert_close(found[0, :, 0], torch.tensor(expected))


def test_a_dead_band_is_learned_by_hinges_and_not_by_a_line(
    machine: Machine, tmp_path: Path
) -> None:
    run = make_recording(machine)
    cut = open_loop.cut_windows([run], machine, 5.0, 1.0)
    errors = {}
    for name in ("arx", "hinge_arx"):
        fitted = option("fit", name).fit(machine, [run], [run], tmp_path, 0, CPU)
        errors[name] = np.abs(open_loop.roll_out(fitted, machine, cut, CPU) - cut.measured).max()
    assert errors["hinge_arx"] < 0.05 * errors["arx"]


def test_trees_answer_as_scikit_learn_does() -> None:
    generator = np.random.default_rng(0)
    x = generator.standard_normal((500, 3)).astype(np.float32)
    y = np.where(x[:, 0] > 0.3, x[:, 1], -x[:, 2])
    model = HistGradientBoostingRegressor(
        max_iter=7, max_depth=4, max_leaf_nodes=None, early_stopping=False
    ).fit(x, y)
    found = tabulate_trees(model, 4)
    tensors = {name: torch.as_tensor(value[None]) for name, value in found.items()}
    tensors["feature"] = tensors["feature"].long()
    new = generator.standard_normal((200, 3)).astype(np.float32)
    answered = evaluate_trees(torch.as_tensor(new)[None], **tensors)[:, 0]
    np.testing.assert_allclose(answered, model.predict(new), atol=1e-5)


def test_a_tree_worked_by_hand() -> None:
    # depth 2: x0 > 0 asks x1 > 5, else x1 > -5
    tensors = {
        "feature": torch.tensor([[[0, 1, 1]]]),
        "threshold": torch.tensor([[[0.0, -5.0, 5.0]]]),
        "leaf": torch.tensor([[[1.0, 2.0, 3.0, 4.0]]]),
        "offset": torch.tensor([10.0]),
    }
    features = torch.tensor([[[-1.0, -6.0], [0.0, 0.0], [1.0, 5.0], [1.0, 6.0]]])
    assert evaluate_trees(features, **tensors)[:, 0].tolist() == [11.0, 12.0, 13.0, 14.0]


def test_a_joint_of_the_trees_sees_all_commands_and_places() -> None:
    u = torch.arange(26.0).view(1, 13, 2)  # joint 0 even, joint 1 odd
    q = torch.tensor([0.0, 1.0]).repeat(1, 13, 1) * torch.arange(13.0)[:, None]
    found = build_tree_features(u, q, torch.tensor([[0.2, 0.8]]))
    assert found.shape == (2, 1, 13 + 12 + 3 * 2 + 2)
    assert found[1, 0, :13].tolist() == u[0, :, 1].tolist()
    assert found[1, 0, 13:25].tolist() == [1.0] * 12
    # 1, 3 and 6 samples back
    assert found[1, 0, 25:31].tolist() == [22.0, 23.0, 18.0, 19.0, 12.0, 13.0]
    torch.testing.assert_close(found[:, 0, 31:], torch.tensor([[0.2, 0.8]] * 2))


@pytest.mark.parametrize("name", ["hinge_arx", "boosting"])
def test_a_fitted_baseline_is_an_actuator(name: str, machine: Machine, tmp_path: Path) -> None:
    run = make_recording(machine)
    check_actuator(option("fit", name).fit(machine, [run], [run], tmp_path, 0, CPU), machine)


@pytest.mark.parametrize("name", ["hinge_arx", "boosting"])
def test_recordings_shorter_than_the_history_are_refused(
    name: str, machine: Machine, tmp_path: Path
) -> None:
    short = make_recording(machine, 10)
    with pytest.raises(RecordingError, match="too little data: none of 2 recordings"):
        option("fit", name).fit(machine, [short, short], [], tmp_path, 0, CPU)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: HingeArxFit(name="a", knees=(1.0,), ridges=(0.1,)), "knees"),
        (lambda: HingeArxFit(name="a", knees=(0.1,), ridges=(0.0,)), "ridges"),
        (
            lambda: BoostingFit(
                name="a", trees=1, depth=9, learning_rate=0.1, min_samples=1, max_rows=1
            ),
            "depth",
        ),
        (
            lambda: BoostingFit(
                name="a", trees=1, depth=3, learning_rate=0.0, min_samples=1, max_rows=1
            ),
            "learning_rate",
        ),
    ],
)
def test_settings_that_make_no_sense_are_refused(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make()


def test_without_scikit_learn_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sklearn.ensemble", None)
    with pytest.raises(ConfigError, match=r"pip install 'brokk-rl\[boosting\]'"):
        option("fit", "boosting").require()


@pytest.mark.parametrize("kind", [HingeArx, BoostedTrees])
def test_a_checkpoint_of_another_kind_is_refused(
    kind: Any, machine: Machine, tmp_path: Path
) -> None:
    run = make_recording(machine)
    fitted = option("fit", "arx").fit(machine, [run], [run], tmp_path, 0, CPU)
    with pytest.raises(CheckpointError, match="holds a 'arx'"):
        kind(checkpoint=fitted.checkpoint).build(machine, 2, CPU)
