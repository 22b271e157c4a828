"""Logs as people have them are read right, or refused with advice that a test follows to the letter."""

from __future__ import annotations

import json
import math
import re
from datetime import UTC, datetime, timedelta
from decimal import Decimal
from pathlib import Path
from typing import Any

import can
import cantools
import numpy as np
import pandas as pd
import pytest
import scipy.io
from log_import import delay, import_log, try_draft, write_messages

from actuators.recordings.guess import ADVICE
from actuators.recordings.log_files import open_log
from actuators.recordings.signal_checks import find_jumps, find_spikes, find_wrap
from brokk_rl import extensions
from brokk_rl.errors import RecordingError
from diagnosis import api

pytestmark = pytest.mark.usefixtures("empty_folder")
RATE_HZ = 50.0
LAG = 5
NAMES = ("time_s", "hip_target_rad", "hip_pos_rad", "knee_target_rad", "knee_pos_rad")


def make_rows(num: int = 600) -> np.ndarray:
    """Returns time, target and position of the hip, target and position of the knee, `(T, 5)`."""
    t_s = np.arange(num) / RATE_HZ
    hip = 0.5 * np.sin(0.9 * t_s) + 0.2 * np.sin(2.3 * t_s)
    knee = 0.4 * np.sin(1.7 * t_s + 1.0) - 0.3 * np.sin(0.6 * t_s)
    return np.stack([t_s, hip, delay(hip, LAG), knee, delay(knee, LAG)], 1)


def write_text(path: str, rows: np.ndarray, names: tuple[str, ...] = NAMES) -> None:
    lines = [",".join(f"{value:.6f}" for value in row) for row in rows]
    Path(path).write_text("\n".join([",".join(names), *lines]) + "\n")


def check_joints(recordings: list[dict[str, Any]], num: int = 600, atol: float = 2e-3) -> None:
    assert sum(len(one["t_s"]) for one in recordings) >= 0.98 * num
    expected = make_rows(num)
    found = recordings[0]
    rows = len(found["t_s"])
    np.testing.assert_allclose(found["q_hip_rad"], expected[:rows, 2], atol=atol)
    np.testing.assert_allclose(found["q_knee_rad"], expected[:rows, 4], atol=atol)


def check_import(option: str) -> None:
    done, recordings = import_log(option)
    assert done.code == 0, done.err
    assert "No guess is unsure" in done.out
    check_joints(recordings)


def follow_advice(text: str) -> str:
    """Returns the setting that a message advises, as it is typed."""
    found = re.search(r"'(log\.\w+=[^']+)'|(log\.\w+=[^\s,;]+)", text)
    assert found is not None, text
    return found[1] or found[2]


def german(rows: np.ndarray, end: str) -> list[str]:
    shown = rows.copy()
    shown[:, 0] *= 1000.0
    shown[:, 1:] = np.degrees(shown[:, 1:])
    return [";".join(f"{v:.4f}".replace(".", ",") for v in row) + end for row in shown]


GERMAN = "Zeit [ms];Soll Hip [°];Ist Hip [°];Soll Knee [°];Ist Knee [°]"
COMMAS = [",".join(f"{v:.6f}" for v in row) for row in make_rows()]
QUOTED = [",".join(f'"{v:.6f}"'.replace(".", ",") for v in row) for row in make_rows()]
NESTED = []
for stamp_s, hip_target, hip, knee_target, knee in make_rows().tolist():
    nested: dict[str, Any] = {"stamp": stamp_s, "target": {"hip": hip_target, "knee": knee_target}}
    NESTED.append(json.dumps(nested | {"position": {"hip": hip, "knee": knee}}))
PLAIN = [" ".join(f"{v:.6f}" for v in row) for row in make_rows()]
FORTRAN = [" ".join(f"{v:.8e}".replace("e", "D") for v in row) for row in make_rows()]
GROUPED = [";".join(f"{1e3 * v:,.3f}".replace(",", "'") for v in row) for row in make_rows()]
GROUPED_NAMES = ["time [ms]", *(f"{name.removesuffix('_rad')} [mrad]" for name in NAMES[1:])]
LABVIEW = ["LabVIEW Measurement", "***End_of_Header***", "Samples\t600\t600\t600\t600"]
THOUSANDS = [",".join(f'"{1e3 * v:,.3f}"' for v in row) for row in make_rows()]
FORMULAS = [",".join(f'"=""{v:.6f}"""' for v in row) for row in make_rows()]
DURATIONS = [line.replace(",", " sec,", 1) for line in COMMAS]
MINUTES = [f"50:{line.partition(',')[0]:>09.9},{line.partition(',')[2]}" for line in COMMAS]
TABBED = [line.replace(" ", "\t") for line in PLAIN]


def write_dates(form: str) -> list[str]:
    """Returns rows with dates; the run passes noon."""
    noon = datetime(2026, 11, 27, 11, 59, 58, tzinfo=UTC)
    lines = ["Time," + ",".join(NAMES[1:])]
    for row in make_rows():
        stamp = (noon + timedelta(seconds=float(row[0]))).strftime(form)
        lines.append(",".join([stamp, *(f"{v:.6f}" for v in row[1:])]))
    return lines


@pytest.mark.parametrize(
    ("name", "lines", "encoding"),
    [
        ("ends.csv", [GERMAN, *german(make_rows(), ";")], "utf-8"),
        ("ends_both.csv", [f"{GERMAN};", *german(make_rows(), ";")], "utf-8-sig"),
        ("latin.txt", [GERMAN, *german(make_rows(), "")], "cp1252"),
        ("wide.csv", ["sep=;", GERMAN, *german(make_rows(), "")], "utf-16"),
        ("comments.csv", ["# operator: A. N., 2 runs", "# note", ",".join(NAMES), *COMMAS], "utf-8"),
        ("units.csv", ["time,hip target,hip pos,knee target,knee pos", "s,rad,rad,rad,rad", *COMMAS], "utf-8"),
        ("marked.dat", ["# " + " ".join(NAMES), *PLAIN], "utf-8"),
        ("quotes.csv", [",".join(NAMES), *QUOTED], "utf-8"),
        ("lines.jsonl", NESTED, "utf-8"),
        ("texts.jsonl", [re.sub(r"(-?\d[-.e\d]*)", r'"\1"', line) for line in NESTED], "utf-8"),
        ("fortran.dat", [" ".join(NAMES), *FORTRAN], "utf-8"),
        ("grouped.csv", [";".join(GROUPED_NAMES), *GROUPED], "utf-8"),
        ("labview.lvm", [*LABVIEW, "\t".join([*NAMES, "Comment"]), *TABBED], "utf-8"),
        ("american.csv", write_dates("%m/%d/%Y %I:%M:%S.%f %p"), "utf-8"),
        ("matlab.csv", write_dates("%d-%b-%Y %H:%M:%S.%f"), "utf-8"),
        ("thousands.csv", [",".join(GROUPED_NAMES), *THOUSANDS], "utf-8"),
        ("formulas.csv", [",".join(NAMES), *FORMULAS], "utf-8"),
        ("durations.csv", [",".join(NAMES), *DURATIONS], "utf-8"),
        ("minutes.csv", [",".join(NAMES), *MINUTES], "utf-8"),
        ("returns.csv", [",".join(NAMES), *COMMAS], "utf-8"),
    ],
)  # fmt: skip
def test_every_layout_of_text_gives_both_joints(name: str, lines: list[str], encoding: str) -> None:
    end = "\r" if name == "returns.csv" else "\r\n"
    Path(name).write_bytes((end.join(lines) + end).encode(encoding))
    check_import(f"log.input={name}")


@pytest.mark.parametrize(
    ("unit", "factor", "text"),
    [
        ("furlong", 1.0, "its unit 'furlong' is not known"),
        ("rad", 57.3, "rad is 6.4 turns: degrees?"),
        ("deg", 1.0, "is the log in rad?"),
        ("mm", 0.4, "is the log in m?"),
        ("", 1.0 / math.tau, "no name has a unit"),
        ("", 6.0, "no name has a unit"),
    ],
)
def test_a_unit_that_is_not_known_or_cannot_be_is_never_sure(
    unit: str, factor: float, text: str
) -> None:
    end = f" [{unit}]" if unit else ""
    names = ("t [s]", *(f"{one}{end}" for one in ("hip cmd", "hip pos", "knee cmd", "knee pos")))
    write_text("a.csv", make_rows() * [1.0, factor, factor, factor, factor], names)
    done = try_draft("log.input=a.csv")
    assert text in done.out
    assert "No guess is unsure" not in done.out


def test_a_delay_beyond_the_longest_lag_is_never_sure() -> None:
    rows = make_rows(2500)
    rows[:, 2] = np.interp(rows[:, 0] - 2.0, rows[:, 0], rows[:, 1])
    write_text("a.csv", rows)
    done = try_draft("log.input=a.csv")
    assert "no longer lag is tried" in done.out
    assert "No guess is unsure" not in done.out


@pytest.mark.parametrize("kind", ["index", "durations", "decimals", "texts"])
def test_columns_of_parquet_of_every_kind_are_read(kind: str) -> None:
    rows = make_rows()
    stamps = pd.to_datetime(1_700_000_000_000 + rows[:, 0] * 1000.0, unit="ms")
    frame = pd.DataFrame(rows[:, 1:], columns=NAMES[1:])
    times = {"index": stamps, "durations": stamps - stamps[0], "texts": stamps.astype(str)}
    frame.insert(0, "time", times.get(kind, rows[:, 0]))
    if kind == "index":
        frame = frame.set_index("time").rename_axis(None)
    if kind == "decimals":
        frame["hip_pos_rad"] = frame["hip_pos_rad"].map(lambda value: Decimal(f"{value:.6f}"))
    frame.to_parquet("a.parquet")
    check_import("log.input=a.parquet")


def test_a_list_that_is_empty_at_first_is_read_and_a_position_without_command_is_told() -> None:
    rows = make_rows()
    targets = [None, *([one] for one in rows[1:, 1])]
    positions = [None, *(rows[1:, 2::2].tolist())]
    frame = pd.DataFrame({"time": rows[:, 0], "target": targets, "position": positions})
    frame.to_parquet("a.parquet")
    done, recordings = import_log("log.input=a.parquet", "log.damaged=skip")
    assert "positions that move without a command: position[1]" in done.out
    np.testing.assert_allclose(recordings[0]["q_joint_0_rad"][1:], rows[2:, 2], atol=2e-3)


@pytest.mark.parametrize(
    ("name", "text"),
    [("a.csv.gz", "unpack it"), ("a.xlsx", "save its sheet as CSV"), ("a.json", ".jsonl"), ("a.mf4", "asammdf")],
)  # fmt: skip
def test_a_file_that_is_no_log_yet_is_refused_with_what_makes_one_of_it(
    name: str, text: str
) -> None:
    Path("raw").mkdir()
    Path("raw", name).write_bytes(b"PK\x03\x04")
    for given in ("raw", f"raw/{name}"):
        assert text in try_draft(f"log.input={given}").err


def test_rows_with_the_newest_first_are_named() -> None:
    write_text("a.csv", make_rows()[::-1])
    assert "the newest row comes first" in try_draft("log.input=a.csv").err


def test_targets_beside_joints_commanded_by_speed_fit_into_the_draft() -> None:
    rows = make_rows()
    rows[:, 1] = np.where(rows[:, 0] % 4 < 2, 0.4, -0.4)  # steps of a target
    rows[:, 2] = np.convolve(rows[:, 1], np.full(20, 0.05))[: len(rows)]
    rows[:, 3] = np.gradient(rows[:, 3], rows[:, 0])
    names = ("time_s", "hip_target_rad", "hip_pos_rad", "knee_cmd_rad_s", "knee_pos_rad")
    write_text("a.csv", rows, names)
    done, recordings = import_log("log.input=a.csv")
    assert "No guess is unsure" in done.out and len(recordings) == 1


def test_a_comma_that_is_delimiter_and_decimal_sign_is_named() -> None:
    lines = [line.replace(".", ",") for line in COMMAS]
    Path("a.csv").write_text("\n".join([",".join(NAMES), *lines]) + "\n")
    done = try_draft("log.input=a.csv")
    assert done.code == 2
    assert "the comma is both delimiter and decimal sign" in done.err


@pytest.mark.parametrize("kind", ["pair", "counter", "epoch"])
def test_stamps_of_several_kinds_are_read(kind: str) -> None:
    rows = make_rows()
    names: tuple[str, ...] = ("sec", "nanosec", *NAMES[1:])
    if kind == "pair":
        ns = 1_574_946_000_350_000_000 + np.round(rows[:, 0] * 1e9).astype(np.int64)
        clock = np.stack([ns // 10**9, ns % 10**9], 1).astype(float)
    elif kind == "counter":  # of milliseconds in 16 bits
        clock = (np.round(rows[:, :1] * 1000.0) + 60_000) % 65536
        names = ("timestamp_ms", *NAMES[1:])
    else:
        clock = 1.7e12 + rows[:, :1] * 1000.0
        names = ("timestamp", *NAMES[1:])
    write_text("a.csv", np.column_stack([clock, rows[:, 1:]]), names)
    check_import("log.input=a.csv")


def test_rows_that_are_lost_by_chance_do_not_cut_a_log_into_pieces() -> None:
    rows = make_rows(2000)
    is_kept = np.random.default_rng(2).random(len(rows)) > 0.2
    is_kept[900:960] = False
    write_text("a.csv", rows[is_kept])
    done, recordings = import_log("log.input=a.csv")
    assert "1 gaps, 1.2" in done.out and "1 runs, 0.6 minutes" in done.out
    assert [round(one["t_s"][-1]) for one in recordings] == [18, 21]


@pytest.mark.parametrize(
    ("kind", "modulus"), [("angle", 2 * np.pi), ("counter", 4096.0), ("position", 2 * np.pi)]
)
def test_wraps_are_taken_out_and_said(kind: str, modulus: float) -> None:
    rows = make_rows()
    scale = 4096.0 / (2 * np.pi) if kind == "counter" else 1.0
    begin = 0.0 if kind == "counter" else np.pi
    turned = scale * (rows[:, 1:3] + begin)  # the hip passes through the end of the turn
    half = 0.0 if kind == "counter" else modulus / 2
    wrapped = np.mod(turned + half, modulus) - half
    if kind == "position":  # the driver unwraps its targets only
        wrapped[:, 0] = turned[:, 0]
    names = ("time_s", "hip_target", "hip_pos")
    write_text("a.csv", np.column_stack([rows[:, 0], np.round(wrapped, 0 if half == 0.0 else 6)]), names)  # fmt: skip
    unit = "0.00153398 rad" if kind == "counter" else "rad"
    done, recordings = import_log("log.input=a.csv", f"log.position_unit={unit}")
    assert done.code == 0, done.err
    assert "hip: wraps" in done.out
    q = recordings[0]["q_hip_rad"]
    np.testing.assert_allclose(q - q[0], rows[: len(q), 2] - rows[0, 2], atol=5e-3)
    done = try_draft("log.input=a.csv", f"log.position_unit={unit}", "log.wraps=0")
    assert "No guess is unsure" not in done.out


def test_steps_that_no_machine_makes_are_found() -> None:
    t_s = np.arange(1000) / RATE_HZ
    q = 300.0 * np.sin(0.5 * t_s)
    wrap = find_wrap(np.where(np.round(q) < 0, 32768 - np.round(q), np.round(q)))
    assert wrap is not None and wrap.modulus == -32768.0
    assert find_wrap(q) is None
    # a square wave goes on at the same speed too
    assert find_wrap(0.5 * np.sign(np.sin(t_s))) is None
    mixed = np.where(np.arange(1000) % 2, 0.0, q)
    assert len(find_spikes(mixed)) > 300
    assert not len(find_spikes(q))
    reset = q + 200.0 * (np.arange(1000) >= 500)
    for cause in (np.zeros(1000), 300.0 * np.sin(0.5 * t_s + 0.1)):
        assert find_jumps(t_s, reset, cause).tolist() == [499]
    step = np.where(t_s > 5.0, 1.0, 0.0)
    assert not len(find_jumps(t_s, delay(step, LAG), step))


def test_what_is_given_is_weighed_like_a_guess() -> None:
    rows = make_rows()
    rows[:, 4] = np.random.default_rng(0).normal(size=len(rows))
    write_text("a.csv", rows)
    given = 'log.joints={knee: ["knee_target_rad", "knee_pos_rad"]}'
    done, _ = import_log("log.input=a.csv", given, "log.command=position")
    assert done.code == 0, done.err
    assert "the numbers speak against what was given" in done.out
    assert "No guess is unsure" not in done.out


def test_a_drive_that_is_off_is_said_with_its_times() -> None:
    rows = make_rows()
    rows[300:450, 4] = rows[300, 4]
    frame = pd.DataFrame(rows, columns=NAMES).assign(knee_torque_enable="on")
    frame.loc[300:449, "knee_torque_enable"] = "off"
    frame.to_json("a.jsonl", orient="records", lines=True)
    done = try_draft("log.input=a.jsonl")
    assert "knee: its drive is off in 25% of the rows, first at 6.00 s, last at 8.98 s" in done.out


@pytest.mark.parametrize("kind", ["structure", "matrices"])
def test_signals_of_simulink_are_read(kind: str) -> None:
    rows = make_rows()
    targets, positions = rows[:, 1:4:2], rows[:, 2:5:2]
    if kind == "structure":
        signals = [
            {"values": targets, "label": "target_rad"},
            {"values": positions, "label": "position_rad"},
        ]
        content: Any = {"simout": {"time": rows[:, :1], "signals": np.array(signals)}}
    else:  # rows, columns, time
        content = {"target_rad": targets.T[:, None], "position_rad": positions.T[:, None]}
        content["tout"] = rows[:, :1]
    scipy.io.savemat("a.mat", content)
    done, recordings = import_log("log.input=a.mat")
    assert done.code == 0, done.err
    np.testing.assert_allclose(recordings[0]["q_joint_0_rad"], rows[: len(recordings[0]["t_s"]), 2], atol=2e-3)  # fmt: skip


DBC = """VERSION ""
BU_: PC
BO_ 2566844672 Cmd: 8 PC
 SG_ Page M : 0|4@1+ (1,0) [0|15] "" PC
 SG_ hip_target m0 : 8|16@1- (0.0001,0) [-1|1] "rad" PC
 SG_ knee_target m1 : 24|16@1- (0.0001,0) [-1|1] "rad" PC
BO_ 257 Encoder: 8 PC
 SG_ hip_position : 0|16@1- (0.0001,0) [-1|1] "rad" PC
 SG_ knee_position : 16|16@1- (0.0001,0) [-1|1] "rad" PC
"""


def list_frames(foreign: bool) -> list[can.Message]:
    """Returns commands as pages of one message, positions, and frames of a foreign device."""
    database: Any = cantools.database.load_string(DBC)
    found = []
    for number, row in enumerate(make_rows()):
        contents = (
            ("Cmd", {"Page": 0, "hip_target": row[1]}),
            ("Cmd", {"Page": 1, "knee_target": row[3]}),
            ("Encoder", {"hip_position": row[2], "knee_position": row[4]}),
        )
        for place, (name, content) in enumerate(contents):
            message = database.get_message_by_name(name)
            found.append(
                can.Message(
                    timestamp=1.7e9 + number / RATE_HZ + 0.001 * place, arbitration_id=message.frame_id,
                    is_extended_id=message.is_extended_frame, data=message.encode(content, strict=False), channel=0,
                )
            )  # fmt: skip
        if foreign:
            time_s = 1.7e9 + number / RATE_HZ + 0.007
            found.append(can.Message(time_s, 257, data=b"\x55" * 8, channel=0))
    return found


@pytest.mark.parametrize("name", ["a.blf", "a.asc", "a.log", "printed.txt", "dated.txt"])
def test_pages_and_kinds_of_identifiers_are_sources_of_their_own(name: str) -> None:
    Path("a.dbc").write_text(DBC)
    frames = list_frames(foreign=True)
    if name.endswith(".txt"):
        lines = []
        for frame in frames:
            number = f"{frame.arbitration_id:0{8 if frame.is_extended_id else 3}X}"
            stamp = f"{frame.timestamp:.6f}"
            if name == "dated.txt":
                stamp = f"{datetime.fromtimestamp(frame.timestamp, UTC):%Y-%m-%d %H:%M:%S.%f}"
            lines.append(f" ({stamp})  can0  {number}   [8]  {frame.data.hex(' ').upper()}")
        Path(name).write_text("\n".join(lines) + "\n")
    else:
        with can.Logger(name) as logger:
            for frame in frames:
                logger.on_message_received(frame)
    done, recordings = import_log(f"log.input={name}", "log.dbc=a.dbc")
    assert done.code == 0, done.err
    assert "No guess is unsure" in done.out
    found = recordings[0]
    rows = make_rows()
    expected = np.interp(found["t_s"], rows[:, 0] - found["t_s"][0], rows[:, 4])
    assert np.abs(found["q_knee_rad"] - expected).max() < 0.01


def write_bus(num_channels: int) -> None:
    Path("a.dbc").write_text(DBC)
    with can.Logger("a.blf") as logger:
        for frame in list_frames(foreign=False):
            for channel in range(num_channels):
                frame.channel = channel
                frame.timestamp += 0.0004 * channel
                logger.on_message_received(frame)


def test_a_cut_off_log_of_a_bus_and_one_without_its_dbc_are_refused() -> None:
    write_bus(num_channels=1)
    assert "log.dbc=<file>" in try_draft("log.input=a.blf").err
    assert "cannot be read" in try_draft("log.input=a.blf", "log.dbc=none.dbc").err
    Path("a.blf").write_bytes(Path("a.blf").read_bytes()[:-40])
    assert "a.blf: cut off at byte" in try_draft("log.input=a.blf", "log.dbc=a.dbc").err


def write_structures(rows: np.ndarray, apart_s: float) -> None:
    """Writes targets and positions, each on a clock of its own."""
    sides = {}
    for name, first, begin_s in (("target_rad", 1, 0.0), ("position_rad", 2, apart_s)):
        signals = {"values": rows[:, first::2], "label": ""}
        sides[name] = {"time": rows[:, :1] + begin_s, "signals": signals}
    scipy.io.savemat("a.mat", sides)


def write_advised(case: str) -> list[str]:
    """Writes a log about which a key is advised; returns the options of its import."""
    rows, names = make_rows(1200 if case == "set back" else 600), NAMES
    plain = tuple(name.removesuffix("_rad") for name in NAMES)
    match case:
        case "channel":
            write_bus(num_channels=2)
            return ["log.input=a.blf", "log.dbc=a.dbc"]
        case "dbc":
            write_bus(num_channels=1)
            return ["log.input=a.blf"]
        case "offset":
            write_structures(rows, 5000.0)
            return ["log.input=a.mat"]
        case "headerless":
            Path("a.dat").write_text("\n".join(PLAIN) + "\n")
            return ["log.input=a.dat"]
        case "short line" | "word for a time":
            word = "soon," + COMMAS[400].partition(",")[2]
            damaged = word if case == "word for a time" else COMMAS[400].rpartition(",")[0]
            lines = [*COMMAS[:400], damaged, *COMMAS[401:]]
            Path("a.csv").write_text("\n".join([",".join(NAMES), *lines]) + "\n")
            return ["log.input=a.csv"]
        case "repeated rows":
            rows = np.repeat(rows, np.tile([1, 3], len(rows) // 2), axis=0)
        case "set back":
            rows[600:, 0] -= 3600.0
        case "coarse clock":
            rows[:, 0] = np.floor(rows[:, 0])
        case "no time":
            rows, names = rows[:, 1:], NAMES[1:]
        case "lost zeros":  # seconds and nanoseconds joined by a point
            parts = [(int(t_s), round(t_s % 1.0 * 1e9)) for t_s in rows[:, 0]]
            rows[:, 0] = [float(f"{second}.{nano}") for second, nano in parts]
        case "differences":
            rows[:, 0], names = 0.02, ("dt_s", *NAMES[1:])
        case "repeated names":
            names = ("time_s", "target", "position", "target", "position")
        case "wraps":
            rows[:, 1:] = np.mod(np.round(rows[:, 1:] * 652.0), 4096.0)
            write_text("a.csv", rows, plain)
            return ["log.input=a.csv", "log.position_unit=0.00153 rad"]
        case "unit":
            rows[:, 1:], names = np.round(2000.0 + rows[:, 1:] * 652.0), plain
        case "command":
            wave = np.sin(2.0 * np.pi * rows[:, :1] / 4.0)
            rows = np.column_stack([rows[:, 0], 3.0 * wave, delay(wave, LAG)])
            names = ("time_s", "hip_action", "hip_pos_rad")
        case "time":
            rows[:, 0], names = 2.0 * np.arange(len(rows)), ("x", *NAMES[1:])
    write_text("a.csv", rows, names)
    return ["log.input=a.csv"]


ADVISED = {
    "repeated rows": "damaged",
    "set back": "damaged",
    "short line": "damaged",
    "word for a time": "damaged",
    "coarse clock": "rate",
    "no time": "rate",
    "lost zeros": "rate",
    "differences": "rate",
    "time": "time",
    "headerless": "joints",
    "repeated names": "joints",
    "channel": "channel",
    "offset": "offset",
    "dbc": "dbc",
    "wraps": "wraps",
    "unit": "unit",
    "command": "command",
}
"""Key that is advised about each log."""


@pytest.mark.parametrize("case", ADVISED)
def test_advice_that_is_followed_to_the_letter_reads_the_log(case: str) -> None:
    options = write_advised(case)
    key = ADVISED[case]
    first = try_draft(*options)
    text = first.err or first.out
    begin = ADVICE[key].split("{")[0]
    assert begin in text, text
    advised = follow_advice(text[text.index(begin) :]).replace("<file>", "a.dbc")
    done, recordings = import_log(*options, advised)
    assert done.code == 0, done.err
    assert "fill in ???" not in done.out
    expected = make_rows(1200)
    for name in recordings[0]:
        other = ("wraps", "unit", "command", "time", "short line", "word for a time")
        if name == "q_hip_rad" and case not in other:
            q = recordings[0][name]
            np.testing.assert_allclose(q, expected[: len(q), 2], atol=2e-3)
    if case == "set back":
        assert [len(one["t_s"]) for one in recordings] == [600, 600]


def test_each_advice_is_followed_by_a_test() -> None:
    assert set(ADVISED.values()) == set(ADVICE)


def test_arm_and_wheels_on_one_topic_keep_their_own_rates() -> None:
    messages = []
    for number, row in enumerate(make_rows()):
        names = ["hip", "knee"]
        messages.append((row[0], "/joint_states", {"name": names, "position": [row[2], row[4]]}))
        content = {"layout": {"data_offset": 0}, "name": names, "target": [row[1], row[3]]}
        messages.append((row[0], "/command", content))
        for part in range(4):
            content = {"name": ["7"], "position": [0.1 * number + 0.02 * part]}
            messages.append((row[0] + 0.001 + 0.004 * part, "/joint_states", content))
    write_messages("a.mcap", messages)
    done, recordings = import_log("log.input=a.mcap")
    assert done.code == 0, done.err
    assert "2 joints at 50 Hz" in done.out
    columns = next(open_log(Path("a.mcap")).read_runs(None)).tables
    joints = ["position[hip]", "position[knee]", "position[7]"]
    assert [*columns["/joint_states"].columns] == ["log_time", *joints]
    assert "layout" not in "".join(columns["/command"].columns)
    check_joints(recordings)


@pytest.mark.parametrize("is_stamped", [True, False])
def test_two_programs_on_one_topic_are_never_sure_and_a_stamp_of_zero_is_no_clock(
    is_stamped: bool,
) -> None:
    messages = []
    for row in make_rows():
        second = 1700 + int(row[0]) if is_stamped else 0
        nano = round(1e9 * (row[0] % 1.0)) if is_stamped else 0
        content = {"header": {"stamp": {"sec": second, "nanosec": nano}}, "name": ["hip"]}
        messages.append((row[0], "/joint_states", {**content, "position": [row[2]]}))
        messages.append((row[0], "/command", {**content, "target": [row[1]]}))
        if is_stamped:
            messages.append((row[0] + 0.001, "/joint_states", {**content, "position": [0.0]}))
    write_messages("a.mcap", messages)
    done = try_draft("log.input=a.mcap")
    assert ("two programs send on one topic" in done.out) is is_stamped
    assert ("No guess is unsure" in done.out) is not is_stamped


def test_the_next_log_of_a_kind_fits_into_the_draft() -> None:
    rows = make_rows()
    write_text("a.csv", rows)
    import_log("log.input=a.csv")
    rows[:, 1:] *= 1.05
    write_text("b.csv", rows)
    reader, machine = (extensions.load_option(one, f"@{one}.yaml") for one in ("import", "machine"))
    (recording,) = reader.read(Path("b.csv"), machine)
    assert recording.num_samples == len(rows)


@pytest.mark.parametrize("command", ["position", "velocity", "torque"])
def test_arrays_become_recordings_of_a_drafted_machine(command: Any) -> None:
    rows = make_rows()
    force = 3.0 if command == "torque" else None
    found = api.from_arrays(rows[:, 0], rows[:, 1::2], rows[:, 2::2], command, ("hip", "knee"), max_force=force)  # fmt: skip
    assert {joint.command for joint in found.machine.joints} == {"valve" if command == "velocity" else command}  # fmt: skip
    (recording,) = found.recordings
    np.testing.assert_allclose(recording.q[:, 1], rows[: recording.num_samples, 4], atol=2e-3)
    with pytest.raises(RecordingError, match="as many joints"):
        api.from_arrays(rows[:, 0], rows[:, 1], rows[:, 2::2], command)
