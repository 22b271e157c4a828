"""A third-party package adds options by its entry point alone."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import Brokk
from packages import install_package

from brokk_rl.job import name_job

PARTS = '''"""Parts of another package."""

import json

import torch

from brokk_rl.session import Session
from brokk_rl.spec import spec


@spec
class Sticky:
    """An actuator that never moves."""

    share: float

    def build(self, machine, num_envs, device):
        return self


@spec
class Show:
    """Writes what it was given."""

    session: Session
    actuator: object
    perception: object
    fails: str

    def run(self):
        if self.fails == "by us":
            raise RuntimeError("our own fault")
        if self.fails == "by hand":
            raise KeyboardInterrupt
        names = [type(part).__name__ for part in (self.actuator, self.perception)]
        (self.session.folder / "seen.json").write_text(json.dumps(names))
        return float("nan") if self.fails == "to learn" else self.actuator.share
'''
MODE = """# @package _global_
defaults:
  - /session@session
  - /actuator: sticky
  - /perception: truth
  - _self_
run: mine.parts.Show
fails: not
"""


@pytest.fixture
def mine(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder on the import path with the package `mine` in it."""
    folder = tmp_path_factory.mktemp("site")
    options = {
        "parts.py": PARTS,
        "conf/actuator/sticky.yaml": "_target_: mine.parts.Sticky\nshare: 0.25\n",
        "conf/mode/show.yaml": MODE,
    }
    install_package(folder, "mine", options, monkeypatch)
    return folder


def test_its_options_run_beside_ours(mine: Path, brokk: Brokk, tmp_path: Path) -> None:
    brokk("mode=show", "actuator=sticky", "session.out=run")
    assert (tmp_path / "run" / "seen.json").read_text() == '["Sticky", "TruthPerception"]'


def test_an_option_that_two_packages_offer_is_chosen_by_its_file(
    mine: Path, brokk: Brokk, monkeypatch: pytest.MonkeyPatch
) -> None:
    sticky = "_target_: mine.parts.Sticky\nshare: 0.5\n"
    install_package(mine, "yours", {"conf/actuator/sticky.yaml": sticky}, monkeypatch)
    for words in (("mode=train", "actuator=sticky"), ("mode=show",)):
        done = brokk(*words, "session.out=run", code=2)
        assert "actuator=sticky: several packages" in done.err
    told = done.err.rpartition("actuator=@")[2].strip()
    done = brokk("mode=train", f"actuator=@{told}", "--cfg", "job", "--package", "actuator")
    assert "share: 0.5" in done.out


def test_an_entry_point_without_its_package_is_named(mine: Path, brokk: Brokk) -> None:
    path = mine / "mine-1.0.dist-info" / "entry_points.txt"
    path.write_text("[brokk_rl.conf]\nmine = mine.missing\n")
    done = brokk("mode=list", code=2)
    assert "mine.missing" in done.err


@pytest.mark.parametrize(
    ("fails", "code", "recorded"),
    [
        ("by us", 1, ('"outcome": "failed"', "our own fault")),
        ("by hand", 130, ('"outcome": "interrupted"',)),
        ("to learn", 0, ('"objective": null',)),
    ],
)
def test_the_record_says_how_a_run_ended(
    fails: str, code: int, recorded: tuple[str, ...], mine: Path, brokk: Brokk
) -> None:
    done = brokk("mode=show", "session.out=run", f"fails='{fails}'", code=code)
    assert ("RuntimeError: our own fault" in done.err) is (code == 1)
    for part in recorded:
        assert part in Path("run/session.json").read_text()


def test_a_group_may_be_chosen_as_a_list(mine: Path, brokk: Brokk, tmp_path: Path) -> None:
    brokk("mode=show", "perception=[truth]", "session.out=run")
    assert '"perception": "[truth]"' in (tmp_path / "run" / "session.json").read_text()


def test_a_sweep_has_one_folder_for_each_job_and_no_others(
    mine: Path, brokk: Brokk, tmp_path: Path
) -> None:
    words = ("mode=show", "session.seed=3,4", "actuator.share=0.5,0.75", "session.device=cpu")
    brokk("-m", *words, "session.out=sweep")
    values = [f"seed-{seed}_share-{share}" for seed in (3, 4) for share in (0.5, 0.75)]
    jobs = [f"{number}_{one}" for number, one in enumerate(values)]
    assert sorted(path.name for path in (tmp_path / "sweep").iterdir()) == [*jobs, "multirun.yaml"]
    files = sorted(path.name for path in (tmp_path / "sweep" / jobs[1]).iterdir())
    assert files == ["resolved.yaml", "seen.json", "session.json"]
    assert '"objective": 0.75' in (tmp_path / "sweep" / jobs[1] / "session.json").read_text()
    assert [path.name for path in tmp_path.iterdir()] == ["sweep"]


def test_the_name_of_a_job_can_be_typed() -> None:
    overrides = ["effect=[@found/effects.yaml,lag]", "fit@baselines.lag=lag", "mode=train"]
    assert name_job(7, overrides, ["mode"]) == "7_effect-effects-lag_lag-lag"
    assert len(name_job(0, [f"a.b={'x' * 300}"], [])) == 120


def test_resolved_runs_again_in_a_new_folder(mine: Path, brokk: Brokk, tmp_path: Path) -> None:
    brokk("mode=show", "actuator.share=0.5", "session.out=run")
    brokk("--config-dir", "run", "--config-name", "resolved", "session.out=again")
    first, again = ((tmp_path / name / "resolved.yaml").read_text() for name in ("run", "again"))
    assert first == again
    brokk("--config-dir", "run", "--config-name", "resolved")
    assert [path.name.split("_", 2)[2] for path in (tmp_path / "runs").iterdir()] == ["parts"]
