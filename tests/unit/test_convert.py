"""Logs of other machines become recordings; a bad log is refused by file, line, row and column."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from composed import option
from conftest import Done

from actuators.recordings.column_map import Column, ColumnMap, CommandColumn
from actuators.recordings.log_files import find_logs
from brokk_rl import record
from brokk_rl.errors import ConfigError, RecordingError
from brokk_rl.machine import Machine

HEADER = "Time,Boom Cmd,Stick Cmd,Bucket Cmd,Swing Cmd,Boom Ms,Stick Ms,Bucket Ms,Swing Ms"
REST = "7.4745,6.9645,7.614,7.4695"


@pytest.fixture(scope="module")
def excavator() -> Machine:
    return option("machine", "mini_excavator")


@pytest.fixture(scope="module")
def reader() -> ColumnMap:
    return option("import", "mini_excavator")


def row(t_s: float, commands: str = REST, boom_cm: float = 8.0) -> str:
    return f"{t_s!r},{commands},{boom_cm!r},9.0,5.0,0.5"


def lines(seconds: float = 8.0, start_s: float = 100.0) -> list[str]:
    """Returns the rows of a log at rest, one every 53 ms."""
    return [row(start_s + 0.053 * k) for k in range(int(seconds / 0.053) + 1)]


def logged(
    folder: Path, rows: list[str], header: str = HEADER, end: str = "\n", name: str = "dig.csv"
) -> Path:
    path = folder / name
    path.write_text("\n".join([header, *rows]) + end)
    return path


def test_commands_are_full_at_the_stated_values_whichever_side_they_lie_on() -> None:
    column = CommandColumn(column="c", neutral=7.0, full_plus=10.0, full_minus=5.0)
    found = column.command(np.array([7.0, 10.0, 5.0, 8.5, 6.0]))
    assert found.tolist() == pytest.approx([0.0, 1.0, -1.0, 0.5, -0.5])
    turned = CommandColumn(column="c", neutral=7.0, full_plus=5.0, full_minus=10.0)
    found = turned.command(np.array([7.0, 10.0, 5.0, 8.5]))
    assert found.tolist() == pytest.approx([0.0, -1.0, 1.0, -0.5])


def test_positions_are_interpolated_and_commands_held(
    tmp_path: Path, excavator: Machine, reader: ColumnMap
) -> None:
    rows = []
    for k in range(101):
        commands = "10.01,6.9645,7.614,7.4695" if k >= 50 else REST
        rows.append(row(10.0 + 0.08 * k, commands, 8.0 + 0.01 * k))
    (recording,) = reader.read(logged(tmp_path, rows), excavator)
    assert recording.t_s[0] == 0.0
    np.testing.assert_allclose(np.diff(recording.t_s), excavator.period_s)
    assert recording.duration_s == pytest.approx(8.0, abs=excavator.period_s)
    # 0.01 cm every 0.08 s, in m
    np.testing.assert_allclose(recording.q[:, 0], 0.08 + 0.0001 * recording.t_s / 0.08, atol=1e-7)
    # the command of row 50 is in force from 4.0 s on, not before
    np.testing.assert_array_equal(recording.u[:, 0], recording.t_s >= 4.0 - 1e-6)
    assert np.abs(recording.u[:, 1:]).max() == 0.0


def test_a_log_is_split_at_its_gaps_and_its_pieces_share_the_run(
    tmp_path: Path, excavator: Machine, reader: ColumnMap, caplog: pytest.LogCaptureFixture
) -> None:
    rows = [*lines(8.0, 0.0), *lines(6.0, 30.0), *lines(2.0, 60.0)]
    pieces = reader.read(logged(tmp_path, rows), excavator)
    assert [round(piece.duration_s) for piece in pieces] == [8, 6]
    assert {piece.run for piece in pieces} == {"dig"}
    assert "1 pieces shorter than 5 s left out" in caplog.text
    for piece in pieces:
        record.check_recording(piece, "piece")


@pytest.mark.parametrize(
    ("tail", "end"), [("108.1,7.4745,6.96", ""), ("108.1,7.4745,6.96", "\n"), (row(108.1)[:-1], "")]
)
def test_a_last_line_that_a_crash_cut_off_is_left_out_and_said(
    tmp_path: Path, excavator: Machine, reader: ColumnMap, caplog: Any, tail: str, end: str
) -> None:
    whole = reader.read(logged(tmp_path, lines()), excavator)
    cut = reader.read(logged(tmp_path, [*lines(), tail], end=end), excavator)
    assert cut[0].num_samples == whole[0].num_samples
    assert "the last line is cut off" in caplog.text


def put(at: int, cell: int, text: str) -> list[str]:
    """Returns a log with one cell changed."""
    rows = lines()
    cells = rows[at].split(",")
    cells[cell] = text
    rows[at] = ",".join(cells)
    return rows


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (put(7, 1, "off"), r"dig\.csv: line 9 \(row 7\), column 'Boom Cmd': 'off' is not a number"),
        (put(7, 6, ""), r"dig\.csv: line 9 \(row 7\), column 'Stick Ms': '' is not a number"),
        (put(3, 8, "nan"), r"dig\.csv: line 5 \(row 3\), column 'Swing Ms': 'nan' is not a number"),
        (put(7, 0, "100.1"), r"line 9 \(row 7\), column 'Time': time does not increase"),
        (put(7, 3, "11.5"), r"row 7\), column 'Bucket Cmd': command 1\.608\d* is beyond full"),
        ([*lines()[:4], "100.2,7.5", *lines()[4:]], r"line 6 \(row 4\): 2 cells, the header has 9"),
        ([], r"dig\.csv: 0 rows of data"),
        (lines(3.0), r"dig\.csv: no piece of 5 s or more"),
    ],
)
def test_a_bad_log_is_refused_by_name(
    tmp_path: Path, excavator: Machine, reader: ColumnMap, rows: list[str], message: str
) -> None:
    with pytest.raises(RecordingError, match=message):
        reader.read(logged(tmp_path, rows), excavator)


def test_a_map_of_another_machine_is_refused(
    tmp_path: Path, machine: Machine, reader: ColumnMap
) -> None:
    with pytest.raises(ConfigError, match=r"joints boom, .* 'brokk170' has q1, .*import=…"):
        reader.read(logged(tmp_path, lines()), machine)


def test_optional_columns_are_read_and_may_have_empty_cells(
    tmp_path: Path, excavator: Machine, reader: ColumnMap
) -> None:
    oil = [f"{line},{'' if k == 3 else 30 + k}" for k, line in enumerate(lines())]
    path = logged(tmp_path, oil, HEADER + ",Oil F")
    fahrenheit = Column(column="Oil F", scale=5.0 / 9.0, offset=-160.0 / 9.0)
    (recording,) = replace(reader, optional={"oil_c": fahrenheit}).read(path, excavator)
    assert recording.extra["oil_c"][0] == pytest.approx((30 - 32) * 5 / 9, abs=1e-5)
    assert np.isnan(recording.extra["oil_c"][3])
    assert np.isfinite(recording.extra["oil_c"][5:]).all()


def test_pieces_are_written_by_log_and_a_bad_log_leaves_none_of_the_others(
    brokk: Callable[..., Done], excavator: Machine
) -> None:
    Path("logs").mkdir()
    logged(Path("logs"), [*lines(8.0, 0.0), *lines(6.0, 30.0)])
    logged(Path("logs"), lines(), name="lift.csv")
    options = ("machine=mini_excavator", "import=mini_excavator", "convert.input=logs/*.csv")
    done = brokk("mode=convert", *options, "session.out=out")
    assert done.code == 0, done.err
    recordings = record.read_recordings("out/recordings/*", excavator)
    names = [one.path.name for one in recordings if one.path is not None]
    assert names == ["dig_00.parquet", "dig_01.parquet", "lift_00.parquet"]
    assert [recording.run for recording in recordings] == ["dig", "dig", "lift"]
    logged(Path("logs"), put(7, 1, "off"), name="zoom.csv")
    done = brokk("mode=convert", *options, "session.out=none", code=2)
    assert done.code == 2
    assert "zoom.csv: line 9 (row 7), column 'Boom Cmd': 'off' is not a number" in done.err
    assert not list(Path("none").rglob("*.parquet"))


def test_two_logs_of_one_name_are_refused(tmp_path: Path) -> None:
    for folder in ("monday", "tuesday"):
        (tmp_path / folder).mkdir()
        logged(tmp_path / folder, lines())
    with pytest.raises(RecordingError, match="would become the same recording"):
        find_logs(f"{tmp_path}/*/dig.csv")
