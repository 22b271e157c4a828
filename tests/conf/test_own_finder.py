"""A finder of a package of one's own works in the checker, in `mode=perceive` and beside the loop."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from composed import option
from drawn import CENTER, K, drawn
from packages import install_package

from brokk_rl.extensions import load_part
from brokk_rl.signals import Frame
from deploy.runtime import perception_process
from deploy.runtime.perception_process import CameraConfig
from deploy.runtime.shm_layout import LoopMemory
from deploy.runtime.target import read_holes
from perception import dataset
from perception.camera import CameraModel, write_camera

FINDER = Path(__file__).parents[2] / "examples/my_package/my_package/darkest.py"
OPTION = "_target_: spots.finder.DarkestSpot\nradius_m: 0.05   # m\nstd_m: 0.05      # m, a guess\n"


@pytest.fixture
def finder_spec(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The spec of a finder in an installed package `spots`."""
    folder = tmp_path_factory.mktemp("site")
    files = {"finder.py": FINDER.read_text(), "conf/perception/darkest.yaml": OPTION}
    install_package(folder, "spots", files, monkeypatch)
    return importlib.import_module("spots.finder").DarkestSpot(radius_m=0.05, std_m=0.05)


def test_mode_perceive_takes_it_by_name(finder_spec: Any, brokk: Callable, tmp_path: Path) -> None:
    frame, _, _ = drawn()
    camera = CameraModel(K, size_px=(640, 480), base_from_camera=np.eye(4))
    write_camera(tmp_path / "frames", camera)
    for number in range(3):
        dataset.write_frame(tmp_path / "frames" / f"{number:05d}", frame.color, frame.depth_m)
    done = brokk("mode=perceive", "perceive.input=frames", "perception=darkest", "session.out=out")
    assert done.code == 0, done.err
    frames = json.loads(Path("out/holes.json").read_text())["frames"]
    assert [len(one["holes"]) for one in frames] == [1, 1, 1]
    assert frames[0]["holes"][0]["frame"] == "base"
    assert frames[0]["holes"][0]["center_m"] == pytest.approx(CENTER, abs=0.1)
    assert [one["target"] and one["target"]["num_frames"] for one in frames] == [None, None, 3]
    assert Path("out/overlays/00002.png").exists() and Path("out/explain.txt").exists()


class TwoFrames:
    """A source of two frames."""

    num_frames = 2

    def __init__(self, frame: Frame) -> None:
        self._frames = [frame, frame]

    def build(self) -> TwoFrames:
        return self

    def __enter__(self) -> TwoFrames:
        return self

    def __exit__(self, *exc: Any) -> None: ...

    def read_latest(self) -> Frame | None:
        return self._frames.pop() if self._frames else None


@pytest.mark.parametrize("name", ["own", "truth"])
def test_the_camera_process_publishes_its_holes(name: str, finder_spec: Any) -> None:
    frame, _, _ = drawn()
    finder = finder_spec if name == "own" else option("perception", "truth")
    camera = CameraConfig(
        source=TwoFrames(frame), finder=finder, tracker=load_part("tracker"), rate_hz=100.0, num_px=frame.depth_m.size,
        stale_s=1.0, record_hz=0.0,
    )  # fmt: skip
    num_joints = option("machine", "brokk170").num_joints
    memory = LoopMemory(num_joints, commands=False, frame_px=frame.depth_m.size)
    try:
        perception_process.run(lambda: False, camera, memory)
        (hole,) = read_holes(memory.holes)
        expected_m = CENTER if name == "own" else [2.6, 0.0, 0.4]
        assert hole["center_in_base_m"] == pytest.approx(expected_m, abs=0.1)
        assert int(hole["name"]) == 1
    finally:
        memory.close()
