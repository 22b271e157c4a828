"""The observer's file: thresholds from a machine's own recordings, and whose file counts on which bus."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from composed import MACHINE, option
from conftest import Brokk
from motion import build_nominal_tables, make_recording

from brokk_rl.errors import ConfigError
from brokk_rl.record import Recording, write_recording
from deploy.guard_setup import build_observer, is_from_machine, read_observer_content
from deploy.observer_file import FILE, ThresholdSettings, count_alarms, find_thresholds

GUARD = option("guard", "default")
SPEED = np.array([joint.max_speed.value for joint in MACHINE.joints])
SETTINGS = ThresholdSettings(window_s=1.0, share=0.25, least_slack_s=0.06, margin=1.5)


CONTENT = {"model": build_nominal_tables(MACHINE, dead_time_s=0.2)}


def record(jump_rad: float, source: str = "machine: socketcan can0, excitation: sine") -> Recording:
    """A minute of the machine of that model, to and fro; the second joint slips once, at rest."""
    length, period_s = 1200, MACHINE.period_s
    u = np.zeros((length, 5))
    for number in range(0, length, 60):
        u[number : number + 30] = 0.4 * (1 - 2 * (number // 60 % 2)) * np.array([1, 0, 1, 1, 1])
    acting = np.concatenate([np.zeros((4, 5)), u[:-4]])
    steps = acting * SPEED * period_s
    q = np.array(MACHINE.home) + np.concatenate([np.zeros((1, 5)), steps.cumsum(0)[:-1]])
    q[600:, 1] += jump_rad
    return make_recording(MACHINE, u, q, metadata={"run": "one", "source": source})


def test_slack_is_the_largest_difference_in_the_recordings_times_the_margin() -> None:
    found = find_thresholds(SETTINGS, CONTENT, MACHINE, [record(0.1)])
    least, second_s = [0.06] * 3, 1.5 * 0.1 / SPEED[1]
    assert found["slack_s"] == pytest.approx([0.06, second_s, *least], abs=1e-3)
    assert (found["window_s"], found["share"], found["minutes"]) == (1.0, 0.25, 1.0)


def test_thresholds_raise_no_alarm_where_they_come_from_and_one_beyond() -> None:
    thresholds = find_thresholds(SETTINGS, CONTENT, MACHINE, [record(0.1)])
    content = CONTENT | {"thresholds": thresholds}
    for jump_rad, number in ((0.1, 0), (0.149, 0), (0.151, 1)):
        counts = count_alarms(content, MACHINE, [record(jump_rad)])
        assert counts.faults.total() == number, jump_rad
    assert counts.seconds == pytest.approx(60.0, abs=0.1)
    assert counts.faults_a_shift == pytest.approx(480.0, rel=0.01)
    # One alarm, cleared, is not found again in what is left of its window.
    assert list(counts.faults) == ["q2 a joint moves unasked: sensor drifts, or valve leaks"]


def test_the_command_writes_a_file_that_names_its_recordings_and_counts_others(
    brokk: Brokk,
) -> None:
    for name, jump_rad in (("own", 0.05), ("other", 0.2)):
        write_recording(record(jump_rad), Path(f"{name}.parquet"))
    brokk("mode=observe", "observe.recordings=own.parquet", "session.out=made")
    content = json.loads((Path("made") / FILE).read_text())
    assert content["sources"] == ["machine: socketcan can0"]
    assert content["thresholds"]["slack_s"][1] >= 1.5 * 0.05 / SPEED[1] - 1e-3
    path = f"observe.path=made/{FILE}"
    brokk("mode=observe", path, "observe.recordings=other.parquet", "session.out=counted")
    counted = json.loads(Path("counted/observed.json").read_text())
    assert counted["runs"] == 1 and counted["minutes"] == pytest.approx(1.0, abs=0.01)
    assert any(name.startswith("q2 ") for name in counted["faults"])


@pytest.mark.parametrize(
    ("source", "is_real"),
    [
        ("machine: socketcan can0", True),
        ("capture: socketcan can1", True),
        ("log: monday.csv", True),
        ("machine: udp_multicast 239.74.163.2", False),
        ("capture: udp_multicast 239.74.163.2", False),
        ("simulator: Hydraulic", False),
        ("simulated site", False),
        ("nominal machine", False),
        ("unknown", False),
    ],
)
def test_whose_recordings_these_are(source: str, is_real: bool) -> None:
    assert is_from_machine(source) is is_real


def write_file(path: Path, machine: Any, *sources: str) -> Any:
    """The limits of a guard whose observer has a file of `machine` from `sources`."""
    content = CONTENT | {"schema": 2, "machine": machine.name, "sources": list(sources)}
    content["fingerprint"] = machine.fingerprint()
    slack_s = [0.06, 0.07, 0.08, 0.09, 0.1]
    content["thresholds"] = {"window_s": 1.0, "share": 0.25, "slack_s": slack_s, "minutes": 30.0}
    path.write_text(json.dumps(content))
    return replace(GUARD, observer=replace(GUARD.observer, path=str(path)))


@pytest.mark.parametrize("commands", [True, False])
def test_thresholds_of_a_simulator_or_of_another_machine_count_for_nothing_on_a_machine(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, commands: bool
) -> None:
    real, simulated = "machine: socketcan can0", "simulator: Hydraulic"
    other = option("machine", "mini_excavator")
    for machine, sources, interface, reason in (
        (MACHINE, (simulated,), "socketcan", "made from simulator: Hydraulic, and this bus"),
        (MACHINE, (real, simulated), "socketcan", "can0 and 1 more, and this bus is"),
        (other, (real,), "socketcan", "made for machine mini_excavator, which differs"),
        (other, (real,), "udp_multicast", "made for machine mini_excavator, which differs"),
    ):
        limits = write_file(tmp_path / "observer.json", machine, *sources)
        caplog.clear()
        if commands:
            with pytest.raises(ConfigError, match=reason) as caught:
                read_observer_content(limits, MACHINE, interface, commands)
            assert "mode=observe" in str(caught.value)
            assert "guard.observer=null" in str(caught.value)
        else:
            assert build_observer(limits, MACHINE, interface, commands) is None
            assert reason in caplog.text and "mode=observe" in caplog.text
    assert read_observer_content(replace(GUARD, observer=None), MACHINE, "socketcan", True) is None
