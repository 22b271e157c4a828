"""A story: its stages in order, each once, what they take from it, where it goes on and where it ends."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import pytest
import yaml
from conftest import Done

from diagnosis import story


class Played:
    """Stands in for the processes of the stages: notes the commands, leaves the record of a finished run."""

    def __init__(self) -> None:
        self.commands: dict[str, list[str]] = {}
        self.failing = ""

    def __call__(self, words: list[str], env: dict[str, str]) -> Self:
        assert "HYDRA_FULL_ERROR" not in env  # a stage would print a traceback of user errors
        place = Path(
            next(word for word in words if word.startswith("session.out=")).partition("=")[2]
        )
        words = words[words.index("brokk_rl") :]
        self.commands[place.name] = words[1:]
        self.code = int(place.name == self.failing)
        place.mkdir(exist_ok=True)
        record = {
            "outcome": "failed" if self.code else "finished",
            "mode": words[1].partition("=")[2],
            "command": words,
        }
        begun = "2024-05-01T08:00:00+00:00"
        (place / "session.json").write_text(
            json.dumps(record | {"started": begun, "ended": begun.replace("08:00", "08:03")})
        )
        if place.name == "diagnosis":
            (place / "effects.yaml").write_text("lag: {time_constant_s: 0.1}\n")
        return self

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: Any) -> None:
        pass

    def wait(self) -> int:
        return self.code

    def terminate(self) -> None:
        pass


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch) -> Played:
    found = Played()
    # Not for those who import meanwhile.
    monkeypatch.setattr(story, "subprocess", SimpleNamespace(Popen=found))
    return found


def test_each_stage_is_a_command_with_what_it_takes_from_the_story(
    played: Played, brokk: Callable[..., Done], tmp_path: Path
) -> None:
    done = brokk(
        "experiment=gap_loop",
        "session.out=story",
        "session.device=cpu",
        "rl.budget.max_seconds=7",
        "sim.native.num_worlds=3",
    )
    assert done.code == 0, done.err
    folder = tmp_path / "story"
    assert list(played.commands) == [
        "reference",
        "simulator",
        "policy",
        "believed",
        "changed",
        "field",
        "diagnosis",
        "repair",
    ]
    training = played.commands["policy"]
    assert (
        training[0] == "mode=train"
        and f"rl=@{folder}/given/rl.yaml" in training
        and "session.device=cpu" in training
    )
    assert yaml.safe_load((folder / "given/rl.yaml").read_text())["budget"]["max_seconds"] == 7
    assert yaml.safe_load((folder / "given/sim.yaml").read_text())["native"]["num_worlds"] == 3
    blind = [
        name
        for name, words in played.commands.items()
        if not any("withheld" in word for word in words)
    ]
    assert blind == ["reference", "simulator", "policy", "believed", "diagnosis"]
    assert (folder / "case/field").readlink() == folder / "field/recordings"


def test_a_story_goes_on_where_it_failed(
    played: Played, brokk: Callable[..., Done], tmp_path: Path
) -> None:
    played.failing = "policy"
    done = brokk("experiment=gap_loop", "session.out=story")
    assert done.code == 2 and "resume=story session.out=story" in done.err
    played.failing, played.commands = "", {}
    assert brokk("experiment=gap_loop", "session.out=story", "resume=story").code == 0
    assert next(iter(played.commands)) == "policy"


def test_a_story_that_another_command_began_is_not_gone_on_with(
    played: Played, brokk: Callable[..., Done], tmp_path: Path
) -> None:
    assert brokk("experiment=gap_loop", "session.out=story").code == 0
    path = tmp_path / "story/reference/session.json"
    done_before = json.loads(path.read_text())
    path.write_text(json.dumps({**done_before, "overrides": ["mode=collect"]}))
    done = brokk("experiment=gap_loop", "session.out=story", "resume=story")
    assert done.code == 2 and "the stage 'reference' was run without" in done.err


def test_without_a_found_effect_nothing_is_retrained(
    played: Played, brokk: Callable[..., Done], tmp_path: Path
) -> None:
    assert brokk("experiment=gap_loop", "session.out=story").code == 0
    (tmp_path / "story/diagnosis/effects.yaml").write_text("# none: nothing was found\n")
    (tmp_path / "story/repair/session.json").unlink()
    played.commands = {}
    done = brokk("experiment=gap_loop", "session.out=story", "resume=story")
    assert done.code == 0 and not played.commands


def test_a_stage_takes_only_what_a_story_has(brokk: Callable[..., Done]) -> None:
    done = brokk("experiment=gap_loop", "stages.policy.takes=[weather]")
    assert done.code == 2 and "weather" in done.err and "evaluation" in done.err


def test_a_mode_without_a_story_says_so(brokk: Callable[..., Done]) -> None:
    done = brokk("mode=rehearse")
    assert done.code == 2 and "experiment=gap_loop" in done.err
