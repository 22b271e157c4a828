"""The scorecard on real machines: knowledge against answers, logs of a toy folder, resume, missing folders."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from composed import every, option
from conftest import Done
from scipy import io as matlab

from brokk_rl.errors import ConfigError, RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from exam import real_cases, scorecard
from exam.real_cases import KnownCauses, RealCase

KNOWN = KnownCauses(
    explainable=True,
    effects={"dead_band": ("boom", "stick")},
    plausible=("lag",),
    source="measured",
)
NOT_EXPLAINABLE = KnownCauses(explainable=False, effects={}, plausible=(), source="measured")


def answer(*selected: tuple[str, tuple[str, ...]], verdict: str = "effects") -> dict[str, Any]:
    return {
        "verdict": verdict,
        "selected": [
            {"effect": name, "joints": list(joints), "same_as": []} for name, joints in selected
        ],
    }


def test_known_effects_are_counted_joint_by_joint() -> None:
    found = scorecard.score_answer(answer(("dead_band", ("stick", "swing"))), KNOWN)
    assert found["first_right"] is True
    assert found["known"] == ["dead_band boom", "dead_band stick"]
    assert found["found"] == ["dead_band stick"]
    assert found["phantoms"] == ["dead_band swing"]
    assert found["abstention_right"] is True


def test_a_plausible_effect_is_no_phantom_and_no_right_first_pick() -> None:
    found = scorecard.score_answer(answer(("lag", ("boom",)), ("stiction", ("boom",))), KNOWN)
    assert found["first_right"] is False
    assert found["phantoms"] == ["stiction boom"]


def test_a_name_of_the_class_counts_as_the_known_effect() -> None:
    given = answer(("stiction", ("boom",)))
    given["selected"][0]["same_as"] = ["dead_band"]
    found = scorecard.score_answer(given, KNOWN)
    assert (found["first_right"], found["found"], found["phantoms"]) == (
        True,
        ["dead_band boom"],
        [],
    )


@pytest.mark.parametrize(
    ("verdict", "known", "right"),
    [
        ("unknown", NOT_EXPLAINABLE, True),
        ("refused", NOT_EXPLAINABLE, True),
        ("none", NOT_EXPLAINABLE, False),
        ("unknown", KNOWN, False),
    ],
)
def test_abstention_is_right_where_the_library_cannot_explain(
    verdict: str, known: KnownCauses, right: bool
) -> None:
    assert scorecard.score_answer(answer(verdict=verdict), known)["abstention_right"] is right


def test_knowledge_that_contradicts_itself_is_refused() -> None:
    with pytest.raises(ConfigError, match="not explainable"):
        KnownCauses(explainable=False, effects={"lag": ()}, plausible=(), source="x")


def test_shares_are_read_and_errors_apart_are_joined_over_travel(machine: Machine) -> None:
    travel = dict(zip(machine.joint_names, machine.upper - machine.lower, strict=True))
    joints = {
        name: {"before": 0.1 * size, "after": 0.05 * size, "share": 0.5}
        for name, size in travel.items()
    }
    given = {
        "gap": {
            "before": {"rmse_rad": 0.4},
            "after": {"rmse_rad": 0.1},
            "floor": {"rmse_rad": None},
            "closed": None,
        },
        "unseen": {"joints": joints},
        "rivals": {"hold": {"rmse_rad": 0.3}},
    }
    found = scorecard.read_errors(given, machine)
    assert (found["before"], found["after"]) == (0.4, 0.1)
    assert found["apart"] == pytest.approx(0.5)
    assert found["rivals"] == {"hold": 0.3}
    assert found["closed"] is None


def test_effects_are_contradicted_by_standing_still_and_by_a_rival_that_is_much_better() -> None:
    errors = {"after": 0.3, "rivals": {"hold": 0.29, "arx": 0.25, "model": 0.19}}
    scores = {"verdict": "effects"}
    assert scorecard.list_better_rivals(scores, errors) == ["hold", "model"]
    assert scorecard.list_better_rivals({"verdict": "unknown"}, errors) == []


def test_standing_still_errs_by_the_motion(machine: Machine) -> None:
    # at a constant speed v the error is v t; its mean square over 5 s in steps of 0.05 s is
    # v² 0.05² (K + 1)(2 K + 1) / 6 with K = 100
    t_s = np.arange(600) * machine.period_s
    q = np.repeat(0.01 * t_s[:, None], len(machine.joint_names), 1)
    recording = Recording(
        machine=machine.name, joints=machine.joint_names, units=("rad",) * 5, rate_hz=20.0,
        t_s=t_s, u=np.zeros_like(q), q=q,
    )  # fmt: skip
    expected = 0.01 * 0.05 * np.sqrt(101 * 201 / 6)
    assert scorecard.compute_hold_error([recording], machine, "rad") == pytest.approx(expected)


@every("real_machine")
def test_every_case_that_ships_is_complete(name: str) -> None:
    case = option("real_machine", name)
    assert isinstance(case, RealCase)
    assert case.reader.joints.keys() == set(case.machine.joint_names)  # pyright: ignore[reportAttributeAccessIssue]


def drive_log(seconds: float) -> dict[str, np.ndarray]:
    t_s = np.arange(0.0, seconds, 0.001)
    return {"t": t_s, "vir": 5.0 * np.sin(t_s), "qm": 0.12 - 0.1 * np.cos(t_s)}


def test_matlab_logs_become_recordings(tmp_path: Path) -> None:
    log = drive_log(8.0)
    matlab.savemat(tmp_path / "a.mat", {**{k: v[:, None] for k, v in log.items()}, "gain": 3.0})
    machine, reader = option("machine", "emps"), option("import", "emps")
    (found,) = reader.read(tmp_path / "a.mat", machine)
    # the mean of the five samples of a period
    np.testing.assert_allclose(found.u[:, 0], 0.5 * np.sin(found.t_s + 0.002), atol=1e-4)
    np.testing.assert_allclose(found.q[:, 0], 0.12 - 0.1 * np.cos(found.t_s), atol=1e-6)


def test_parquet_logs_become_recordings_and_a_missing_column_is_named(tmp_path: Path) -> None:
    machine, reader = option("machine", "so101"), option("import", "so101")
    t_s = np.arange(0.0, 8.0, 0.02)
    columns = {"t_state_s": t_s}
    for joint, middle in zip(machine.joint_names, (machine.lower + machine.upper) / 2, strict=True):
        columns[f"target_{joint}_rad"] = np.full(len(t_s), middle)
        columns[f"q_{joint}_rad"] = np.full(len(t_s), middle)
    pq.write_table(pa.table(columns), tmp_path / "a.parquet")
    (found,) = reader.read(tmp_path / "a.parquet", machine)
    np.testing.assert_allclose(found.u, 0.0, atol=1e-4)
    del columns["q_elbow_rad"]
    pq.write_table(pa.table(columns), tmp_path / "b.parquet")
    with pytest.raises(RecordingError, match="column 'q_elbow_rad' is missing"):
        reader.read(tmp_path / "b.parquet", machine)


def test_a_target_is_the_command_of_a_servo_and_its_speed_that_of_a_valve(tmp_path: Path) -> None:
    machine, reader = option("machine", "so101"), option("import", "so101")
    t_s = np.arange(0.0, 8.0, 0.02)
    columns = {"t_state_s": t_s}
    for joint, low, high in zip(machine.joint_names, machine.lower, machine.upper, strict=True):
        columns[f"target_{joint}_rad"] = low + (high - low) * np.minimum(t_s, 4.0) / 8.0
        columns[f"q_{joint}_rad"] = columns[f"target_{joint}_rad"]
    pq.write_table(pa.table(columns), tmp_path / "a.parquet")
    (found,) = reader.read(tmp_path / "a.parquet", machine)
    np.testing.assert_allclose(found.u[:, 0], np.minimum(t_s, 4.0) / 4.0 - 1.0, atol=1e-5)
    speeds = {
        name: replace(one, command=replace(one.command, full_speed=1.0))
        for name, one in reader.joints.items()
    }
    with pytest.raises(ConfigError, match=r"commanded by position; give .* as null"):
        replace(reader, joints=speeds).read(tmp_path / "a.parquet", machine)
    valves = replace(machine, joints=tuple(replace(one, command="valve") for one in machine.joints))
    (found,) = replace(reader, joints=speeds).read(tmp_path / "a.parquet", valves)
    # a travel of 1.6 rad in 8 s, until it stops
    np.testing.assert_allclose(found.u[found.t_s < 3.99, 0], 0.2, atol=1e-5)
    np.testing.assert_allclose(found.u[found.t_s > 4.01, 0], 0.0, atol=1e-5)


class Stages:
    """Stands in for the processes of the stages: leaves the answer of an `unknown`, or fails."""

    def __init__(self) -> None:
        self.commands: list[list[str]] = []
        self.code = 0

    def __call__(self, words: list[str], stderr: Any) -> Stages:
        self.commands.append(words)
        place = Path(next(w for w in words if w.startswith("session.out=")).partition("=")[2])
        place.mkdir()
        gap = {"before": {"rmse_m": 0.2}, "after": {"rmse_m": 0.2}, "floor": {"rmse_m": 0.1}}
        given = {**answer(verdict="unknown"), "gap": {**gap, "closed": None}}
        (place / "diagnosis.json").write_text(json.dumps(given))
        stderr.write("error: too little data\n" if self.code else "")
        stderr.flush()
        return self

    def __enter__(self) -> Stages:
        return self

    def __exit__(self, *exc: Any) -> None:
        pass

    def wait(self, timeout: float) -> int:
        return self.code


@pytest.fixture
def stages(monkeypatch: pytest.MonkeyPatch) -> Stages:
    found = Stages()
    monkeypatch.setattr(
        real_cases, "subprocess", SimpleNamespace(Popen=found, TimeoutExpired=TimeoutError)
    )
    return found


@pytest.fixture
def data(tmp_path: Path) -> Path:
    folder = tmp_path / "data" / "emps"
    folder.mkdir(parents=True)
    for name in ("emps.mat", "emps_p.mat"):
        matlab.savemat(folder / name, drive_log(12.0))
    return folder.parent


EMPS_KNOWN = "real_machine.emps.known"
BEYOND = [
    f"{EMPS_KNOWN}.explainable=false",
    f"~{EMPS_KNOWN}.effects.coulomb_friction",
    f"~{EMPS_KNOWN}.effects.viscous_friction",
]
"""A machine whose causes the library lacks: an abstention is right."""


def test_a_scorecard_skips_missing_folders_and_keeps_finished_cases(
    brokk: Callable[..., Done], stages: Stages, data: Path, caplog: pytest.LogCaptureFixture
) -> None:
    words = ["mode=scorecard", f"scorecard.data={data}", "session.out=card", *BEYOND]
    done = brokk(*words)
    assert done.code == 0, done.err
    assert "so101 is skipped: there is no folder" in caplog.text
    assert len(stages.commands) == 1
    found = json.loads((data.parent / "card" / "scorecard.json").read_text())
    assert found["cases"]["emps"]["scores"]["abstention_right"] is True
    assert found["cases"]["emps"]["errors"]["rivals"]["hold"] > 0
    assert set(found["skipped"]) == {"mini_excavator", "so101"}
    assert "| emps | unknown |" in (data.parent / "card" / "scorecard.md").read_text()
    assert "Known:" in (data.parent / "card" / "scorecard.html").read_text()
    # the answer stands; knowledge that has changed meanwhile counts
    again = brokk(*words, "resume=card", f"{EMPS_KNOWN}.plausible=[lag]")
    assert again.code == 0, again.err
    assert len(stages.commands) == 1
    later = json.loads((data.parent / "card" / "scorecard.json").read_text())
    assert later["cases"] == found["cases"]


def test_a_refusal_is_an_abstention_and_a_failure_is_none(
    brokk: Callable[..., Done], stages: Stages, data: Path
) -> None:
    words = ["mode=scorecard", f"scorecard.data={data}", "real_machine=[emps]", *BEYOND]
    outcomes = {}
    for stages.code in (2, 1):
        assert brokk(*words, f"session.out=card{stages.code}").code == 0
        path = data.parent / f"card{stages.code}" / "scorecard.json"
        outcomes[stages.code] = json.loads(path.read_text())["cases"]["emps"]
    assert outcomes[2]["scores"]["verdict"] == "refused"
    assert outcomes[2]["scores"]["abstention_right"] is True
    assert outcomes[1]["outcome"] == "failed"
    assert "too little data" in outcomes[1]["reason"]


def test_without_any_folder_of_logs_the_scorecard_is_refused(
    brokk: Callable[..., Done], tmp_path: Path
) -> None:
    done = brokk("mode=scorecard", f"scorecard.data={tmp_path}", "session.out=card")
    assert done.code == 2
    assert "expected a folder of logs" in done.err
