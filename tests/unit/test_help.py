"""The help of the command and of its modes, and the comments of composed values."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import hydra
import pytest
from omegaconf import OmegaConf

from brokk_rl.help import MAIN_MODES, collect_comments


def test_a_mode_has_a_help_of_its_own(brokk: Callable[..., Any]) -> None:
    done = brokk("mode=identify", "fit=servo", "--help")
    assert done.code == 0
    assert "fit=servo" in done.out and "arx" in done.out
    text = " ".join(done.out.split())
    assert "identify.recordings=??? glob or list of globs" in text
    assert "identify.hold_out=6 one part in so many" in text
    assert "session.seed=0" in text and " fit." in text, "values of groups too"
    assert "perception/segmenter" not in text, "only what the mode uses"


@pytest.mark.parametrize("name", ["train", "export", "deploy", "study"])
def test_every_value_of_a_mode_is_listed(name: str, brokk: Callable[..., Any]) -> None:
    done = brokk(f"mode={name}", "--help")
    assert done.code == 0
    with hydra.initialize_config_module("conf", version_base="1.3"):
        cfg = hydra.compose("config", [f"mode={name}", *(["policy=trained"] * (name == "export"))])
    missing = []
    for key in list_keys(OmegaConf.to_container(cfg)):
        if f"  {key}=" not in done.out and not key.startswith("policy."):
            missing.append(key)
    assert missing == []


def list_keys(node: Any, above: str = "") -> list[str]:
    """Return the dotted names of the values that a person can change."""
    keys = []
    for key, value in node.items():
        if isinstance(value, dict) and value:
            keys += list_keys(value, f"{above}{key}.")
        elif key not in ("_target_", "run") and value != {}:
            keys.append(f"{above}{key}")
    return keys


@pytest.mark.parametrize("words", [(), ("--help",)], ids=str)
def test_the_command_alone_says_how_to_begin_and_starts_nothing(
    words: tuple[str, ...], brokk: Callable[..., Any], tmp_path: Path
) -> None:
    done = brokk(*words)
    assert done.code == 0 and not list(tmp_path.iterdir())
    for name in MAIN_MODES:
        assert f"brokk mode={name} " in done.out
    assert len(done.out.splitlines()) < 25


def test_values_that_bear_the_name_of_a_group_are_values(brokk: Callable[..., Any]) -> None:
    told = brokk("mode=bench", "--help").out
    assert "bench.num_envs=[128,256]" in told and "bench=[" not in told


def test_comments_are_found_beside_and_above_their_values(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(
        "# Head of the file.\nx: 1   # m\ninner:   # of two\n  # s\n  y: {z: 2, w: '#3'}   # rad\nlist: [1]\n"
    )
    comments = collect_comments([("node", tmp_path / "a.yaml")])
    assert comments == {"node.x": "m", "node.inner": "of two", "node.inner.y": "rad"}
