"""Recordings that can tell nothing, typed as a person would: a refusal that says what to change, or "cannot tell, because …"."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from composed import MACHINE
from conftest import Brokk
from gaps import recording

from brokk_rl import record
from brokk_rl.record import Recording


def given(folder: Path, *recordings: Recording) -> str:
    """Writes recordings and returns what `diagnosis.field` takes."""
    for number, one in enumerate(recordings):
        record.write_recording(one, folder / f"{number}.parquet")
    return f"diagnosis.field={folder}/*.parquet"


@pytest.mark.parametrize(
    ("change", "count", "reason"),
    [
        (lambda r: replace(r, t_s=r.t_s[:280], u=r.u[:280], q=r.q[:280]), 2, "28 s in all; 60 s or more are needed"),
        (lambda r: r, 1, "one recording only"),
        (lambda r: replace(r, u=np.zeros_like(r.u)), 2, "no joint is ever commanded"),
        (lambda r: replace(r, u=np.full_like(r.u, 0.4)), 2, "the commands never change"),
    ],
)  # fmt: skip
def test_recordings_that_can_tell_nothing_get_no_name_but_a_reason(
    brokk: Brokk, tmp_path: Path, change: Callable, count: int, reason: str
) -> None:
    field = given(tmp_path / "field", *[change(recording(MACHINE))] * count)
    brokk("mode=diagnose", field, "actuator=lag", "session.out=out", "session.device=cpu")
    found = json.loads(Path("out/diagnosis.json").read_text())
    assert found["verdict"] == "unknown" and not found["selected"] and found["gap"] is None
    assert "cannot tell, because" in found["reason"] and reason in found["reason"]
    assert "There is no telling" in Path("out/report.html").read_text()
    lines = Path("out/effects.yaml").read_text().splitlines()
    assert all(line.startswith("#") for line in lines if line)  # nothing that training would take


def test_neither_a_simulator_nor_a_reference_is_refused(brokk: Brokk, tmp_path: Path) -> None:
    field = given(tmp_path / "field", recording(MACHINE))
    case = f"diagnosis.case={tmp_path}"
    for word, told in ((field, "add actuator=<name>"), (case, "no reference/*.parquet")):
        done = brokk("mode=diagnose", word, "session.out=out", code=2)
        assert told in done.err


def test_recordings_of_another_machine_are_refused_by_name(brokk: Brokk, tmp_path: Path) -> None:
    stretched = replace(MACHINE.joints[2], upper=replace(MACHINE.joints[2].upper, value=2.5))
    other = replace(MACHINE, joints=(*MACHINE.joints[:2], stretched, *MACHINE.joints[3:]))
    stamp = {"fingerprint": record.format_fingerprint(other)}
    stamped = replace(recording(MACHINE), metadata=stamp)
    words = ("mode=diagnose", given(tmp_path / "field", stamped), "actuator=lag")
    done = brokk(*words, "session.out=out", code=2)
    assert "limits differ" in done.err and "0.parquet" in done.err
    done = brokk(*words, "machine=mini_excavator", "session.out=out2", code=2)
    assert "brokk170" in done.err


def test_a_position_that_is_no_number_is_refused_by_name(brokk: Brokk, tmp_path: Path) -> None:
    import pyarrow.parquet as pq

    given(tmp_path / "field", recording(MACHINE), recording(MACHINE))
    path = tmp_path / "field" / "1.parquet"
    table = pq.read_table(path)
    place = table.column_names.index("q_q3_rad")
    values = table.column(place).to_numpy().copy()
    values[100] = np.nan
    pq.write_table(table.set_column(place, table.field(place), [values]), path)
    field = f"diagnosis.field={tmp_path}/field/*"
    done = brokk("mode=diagnose", field, "actuator=lag", "session.out=out", code=2)
    assert "1.parquet" in done.err and "q_q3_rad" in done.err
    assert not Path("out/diagnosis.json").exists()
