"""`mode=identify` from recordings to verdict: judged by whole unseen runs, resumed without doing anything twice, said in words."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from axis import driven
from composed import MACHINE, option

from actuators.contracts import FitTask
from actuators.identify import page
from actuators.identify.request import Identification
from actuators.identify.results import write_verdict
from actuators.models.lag import FirstOrderLag
from actuators.models.linear import Hold
from actuators.modes.identify import Identify
from brokk_rl import record
from brokk_rl.errors import ConfigError, RecordingError, StorageError
from brokk_rl.session import Session

CPU = torch.device("cpu")
PLANT = FirstOrderLag(
    dead_time_s=0.55, dead_band_extend=0.1, dead_band_retract=0.1, gain=0.6, time_constant_s=0.0
)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six runs of 30 s of random levels on all joints, two files each."""
    folder = tmp_path_factory.mktemp("recordings")
    for run, made in enumerate(driven(MACHINE, 6, 30.0, 0, PLANT, 0.0)):
        for part in range(2):
            rows = slice(300 * part, 300 * part + 300)
            half = {"t_s": made.t_s[rows], "u": made.u[rows], "q": made.q[rows]}
            half["metadata"] = {"run": f"run {run}", "source": "test"}
            record.write_recording(replace(made, **half), folder / f"run{run}_{part}.parquet")
    return folder


class Fit:
    """Knows the plant from the start; counts its fits and can be interrupted before one of them."""

    name = "plant"

    def __init__(self, actuator: Any = PLANT, interrupted_at: int | None = None) -> None:
        self.actuator, self.interrupted_at = actuator, interrupted_at
        self.fitted_to: list[tuple[set[str], set[str]]] = []

    def __repr__(self) -> str:
        return "Fit"

    def fit(self, task: FitTask) -> Any:
        if len(self.fitted_to) == self.interrupted_at:
            raise KeyboardInterrupt
        self.fitted_to.append(({r.run for r in task.train}, {r.run for r in task.validation}))
        return self.actuator


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spares drawing and writing pictures, which is most of the time of an identification of so little."""
    monkeypatch.setattr(page, "write_page", lambda *arguments: None)


def identify(out: Path, folder: Path, fit: Any, resume: bool = False, **options: Any) -> Identify:
    own = {"recordings": f"{folder}/*", "test": None, "folds": None, "hold_out": 3, "stride_s": 1.0}
    return Identify(
        session=Session(out=str(out), seed=0, device="cpu"), machine=MACHINE, fit=fit,
        baselines={"hold": option("fit", "hold"), "arx": option("fit", "arx")},
        identify=Identification(**own | options), resume=str(out) if resume else None,
    )  # fmt: skip


def run(mode: Identify) -> dict[str, Any]:
    with mode.session.start("", {}, resume=mode.resume is not None):
        mode.run()
    return json.loads((mode.session.folder / "identification.json").read_text())


@pytest.mark.usefixtures("undrawn")
def test_each_run_is_judged_once_by_a_model_that_has_not_seen_it(
    recordings: Path, tmp_path: Path
) -> None:
    fit = Fit()
    result = run(identify(tmp_path / "out", recordings, fit, folds=3))
    every = {f"run {n}" for n in range(6)}
    stages = result["data"]["runs"]
    assert sorted(name for stage in stages for name in stage["test"]) == sorted(every)
    for stage, (train, validation) in zip(stages, fit.fitted_to, strict=True):
        assert (set(stage["train"]), set(stage["validation"])) == (train, validation)
        assert not train & validation and train | validation == every - set(stage["test"])
    assert stages[-1]["test"] == [] and len(stages) == 4
    assert result["data"]["test"]["runs"] == 6
    # 15 s files: 1 s windows up to those of 10 s
    plant, hold = (result["joints"]["q1"][name]["10"]["percent"] for name in ("plant", "hold"))
    assert plant < 0.1 < hold


@pytest.mark.usefixtures("undrawn")
def test_an_interrupted_identification_goes_on_and_does_no_fit_twice(
    recordings: Path, tmp_path: Path
) -> None:
    whole = run(identify(tmp_path / "whole", recordings, Fit(), folds=3))
    broken = Fit(interrupted_at=2)
    with pytest.raises(KeyboardInterrupt):
        run(identify(tmp_path / "parts", recordings, broken, folds=3))
    again = Fit()
    parts = run(identify(tmp_path / "parts", recordings, again, resume=True, folds=3))
    assert len(broken.fitted_to) == 2 and len(again.fitted_to) == 2
    assert all(parts[key] == whole[key] for key in ("joints", "overall", "against", "delay_s"))
    others = {"resume": True, "folds": 3, "stride_s": 2.0}
    with pytest.raises(StorageError, match="is of another fit, or of other recordings or windows"):
        run(identify(tmp_path / "parts", recordings, Fit(), **others))


def test_going_on_needs_the_folder_itself_and_a_run_in_it(recordings: Path, tmp_path: Path) -> None:
    mode = identify(tmp_path / "none", recordings, Fit(), resume=True)
    with pytest.raises(ConfigError, match="there is no run to go on with"):
        run(mode)
    elsewhere = Identify(**{**vars(mode), "resume": str(tmp_path / "other")})
    with pytest.raises(ConfigError, match=r"goes on in its own folder; add session\.out="):
        run(elsewhere)


def test_a_run_is_refused_as_test_when_it_was_fitted_to(recordings: Path, tmp_path: Path) -> None:
    seen: dict[str, Any] = {"recordings": f"{recordings}/*_0.parquet"}
    seen["test"] = f"{recordings}/run0_1.parquet"
    with pytest.raises(RecordingError, match=r"run 0 is also among identify\.recordings"):
        run(identify(tmp_path / "a", recordings, Fit(), **seen))
    with pytest.raises(ConfigError, match="folds and test are two ways"):
        identify(tmp_path / "a", recordings, Fit(), test="x", folds=2)


def test_the_report_of_a_good_model_says_so(recordings: Path, tmp_path: Path) -> None:
    result = run(identify(tmp_path / "out", recordings, Fit()))
    assert {path.name for path in (tmp_path / "out").iterdir()} >= {
        "identification.json", "identification.html", "prediction.png",
    }  # fmt: skip
    assert result["verdict"][0]["tone"] == "good"
    text = (tmp_path / "out" / "identification.html").read_text()
    assert text.count("data:image/png;base64,") == 1 and result["verdict"][0]["text"] in text


@pytest.mark.usefixtures("undrawn")
def test_a_model_that_stands_still_is_no_good_news(recordings: Path, tmp_path: Path) -> None:
    result = run(identify(tmp_path / "out", recordings, Fit(Hold())))
    verdict = result["verdict"][0]
    assert verdict["tone"] == "bad" and "worse on q1, q2, q3, q4, q5" in verdict["text"]
    result["delay_s"]["q4"] |= {"value": 0.8, "ci95": [0.78, 0.82]}
    texts = [finding.text for finding in write_verdict(result, MACHINE)]
    for part in (
        "dead time of q4 may exceed the history of 0.65 s",
        "num_history of machine 'brokk170' to 19 or more",
    ):
        assert any(part in text for text in texts)
