"""Captures: what is written, what a crash leaves, and the recordings that are made of them."""

from __future__ import annotations

import json
import os
import random
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zstandard
from composed import MACHINE
from conftest import Brokk, Note
from desk import DBC
from mcap.reader import make_reader
from mcap.records import Chunk

from brokk_rl import record
from brokk_rl.errors import RecordingError
from deploy.bus.description import BusDescription
from deploy.kernel.bus_process import FRAME, FRAMES
from deploy.recorder import capture_reader
from deploy.recorder.capture import MCAP, CaptureConfig, CaptureWriter
from deploy.recorder.conversion import CaptureLogReader
from deploy.runtime.shm_layout import TEXT

READER = CaptureLogReader(longest_gap_s=0.15, shortest_s=1.0)


def write(
    folder: Path,
    seconds: float = 3.0,
    gap_s: float = 0.0,
    close: bool = True,
    advice_until_s: float = np.inf,
) -> CaptureWriter:
    """Writes a capture of a machine whose first joint follows a known path: q1 = 0.1 t, flow a step of 0.5 at 1.025 s."""
    bus = BusDescription(DBC, MACHINE)
    log = CaptureWriter(CaptureConfig(folder, DBC, MACHINE, {"source": "test"}, 0.0))
    begun_s, counter = time.monotonic(), 0
    for k in range(round(seconds * 100)):
        t_s = k * 0.01
        values = {"OilTemperature": 35.0}
        for j in range(1, 6):
            values |= {f"Position_q{j}": 0.1 * t_s, f"Valid_q{j}": 1.0}
        if t_s > 1.02:
            values |= {"Flow_q1": 0.5, "Flow_q3": 0.5}
        if gap_s and 1.5 <= t_s < 1.5 + gap_s:
            continue
        names = ["JointPos1", "JointPos2", "JointPos3"]
        if k % 2 == 0:
            names += ["ValveFeedback", "MachineStatus"]
        data = b""
        for name in names:
            payload = bus.encode(name, values, counter)
            data += FRAME.pack(begun_s + t_s, bus.layouts[name].frame_id, 0, len(payload)) + payload
        counter += 1
        log.add(FRAMES + data)
        if k % 5 == 0 and t_s < advice_until_s:
            told = {"topic": "advice", "t_s": begun_s + t_s, "target_in_base_m": [2.6, 0.0, 0.75]}
            told |= {"u": [0.1] * 5, "reason": "history is filling", "observation": []}
            if t_s > 0.5:
                told |= {"reason": "valid", "observation": [t_s, 2.0]}
            log.add(TEXT + json.dumps(told).encode())
        if k % 50 == 0:
            log.flush()
    if close:
        log.__exit__(None)
    return log


def test_a_capture_becomes_the_recording_of_what_happened(tmp_path: Path) -> None:
    write(tmp_path)
    (found,) = READER.read(tmp_path / MCAP, MACHINE)
    record.write_recording(found, tmp_path / "x.parquet")
    again = record.read_recording(tmp_path / "x.parquet", MACHINE)
    assert again.rate_hz == 20.0 and again.num_samples == pytest.approx(59, abs=2)
    assert again.q[:, 0] == pytest.approx(0.1 * again.t_s, abs=1e-3)
    step = int(np.flatnonzero(again.u[:, 0] > 0)[0])
    # Part of that period.
    assert again.t_s[step] == pytest.approx(1.0)
    assert again.u[step, 0] == pytest.approx(0.2, abs=0.11)
    assert (again.u[step + 1 :, 0] == pytest.approx(0.5)) and not again.u[:, 1].any()
    assert again.extra["oil_c"] == pytest.approx(35.0) and np.isnan(again.extra["advice_q1"][5])
    assert again.extra["advice_q1"][20] == pytest.approx(0.1)
    assert again.metadata["source"] == "capture: test"


def test_rows_lie_on_the_decisions_and_hold_what_the_policy_saw(tmp_path: Path) -> None:
    write(tmp_path)
    (found,) = READER.read(tmp_path / MCAP, MACHINE)
    assert found.extra["target_x_m"][20] == pytest.approx(2.6)
    assert np.isnan(found.extra["target_x_m"][5])
    seen_s = found.extra["obs_0"][15:40]
    # q1 is 0.1 t: position and observation of a row are of the same moment.
    assert found.q[15:40, 0] == pytest.approx(0.1 * seen_s, abs=1.5e-3)
    assert found.extra["obs_1"][20] == 2.0


def test_after_its_last_decision_a_policy_sees_nothing(tmp_path: Path) -> None:
    write(tmp_path, advice_until_s=2.0)
    (found,) = READER.read(tmp_path / MCAP, MACHINE)
    seen = np.isfinite(found.extra["obs_0"])
    assert seen[15:38].all() and not seen[42:].any() and found.num_samples > 50
    assert np.isfinite(found.extra["advice_q1"][42:]).all(), "advice stays in force until withdrawn"


def test_a_gap_splits_the_recording(tmp_path: Path) -> None:
    write(tmp_path, seconds=4.0, gap_s=0.4)
    first, second = READER.read(tmp_path / MCAP, MACHINE)
    assert first.duration_s == pytest.approx(1.4, abs=0.15)
    assert second.duration_s == pytest.approx(2.0, abs=0.15)
    assert first.metadata["run"] == second.metadata["run"]


def test_nothing_that_was_flushed_is_lost_when_the_log_is_killed(tmp_path: Path) -> None:
    log = write(tmp_path, close=False)  # never closed, as after SIGKILL
    contents = capture_reader.read_capture(tmp_path / MCAP)
    positions = contents.messages["JointPos1"]
    # Flushed last at 2.5 s.
    assert not contents.whole and positions[-1][0] - positions[0][0] >= 2.49
    log.__exit__(None)


@pytest.mark.parametrize("part", [0.5, 0.7, 0.9, 0.999])
def test_a_capture_cut_off_anywhere_is_recovered_up_to_there(tmp_path: Path, part: float) -> None:
    write(tmp_path, seconds=6.0)
    whole = len(capture_reader.read_capture(tmp_path / MCAP).messages["JointPos1"])
    content = (tmp_path / MCAP).read_bytes()
    (tmp_path / f"cut_{MCAP}").write_bytes(content[: int(part * len(content))])
    found = capture_reader.read_capture(tmp_path / f"cut_{MCAP}")
    assert found.num_damaged == 0, "what was cut off was never flushed"
    assert not found.whole and found.facts["source"] == "test"
    assert min(1.0, part - 0.25) * whole <= len(found.messages["JointPos1"]) <= whole


def test_a_wrong_byte_anywhere_costs_at_most_its_chunk(
    tmp_path: Path, brokk: Brokk, record_property: Note
) -> None:
    write(tmp_path, seconds=6.0)
    path, draw = tmp_path / MCAP, random.Random(5)
    content = path.read_bytes()
    whole = capture_reader.read_capture(path)
    num_messages = sum(map(len, whole.messages.values()))
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None and whole.num_lost == whole.num_damaged == 0
    chunks = summary.chunk_indexes
    # The first bytes of each chunk hide its length, and those of the file what it is.
    places = [one.chunk_start_offset + k for one in chunks[1:4] for k in (0, 1, 3, 8, 20, 40)]
    places += [0, 8, 9, 20, 40, len(content) - 20]
    places += [draw.randrange(len(content)) for _ in range(60)]
    for place in places:
        wrong = bytearray(content)
        wrong[place] ^= 1 << draw.randrange(8)
        path.write_bytes(wrong)
        found = capture_reader.read_capture(path)
        lost = num_messages - sum(map(len, found.messages.values()))
        assert lost <= num_messages / len(chunks) * 2.5, place
        assert found.facts == whole.facts and (lost == 0 or found.num_damaged)
        share = round(lost / num_messages, 3)
        record_property(f"capture: a wrong byte, {len(chunks)} chunks; part lost", share)
    # Bytes that are missing or too many shift all that follows, the index at the end included.
    first = chunks[0].chunk_start_offset
    for begin, end in ((0, 1000), (first + 60, first + 90)):
        for shifted in (content[:begin] + content[end:], content[:end] + content[begin:]):
            path.write_bytes(shifted)
            found = capture_reader.read_capture(path)
            lost = num_messages - sum(map(len, found.messages.values()))
            assert lost <= num_messages / len(chunks) * 2.5, (begin, end)
            assert found.facts == whole.facts and found.num_damaged
    # A chunk in the middle: its number of messages is known, and the command says it by its code.
    wrong = bytearray(content)
    wrong[chunks[2].chunk_start_offset + 60] ^= 1
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / MCAP).write_bytes(wrong)
    found = capture_reader.read_capture(tmp_path / "run" / MCAP)
    # Messages for viewers are lost with it.
    assert found.num_lost >= num_messages - sum(map(len, found.messages.values())) > 0
    assert found.num_damaged == 1
    command = ("mode=convert", "import=capture", "reader.shortest_s=1", "convert.input=run/*.mcap")
    done = brokk(*command, "session.out=mended", code=2)
    assert f"{found.num_lost} messages or more are lost in 1 places" in done.err
    record_property("capture: a wrong byte; exit code of mode=convert", done.code)
    assert list((tmp_path / "mended/recordings").glob("*.parquet"))
    # What a power failure cuts off was never flushed: nothing is lost.
    (tmp_path / "run" / MCAP).write_bytes(content[:-200])
    brokk(*command, "session.out=cut")
    assert list((tmp_path / "cut/recordings").glob("*.parquet"))


def test_a_chunk_that_claims_gigabytes_is_not_opened() -> None:
    data = zstandard.ZstdCompressor().compress(bytes(1 << 20))
    chunk = Chunk("zstd", data, 0, 0, 0, 1 << 33)
    assert capture_reader._open_chunk(chunk) is None
    bomb = zstandard.ZstdCompressor().compress(bytes(capture_reader.MOST_CHUNK_BYTES + 1))
    assert capture_reader._open_chunk(Chunk("zstd", bomb, 0, 0, 0, 100)) is None


def test_a_pipe_is_no_capture(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / MCAP)
    with pytest.raises(RecordingError, match="no plain one"):
        capture_reader.read_capture(tmp_path / MCAP)


def test_frames_that_were_refused_are_kept_and_said(tmp_path: Path) -> None:
    bus = BusDescription(DBC, MACHINE)
    with CaptureWriter(CaptureConfig(tmp_path, DBC, MACHINE, {}, 0.0)) as log:
        payload = bytearray(bus.encode("JointPos1", {}, 1))
        payload[0] ^= 1
        head = FRAME.pack(time.monotonic(), bus.layouts["JointPos1"].frame_id, 0, 8)
        log.add(FRAMES + head + payload)
    refused = capture_reader.read_capture(tmp_path / MCAP).messages["refused"][0][1]
    assert (refused["fault"], refused["data"]) == ("wrong CRC", payload.hex())


def test_a_step_of_the_wall_clock_shows_nowhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, shift_ns = time.time_ns, 0
    monkeypatch.setattr("time.time_ns", lambda: real() + shift_ns)
    with CaptureWriter(CaptureConfig(tmp_path, DBC, MACHINE, {}, 0.0)) as log:
        for shift_ns in (0, 3600 * 10**9, -3600 * 10**9):  # noqa: B007
            advice = {"topic": "advice", "t_s": time.monotonic(), "reason": "valid", "u": [0.0] * 5}
            log.add(TEXT + json.dumps(advice).encode())
    with (tmp_path / MCAP).open("rb") as file:
        times = [message.log_time for _, _, message in make_reader(file).iter_messages(["advice"])]
    assert len(times) == 3 and 0 <= times[2] - times[0] < 5 * 10**9


def test_a_capture_of_another_machine_or_of_nothing_is_refused(tmp_path: Path) -> None:
    write(tmp_path, seconds=1.5)
    with pytest.raises(RecordingError, match="another machine"):
        READER.read(tmp_path / MCAP, replace(MACHINE, name="other"))
    with pytest.raises(RecordingError, match="no piece"):
        replace(READER, shortest_s=10.0).read(tmp_path / MCAP, MACHINE)
    facts = {"fingerprint": "[" * 100_000}
    with CaptureWriter(CaptureConfig(tmp_path / "nested", DBC, MACHINE, facts, 0.0)):
        pass
    with pytest.raises(RecordingError, match="nested too deeply"):
        READER.read(tmp_path / "nested" / MCAP, MACHINE)
    (tmp_path / "empty.mcap").write_bytes(b"")
    with pytest.raises(RecordingError, match="cut off"):
        READER.read(tmp_path / "empty.mcap", MACHINE)
    with pytest.raises(RecordingError, match="no such"):
        READER.read(tmp_path / "none.mcap", MACHINE)


def test_messages_of_numbers_are_kept_by_column_and_others_as_they_are() -> None:
    said = [
        (0.1, {"q": 1.5, "sent": True}),
        (0.2, {"q": 2, "sent": False}),
        (0.3, {"q": -1.0, "sent": True}),
    ]
    messages = capture_reader.TopicMessages()
    for t_s, values in said:
        messages.add(t_s, values)
    assert list(messages) == said and messages[-1] == said[-1] and len(messages) == 3
    assert messages.series("q").tolist() == [1.5, 2.0, -1.0]
    assert messages.series("t_s").tolist() == [0.1, 0.2, 0.3]
    said += [(0.4, {"q": 0.0, "why": "text"}), (0.5, {"q": 7.0})]
    for t_s, values in said[3:]:
        messages.add(t_s, values)
    assert list(messages) == said and messages.series("q").tolist() == [1.5, 2.0, -1.0, 0.0, 7.0]
    assert messages.names == {"q", "sent"}
