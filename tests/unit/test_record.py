"""Recordings: the file as others read it, and every refusal by file, row and column."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from composed import MACHINE
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from brokk_rl import record
from brokk_rl.errors import RecordingError
from brokk_rl.record import Recording

JOINTS = ("q1", "q2", "q3", "q4", "q5")


def recording(num_samples: int = 40, **changes: object) -> Recording:
    generator = np.random.default_rng(0)
    whole = Recording(
        machine="brokk170", joints=JOINTS, units=("rad",) * 5, rate_hz=20.0,
        t_s=np.arange(num_samples) * 0.05,
        u=generator.uniform(-1.0, 1.0, (num_samples, 5)),
        q=generator.uniform(-0.2, 0.0, (num_samples, 5)),
    )  # fmt: skip
    return replace(whole, **changes)


def changed(path: Path, column: str, row: int, value: float) -> Path:
    """Changes one cell behind the format's back."""
    table = pq.read_table(path)
    values = table.column(column).to_numpy().copy()
    values[row] = value
    index = table.column_names.index(column)
    pq.write_table(table.set_column(index, column, pa.array(values)), path)
    return path


@pytest.fixture
def path(tmp_path: Path) -> Path:
    record.write_recording(recording(), tmp_path / "run.parquet")
    return tmp_path / "run.parquet"


def test_the_file_is_what_the_format_says(path: Path) -> None:
    file = pq.ParquetFile(path)
    schema = {field.name: str(field.type) for field in file.schema_arrow}
    assert list(schema) == ["t_s", *(f"u_{j}" for j in JOINTS), *(f"q_{j}_rad" for j in JOINTS)]
    assert schema["t_s"] == "double"
    assert set(list(schema.values())[1:]) == {"float"}
    stated = file.schema_arrow.metadata
    for key, value in ((b"schema", b"1"), (b"machine", b"brokk170"), (b"rate_hz", b"20")):
        assert stated[b"brokk." + key] == value
    assert file.metadata.row_group(0).column(0).compression == "ZSTD"


@settings(
    max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    num_samples=st.integers(2, 60),
    jitter=st.floats(0.0, 0.09),
    seed=st.integers(0, 99),
    oil=st.booleans(),
)
def test_what_is_written_is_read(
    tmp_path: Path, num_samples: int, jitter: float, seed: int, oil: bool
) -> None:
    generator = np.random.default_rng(seed)
    t_s = np.arange(num_samples) * 0.05 + 0.05 * jitter * generator.uniform(-1.0, 1.0, num_samples)
    extra = {"oil_c": generator.uniform(20.0, 60.0, num_samples).astype(np.float32)} if oil else {}
    told = {"source": "test", "seed": str(seed)}
    before = recording(num_samples, t_s=t_s, extra=extra, metadata=told)
    record.write_recording(before, tmp_path / "a.parquet")
    after = record.read_recording(tmp_path / "a.parquet", MACHINE)
    np.testing.assert_array_equal(after.t_s, t_s)
    np.testing.assert_array_equal(after.u, before.u.astype(np.float32))
    np.testing.assert_array_equal(after.q, before.q.astype(np.float32))
    assert after.extra.keys() == extra.keys()
    assert all(np.array_equal(after.extra[name], extra[name]) for name in extra)
    assert (after.metadata, after.rate_hz, after.joints) == (before.metadata, 20.0, JOINTS)


@pytest.mark.parametrize(
    ("column", "row", "value", "message"),
    [
        ("u_q3", 7, 1.2, r"row 7, column 'u_q3': command 1\.2 lies outside \[-1, 1\]"),
        ("u_q1", 0, np.nan, r"row 0, column 'u_q1': nan is not a number"),
        ("q_q5_rad", 39, np.inf, r"row 39, column 'q_q5_rad': inf is not a number"),
        ("t_s", 5, 0.2, r"row 5, column 't_s': time does not increase \(0\.2 s, then 0\.2 s\)"),
        ("t_s", 5, 0.265, r"row 5, column 't_s': 0\.065 s after the row before, but brokk\.rate_hz = 20 means 0\.05 s"),
        ("t_s", 39, 9.0, r"row 39, column 't_s': 7\.1 s after .*split the recording at the gap"),
    ],
)  # fmt: skip
def test_a_bad_cell_is_refused_by_name(
    path: Path, column: str, row: int, value: float, message: str
) -> None:
    with pytest.raises(RecordingError, match=rf"run\.parquet: {message}"):
        record.read_recording(changed(path, column, row, value), MACHINE)


def test_every_breach_is_found_with_its_row_and_column(path: Path) -> None:
    commands = [("u_q3", 7, 1.2), ("u_q3", 8, 1.3), ("u_q3", 20, -4.0)]
    for column, row, value in [*commands, ("q_q1_rad", 3, np.nan), ("t_s", 30, 1.45)]:
        changed(path, column, row, value)
    table = pq.read_table(path)
    pq.write_table(table.drop_columns("q_q5_rad"), path)
    recording_, found = record.examine_recording(path, MACHINE)
    assert np.isnan(recording_.q[:, 4]).all()
    assert [(breach.column, breach.row, breach.num_rows) for breach in found] == [
        ("q_q5_rad", None, 1), ("q_q1_rad", 3, 1), ("u_q3", 7, 2), ("u_q3", 20, 1), ("t_s", 30, 1), ("t_s", 31, 1),
    ]  # fmt: skip
    assert str(found[2]).startswith("row 7, column 'u_q3': command 1.2")


def test_a_missing_column_is_refused_with_the_nearest_names(path: Path) -> None:
    table = pq.read_table(path)
    names = [name.replace("q_q4_rad", "q_q4_deg") for name in table.column_names]
    pq.write_table(table.rename_columns(names).replace_schema_metadata(table.schema.metadata), path)
    with pytest.raises(RecordingError, match=r"'q_q4_rad' is missing; did you mean 'q_q\d_\w+'"):
        record.read_recording(path, MACHINE)


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        (None, r"metadata 'brokk\.schema' is missing"),
        (("2", "brokk170", "20"), r"brokk\.schema is '2', this version reads '1'"),
        (("1", "crane", "20"), "unknown machine 'crane', expected 'brokk170'"),
        (("1", "brokk170", "fast"), "'fast', expected a positive number"),
        (("1", "brokk170", "100"), r"row 1, column 't_s': 0\.05 s after"),
    ],
)
def test_wrong_metadata_is_refused(
    path: Path, metadata: tuple[str, ...] | None, message: str
) -> None:
    keys = ("brokk.schema", "brokk.machine", "brokk.rate_hz")
    stated = dict(zip(keys, metadata or (), strict=False))
    pq.write_table(pq.read_table(path).replace_schema_metadata(stated), path)
    with pytest.raises(RecordingError, match=message):
        record.read_recording(path, MACHINE)


def test_a_truncated_file_is_refused(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(RecordingError, match=r"run\.parquet: truncated or not a Parquet file"):
        record.read_recording(path, MACHINE)


def test_a_column_of_text_is_refused(path: Path) -> None:
    table = pq.read_table(path)
    pq.write_table(table.set_column(1, "u_q1", pa.array(["0.1"] * len(table))), path)
    with pytest.raises(RecordingError, match="column 'u_q1' holds string, expected numbers"):
        record.read_recording(path, MACHINE)


def test_further_columns_are_kept_and_may_have_gaps(tmp_path: Path) -> None:
    force = np.full(40, np.nan)
    record.write_recording(recording(extra={"force_n": force}), tmp_path / "a.parquet")
    assert np.isnan(record.read_recording(tmp_path / "a.parquet", MACHINE).extra["force_n"]).all()


def test_a_bad_recording_is_not_written(tmp_path: Path) -> None:
    bad = recording()
    bad.u[3, 1] = -1.5
    with pytest.raises(RecordingError, match="row 3, column 'u_q2'"):
        record.write_recording(bad, tmp_path / "a.parquet")
    assert list(tmp_path.iterdir()) == []
