"""The fit of a valve finds a known valve: its delay, its curves, and how two joints share a pump."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from axis import driven
from composed import MACHINE, option

from actuators import open_loop
from actuators.contracts import FitTask
from brokk_rl.errors import RecordingError


def test_a_known_valve_is_found(tmp_path: Path) -> None:
    joints = tuple(replace(one, body=None) for one in MACHINE.joints[3:])
    pair = replace(MACHINE, mjcf=None, tool_m=None, joints=joints, exclusive=(), levers=())
    truth = option("actuator", "valve", dead_time_s=0.28, play=0.03, spool_s=0.06, speed_s=0.05)
    curves = {"curve_extend": (0.0, 0.0, 0.3, 1.0), "curve_retract": (0.0, 0.02, 0.25, 0.7)}
    truth = replace(truth, demand=0.8, knots=(0.0, 0.1, 0.4, 1.0), **curves)
    runs = driven(pair, 6, 120.0, 0, truth)
    fitted = option("fit", "valve").fit(FitTask(pair, runs[:5], [], tmp_path))
    cut = open_loop.cut_windows(runs[5:], pair, 5.0, 2.0)
    path, ideal = (
        open_loop.roll_out(one, pair, cut, torch.device("cpu")) for one in (fitted, truth)
    )
    error, least = (np.sqrt(np.square(one - cut.measured).mean()) for one in (path, ideal))
    assert error < 1.2 * least + 1e-3
    for name in pair.joint_names:
        lags_s = fitted.dead_time_s[name] + fitted.spool_s[name] + fitted.speed_s[name]
        assert lags_s == pytest.approx(0.39, abs=0.015)
        assert fitted.demand[name] == pytest.approx(0.8, abs=0.1)
        for side, knots in curves.items():
            found = getattr(fitted, side)[name]
            expected = np.interp(fitted.knots, truth.knots, knots)
            np.testing.assert_allclose(found, expected, atol=0.04, err_msg=side)
    still = [replace(runs[0], q=np.full_like(runs[0].q, 0.1))]
    with pytest.raises(RecordingError, match="q4, q5 never moves"):
        option("fit", "valve").fit(FitTask(pair, still, [], tmp_path))
