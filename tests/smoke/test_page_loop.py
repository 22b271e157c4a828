"""The operator's page beside a real loop and a real twin, as a person starts them."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from block import TARGETS, seen_at, take_frame
from desk import free_port
from PIL import Image
from websockets.asyncio.client import connect

FRAME = take_frame((640, 360), 0, 0.0)
TOKEN = "correct horse battery staple"


@pytest.mark.slow
def test_the_loop_is_shown_recorded_again_on_a_wish_and_outlives_its_page(tmp_path: Path) -> None:
    _photograph(tmp_path / "camera")
    words = (
        "preset=bench", "bench=guided", "page.port=0", f"page.token='{TOKEN}'", "deploy.seconds=300", f"bus.port={free_port()}",
        "camera=pictures", "perception/source@source=folder", f"source.folder={tmp_path / 'camera'}",
        "deploy.camera.record_hz=5", f"session.out={tmp_path / 'run'}",
    )  # fmt: skip
    command = [sys.executable, "-m", "brokk_rl", *words]
    loop = subprocess.Popen(command, cwd=tmp_path, env=os.environ | {"OMP_NUM_THREADS": "1"})
    try:
        link = _patiently(lambda: (tmp_path / "run" / "page.url").read_text().strip(), 90)
        address = link.partition("/#")[0]
        pids = json.loads((tmp_path / "run" / "processes.json").read_text())
        asyncio.run(_use(address.removeprefix("http://"), tmp_path / "run"))
        os.kill(pids["page"], signal.SIGKILL)
        time.sleep(1.0)
        assert loop.poll() is None, "the loop goes on without its page"
    finally:
        loop.send_signal(signal.SIGINT)
        assert loop.wait(60) == 0
    timing = json.loads((tmp_path / "run" / "timing.json").read_text())
    assert {one["process"] for one in timing["processes"]} >= {"bus", "policy"}


async def _use(host: str, run: Path) -> None:
    async with (
        connect(f"ws://{host}/state", proxy=None) as state,
        connect(f"ws://{host}/control", origin=f"http://{host}", proxy=None) as control,  # type: ignore[arg-type]
    ):
        await control.send(json.dumps({"token": TOKEN}))
        assert json.loads(await control.recv()) == {"ready": True}
        await _shown(state, is_led)
        assert (await _shown(state, lambda shown: shown["recording"]["on"]))["path_in_base_m"]
        for value, on in (("off", False), ("on", True)):
            await control.send(json.dumps({"kind": "record", "value": value}))
            assert json.loads(await control.recv()) == {"done": "record", "kind": "record"}
            await _shown(state, lambda shown, on=on: shown["recording"]["on"] == on)
        # The picture that is touched has to be there; the camera's process starts last.
        await _shown(state, has_picture)
        x, y = seen_at(FRAME, np.array(TARGETS[1].center_in_base_m))
        await control.send(json.dumps({"kind": "point", "value": f"{x:.4f},{y:.4f}"}))
        assert json.loads(await control.recv()) == {"done": "point", "kind": "point"}
        shown = await _shown(state, lambda shown: shown["targets"][0]["std_m"] is not None)
        touched = shown["targets"][0]
        away_m = np.array(touched["center_in_base_m"]) - TARGETS[1].center_in_base_m
        assert np.linalg.norm(away_m) < 0.02 and touched["chosen"]
        assert (run / "capture.mcap").stat().st_size > 0
        _patiently(lambda: (run / "recording_2" / "capture.mcap").stat(), 20)


def is_led(shown: dict[str, Any]) -> bool:
    """Return whether an operator who holds the dead-man sees a valid advice."""
    advice = shown["advice"]
    return bool(shown["alive"] and advice and advice["valid"] and shown["safety"]["deadman"])


def has_picture(shown: dict[str, Any]) -> bool:
    seen = [one["name"] for one in shown["streams"] if one["age_s"] is not None]
    return "camera" in seen


def _photograph(folder: Path) -> None:
    """Leaves a folder with a frame of the demo's camera."""
    folder.mkdir()
    Image.fromarray(FRAME.color).save(folder / "0.color.png")
    np.save(folder / "0.depth.npy", FRAME.depth_m)
    camera = {"K": FRAME.camera_matrix.tolist(), "T_base_cam": FRAME.base_from_camera.tolist()}
    (folder / "camera.yaml").write_text(json.dumps(camera))


async def _shown(state: Any, claim: Any) -> dict[str, Any]:
    """Returns the first state of which the claim is true; draws all on the way."""
    end_s = time.monotonic() + 60
    while time.monotonic() < end_s:
        said = json.loads(await asyncio.wait_for(state.recv(), 10))
        await state.send(str(said["number"]))
        if claim(said["shown"]):
            return said["shown"]
    raise AssertionError(f"it did not come true: {said['shown']}")


def _patiently(look: Any, seconds: float) -> Any:
    end_s = time.monotonic() + seconds
    while True:
        try:
            return look()
        except FileNotFoundError:
            assert time.monotonic() < end_s, "it never came"
            time.sleep(0.1)
