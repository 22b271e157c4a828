"""A story: its stages in order, each once, what they take from it, where it goes on, where it ends; and the page that tells it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import pytest
import yaml
from conftest import Done

from brokk_rl import story
from diagnosis import retraining
from diagnosis.answer import Answer, Estimate, Gap, Selected, Where
from diagnosis.modes import rehearse as story_page

SHARE = {"mean": 0.5, "ci95": [0.4, 0.6]}
WITHHELD = {
    "asymmetry": {
        "joints": ["q3", "q4"],
        "extend_gain": 0.5,
        "retract_gain": {"q3": 0.9, "other": 1.0},
    }
}


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
    assert "3.0" in (folder / story_page.STORY_FILE).read_text(), "each stage took three minutes"


def test_a_story_goes_on_where_it_failed(
    played: Played, brokk: Callable[..., Done], tmp_path: Path
) -> None:
    played.failing = "policy"
    done = brokk("experiment=gap_loop", "session.out=story")
    assert done.code == 2 and "resume=story session.out=story" in done.err
    played.failing, played.commands = "", {}
    assert brokk("experiment=gap_loop", "session.out=story", "resume=story").code == 0
    assert next(iter(played.commands)) == "policy"
    assert f"resume={tmp_path}/story/policy" in played.commands["policy"], (
        "training goes on from its checkpoint"
    )
    assert not any(word.startswith("resume=") for word in played.commands["believed"])


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


@pytest.mark.parametrize(
    ("effect", "same_as", "told"),
    [
        ("asymmetry", (), "as it is"),
        ("flow_gain", ("asymmetry",), "as it is"),
        ("lag", (), "but the machine has asymmetry on q3 and q4"),
    ],
)
def test_the_page_says_whether_the_diagnosis_was_right(
    tmp_path: Path, effect: str, same_as: tuple[str, ...], told: str
) -> None:
    one = Selected(
        effect=effect, joints=("q3", "q4"), probability=0.9, same_as=same_as, gap_closed=Estimate(0.9, (0.8, 1.0)),
        parameters={"extend_gain": {"q3": Estimate(0.52, (0.5, 0.55))}}, decided_by=None,
    )  # fmt: skip
    answer = Answer(
        verdict="effects", selected=(one,), ranking=(), where=Where({}, (), None),
        gap=Gap(0.03, 0.01, 0.009, Estimate(0.95, (0.9, 1.0))), next_experiment=None, reason="",
    )  # fmt: skip
    (tmp_path / "diagnosis").mkdir()
    answer.write(tmp_path / "diagnosis" / "diagnosis.json")
    story_page.write_story(tmp_path, {"reference": "recorded"}, WITHHELD)
    page = (tmp_path / story_page.STORY_FILE).read_text()
    assert told in page and ('<td class="number">0.5</td>' in page) == (effect == "asymmetry")


def test_the_page_tells_success_that_fell_and_came_back(tmp_path: Path) -> None:
    rates = {"before": (0.95, 0.2, 0.15), "after": (0.9, 0.95, 0.93)}
    evaluations = {
        place: {
            "episodes": 200,
            "policies": {
                name: {
                    "episodes": 200,
                    "success_strict": {"mean": three[number]},
                    "time_to_insert_s": {"median": 9.0},
                }
                for name, three in rates.items()
            },
        }
        for number, place in enumerate(retraining.PLANTS)
    }
    for name in ("diagnosis", "repair"):
        (tmp_path / name).mkdir()
    (tmp_path / "repair" / retraining.COMPARISON_FILE).write_text(
        json.dumps(retraining.compare_policies(evaluations))
    )
    answer = Answer(
        verdict="none",
        selected=(),
        ranking=(),
        where=Where({}, (), None),
        gap=Gap(0.01, 0.01, 0.01, None),
        next_experiment=None,
    )
    answer.write(tmp_path / "diagnosis/diagnosis.json")
    story_page.write_story(tmp_path, {}, WITHHELD)
    assert (
        "found nothing; the machine has asymmetry on q3 and q4"
        in (tmp_path / story_page.STORY_FILE).read_text()
    )
