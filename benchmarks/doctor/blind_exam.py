"""Blind exam of the deployment doctor.

    python benchmarks/doctor/blind_exam.py make <folder>                # logs, and labels apart from them
    python benchmarks/doctor/blind_exam.py answer <folder>              # reads the logs alone
    python benchmarks/doctor/blind_exam.py score <folder> <out.json>    # opens the labels

`make` runs each policy in a deployed loop of its own making (`faults.py`), on a simulated machine with
contact and with the effects of the training, forty times with a fault, and twenty times without one over
all policies. The labels are written once, with their hash in `seal.txt`; `answer` takes
the logs in an order of chance and does not open the labels, which lie unencrypted in the same folder.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import platform
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "benchmarks/doctor"))

import faults as made  # noqa: E402

from brokk_rl import extensions  # noqa: E402
from brokk_rl.record import Recording, read_recording, write_recording  # noqa: E402

POLICIES = {
    "residual": (ROOT / "tasks/policies/borehole_insertion", "borehole_insertion"),
    "direct": (ROOT / "benchmarks/doctor/policies/direct", "borehole_insertion"),
    "goal_pose": (ROOT / "benchmarks/doctor/policies/goal_pose", "goal_pose"),
}
OTHERS = {"goal_pose_early": ROOT / "benchmarks/doctor/policies/goal_pose_early"}
"""An earlier checkpoint of the pose policy, which sits no exam of its own."""
OTHER = {"residual": "direct", "direct": "residual", "goal_pose": "goal_pose_early"}
"""Network that was copied by mistake."""
NUM_WORKERS = 2
NUM_CLEAN = 20
NUM_STEPS = 300
"""Control periods of a log, 15 s."""
DETAILS = ("command", "advice", "observation")
"""Kinds of logs. Each holds positions, the target and the command in force; the second also the policy's
advice, the third also the observation."""
ROUNDED = 1e-4
"""Positions of some logs are rounded to so much when they are written, rad."""
MOVES_RAD = 0.15
"""Motion of a joint from which an effect on it counts."""
NOISE_RAD = 0.0003
"""Noise of the encoders, rad; 14 bits, as in `link=site`."""
ACTS_START, LEAST_START = 0.006, 4
"""The same of a wrong start of the history: change of the command, and periods."""
NUM_TRIES = 4
"""Sizes of a fault that are drawn before another fault takes its place."""
ACTS, ACTS_SHARE = 0.02, 0.05
"""A fault of the code changes the command by so much in so many periods, else its size is drawn again."""


class Loop:
    """A deployed policy in numpy, as a stranger writes it from `policy.json`."""

    def __init__(self, folder: Path, fault: made.Fault | None) -> None:
        self.contract = json.loads((folder / "policy.json").read_text())
        self.fault = fault or made.Fault((), ())
        name = self.fault.network
        places = {key: place for key, (place, _) in POLICIES.items()} | OTHERS
        path = (places[name] if name else folder) / "policy.onnx"
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self.net = onnxruntime.InferenceSession(str(path), options)
        self.q = self.u = None
        self.steps = 0

    def step(
        self, target_m: np.ndarray, q: np.ndarray, u: np.ndarray, pitch_rad: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns what the network saw, what it commanded, and what leaves for the valves."""
        fault, samples = self.fault, self.contract["history"]["samples"]
        step = self.steps

        def see(term: str, value: np.ndarray) -> np.ndarray:
            return fault.see[term](value, step) if term in fault.see else value

        target_m, q, u = see("target", target_m), see("q", q), see("u", u)
        if self.q is None:
            begin = fault.before.get("q")
            self.q = np.tile(q if begin is None else np.full_like(q, begin), (samples, 1))
            self.q[-1], self.u = q, np.zeros((samples, len(u)))
        else:
            self.q, self.u = np.vstack([self.q[1:], q]), np.vstack([self.u[1:], u])
        handed = {"q": self.q, "u": self.u}
        for term, hook in fault.window.items():
            handed[term] = hook(handed[term], step)
        scale = self.contract["observation"]
        pitch = scale.get("pitch", {"mean_rad": 0.0, "std_rad": 1.0})
        parts = {
            "target_in_base_m": (target_m - np.array(scale["target"]["mean_m"]))
            / scale["target"]["std_m"],
            "q": (handed["q"] - np.array(scale["q"]["mean"])) / scale["q"]["std"],
            "u": (handed["u"] - np.array(scale["u"]["mean"])) / scale["u"]["std"],
            "pitch_rad": np.array([(pitch_rad - pitch["mean_rad"]) / pitch["std_rad"]]),
        }
        vector = np.concatenate([np.ravel(parts[name.split()[0]]) for name in scale["order"]])
        if fault.vector:
            vector = fault.vector(vector, step)
        vector = vector.astype(np.float32)
        command = self.net.run(None, {"observation": vector[None]})[0][0].astype(float)
        sent = fault.send(command, step) if fault.send else command
        self.steps += 1
        return vector, command, sent.clip(-1.0, 1.0)


@dataclass
class Worksite:
    """Simulated machines side by side, each with a start and a target of its own."""

    machine: Any
    q: np.ndarray
    scene: np.ndarray
    target_m: np.ndarray
    pitch_rad: np.ndarray


def draw_worksite(policy: str, num: int, seed: int) -> Worksite:
    """Returns starts of the policy's own task."""
    import torch

    machine = extensions.load_option("machine", "brokk170")
    process = extensions.load_option("task", POLICIES[policy][1]).build(
        machine, 1, torch.device("cpu")
    )
    start = {name: value.numpy() for name, value in process.starts(num, seed).items()}
    return Worksite(
        machine,
        start["q"],
        start["scene"],
        start["target_m"].astype(float),
        start["target_pitch_rad"].astype(float),
    )


def drive(
    site: Worksite, cases: list[dict[str, Any]], found: list[made.Fault | None]
) -> list[dict[str, np.ndarray]]:
    """Runs cases side by side; returns what each of them did. An effect of the first case is had by all."""
    import torch

    from brokk_rl.history import History

    cpu, num, machine = torch.device("cpu"), len(cases), site.machine
    torch.set_num_threads(1)
    torch.manual_seed(cases[0]["seed"])
    sim = replace(extensions.load_option("sim", "native"), num_worlds=num, num_threads=2)
    world = sim.build(machine, cpu, num)
    model = extensions.load_option("actuator", "mlp").build(machine, num, cpu)
    model = extensions.load_option("effect", "library").wrap(model, machine, num, cpu)
    if cases[0].get("effect"):
        name, numbers = cases[0]["effect"]
        model = extensions.load_option("effect", name, **numbers).wrap(model, machine, num, cpu)
    rows = np.array([case["row"] for case in cases])
    rim_m, scene = site.target_m[rows], site.scene[rows].copy()
    for index, case in enumerate(cases):
        if case["kind"] == "task":
            before_m = rim_m[index].copy()
            rim_m[index] = made.move_target(
                case["number"], np.random.default_rng(case["seed"] + 1), before_m
            )
            scene[index, :3] += rim_m[index] - before_m
    everywhere = torch.ones(num, dtype=torch.bool)
    start = torch.as_tensor(site.q[rows], dtype=torch.float32)
    model.reset(everywhere)
    world.reset(everywhere, start, torch.as_tensor(scene, dtype=torch.float32))
    history = History(
        q=torch.zeros(num, machine.num_history, machine.num_joints),
        u=torch.zeros(num, machine.num_history, machine.num_joints),
    )
    history.reset(everywhere, start)
    loops = [
        Loop(POLICIES[case["policy"]][0], fault) for case, fault in zip(cases, found, strict=True)
    ]
    noises = [np.random.default_rng(case["seed"]) for case in cases]
    bias_m = [noise.uniform(-0.002, 0.002, 3) for noise in noises]
    sums, before = np.zeros((num, 3)), np.zeros((num, machine.num_joints))
    logs: list[dict[str, list[np.ndarray]]] = [
        {name: [] for name in ("q", "u", "advice", "target", "obs")} for _ in cases
    ]
    for k in range(NUM_STEPS):
        truth, given = history.q[:, -1].numpy().astype(float), np.zeros_like(before)
        for n, (loop, noise) in enumerate(zip(loops, noises, strict=True)):
            q = (
                (truth[n] + NOISE_RAD * noise.standard_normal(len(truth[n])))
                .astype(np.float32)
                .astype(float)
            )
            sums[n] += rim_m[n] + bias_m[n] + noise.uniform(-0.004, 0.004, 3)
            target_m = (sums[n] / (k + 1)).astype(np.float32).astype(float)
            vector, command, sent = loop.step(target_m, q, before[n], site.pitch_rad[rows[n]])
            given[n] = sent
            for name, value in (
                ("q", q),
                ("u", sent),
                ("advice", command),
                ("target", target_m),
                ("obs", vector),
            ):
                logs[n][name].append(np.array(value))
        with torch.inference_mode():
            history.push_u(torch.as_tensor(given, dtype=torch.float32))
            world.step(model.step(history) - history.q[:, -1])
            history.push_q(world.q)
        before = given.astype(np.float32).astype(float)
    return [{name: np.stack(values) for name, values in one.items()} for one in logs]


def make_recording(
    machine: Any, rows: dict[str, np.ndarray], case: dict[str, Any], pitch_rad: float
) -> Recording:
    """Returns the log with as much detail as the case has."""
    extra = {f"target_{axis}_m": rows["target"][:, i] for i, axis in enumerate("xyz")}
    extra["target_pitch_rad"] = np.full(NUM_STEPS, pitch_rad)
    if case["detail"] != "command":
        extra |= {
            f"advice_{name}": rows["advice"][:, j] for j, name in enumerate(machine.joint_names)
        }
    if case["detail"] == "observation":
        extra |= {f"obs_{j}": rows["obs"][:, j] for j in range(rows["obs"].shape[1])}
    q = np.round(rows["q"] / ROUNDED) * ROUNDED if case["rounded"] else rows["q"]
    return Recording(
        machine=machine.name,
        joints=machine.joint_names,
        units=tuple(joint.unit for joint in machine.joints),
        rate_hz=1.0 / machine.period_s,
        t_s=np.arange(NUM_STEPS) * machine.period_s,
        u=rows["u"].astype(np.float32),
        q=q.astype(np.float32),
        extra={name: values.astype(np.float32) for name, values in extra.items()},
        metadata={"source": "deployed loop"},
    )


def list_cases(seed: int, per_policy: int | None) -> list[dict[str, Any]]:
    """Returns all cases of an exam."""
    rng, cases = np.random.default_rng(seed), []
    names = list(POLICIES)
    for policy in names:
        chosen = [("listed", i) for i in range(len(made.LISTED))]
        chosen += [("unlisted", i) for i in range(len(made.UNLISTED))]
        chosen += [("effect", i) for i in range(made.NUM_EFFECTS)] + [
            ("task", i) for i in range(made.NUM_TASKS)
        ]
        if per_policy:
            chosen = [chosen[i] for i in rng.permutation(len(chosen))[:per_policy]]
        for kind, number in chosen:
            cases.append({"policy": policy, "kind": kind, "number": number})
    for number in range(per_policy or NUM_CLEAN):
        cases.append({"policy": names[number % len(names)], "kind": "clean", "number": number})
    for index, case in enumerate(cases):
        case["seed"] = int(rng.integers(1 << 30))
        case["detail"] = (
            DETAILS[index % 3] if case["kind"] != "clean" else DETAILS[case["number"] // 3 % 3]
        )
        case["rounded"] = bool(rng.random() < 0.3)
    return cases


def make_logs(
    policy: str, cases: list[dict[str, Any]], seed: int
) -> list[tuple[dict[str, np.ndarray], dict[str, Any], float]]:
    """Makes the logs of all cases of a policy; returns rows, label and wanted pitch of each."""
    site = draw_worksite(policy, len(cases), seed)
    for row, case in enumerate(cases):
        case["row"] = row
    contract = json.loads((POLICIES[policy][0] / "policy.json").read_text())
    target = contract["observation"]["target"]
    facts = {
        "moving": np.arange(5),
        "other": OTHER[policy],
        "target_mean": target["mean_m"],
        "target_std": target["std_m"],
    }
    done: dict[int, tuple[dict[str, np.ndarray], dict[str, Any], float]] = {}
    rng = np.random.default_rng(seed + 7)
    for attempt in range(2 * NUM_TRIES):
        open_cases = [case for case in cases if case["row"] not in done]
        if attempt >= NUM_TRIES:  # this policy does not care: another fault takes the place
            for case in open_cases:
                if case["kind"] == "listed":
                    case["number"] = int(rng.integers(len(made.LISTED)))
        together = [case for case in open_cases if case["kind"] != "effect"]
        batches = ([together] if together else []) + [
            [case] for case in open_cases if case["kind"] == "effect"
        ]
        for batch in batches:
            found, labels = [], []
            for case in batch:
                fault, label = draw_fault(case, rng, facts)
                found.append(fault)
                labels.append(label)
            for case, label, rows in zip(batch, labels, drive(site, batch, found), strict=True):
                pitch_rad = float(site.pitch_rad[case["row"]])
                if is_visible(case, rows, pitch_rad):
                    done[case["row"]] = rows, dict(case) | label, pitch_rad
        if len(done) == len(cases):
            return [done[row] for row in range(len(cases))]
    raise RuntimeError(
        f"faults that never act: {[case for case in cases if case['row'] not in done]}"
    )


def draw_fault(
    case: dict[str, Any], rng: np.random.Generator, facts: dict[str, Any]
) -> tuple[made.Fault | None, dict[str, Any]]:
    """Draws the size of a case's fault; returns the fault and its label."""
    if case["kind"] in ("clean", "task"):
        return None, {"verdict": "nothing" if case["kind"] == "clean" else "task"}
    if case["kind"] == "effect":
        case["effect"] = made.draw_effect(
            case["number"], rng, f"q{int(rng.choice([0, 2, 3, 4])) + 1}"
        )
        return None, {"verdict": "actuator", "size": case["effect"]}
    draw = (made.LISTED if case["kind"] == "listed" else made.UNLISTED)[case["number"]]
    fault = draw(rng, facts)
    return fault, {
        "verdict": "code",
        "fault": draw.__name__,
        "kinds": fault.label,
        "terms": fault.term,
        "size": fault.size,
    }


def is_visible(case: dict[str, Any], rows: dict[str, np.ndarray], pitch_rad: float) -> bool:
    """Returns whether the fault of a case changed anything: the command, or the motion of its joints."""
    if case["kind"] in ("clean", "task"):
        return True
    if case["kind"] == "effect":
        joints = case["effect"][1]["joints"]
        moved = np.ptp(rows["q"], axis=0) > MOVES_RAD
        return joints == "all" or bool(moved[int(joints[0][1:]) - 1])
    is_start = case["kind"] == "listed" and made.LISTED[case["number"]] is made.history_zero
    least = ACTS_START if is_start else ACTS
    loop, before, off = Loop(POLICIES[case["policy"]][0], None), np.zeros(5), 0
    for k in range(NUM_STEPS):
        _, command, _ = loop.step(rows["target"][k], rows["q"][k], before, pitch_rad)
        off += int(np.abs(command - rows["u"][k]).max() > least)
        before = rows["u"][k].astype(np.float32).astype(float)
    return off >= (LEAST_START if is_start else ACTS_SHARE * NUM_STEPS)


def make(folder: Path, seed: int, per_policy: int | None) -> None:
    """Makes all logs; the labels lie sealed beside them."""
    cases = list_cases(seed, per_policy)
    order = np.random.default_rng(seed + 1).permutation(len(cases))
    (folder / "logs").mkdir(parents=True)
    paths, labels = [folder / "logs" / f"{number:03d}.parquet" for number in order], []
    chosen = {policy: [case for case in cases if case["policy"] == policy] for policy in POLICIES}
    with ProcessPoolExecutor(NUM_WORKERS) as pool:
        seeds = [seed + 100 * number for number in range(len(chosen))]
        made_logs = dict(
            zip(chosen, pool.map(make_logs, chosen, chosen.values(), seeds), strict=True)
        )
    machine = extensions.load_option("machine", "brokk170")
    for case, path in zip(cases, paths, strict=True):
        rows, label, pitch_rad = made_logs[case["policy"]].pop(0)
        write_recording(make_recording(machine, rows, case, pitch_rad), path)
        labels.append(label)
    found = {path.stem: label for path, label in zip(paths, labels, strict=True)}
    text = json.dumps(dict(sorted(found.items())), indent=1, default=str)
    (folder / "labels.json").write_text(text)
    (folder / "seal.txt").write_text(hashlib.sha256(text.encode()).hexdigest() + "\n")
    given = {path.stem: case["policy"] for path, case in zip(paths, cases, strict=True)}
    (folder / "policies.json").write_text(json.dumps(dict(sorted(given.items()))))


@cache
def load_given() -> tuple[Any, dict[str, Any], Any, Any]:
    """Returns machine, policies by name, actuator and effects of the training."""
    from diagnosis.deployment.contract import load_policy

    machine = extensions.load_option("machine", "brokk170")
    places = {key: place for key, (place, _) in POLICIES.items()} | OTHERS
    policies = {key: load_policy(str(place), machine) for key, place in places.items()}
    actuator = extensions.load_option("actuator", "mlp")
    return machine, policies, actuator, extensions.load_option("effect", "library")


def answer_one(folder: Path, name: str, policy_name: str) -> dict[str, Any]:
    """Returns the doctor's answer to one log."""
    from diagnosis.deployment.doctor import examine_deployment

    machine, known, actuator, library = load_given()
    policies = dict(known)
    recording = read_recording(folder / "logs" / f"{name}.parquet", machine)
    begun = time.perf_counter()
    found = examine_deployment(
        policies.pop(policy_name),
        [recording],
        machine,
        others=policies,
        target_m=None,
        is_sent=True,
        actuator=actuator,
        effects={"library": library},
        seed=0,
    )
    return found.to_json() | {"seconds": time.perf_counter() - begun}


def answer(folder: Path) -> None:
    """Answers all logs; the labels are not read."""
    given = json.loads((folder / "policies.json").read_text())
    with ProcessPoolExecutor(NUM_WORKERS) as pool:
        found = list(pool.map(answer_one, [folder] * len(given), given, given.values()))
    (folder / "answers.json").write_text(json.dumps(dict(zip(given, found, strict=True)), indent=1))


def judge(label: dict[str, Any], found: dict[str, Any]) -> dict[str, Any]:
    """Returns how right an answer is: its verdict, and for code its name."""
    told = [one for log in found["logs"] for one in log["findings"]]
    pairs = [(one["kind"], one["field"].partition(".")[0]) for one in told]
    pairs += [
        (one["kind"], one["field"].partition(".")[0])
        for finding in told
        for one in finding["same_as"]
    ]
    verdict = found["verdict"] == label["verdict"]
    named = verdict
    if label["verdict"] == "code" and label["kinds"] != ["unlisted"]:
        named = verdict and any(
            kind in label["kinds"] and term in label["terms"] for kind, term in pairs
        )
        named = named and len(told) == 1
    elif label["verdict"] == "code":
        # No name is right here: code without one.
        named = verdict and all(one["kind"] == "unlisted" for one in told)
    return {"verdict": verdict, "named": bool(named), "told": pairs, "said": found["verdict"]}


def score(folder: Path, out: Path) -> None:
    """Opens the labels, checks the seal, and writes the result."""
    text = (folder / "labels.json").read_text()
    seal = hashlib.sha256(text.encode()).hexdigest()
    if seal != (folder / "seal.txt").read_text().strip():
        raise SystemExit("the labels were changed after they were sealed")
    labels, answers = json.loads(text), json.loads((folder / "answers.json").read_text())
    rows = {name: judge(label, answers[name]) | {"label": label} for name, label in labels.items()}

    def share(select: Any, key: str = "named") -> dict[str, Any]:
        chosen = [row for row in rows.values() if select(row["label"])]
        return {"of": len(chosen), "right": sum(row[key] for row in chosen)}

    is_fault = lambda one: one["kind"] != "clean"  # noqa: E731
    clean = [row for row in rows.values() if row["label"]["kind"] == "clean"]
    result = {
        "command": "python benchmarks/doctor/blind_exam.py make|answer|score",
        "seal": seal,
        "faults": share(is_fault),
        "verdicts": share(is_fault, "verdict"),
        "false_alarms": {"of": len(clean), "right": sum(row["said"] not in ("nothing", "cannot_tell") for row in clean)},
        "by_kind": {kind: share(lambda one, kind=kind: one["kind"] == kind) for kind in ("listed", "unlisted", "effect", "task")},
        "by_policy": {policy: share(lambda one, policy=policy: is_fault(one) and one["policy"] == policy) for policy in POLICIES},
        "by_detail": {detail: share(lambda one, detail=detail: is_fault(one) and one["detail"] == detail) for detail in DETAILS},
        "wrong": [
            {"log": name, "policy": row["label"]["policy"], "detail": row["label"]["detail"],
 "fault": row["label"].get("fault", row["label"]["kind"]),
             "size": row["label"].get("size"), "said": row["said"], "told": row["told"]}
            for name, row in rows.items() if not row["named"]
        ],
        "seconds_per_log": float(np.median([one["seconds"] for one in answers.values()])),
        "machine": f"{platform.machine()}, 2 shared cores, Python {platform.python_version()}",
        "commit": subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, cwd=ROOT).stdout.strip(),
    }  # fmt: skip
    out.write_text(json.dumps(result, indent=2) + "\n")


def main() -> None:
    """Runs one step of the exam."""
    parser = argparse.ArgumentParser()
    parser.add_argument("do", choices=("make", "answer", "score"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("out", type=Path, nargs="?")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--per-policy", type=int, default=None, help="fewer faults, for a trial")
    given = parser.parse_args()
    if given.do == "make":
        make(given.folder, given.seed, given.per_policy)
    elif given.do == "answer":
        answer(given.folder)
    else:
        score(given.folder, given.out)


if __name__ == "__main__":
    main()
