"""What tests share: the default machine, and the command in a folder of its own."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from composed import option
from matplotlib.figure import Figure
from quick_compose import compose_once

from brokk_rl import cli, plot
from brokk_rl.machine import Machine

compose_once()
torch.set_num_threads(1)  # small tensors: threads would only wait for each other
gc.set_threshold(50_000, 20, 50)  # the libraries' objects stay: searching them took a fifth


def make_plain_figure(figsize: tuple[float, float], layout: str) -> Figure:
    """Returns a figure without a layout: placing labels takes most of the time of a picture."""
    return Figure(figsize=figsize)


plot.Figure = make_plain_figure
plot.DPI = 50


def pytest_collection_finish() -> None:
    gc.collect()
    gc.freeze()


LONGEST = (
    "test_check", "test_circuit", "test_collect", "test_compose", "test_deploy_faults", "test_every_experiment",
    "test_exam", "test_exam_plants", "test_exam_sitting", "test_identification", "test_log_kinds", "test_messages", "test_own_task",
    "test_perception_calibrate", "test_video",
)  # fmt: skip
"""Files that take more than ten seconds: they begin first, so that no core waits for one at the end."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: item.path.stem not in LONGEST)
    if torch.cuda.is_available():
        return
    for item in items:
        if item.get_closest_marker("gpu"):
            item.add_marker(pytest.mark.skip(reason="needs a CUDA GPU"))


@pytest.fixture(scope="session")
def machine() -> Machine:
    """The default machine."""
    return option("machine", "brokk170")


@pytest.fixture(scope="session")
def carriage() -> Machine:
    """A machine of one joint, for logs of every kind."""
    from carriage import make_carriage

    return make_carriage()


@pytest.fixture
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty folder is the working directory."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def warp_device() -> Iterator[None]:
    """Warp's device is a GPU where there is one: there a world has 32 threads."""
    import warp as wp

    with wp.ScopedDevice("cuda:0" if wp.is_cuda_available() else "cpu"):
        yield


@pytest.fixture
def feed() -> Any:
    """A feed of the page that the test fills."""
    from browser import Scripted

    return Scripted()


@pytest.fixture
def port(feed: Any) -> Iterator[int]:
    """The port of a page that shows this feed."""
    from browser import served

    with served(feed) as found:
        yield found


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A headless Chromium."""
    from browser import chromium

    with chromium() as found:
        yield found


@dataclass(frozen=True)
class Done:
    """What the command did: exit code and what it wrote."""

    code: int
    out: str
    err: str


Brokk = Callable[..., Done]
Note = Callable[[str, object], None]
"""Fixture `record_property`: notes a figure for benchmarks/results/found.json."""


@pytest.fixture
def brokk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Brokk:
    """Runs the command in this process, in an empty folder, and sees it end with `code`, 0 unless told otherwise."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    for name in ("HYDRA_FULL_ERROR", "BROKK_TRACE"):
        monkeypatch.delenv(name, raising=False)

    def run(*arguments: str, code: int = 0) -> Done:
        monkeypatch.setattr("sys.argv", ["brokk", *arguments])
        capfd.readouterr()
        try:
            left = cli.main()
        except SystemExit as raised:
            left = int(raised.code or 0)
        written = capfd.readouterr()
        assert left == code, written.err
        return Done(left, written.out, written.err)

    return run
