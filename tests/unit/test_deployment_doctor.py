"""The deployment doctor: mistakes of a deployed loop are named, and a right one is left alone."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from arm import make_machine
from composed import MACHINE
from motion import make_recording
from torch import nn

from brokk_rl.errors import CheckpointError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording, write_recording
from brokk_rl.rl.export import _write_onnx
from diagnosis.case import select_rows
from diagnosis.deployment.contract import LoadedPolicy, load_policy
from diagnosis.deployment.examination import Deployment, DoctorAnswer
from diagnosis.deployment.replay import measure_resolution
from diagnosis.deployment.training_range import measure_margin

NUM_ROWS, SAMPLES = 120, 4
TERMS = (("target", 3), ("q", 5 * SAMPLES), ("u", 5 * SAMPLES))
Loop = Callable[[np.ndarray, int], np.ndarray]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy of another maker: a network of two layers with a contract that lists its terms."""
    place, size = tmp_path_factory.mktemp("policy"), sum(number for _, number in TERMS)
    layers = [nn.Linear(size, 24), nn.Tanh(), nn.Linear(24, 5), nn.Tanh()]
    network, rng = nn.Sequential(*layers), torch.Generator().manual_seed(0)
    for weights, std in zip(network.parameters(), (0.4, 0.2, 0.3, 0.1), strict=True):
        nn.init.normal_(weights, std=std, generator=rng)
    _write_onnx(network, torch.zeros(1, size), place / "policy.onnx")
    names = MACHINE.joint_names
    terms = [
        {"name": "target", "columns": ["target_x_m", "target_y_m", "target_z_m"], "mean": [2.5, 0, 0.7], "std": 0.5},
        {"name": "q", "columns": [f"q_{name}_rad" for name in names], "samples": SAMPLES, "mean": 0.3, "std": 0.7},
        {"name": "u", "columns": [f"u_{name}" for name in names], "samples": SAMPLES, "newest": -1},
    ]  # fmt: skip
    ranges = {"target.distance": [2.0, 3.5], "q.q1": [-9.0, 9.0]}
    contract = {
        "rate_hz": 20, "joints": list(names), "observation": {"terms": terms},
        "training_observations": {"count": 500, "ranges": ranges},
    }  # fmt: skip
    (place / "policy.json").write_text(json.dumps(contract))
    return place


@pytest.fixture(scope="module")
def policy(folder: Path) -> LoadedPolicy:
    return load_policy(str(folder), MACHINE)


def run_loop(
    policy: LoadedPolicy,
    machine: Machine,
    *,
    see_q: Loop = lambda q, _: q,
    see_target: Loop = lambda target, _: target,
    send: Loop = lambda u, _: u,
    vector: Loop = lambda v, _: v,
    detail: str = "command",
    target_m: tuple[float, ...] = (2.4, 0.3, 0.8),
) -> Recording:
    """Runs the policy on a machine that integrates its commands; the loop may make a mistake."""
    rng = np.random.default_rng(1)
    mean = {"target": np.array([2.5, 0, 0.7]), "q": 0.3, "u": 0.0}
    std = {"target": 0.5, "q": 0.7, "u": 1.0}
    q, before, rows = machine.home.copy(), np.zeros(5), []
    past_q, past_u = None, np.zeros((SAMPLES, 5))
    for k in range(NUM_ROWS):
        measured = (q + rng.normal(0.0, 3e-4, 5)).astype(np.float32).astype(float)
        target = np.array(target_m) + 0.4 * np.sin(0.07 * k + np.arange(3))
        target = target.astype(np.float32).astype(float)
        seen = see_q(measured, k)
        past_q = np.tile(seen, (SAMPLES, 1)) if past_q is None else np.vstack([past_q[1:], seen])
        past_u = np.vstack([past_u[1:], before]) if k else past_u
        parts = {"target": see_target(target, k), "q": past_q, "u": past_u}
        scaled = [np.ravel((parts[name] - mean[name]) / std[name]) for name, _ in TERMS]
        made = np.asarray(vector(np.concatenate(scaled), k), np.float32)
        command = policy.network.answer(made[None])[0]
        sent = send(command, k)
        rows.append((measured, sent, target, command, made))
        before = sent.astype(np.float32).astype(float)
        # A swing keeps all joints moving whatever the network says.
        q = q + 0.05 * (0.3 * sent + 0.2 * np.sin(0.1 * k + np.arange(5)))
    q_log, u, target, advice, obs = (np.stack(part) for part in zip(*rows, strict=True))
    extra = {f"target_{axis}_m": target[:, i] for i, axis in enumerate("xyz")}
    if detail != "command":
        extra |= {f"advice_{name}": advice[:, j] for j, name in enumerate(machine.joint_names)}
    if detail == "observation":
        extra |= {f"obs_{j}": obs[:, j] for j in range(obs.shape[1])}
    told = {name: values.astype(np.float32) for name, values in extra.items()}
    return make_recording(machine, u, q_log, extra=told)


def ask(policy: LoadedPolicy, recording: Recording, machine: Machine) -> DoctorAnswer:
    return Deployment(policy, machine).examine([recording], None, {}, 0)


def turn_joint(values: np.ndarray, _: int) -> np.ndarray:
    return values * np.array([1, 1, -1, 1, 1])


NEWEST_FIRST = np.r_[0:3, 18:23, 13:18, 8:13, 3:8, 23:43]
FAULTS = {
    "sign": ({"see_q": turn_joint}, "sign", "q.q3"),
    "unit": ({"see_q": lambda q, _: np.rad2deg(q)}, "scale", "q"),
    "offset": ({"see_q": lambda q, _: q + np.array([0, 0.2, 0, 0, 0])}, "default_pose", "q.q2"),
    "frame": ({"see_target": lambda p, _: np.array([-p[1], p[0], p[2]])}, "frame", "target"),
    "valves": ({"send": lambda u, _: u[[1, 0, 2, 3, 4]]}, "order", "command"),
    "slow": ({"send": lambda u, _: 0.6 * u}, "scale", "command"),
    "clip": ({"vector": lambda v, _: v.clip(-0.4, 0.4)}, "clip", "observation"),
    "history": ({"vector": lambda v, _: v[NEWEST_FIRST]}, "order", "q"),
    "raw": ({"vector": lambda v, _: [*v[:3], *(0.7 * v[3:23] + 0.3), *v[23:]]}, "scale", "q"),
}


@pytest.mark.parametrize(
    ("name", "detail"),
    [*((name, "command") for name in FAULTS), ("sign", "observation"), ("frame", "observation")],
)
def test_a_mistake_is_named_with_its_field(name: str, detail: str, policy: LoadedPolicy) -> None:
    hooks, kind, place = FAULTS[name]
    found = ask(policy, run_loop(policy, MACHINE, detail=detail, **hooks), MACHINE)
    assert found.verdict == "code"
    assert [(one.kind, one.field) for one in found.findings] == [(kind, place)]
    assert found.findings[0].time_s[0] < 0.5


@pytest.mark.parametrize("detail", ["command", "advice", "observation"])
def test_a_right_loop_is_left_alone(detail: str, policy: LoadedPolicy) -> None:
    found = ask(policy, run_loop(policy, MACHINE, detail=detail), MACHINE)
    assert (found.verdict, found.findings) == ("nothing", ())


def test_a_log_that_begins_in_motion_is_judged_where_it_holds_the_history(
    policy: LoadedPolicy,
) -> None:
    recording = run_loop(policy, MACHINE)
    for first, verdict in ((40, "nothing"), (NUM_ROWS - SAMPLES - 1, "cannot_tell")):
        found = ask(policy, select_rows(recording, slice(first, None)), MACHINE)
        assert found.verdict == verdict, found.reason


def test_a_fitted_number_is_the_true_one(policy: LoadedPolicy) -> None:
    recording = run_loop(policy, MACHINE, see_q=lambda q, _: q * np.array([1, 1, 1, 0.83, 1]))
    (finding,) = ask(policy, recording, MACHINE).findings
    assert (finding.kind, finding.field) == ("scale", "q.q4")
    assert finding.parameters["factor"] == pytest.approx(0.83, abs=2e-3)


def test_a_signal_that_stops_is_told_with_its_time(policy: LoadedPolicy) -> None:
    kept = {}

    def stop(q: np.ndarray, k: int) -> np.ndarray:
        if k <= 70:
            kept["q5"] = q[4]
        return np.append(q[:4], kept["q5"])

    (finding,) = ask(policy, run_loop(policy, MACHINE, see_q=stop), MACHINE).findings
    assert (finding.kind, finding.field) == ("stale", "q.q5")
    assert finding.time_s[0] == pytest.approx(3.55, abs=0.16)


def test_a_mistake_without_a_name_gets_none(policy: LoadedPolicy) -> None:
    rng = np.random.default_rng(5)
    recording = run_loop(policy, MACHINE, vector=lambda v, _: v + 0.2 * rng.standard_normal(len(v)))
    found = ask(policy, recording, MACHINE)
    assert found.verdict == "code"
    assert [one.kind for one in found.findings] == ["unlisted"]


def test_a_target_out_of_the_training_is_the_task(policy: LoadedPolicy) -> None:
    found = ask(policy, run_loop(policy, MACHINE, target_m=(5.5, 0.3, 0.8)), MACHINE)
    assert found.verdict == "task" and "target.distance" in found.reason


@pytest.mark.parametrize(("margin_rad", "verdict"), [(0.05, "nothing"), (-0.05, "task")])
def test_only_the_pose_at_the_start_is_part_of_the_task(
    policy: LoadedPolicy, margin_rad: float, verdict: str
) -> None:
    recording = run_loop(policy, MACHINE)
    start = float(recording.q[0, 1])
    assert np.abs(recording.q[:, 1] - start).max() > 0.2
    ranges = {"q.q2": [start - 0.1 - margin_rad, start + margin_rad]}
    contract = replace(policy.contract, training={"count": 2048, "ranges": ranges})
    found = ask(replace(policy, contract=contract), recording, MACHINE)
    assert found.verdict == verdict


def test_a_log_without_the_target_cannot_tell(policy: LoadedPolicy) -> None:
    found = ask(policy, replace(run_loop(policy, MACHINE), extra={}), MACHINE)
    assert found.verdict == "cannot_tell" and "target_x_m" in found.reason


LONGER = {"obs_43": np.zeros(NUM_ROWS, np.float32)}


@pytest.mark.parametrize(
    ("change", "kind", "field"),
    [
        (lambda one: replace(one, rate_hz=10.0, t_s=one.t_s * 2), "rate", "loop"),
        (lambda one: replace(one, extra={**one.extra, **LONGER}), "network", "observation"),
    ],
)
def test_another_rate_and_another_length_are_told(
    policy: LoadedPolicy, change: Any, kind: str, field: str
) -> None:
    found = ask(policy, change(run_loop(policy, MACHINE, detail="observation")), MACHINE)
    assert (found.findings[0].kind, found.findings[0].field) == (kind, field)


class Backwards:
    """A network that takes its numbers in reverse."""

    def __init__(self, policy: LoadedPolicy) -> None:
        self.answer = lambda vectors: policy.network.answer(vectors[:, ::-1])


def test_another_network_is_told_and_named_if_given(policy: LoadedPolicy) -> None:
    other = LoadedPolicy(policy.contract, Backwards(policy))  # type: ignore[arg-type]
    recording = run_loop(other, MACHINE, detail="observation")
    (unnamed,) = ask(policy, recording, MACHINE).findings
    given = Deployment(policy, MACHINE, {"runs/{old}": other})
    (named,) = given.examine([recording], None, {}, 0).findings
    assert "another network" in unnamed.text and named.text == "the network is that of runs/{old}"
    assert (unnamed.kind, unnamed.field) == (named.kind, named.field) == ("network", "network")


def test_rounding_of_the_log_is_no_mistake(policy: LoadedPolicy) -> None:
    recording = run_loop(policy, MACHINE)
    rounded = np.round(recording.q / 1e-3) * 1e-3
    assert measure_resolution(rounded[:, 0].astype(float)) == pytest.approx(1e-3, rel=1e-2)
    found = ask(policy, replace(recording, q=rounded.astype(np.float32)), MACHINE)
    assert found.verdict == "nothing"


PARTS = {"parts": [{"name": "distance", "samples": 1, "width": 3}]}


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda made: made["observation"]["terms"].pop(), "23 numbers, the network takes 43"),
        (lambda made: made.pop("joints"), "lacks 'joints'"),
        (
            lambda made: made["joints"].__delitem__(slice(3, 5)),
            "gives 5 commands, the contract names 3",
        ),
        (lambda made: made["observation"]["terms"][1].update(std=0), "and std above 0"),
        (lambda made: made.update(observation=PARTS), r"terms of the task's own \(distance\)"),
    ],
)
def test_a_contract_that_does_not_fit_is_refused(
    folder: Path, tmp_path: Path, change: Callable[[Any], None], told: str
) -> None:
    contract = json.loads((folder / "policy.json").read_text())
    change(contract)
    (tmp_path / "policy.json").write_text(json.dumps(contract))
    (tmp_path / "policy.onnx").write_bytes((folder / "policy.onnx").read_bytes())
    with pytest.raises(CheckpointError, match=told):
        load_policy(str(tmp_path), MACHINE)


def test_a_policy_of_another_machine_is_refused_by_its_joints() -> None:
    with pytest.raises(CheckpointError, match="has hinge, without q1, q2, q3, q4, q5; give the"):
        load_policy("tasks:policies/borehole_insertion", make_machine("hinge"))


def test_the_doctor_from_the_command(
    brokk: Callable[..., object], policy: LoadedPolicy, folder: Path
) -> None:
    write_recording(run_loop(policy, MACHINE, see_q=turn_joint), Path("log.parquet"))
    arguments = ("~actuator", "doctor.log=log.parquet", f"policy={folder}", "session.out=out")
    brokk("mode=doctor_policy", *arguments)
    told = json.loads(Path("out/doctor.json").read_text())
    assert (told["verdict"], told["logs"][0]["findings"][0]["field"]) == ("code", "q.q3")
    assert "q.q3 has the wrong sign" in Path("out/doctor.html").read_text()


@pytest.mark.parametrize("name", ["standard_normal", "standard_exponential", "random"])
def test_a_run_of_the_training_itself_is_hardly_ever_outside_of_it(name: str) -> None:
    draw = getattr(np.random.default_rng(0), name)
    count, num_values, num_runs = 256, 9, 2000
    margin = measure_margin(count, num_values)
    num_outside = 0
    for _ in range(num_runs):
        seen, new = draw((count, num_values)), draw(num_values)
        low, high = seen.min(0), seen.max(0)
        spare = margin * (high - low)
        num_outside += ((new < low - spare) | (new > high + spare)).any()
    assert num_outside <= 0.03 * num_runs
    assert measure_margin(20, num_values) > margin > measure_margin(2048, num_values) > 0.0
