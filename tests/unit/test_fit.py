"""Fits on a machine small enough to know the answer: they repeat, go on where they stopped, and say what they lack."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from axis import driven
from composed import MACHINE, option
from safetensors.torch import load_file

from actuators.contracts import FitTask
from actuators.identify import network_fit
from actuators.identify.network_fit import NetworkFit, TrainingWindows
from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording

Runs = tuple[list[Recording], list[Recording]]
TINY: dict[str, Any] = {
    "one_step_updates": 30, "one_step_batch": 32, "horizons_s": (0.2, 0.4), "updates": 20, "batch": 8, "validate_every": 10,
    "validation_s": 1.0, "width": 8,
}  # fmt: skip


@cache
def recording(machine: Machine, seed: int = 0, minutes: float = 1.0) -> Recording:
    return driven(machine, 1, 60.0 * minutes, seed)[0]


def tiny(name: str, **changes: Any) -> NetworkFit:
    return dataclasses.replace(option("fit", name), **{**TINY, **changes})


def weights(folder: Path, name: str) -> dict[str, torch.Tensor]:
    return load_file(folder / f"{name}.safetensors")


@pytest.fixture(scope="module")
def runs() -> Runs:
    """Recordings to fit to and to stop by."""
    return [recording(MACHINE, seed) for seed in range(2)], [recording(MACHINE, 9)]


def test_a_fit_repeats_with_its_seed(runs: Runs, tmp_path: Path) -> None:
    for folder, seed in (("a", 1), ("b", 1), ("c", 2)):
        tiny("mlp").fit(FitTask(MACHINE, *runs, tmp_path / folder, seed))
    a, b, c = (weights(tmp_path / folder, "mlp") for folder in "abc")
    assert all(torch.equal(a[key], b[key]) for key in a)
    assert not torch.equal(a["weight.0"], c["weight.0"])


def test_the_same_seed_draws_the_same_windows_and_none_crosses_recordings() -> None:
    parts = [recording(MACHINE, seed, minutes=0.2) for seed in range(3)]
    marked = []
    for number, part in enumerate(parts):
        marked.append(dataclasses.replace(part, q=np.full_like(part.q, number)))
    windows = TrainingWindows(marked, MACHINE, 7, torch.device("cpu"))
    draws = [windows.draw(64, 0.25, torch.Generator().manual_seed(seed)) for seed in (5, 5, 6)]
    assert draws[0][0].shape == draws[0][1].shape == (5, 64, 13 + 7)
    assert torch.equal(draws[0][0], draws[1][0])
    assert not torch.equal(draws[0][0], draws[2][0])
    q = draws[0][1]
    assert (q == q[..., :1]).all()
    assert set(q.unique().tolist()) == {0.0, 1.0, 2.0}
    moving = draws[0][0][:, 16:].abs() > 0.02
    assert moving.any(2).all()


@pytest.mark.parametrize(("noise", "step"), [(2e-4, 0.0), (1e-5, 0.002), (0.0, 0.004)])
def test_the_noise_of_a_resting_joint_is_that_of_its_sensor(noise: float, step: float) -> None:
    made = recording(MACHINE, minutes=10.0)
    u = made.u.copy()
    u[: u.shape[0] // 2] = 0.0
    q = made.q.copy()
    q[: len(q) // 2] = q[0] + noise * np.random.default_rng(1).standard_normal((len(q) // 2, 5))
    if step:
        q = np.round(q / step) * step
    found = network_fit.estimate_resting_noise(
        [dataclasses.replace(made, u=u, q=q.astype(np.float32))], MACHINE
    )
    assert found == pytest.approx(step / 6**0.5 if step else noise * 2**0.5, rel=0.05)


def test_too_little_data_says_how_much_and_of_which_joint() -> None:
    part = recording(MACHINE, minutes=2.0)
    u = part.u.copy()
    u[:, 2] = np.minimum(u[:, 2], 0.0)
    with pytest.raises(RecordingError, match=r"q3 0\.0 min forth and .* needed are 0\.25 min"):
        network_fit.check_enough([dataclasses.replace(part, u=u)], MACHINE)
