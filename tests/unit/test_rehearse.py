"""A story: its stages in order, each once, what they take from it, and where it ends."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import pytest
from conftest import Brokk

from brokk_rl import extensions
from diagnosis import story


class Played(AbstractContextManager[Any]):
    """Stands in for the processes of the stages: notes the commands."""

    def __init__(self) -> None:
        self.commands: dict[str, list[str]] = {}
        self.failing = ""
        self.found = "lag: {time_constant_s: 0.1}\n"

    def __call__(self, words: list[str], env: dict[str, str]) -> Self:
        out = next(word for word in words if word.startswith("session.out="))
        place = Path(out.partition("=")[2])
        words = words[words.index("brokk_rl") :]
        self.commands[place.name] = words[1:]
        self.code = int(place.name == self.failing)
        place.mkdir(exist_ok=True)
        if place.name == "diagnosis":
            (place / "effects.yaml").write_text(self.found)
        return self

    def __exit__(self, *exc: Any) -> None:
        pass

    def wait(self) -> int:
        return self.code


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch) -> Played:
    found = Played()
    # Not for those who import meanwhile.
    monkeypatch.setattr(story, "subprocess", SimpleNamespace(Popen=found))
    return found


def test_each_stage_is_a_command_with_what_it_takes_from_the_story(
    played: Played, brokk: Brokk, tmp_path: Path
) -> None:
    changes = ("session.device=cpu", "rl.budget.max_seconds=7", "sim.num_worlds=3")
    brokk("experiment=gap_loop", "session.out=story", "evaluation.episodes=5", *changes)
    folder = tmp_path / "story"
    stages = "reference simulator policy believed changed field diagnosis retrained"
    assert " ".join(played.commands) == f"{stages} in_simulator in_repaired on_machine"
    training = played.commands["policy"]
    # The simulator that the stage before leaves is not there.
    mode = extensions.load_mode(*(word for word in training if not word.startswith("actuator=")))
    given = (mode.session.device, mode.rl.budget.max_seconds, mode.sim.num_worlds)
    assert given == ("cpu", 7, 3) and mode.evaluation.episodes == 5
    told = {name for name, words in played.commands.items() if "withheld" in " ".join(words)}
    assert told == {"changed", "field", "on_machine"}
    assert (folder / "case/field").readlink() == folder / "field/recordings"


def test_a_failed_stage_ends_the_story(played: Played, brokk: Brokk) -> None:
    played.failing = "policy"
    done = brokk("experiment=gap_loop", "session.out=story", code=2)
    assert "the stage 'policy' failed" in done.err
    assert list(played.commands) == ["reference", "simulator", "policy"]


def test_without_a_found_effect_nothing_is_retrained(played: Played, brokk: Brokk) -> None:
    played.found = "# none: nothing was found\n"
    brokk("experiment=gap_loop", "session.out=story")
    assert list(played.commands)[-1] == "diagnosis"
