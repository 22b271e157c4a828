"""The help of one mode names its groups as chosen, and the meaning of its own values."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from composed import every, names

from brokk_rl import registry


def test_a_mode_has_a_help_of_its_own(brokk: Callable[..., Any]) -> None:
    done = brokk("mode=identify", "fit=lag", "--help")
    assert done.code == 0
    assert "fit=lag" in done.out and "arx" in done.out
    assert "identify.recordings=???" in done.out
    text = " ".join(done.out.split())
    assert "identify.folds=null Cross-validation: each run is judged once" in text
    assert "perception/segmenter" not in text, "only what the mode uses"


def test_options_chosen_as_a_list_are_named(brokk: Callable[..., Any]) -> None:
    text = brokk("mode=train", "effect=[backlash,lag]", "--help").out
    assert "effect=[backlash,lag]" in text


@every("mode")
def test_the_help_of_every_mode_is_short(name: str, brokk: Callable[..., Any]) -> None:
    done = brokk(f"mode={name}", "--help")
    assert done.code == 0
    assert len(done.out.splitlines()) < 80
    assert len(names("mode")) > 20


def test_a_mode_that_is_not_there_is_explained(brokk: Callable[..., Any]) -> None:
    done = brokk("mode=identfy", "--help")
    assert done.code == 2 and "did you mean 'identify'?" in done.err


def test_a_field_has_the_meaning_of_its_docstring() -> None:
    meanings = registry.read_attributes("brokk_rl.session.Session")
    assert meanings["out"] == "Run folder."
    assert list(meanings) == ["out", "seed", "device"]


def test_values_that_bear_the_name_of_a_group_are_values(brokk: Callable[..., Any]) -> None:
    told = brokk("mode=bench", "--help").out
    assert "bench.num_envs=[128, 256]" in told and "bench=[" not in told
