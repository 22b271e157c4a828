"""Logging that waits for no terminal."""

from __future__ import annotations

import logging
import os
import threading
import time
from pathlib import Path

import pytest

from brokk_rl.errors import FrameError
from deploy.runtime.detached_log import MOST_RECORDS, DetachedHandler, detach_logging
from deploy.runtime.process import ChildProcess


class Frozen(logging.Handler):
    """A terminal that is not read until somebody lets go of it."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self.free, self.written = threading.Event(), list[str]()

    def emit(self, record: logging.LogRecord) -> None:
        self.free.wait()
        self.written.append(record.getMessage())


def test_a_log_that_blocks_holds_up_nobody_and_loses_only_what_finds_no_room() -> None:
    terminal = Frozen()
    handler, log = DetachedHandler([terminal]), logging.Logger("loop")
    log.addHandler(handler)
    begun_s = time.monotonic()
    for number in range(MOST_RECORDS + 50):
        log.warning("%d", number)
    handler.flush()
    # half a second for the last words, whatever the terminal does
    assert time.monotonic() - begun_s < 5.0
    assert 49 <= handler.dropped <= 50
    terminal.free.set()
    handler.flush()
    assert terminal.written[:3] == ["0", "1", "2"]
    assert len(terminal.written) == MOST_RECORDS + 50 - handler.dropped


def test_the_handlers_of_before_get_the_records_and_come_back() -> None:
    terminal, root = Frozen(), logging.getLogger()
    terminal.free.set()
    before = list(root.handlers)
    root.addHandler(terminal)
    try:
        with detach_logging():
            logging.getLogger("loop").warning("seen")
            logging.getLogger("loop").log(logging.INFO - 1, "below its level")
        assert root.handlers == [*before, terminal] and "seen" in terminal.written
        assert "below its level" not in terminal.written
    finally:
        root.removeHandler(terminal)


def refuse(stop: object) -> None:
    """Child process that cannot begin."""
    raise FrameError("there is no camera")


def test_a_child_that_is_refused_says_why_in_one_line(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folders = [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(folders))
    child = ChildProcess("camera", "test_deploy_logging:refuse", (), ())
    while child.code is None:
        time.sleep(0.05)
    assert child.code == 1
    assert capfd.readouterr().err == "camera: there is no camera\n"
