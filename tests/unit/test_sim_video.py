"""A film of an episode, and what is said where none can be drawn."""

import os
import types

import numpy as np
import pytest
from composed import MACHINE

from brokk_rl.errors import StorageError
from brokk_rl.sim import video
from brokk_rl.sim.probe import RENDERERS, find_renderer, keep_renderer_for_drawing
from brokk_rl.sim.scene import make_nominal_scenes


@pytest.fixture
def motion():
    share = np.linspace(0.4, 0.6, 5)[:, None]
    return types.SimpleNamespace(
        q=MACHINE.lower + share * (MACHINE.upper - MACHINE.lower),
        u=np.zeros((5, MACHINE.num_joints)),
        force_n=np.zeros(5),
        scene=make_nominal_scenes(1)[0].numpy(),
        target_m=None,
    )


def test_without_a_gl_library_there_is_no_video(motion, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(video, "find_renderer", lambda: None)
    assert video.render_video(MACHINE, motion, tmp_path / "film.mp4") is None
    assert "libegl1" in caplog.text and list(tmp_path.iterdir()) == []


def test_a_renderer_that_fails_says_why(motion, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(video, "find_renderer", lambda: "nonsense")
    assert video.render_video(MACHINE, motion, tmp_path / "film.mp4") is None
    assert "MUJOCO_GL=nonsense" in caplog.text and "invalid value" in caplog.text


@pytest.mark.slow
def test_an_unknown_gl_library_falls_back_to_one_that_draws(monkeypatch, caplog):
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    keep_renderer_for_drawing()
    assert "MUJOCO_GL" not in os.environ
    found = find_renderer()
    assert found is None or (found in RENDERERS and "MUJOCO_GL=nonsense" in caplog.text)


@pytest.mark.slow
def test_a_gl_library_gives_pictures_of_the_machine(motion, tmp_path):
    import imageio.v2 as imageio

    if find_renderer() is None:
        pytest.skip("no GL library works here")
    video.render_video(MACHINE, motion, tmp_path / "film.mp4")
    picture = imageio.imread(tmp_path / "film_2.png").astype(int)
    yellow = (picture[..., 0] > 180) & (picture[..., 2] < 60)
    assert picture.shape == (540, 1200, 3) and yellow.mean() > 0.01
    with pytest.raises(StorageError, match="cannot write"):
        video.render_video(MACHINE, motion, tmp_path / "film.mp4" / "film.mp4")
