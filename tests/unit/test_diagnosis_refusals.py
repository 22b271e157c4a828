"""Recordings that can tell nothing, typed as a person would: a refusal that says what to change, or "cannot tell, because …"."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import Done

from brokk_rl import record
from brokk_rl.machine import Machine
from brokk_rl.record import Recording

Brokk = Callable[..., Done]
LONG_S = 120.0


def driven(
    machine: Machine, seconds: float = LONG_S, level: float = 0.4, alternating: bool = True
) -> Recording:
    """Returns a recording in which all joints but q2 go to and fro, or are given one command all the time."""
    steps = round(seconds / machine.period_s)
    turns = (
        np.array([0.0, 1.0, 0.0, -1.0])[(np.arange(steps) // 60) % 4]
        if alternating
        else np.ones(steps)
    )
    u = np.outer(turns, level * np.array([1.0, 0.0, 1.0, 1.0, 1.0]))
    q = machine.home + np.cumsum(u * machine.max_speed * machine.period_s * alternating, 0)
    return Recording(
        machine=machine.name, joints=machine.joint_names, units=tuple(joint.unit for joint in machine.joints), rate_hz=20.0,
        t_s=np.arange(steps) * machine.period_s, u=u.astype(np.float32), q=q.astype(np.float32), metadata={},
    )  # fmt: skip


def given(folder: Path, *recordings: Recording) -> str:
    """Writes recordings and returns what `diagnosis.field` takes."""
    for number, recording in enumerate(recordings):
        record.write_recording(recording, folder / f"{number}.parquet")
    return f"diagnosis.field={folder}/*.parquet"


@pytest.mark.parametrize(
    ("change", "count", "reason"),
    [
        ({"seconds": 14.0}, 2, "28 s in all; 60 s or more are needed"),
        ({}, 1, "one recording only"),
        ({"level": 0.0}, 2, "no joint is ever commanded"),
        ({"alternating": False}, 2, "the commands never change"),
    ],
)
def test_recordings_that_can_tell_nothing_get_no_name_but_a_reason(
    machine: Machine, brokk: Brokk, tmp_path: Path, change: dict, count: int, reason: str
) -> None:
    field = given(tmp_path / "field", *[driven(machine, **change)] * count)
    done = brokk("mode=diagnose", field, "actuator=lag", "session.out=out", "session.device=cpu")
    assert done.code == 0, done.err
    found = json.loads(Path("out/diagnosis.json").read_text())
    assert found["verdict"] == "unknown" and not found["selected"] and found["gap"] is None
    assert "cannot tell, because" in found["reason"] and reason in found["reason"]
    assert "There is no telling" in Path("out/report.html").read_text()
    lines = Path("out/effects.yaml").read_text().splitlines()
    assert all(line.startswith("#") for line in lines if line)  # nothing that training would take


def test_neither_a_simulator_nor_a_reference_is_refused(
    machine: Machine, brokk: Brokk, tmp_path: Path
) -> None:
    done = brokk("mode=diagnose", given(tmp_path / "field", driven(machine)), "session.out=out")
    assert done.code != 0 and "add actuator=<name>" in done.err
    done = brokk("mode=diagnose", f"diagnosis.case={tmp_path}", "session.out=out2")
    assert done.code != 0 and "no reference/*.parquet" in done.err
    done = brokk("mode=diagnose", "session.out=out3")
    assert done.code != 0 and "give either case=" in done.err


def test_recordings_of_another_machine_are_refused_by_name(
    machine: Machine, brokk: Brokk, tmp_path: Path
) -> None:
    stretched = replace(machine.joints[2], upper=replace(machine.joints[2].upper, value=2.5))
    other = replace(machine, joints=(*machine.joints[:2], stretched, *machine.joints[3:]))
    stamped = replace(driven(machine), metadata={"fingerprint": record.format_fingerprint(other)})
    done = brokk(
        "mode=diagnose", given(tmp_path / "field", stamped), "actuator=lag", "session.out=out"
    )
    assert done.code != 0 and "limits differ" in done.err and "0.parquet" in done.err
    done = brokk(
        "mode=diagnose",
        f"diagnosis.field={tmp_path}/field/*",
        "machine=mini_excavator",
        "actuator=lag",
        "session.out=out2",
    )
    assert done.code != 0 and "brokk170" in done.err


def test_a_position_that_is_no_number_is_refused_by_name(
    machine: Machine, brokk: Brokk, tmp_path: Path
) -> None:
    import pyarrow.parquet as pq

    given(tmp_path / "field", driven(machine), driven(machine))
    path = tmp_path / "field" / "1.parquet"
    table = pq.read_table(path)
    place = table.column_names.index("q_q3_rad")
    values = table.column(place).to_numpy().copy()
    values[100] = np.nan
    pq.write_table(table.set_column(place, table.field(place), [values]), path)
    done = brokk(
        "mode=diagnose", f"diagnosis.field={tmp_path}/field/*", "actuator=lag", "session.out=out"
    )
    assert (
        done.code != 0
        and "1.parquet" in done.err
        and "q_q3_rad" in done.err
        and not Path("out/diagnosis.json").exists()
    )
