"""Progress where nobody sees a bar: a line a minute, with the time left."""

from __future__ import annotations

import pytest

from brokk_rl.progress import SHARE, ItemProgress


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time that the module reads, s."""
    now = [0.0]
    monkeypatch.setattr("rich.console.monotonic", lambda: now[0])
    return now


def test_a_log_file_gets_a_line_a_minute(
    clock: list[float], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    work = ItemProgress("training", SHARE)
    for second in range(0, 181, 10):
        clock[0] = float(second)
        work.reach(second / 360.0, note="300 steps/s")
    # 70 s are 0.194 of the whole: 290 s are left; the next line comes more than a minute later
    assert caplog.messages == [
        "training: 19%, about 5 min left, 300 steps/s",
        "training: 39%, about 4 min left, 300 steps/s",
    ]


def test_a_repeated_step_does_not_go_back_and_quiet_work_says_nothing(
    clock: list[float], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    work = ItemProgress("frames", None, quiet=True)
    work.reach(7)
    clock[0] = 100.0
    work.reach(3, title="looking")
    assert work.describe() == "7" and caplog.messages == []
