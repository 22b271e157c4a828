"""Signals of a machine of one joint, for logs of every kind, and the map that reads them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from composed import option

from actuators.recordings.column_map import Column, ColumnMap, CommandColumn, JointColumns
from brokk_rl.machine import Machine
from brokk_rl.record import Recording

NUM = 200
PERIOD_S = 0.01


def make_carriage() -> Machine:
    """Returns a machine of one joint behind a valve, at 100 Hz; the shipped drive has a force and 200 Hz."""
    drive = option("machine", "emps")
    joint = replace(drive.joints[0], command="valve", max_force=None)
    return replace(drive, joints=(joint,), period_s=PERIOD_S, dead_time_s=PERIOD_S)


def make_map(
    command: str = "u", position: str = "q", time: str = "t", full_minus: float | None = -1.0
) -> ColumnMap:
    ends = {"neutral": 0.0, "full_plus": 1.0, "full_minus": full_minus}
    place = Column(column=position, scale=1.0, offset=0.0)
    joint = JointColumns(command=CommandColumn(column=command, **ends), position=place)
    reader = replace(option("import", "mini_excavator"), joints={"carriage": joint}, overrun=0.0)
    clock = Column(column=time, scale=1.0, offset=0.0)
    return replace(reader, time=clock, longest_gap_s=0.1, shortest_s=0.5)


def make_signals() -> dict[str, np.ndarray]:
    """Returns times, commands and positions at the machine's rate, exact in 32 bits."""
    k = np.arange(NUM)
    return {"t": k * PERIOD_S, "u": np.round(np.sin(k / 9) * 64) / 128, "q": (k % 32) / 256}


def check(recording: Recording, atol: float = 1e-6) -> None:
    signals = make_signals()
    np.testing.assert_allclose(recording.t_s, signals["t"], atol=1e-12)
    np.testing.assert_array_equal(recording.u[:, 0], signals["u"].astype(np.float32))
    np.testing.assert_allclose(recording.q[:, 0], signals["q"], atol=atol)
