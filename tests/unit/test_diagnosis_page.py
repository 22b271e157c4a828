"""The report says what the diagnosis says, and opens without a network."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from motion import make_recording

from actuators.recordings.recording_checks import RecordingRemark
from brokk_rl.machine import Machine
from diagnosis import report
from diagnosis.answer import Answer, Estimate, Gap, Outcome, Selected
from diagnosis.free_runs import WindowedRuns
from diagnosis.where import locate_gap

GAIN = Selected(
    effect="flow_gain", joints=("q4",), probability=0.97, parameters={"gain": {"q4": Estimate(0.81, (0.78, 0.84))}},
    gap_closed=Estimate(0.86, (0.8, 0.9)), same_as=("encoder_scale",), decided_by="a measured tool point",
)  # fmt: skip


def runs(machine: Machine, count: int, seed: int, factor: float) -> WindowedRuns:
    """Returns free runs of a simulator whose q4 moves `factor` times as fast as the machine's."""
    rng, recordings, row, source = np.random.default_rng(seed), [], [], []
    for number in range(count):
        u = np.repeat(rng.choice([-0.6, 0.0, 0.6], (30, 5)) * [1, 0, 1, 1, 1], 40, 0)
        q = machine.home + 0.1 * np.cumsum(np.roll(u, 11, 0) * machine.max_speed * 0.05, 0)
        recordings.append(make_recording(machine, u, q, f"<run> {seed}-{number}"))
        row += range(40, 1140, 100)
        source += [number] * 11
    pairs = list(zip(source, row, strict=True))
    measured = np.stack([recordings[s].q[k : k + 100] for s, k in pairs])
    found = WindowedRuns(recordings, np.array(source), np.array(row), measured, measured)
    start = np.stack([recordings[s].q[k - 1] for s, k in pairs])[:, None]
    way = np.where(np.arange(5) == 3, factor, 1.0) * (found.measured - start)
    return replace(found, simulated=start + way + 2e-4 * rng.standard_normal(way.shape).cumsum(1))


@pytest.fixture(scope="module")
def seen(machine: Machine) -> Outcome:
    before, after = runs(machine, 3, 0, 1.25), runs(machine, 3, 0, 1.01)
    rivals = [
        {"effect": "flow_gain", "joints": ["q4"], "score": 40.0},
        {"effect": "backlash", "joints": ["q3"], "score": -1.0},
    ]
    answer = Answer(
        verdict="effects", selected=(GAIN,), ranking=(),
        gap=Gap(0.03, 0.006, 0.004, Estimate(0.93, (0.88, 0.96))),
        where=locate_gap(before, np.full(5, 0.006), np.full(5, 0.004), machine),
        more={"evidence": {"rivals": rivals, "threshold": 5.0}},
    )  # fmt: skip
    return Outcome(answer, before, after)


def test_the_report_holds_names_numbers_and_pictures_and_fetches_nothing(
    machine: Machine, seen: Outcome, tmp_path: Path
) -> None:
    report.write_report(seen, tmp_path, machine)
    text = (tmp_path / "report.html").read_text()
    for part in ("0.81", "0.78 to 0.84", "What would decide: a measured tool point"):
        assert part in text
    assert "https:" not in text and "<run>" not in text and "nan" not in text.split("base64")[0]
    assert text.count("data:image/png;base64,") == 1


@pytest.mark.parametrize("verdict", ["none", "unknown"])
def test_an_answer_without_effects_has_a_report(
    machine: Machine, seen: Outcome, tmp_path: Path, verdict
) -> None:
    gap = Gap(0.012, 0.012, 0.01, None)
    answer = replace(seen.answer, verdict=verdict, selected=(), gap=gap, reason="Few data.")
    remark = RecordingRemark("jumps", "q4", "run", 0.0, 1.0, 1, "one")
    bare = replace(answer, more={"sanity": [remark.plain()] * 30})
    assert report.write_headline(bare)[1] == ("good" if verdict == "none" else "warn")
    report.write_report(Outcome(bare, seen.before, None), tmp_path, machine)
    page = (tmp_path / "report.html").read_text()
    assert "12.0 mrad before; the floor is 10.0 mrad" in page
    assert f"{30 - report.MAX_LISTED} more" in page
    assert "lies in q4" in report.write_headline(replace(bare, verdict="unknown"))[0]
