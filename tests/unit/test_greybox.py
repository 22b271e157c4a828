"""Grey-box fits find numbers that are known, and say how sure they are."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from composed import option

from actuators import open_loop
from actuators.identify import greybox
from actuators.identify.gauss_newton import CandidateRuns, estimate_uncertainty
from actuators.identify.greybox import GreyBoxFit
from actuators.models.lag import FirstOrderLag
from brokk_rl.errors import ConfigError
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.record import Recording

CPU = torch.device("cpu")
TRUTH = FirstOrderLag(
    dead_time_s={"q1": 0.41, "q3": 0.525, "other": 0.46},
    dead_band_extend={"q1": 0.05, "q4": 0.16, "other": 0.1},
    dead_band_retract={"q2": 0.12, "other": 0.07},
    gain={"q1": 0.8, "q5": 1.2, "other": 0.95},
    time_constant_s={"q2": 0.2, "other": 0.12},
)


def recordings(
    actuator: Any,
    machine: Machine,
    count: int,
    seconds: float,
    seed: int = 0,
    least: float = -0.8,
    noise: float = 0.0003,
) -> list[Recording]:
    """Returns runs under levels of up to 0.8, each held for 0.3 to 1.2 s, turned round before a stop; encoder noise in rad."""
    random = np.random.default_rng(seed)
    num, joints = round(seconds / machine.period_s), machine.num_joints
    model = actuator.build(machine, count, CPU)
    home = torch.as_tensor(machine.home, dtype=torch.float32).expand(count, -1)
    history = History(*(torch.zeros(count, machine.num_history, joints) for _ in range(2)))
    history.reset(torch.ones(count, dtype=torch.bool), home)
    margin = 0.15 * (machine.upper - machine.lower)
    level, left, commands, positions = np.zeros((count, joints)), np.zeros((count, joints)), [], []
    for _ in range(num):
        q = history.q[:, -1].numpy()
        level = np.where(left <= 0, random.uniform(least, 0.8, level.shape), level)
        left = np.where(left <= 0, random.uniform(0.3, 1.2, level.shape), left) - machine.period_s
        level = np.where(
            (q > machine.upper - margin) & (level > 0), -0.5 if least < 0 else 0.0, level
        )
        level = np.where((q < machine.lower + margin) & (level < 0), 0.5, level)
        commands.append(level)
        positions.append(q + noise * random.standard_normal(q.shape))
        history.push_u(torch.as_tensor(level, dtype=torch.float32))
        history.push_q(model.step(history))
    u, q = (np.stack(rows, 1).astype(np.float32) for rows in (commands, positions))
    return [
        Recording(
            machine=machine.name, joints=machine.joint_names, units=("rad",) * 5, rate_hz=20.0, t_s=np.arange(num) * 0.05,
            u=u[n], q=q[n], metadata={"run": f"run_{seed}_{n}"},
        )
        for n in range(count)
    ]  # fmt: skip


def quick(name: str, **changes: Any) -> GreyBoxFit:
    """The shipped fit with less to do."""
    less = {
        "windows": 16,
        "validation_windows": 6,
        "candidates": 24,
        "starts": 2,
        "iterations": 8,
        "horizon_s": 3.0,
    }
    return dataclasses.replace(option("fit", name), **(less | changes))


@pytest.fixture(scope="module")
def runs(machine: Machine) -> list[Recording]:
    return recordings(TRUTH, machine, 5, 30.0)


def test_known_numbers_of_a_lag_are_found_within_their_intervals(
    machine: Machine, runs: list[Recording], tmp_path: Path
) -> None:
    fitted = quick("lag").fit(machine, runs[:4], runs[4:], tmp_path, 0, CPU)
    facts = json.loads((tmp_path / "lag.json").read_text())
    inside = []
    for name, near in (
        ("dead_time_s", 0.01),
        ("dead_band_extend", 0.01),
        ("dead_band_retract", 0.01),
        ("gain", 0.01),
    ):
        for joint in machine.joint_names:
            true, cell = (
                getattr(TRUTH, name).get(joint, getattr(TRUTH, name)["other"]),
                facts["parameters"][name][joint],
            )
            assert getattr(fitted, name)[joint] == cell["value"] == pytest.approx(true, abs=near)
            assert cell["told"] and not cell["at_bound"] and cell["runs"] == 4
            inside.append(cell["ci95"][0] <= true <= cell["ci95"][1])
    assert np.mean(inside) > 0.8
    assert max(facts["validation_rmse"].values()) < 0.003


def test_what_a_fit_leaves_is_an_option(
    machine: Machine, runs: list[Recording], tmp_path: Path, brokk: Callable[..., Any]
) -> None:
    fitted = quick("lag", iterations=2, starts=1).fit(machine, runs[:4], runs[4:], tmp_path, 0, CPU)
    text = (tmp_path / "lag.yaml").read_text()
    assert "4 recordings (4 runs, 2 min)" in text and "95 % intervals" in text
    done = brokk("mode=train", f"actuator=@{tmp_path}/lag.yaml", "--cfg", "job")
    node = yaml.safe_load(done.out)["actuator"]
    assert node.pop("_target_") == "actuators.models.lag.FirstOrderLag"
    assert FirstOrderLag(**node) == fitted


def test_what_the_recordings_do_not_show_is_said(
    machine: Machine, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    forward = recordings(TRUTH, machine, 4, 8.0, least=0.0)  # no joint ever retracts
    fit = quick("lag", horizon_s=2.0)
    fit.fit(machine, forward[:3], forward[3:], tmp_path, 0, CPU)
    cells = json.loads((tmp_path / "lag.json").read_text())["parameters"]
    for joint in machine.joint_names:
        assert not cells["dead_band_retract"][joint]["told"]
        assert cells["dead_band_retract"][joint]["ci95"] == [0.0, 0.8]
        assert cells["dead_time_s"][joint]["told"]
    assert "dead_band_retract: the recordings do not tell it for q1, q2, q3, q4, q5" in caplog.text


def test_a_machine_that_was_blocked_for_a_while_hardly_moves_the_numbers(
    machine: Machine, runs: list[Recording], tmp_path: Path
) -> None:
    blocked = runs[0].q.copy()
    blocked[200:260] = blocked[200]
    data = [dataclasses.replace(runs[0], q=blocked), *runs[1:4]]
    fitted = quick("lag").fit(machine, data, runs[4:], tmp_path, 0, CPU)
    for joint in machine.joint_names:
        assert fitted.gain[joint] == pytest.approx(TRUTH.gain.get(joint, 0.95), abs=0.03)  # pyright: ignore[reportAttributeAccessIssue]


def test_the_interval_covers_as_often_as_it_says(machine: Machine) -> None:
    """A model with a wrong time constant has errors that are no white noise; the runs' own spread must carry the interval."""
    free, hits = {"gain": (0.5, 1.5)}, []
    wrong = dataclasses.replace(TRUTH, time_constant_s=0.0, gain=1.0)
    every = recordings(TRUTH, machine, 48, 12.0, seed=5)

    def fitted(part: list[Recording]) -> tuple[np.ndarray, np.ndarray]:
        cut = open_loop.cut_windows(part, machine, 3.0, 3.0)
        runs = CandidateRuns(wrong, free, machine, cut, np.ones((len(cut.q), 5), dtype=bool), CPU)
        x = np.full((1, 5), 0.5)
        for _ in range(4):
            x, _ = greybox.take_step(runs, x, 3.0)
        return x, estimate_uncertainty(runs, x, 3.0).half

    limit, _ = fitted(every)  # where the wrong model ends up with many runs
    for start in range(0, 48, 6):
        x, half = fitted(every[start : start + 6])
        hits += (np.abs(x - limit) <= half).ravel().tolist()
    assert 0.85 <= np.mean(hits) <= 1.0


def test_a_lag_can_be_fitted_by_gradient_too(machine: Machine) -> None:
    u = torch.rand(30, 2, 5, generator=torch.Generator().manual_seed(0)) * 1.6 - 0.8
    model = TRUTH.build(machine, 2, CPU)

    def end(gain: torch.Tensor) -> torch.Tensor:
        model.parameters["gain"] = gain
        model.reset(torch.ones(2, dtype=torch.bool))
        history = History(*(torch.zeros(2, machine.num_history, 5) for _ in range(2)))
        history.reset(
            torch.ones(2, dtype=torch.bool),
            torch.as_tensor(machine.home, dtype=torch.float32).expand(2, -1),
        )
        for command in u:
            history.push_u(command)
            history.push_q(model.step(history))
        return history.q[:, -1]

    for _ in range(2):  # again after a reset, which cuts the gradients of the run before
        gain = torch.full((2, 5), 0.9, requires_grad=True)
        (slope,) = torch.autograd.grad(end(gain).sum(), gain)
        with torch.no_grad():
            difference = (end(torch.full((2, 5), 0.95)) - end(torch.full((2, 5), 0.85))) / 0.1
        torch.testing.assert_close(slope, difference, atol=2e-3, rtol=1e-2)


@pytest.mark.parametrize("name", ["lag", "hydraulic"])
def test_a_free_run_that_begins_in_motion_goes_on_with_it(name: str, machine: Machine) -> None:
    actuator = option("actuator", name)
    moving = recordings(actuator, machine, 1, 12.0, noise=0.0)[0]
    u, q = (torch.as_tensor(values)[None] for values in (moving.u, moving.q))
    missed, moved = 0.0, 0.0
    for start in range(40, 200, 7):
        rows = slice(start - machine.num_history + 1, start + 1)
        model = actuator.build(machine, 1, CPU)
        ahead = model.step(History(q=q[:, rows].clone(), u=u[:, rows].clone()))
        missed += float((ahead - q[:, start + 1]).abs().sum())
        moved += float((q[:, start + 1] - q[:, start]).abs().sum())
    assert missed < 0.2 * moved


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        (
            {"free": {"gian": (0.2, 2.0)}},
            r"'gian' is no number of FirstOrderLagModel; did you mean 'gain'",
        ),
        ({"free": {"gain": (2.0, 0.2)}}, r"free\.gain: expected \[low, high\] with low < high"),
        ({"free": {}}, "at least one number"),
        (
            {"free": {"dead_time_s": (0.0, 2.0)}},
            r"upper bound: actuator\.dead_time_s.*does not fit",
        ),
        ({"actuator": option("actuator", "ideal")}, "IdealModel has no numbers to fit"),
        ({"starts": 60}, "starts: 60 of"),
    ],
)
def test_a_fit_that_makes_no_sense_is_refused(
    changes: dict[str, Any], told: str, machine: Machine, runs: list[Recording], tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=told):
        quick("lag", **changes).fit(machine, runs[:4], runs[4:], tmp_path, 0, CPU)
    assert list(tmp_path.iterdir()) == []
