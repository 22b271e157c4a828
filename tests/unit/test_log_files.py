"""Logs of every kind become the same recording; a damaged one is refused by its place."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
from carriage import NUM, check, make_map, make_signals
from hypothesis import given, settings
from hypothesis import strategies as st
from log_import import write_csv

from actuators.recordings.column_map import AlignedTime, Column, ColumnMap, CommandColumn
from actuators.recordings.log_files import find_logs, open_log
from actuators.recordings.log_tables import parse_expression
from brokk_rl.errors import ConfigError, RecordingError
from brokk_rl.machine import Machine


def write_lists(path: Path) -> None:
    columns = (values.tolist() for values in make_signals().values())
    rows = [f'{t!r},"[{u!r}, {q!r}]"' for t, u, q in zip(*columns, strict=True)]
    path.write_text("\n".join(["t,both", *rows]) + "\n")


def write_kind(path: Path) -> ColumnMap:
    """Writes the signals as the ending of `path` says, by the library of that format."""
    signals = make_signals()
    if path.suffix == ".parquet":
        pq.write_table(pa.table(signals), path)
    elif path.suffix == ".npz":
        np.savez_compressed(path, **signals)
    elif path.suffix == ".mat":
        scipy.io.savemat(path, signals)
    elif path.stem == "lists":
        write_lists(path)
        return make_map("both[0]", "both[1]")
    else:
        write_csv(path, signals)
    return make_map()


@pytest.mark.parametrize("name", ["a.csv", "lists.csv", "a.parquet", "a.npz", "a.mat"])
def test_every_kind_of_file_gives_the_same_recording(
    tmp_path: Path, carriage: Machine, name: str
) -> None:
    reader = write_kind(tmp_path / name)
    (recording,) = reader.read(tmp_path / name, carriage)
    check(recording)


def write_lerobot(folder: Path, version: str) -> None:
    """Writes two episodes as LeRobot lays them out: a file each, or one file for both."""
    signals = make_signals()
    (folder / "meta").mkdir(parents=True)
    names = {"motors": ["slide"]} if version == "v2.1" else ["slide"]
    feature = {"dtype": "float32", "shape": [1], "names": names}
    info = {"codebase_version": version, "fps": 100, "features": {"action": feature, "observation.state": feature}}  # fmt: skip
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    episodes = []
    for number in range(2):
        columns = {
            "timestamp": pa.array(signals["t"]),
            "action": pa.array([[v] for v in signals["u"]], pa.list_(pa.float32(), 1)),
            "observation.state": pa.array([[v] for v in signals["q"]], pa.list_(pa.float32())),
            "episode_index": pa.array([number] * NUM),
        }
        episodes.append(pa.table(columns))
    (folder / "data" / "chunk-000").mkdir(parents=True)
    if version == "v2.1":
        for number, table in enumerate(episodes):
            pq.write_table(table, folder / "data" / "chunk-000" / f"episode_{number:06d}.parquet")
    else:
        pq.write_table(pa.concat_tables(episodes), folder / "data/chunk-000/file-000.parquet")


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_each_episode_of_a_lerobot_dataset_is_a_run(
    tmp_path: Path, carriage: Machine, version: str
) -> None:
    write_lerobot(tmp_path / "set", version)
    reader = make_map("action[slide]", "observation.state[slide]", "timestamp")
    recordings = reader.read(tmp_path / "set", carriage)
    assert [recording.run for recording in recordings] == ["set_000000", "set_000001"]
    for recording in recordings:
        check(recording)


def test_an_older_lerobot_dataset_is_refused_by_its_version(tmp_path: Path) -> None:
    write_lerobot(tmp_path / "set", "v1.6")
    with pytest.raises(RecordingError, match=r"codebase_version is 'v1.6', expected v2.x or v3.x"):
        open_log(tmp_path / "set")


def test_a_folder_of_folders_gives_the_logs_below_it(tmp_path: Path) -> None:
    for name in ("b", "a"):
        (tmp_path / "raw" / name).mkdir(parents=True)
        for source in ("control", "state"):
            write_csv(tmp_path / "raw" / name / f"{source}.csv", make_signals())
    (tmp_path / "raw" / "notes").mkdir()
    write_csv(tmp_path / "raw" / "c.csv", make_signals())
    found = find_logs(str(tmp_path / "raw"))
    assert [path.name for path in found] == ["a", "b", "c.csv"]
    with pytest.raises(RecordingError, match="no log in this folder"):
        find_logs(str(tmp_path / "raw" / "notes"))


def test_arithmetic_stands_in_the_place_of_a_column(tmp_path: Path, carriage: Machine) -> None:
    signals = make_signals()
    target = {"t": signals["t"], "target pos": signals["u"] + signals["q"], "q": signals["q"]}
    write_csv(tmp_path / "a.csv", target)
    (recording,) = make_map("`target pos` - q").read(tmp_path / "a.csv", carriage)
    check(recording)


def test_an_expression_is_what_python_computes() -> None:
    a, b, c = np.random.default_rng(0).normal(size=(3, 50))
    parsed = parse_expression("-(a + 2.5e0*`b b`) / q[c].x - .5 * (a - -`b b`)")
    assert parsed.names == ("a", "b b", "q[c].x")
    found = parsed.evaluate({"a": a, "b b": b, "q[c].x": c})
    np.testing.assert_allclose(found, -(a + 2.5 * b) / c - 0.5 * (a - -b))


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os').system('true')", "a.b()", "a if b else c", "a ** b", "lambda: a", "[a]",
        "a @ b", "'a'", "a and b", "3 + 4", "", "a[b()]", "(" * 400 + "a" + ")" * 400,
        "a (b)", "2 (a)", "a;b", "a\x00b", "1j * a", "a" * 2000,
    ],
)  # fmt: skip
def test_anything_but_arithmetic_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="expression"):
        parse_expression(text)


@settings(deadline=None, max_examples=100)
@given(st.text(max_size=60))
def test_any_text_is_parsed_or_refused(text: str) -> None:
    try:
        parse_expression(text)
    except ConfigError:
        return


def test_a_sensor_clock_with_drift_is_tied_to_the_recorder() -> None:
    generator = np.random.default_rng(0)
    true_s = np.arange(6000) * 0.01
    stamp_s = (true_s - 37.0) * (1.0 - 40e-6)  # runs 40 ppm slow, with another zero
    recorder_s = true_s + 0.002 + generator.exponential(0.004, len(true_s))
    time = AlignedTime(column="s", scale=1.0, anchor=Column(column="r", scale=1.0, offset=0.0))
    aligned_s = time.align(stamp_s, recorder_s)
    # the transport's shortest time cannot be told from the clock's zero
    assert np.abs(aligned_s - (true_s + 0.002)).max() < 0.0005
    assert np.abs(recorder_s - (true_s + 0.002)).max() > 0.01


def test_commands_that_go_one_way_only_are_read(tmp_path: Path, carriage: Machine) -> None:
    signals = make_signals() | {"u": np.abs(make_signals()["u"])}
    write_csv(tmp_path / "a.csv", signals)
    (recording,) = make_map(full_minus=None).read(tmp_path / "a.csv", carriage)
    np.testing.assert_array_equal(recording.u[:, 0], signals["u"].astype(np.float32))
    other = CommandColumn(column="u", neutral=0.0, full_plus=None, full_minus=1.0)
    np.testing.assert_array_equal(other.command(np.array([0.0, 0.5])), [0.0, -0.5])
    write_csv(tmp_path / "b.csv", make_signals())
    with pytest.raises(RecordingError, match=r"b\.csv: line \d+ \(row \d+\), column 'u': -\S+ lies on the side"):  # fmt: skip
        make_map(full_minus=None).read(tmp_path / "b.csv", carriage)
    with pytest.raises(ConfigError, match="got None and None"):
        CommandColumn(column="u", neutral=0.0, full_plus=None, full_minus=None)


@pytest.mark.parametrize("name", ["a.parquet", "a.npz", "a.mat"])
@settings(deadline=None, max_examples=12)
@given(place=st.floats(0.0, 0.999))
def test_a_cut_off_file_is_refused_by_name(
    tmp_path_factory: pytest.TempPathFactory, carriage: Machine, name: str, place: float
) -> None:
    path = tmp_path_factory.mktemp("cut") / name
    reader = write_kind(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(place * len(whole))])
    with pytest.raises(RecordingError, match=str(path)):
        reader.read(path, carriage)


def test_a_file_with_the_ending_of_another_kind_is_named(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", **make_signals())
    (tmp_path / "a.npz").rename(tmp_path / "a.csv")
    with pytest.raises(RecordingError, match=r"ends in '\.csv', .* a NumPy archive; rename it to end in '\.npz'"):  # fmt: skip
        open_log(tmp_path / "a.csv")
    (tmp_path / "b.csv").touch()
    with pytest.raises(RecordingError, match=r"b\.csv: the file is empty"):
        open_log(tmp_path / "b.csv")


@pytest.mark.parametrize("ending", ["npz", "mat"])
def test_a_damaged_array_is_named(tmp_path: Path, carriage: Machine, ending: str) -> None:
    path = tmp_path / f"a.{ending}"
    if ending == "npz":
        np.savez(path, **make_signals())
        data = bytearray(path.read_bytes())
        at = data.index(b"q.npy") + 300
        data[at : at + 4] = b"\xff\xff\xff\xff"
    else:
        values = np.random.default_rng(0).random(4000)
        content = {"t": np.arange(4000) * 0.01, "u": values, "q": values}
        scipy.io.savemat(path, content, do_compression=True)
        data = bytearray(path.read_bytes())
        data[-16000:] = bytes(16000)  # the second half of the last array
    path.write_bytes(data)
    with pytest.raises(RecordingError, match=rf"a\.{ending}: array 'q' "):
        make_map().read(path, carriage)


def test_a_list_of_another_length_is_refused_by_its_line(tmp_path: Path, carriage: Machine) -> None:
    write_lists(tmp_path / "a.csv")
    lines = (tmp_path / "a.csv").read_text().splitlines()
    lines[70] = lines[70].replace(", ", ", 1.0, ")
    (tmp_path / "a.csv").write_text("\n".join(lines) + "\n")
    with pytest.raises(RecordingError, match=r"line 71 \(row 69\), column 'both\[1\]': '.*1.0, .*' is not a number"):  # fmt: skip
        make_map("both[0]", "both[1]").read(tmp_path / "a.csv", carriage)


def test_pickled_objects_are_never_loaded(tmp_path: Path, carriage: Machine) -> None:
    np.savez(tmp_path / "a.npz", **make_signals(), evil=np.array([{}] * NUM, dtype=object))
    assert "evil" not in next(open_log(tmp_path / "a.npz").read_runs(None)).places
    (recording,) = make_map().read(tmp_path / "a.npz", carriage)
    check(recording)


def test_a_damaged_line_in_a_folder_of_csv_files_is_left_out_where_asked(tmp_path: Path) -> None:
    rows = [f"{0.05 * k},{k}" for k in range(100)]
    (tmp_path / "goals.csv").write_text("\n".join(["t_s,goal", *rows, ""]))
    lines = ["t_s,q", *rows[:50], "2.5,1,7", *rows[50:], ""]
    (tmp_path / "states.csv").write_text("\n".join(lines))
    with pytest.raises(RecordingError, match=r"states.csv: line 52 .*log.damaged=skip"):
        next(open_log(tmp_path).read_runs(None))
    (run,) = open_log(tmp_path, damaged="skip").read_runs(None)
    assert run.tables["states"].columns["q"].tolist() == list(range(100))


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="expected a folder with the CSV files"):
        open_log(tmp_path)
