"""Free runs and their errors, on plants and numbers whose answer is known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from composed import MACHINE
from motion import make_recording, roll

from actuators import open_loop
from actuators.identify.scores import FreeRunScores
from actuators.models.lag import FirstOrderLag
from brokk_rl.errors import BrokkError, RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording

CPU = torch.device("cpu")
PLANT = FirstOrderLag(
    dead_time_s=0.43, dead_band_extend=0.06, dead_band_retract=0.09, gain=0.5, time_constant_s=0.3
)
"""A plant with a state of its own: the speed."""


def levels(machine: Machine, lengths: Sequence[int], seed: int = 0) -> list[Recording]:
    """Recordings of `PLANT` under random levels, held for a second, one recording a length."""
    generator, found = np.random.default_rng(seed), []
    for number, length in enumerate(lengths):
        u = np.repeat(generator.uniform(-0.6, 0.6, (length // 20 + 1, 5)), 20, 0)[:length]
        commands = torch.as_tensor(u, dtype=torch.float32)[:, None]
        middle = 0.5 * (machine.lower + machine.upper)
        path = roll(PLANT.build(machine, 1, CPU), machine, commands, middle)
        found.append(make_recording(machine, u, path[:-1, 0].numpy(), f"run {number}"))
    return found


def scores(
    cut: open_loop.FreeRunWindows, machine: Machine, **predicted: np.ndarray
) -> FreeRunScores:
    return FreeRunScores(predicted, cut, machine, np.random.default_rng(0))


def test_a_plant_with_a_state_runs_freely_without_error_wherever_a_window_begins() -> None:
    cut = open_loop.cut_windows(levels(MACHINE, [600, 600]), MACHINE, 10.0, 5.0)
    # 0.65 s of history, 1 s to warm up, 10 s: windows at 0, 5, 10 and 15 s of each 30 s
    assert (cut.q.shape, cut.u.shape) == ((8, 233, 5), (8, 232, 5))
    assert list(cut.run) == ["run 0"] * 4 + ["run 1"] * 4
    # what is left of the speed at rest after the warm-up: exp(-1 / 0.3) of it, 0.3 s long
    error = np.abs(open_loop.roll_out(PLANT, MACHINE, cut, CPU) - cut.measured)
    assert error.max() < 0.2 * 0.3 * np.exp(-1.0 / 0.3) * 1.5


def test_short_recordings_serve_the_horizons_that_fit() -> None:
    runs = levels(MACHINE, [33 + 40, 33 + 100, 30])  # room for 2 s, 5 s and nothing
    assert open_loop.find_longest_horizon_s(runs, MACHINE) == pytest.approx(5.0)
    cut = open_loop.cut_windows(runs, MACHINE, 5.0, 1.0, 1.0)
    left = np.isfinite(cut.measured[..., 0]).sum(1)
    assert list(left) == [40, 20, 100, 80, 60, 40, 20]
    assert np.isfinite(cut.q[:, :33]).all()
    found = scores(cut, MACHINE, plant=open_loop.roll_out(PLANT, MACHINE, cut, CPU))
    assert found.at("plant", 5.0)[0]["ci95"] is None
    assert found.at("plant", 2.0)[0]["ci95"] is not None


def test_recordings_too_short_for_any_horizon_are_refused() -> None:
    told = r"needs 11\.65 s of recording, the longest of 2 has 5"
    with pytest.raises(RecordingError, match=told):
        open_loop.cut_windows(levels(MACHINE, [100, 100]), MACHINE, 10.0, 1.0)


def test_a_model_that_runs_into_nan_is_named() -> None:
    cut = open_loop.cut_windows(levels(MACHINE, [100]), MACHINE, 1.0, 1.0)
    cut.u[:] = np.nan
    with pytest.raises(BrokkError, match="Lag ran into NaN in a free run"):
        open_loop.roll_out(PLANT, MACHINE, cut, CPU)


def test_errors_are_those_at_the_end_of_each_horizon() -> None:
    cut = open_loop.cut_windows(levels(MACHINE, [400, 400]), MACHINE, 2.0, 10.0)
    ramp = 0.01 * np.arange(1, 41)[None, :, None]
    found = scores(cut, MACHINE, ramp=cut.measured + ramp)
    row = found.at("ramp", 2.0)[0]
    assert row["rmse"] == pytest.approx(0.40, abs=1e-5)
    assert row["percent"] == pytest.approx(100 * 0.40 / 3.2, abs=1e-3)
    assert row["ci95"] == pytest.approx([0.40, 0.40], abs=1e-5)
    assert found.at("ramp", 1.0)[0]["rmse"] == pytest.approx(0.20, abs=1e-5)


def test_intervals_come_from_runs_not_from_windows() -> None:
    """Of nine runs one is bad throughout: as many windows as one likes in each do not make the interval narrower."""
    still = np.zeros((200, 5))
    runs = [make_recording(MACHINE, still, still, f"run {n}") for n in range(9)]
    widths = []
    for stride_s in (2.0, 0.2):
        cut = open_loop.cut_windows(runs, MACHINE, 1.0, stride_s)
        error = np.where(cut.run == "run 4", 0.3, 0.1)[:, None, None] * np.ones((1, 20, 5))
        row = scores(cut, MACHINE, model=cut.measured + error).at("model", 1.0)[0]
        assert row["rmse"] == pytest.approx(np.sqrt((8 * 0.01 + 0.09) / 9), abs=1e-6)
        widths.append(row["ci95"][1] - row["ci95"][0])
        assert row["ci95"][0] == pytest.approx(0.1, abs=1e-6)
    assert widths[0] == pytest.approx(widths[1])


def test_a_small_difference_that_every_run_shows_is_certain_although_intervals_overlap() -> None:
    still = np.zeros((200, 5))
    runs = [make_recording(MACHINE, still, still, f"run {n}") for n in range(9)]
    cut = open_loop.cut_windows(runs, MACHINE, 1.0, 1.0)
    size = np.array([0.1 * (1 + int(name[-1])) for name in cut.run])[:, None, None]
    size = np.broadcast_to(size, cut.measured.shape)
    found = scores(cut, MACHINE, mine=cut.measured + 0.95 * size, rival=cut.measured + size)
    mine, rival = found.at("mine", 1.0)[0]["ci95"], found.at("rival", 1.0)[0]["ci95"]
    assert mine[1] > rival[0]
    for row in found.against("mine", "rival", 1.0):
        assert row["reduction_percent"] == pytest.approx(5.0) and row["ci95"][1] < 0
        assert row["reduction_ci95"] == pytest.approx([5.0, 5.0])
