"""A finder of a package of one's own works in `mode=perceive`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import Brokk
from drawn import CENTER, K, drawn
from packages import install_package

from perception import dataset
from perception.camera import CameraModel, write_camera

FINDER = Path(__file__).parents[2] / "examples/my_package/my_package/darkest.py"
OPTION = "_target_: spots.finder.DarkestSpot\nradius_m: 0.05   # m\nstd_m: 0.05      # m, a guess\n"


@pytest.fixture
def spots(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """An installed package `spots` with a finder."""
    folder = tmp_path_factory.mktemp("site")
    files = {"finder.py": FINDER.read_text(), "conf/perception/darkest.yaml": OPTION}
    install_package(folder, "spots", files, monkeypatch)


def test_mode_perceive_takes_it_by_name(spots: None, brokk: Brokk, tmp_path: Path) -> None:
    frame, _, _ = drawn()
    camera = CameraModel(K, size_px=(640, 480), base_from_camera=np.eye(4))
    write_camera(tmp_path / "frames", camera)
    for number in range(3):
        dataset.write_frame(tmp_path / "frames" / f"{number:05d}", frame.color, frame.depth_m)
    brokk("mode=perceive", "perceive.input=frames", "perception=darkest", "session.out=out")
    frames = json.loads(Path("out/holes.json").read_text())["frames"]
    assert [len(one["holes"]) for one in frames] == [1, 1, 1]
    assert frames[0]["holes"][0]["frame"] == "base"
    assert frames[0]["holes"][0]["center_m"] == pytest.approx(CENTER, abs=0.1)
    assert [one["target"] and one["target"]["num_frames"] for one in frames] == [None, None, 3]
    assert Path("out/overlays/00002.png").exists() and Path("out/explain.txt").exists()
