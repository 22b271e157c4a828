"""Insertion on the twin, guided and alone: python benchmarks/deploy/guided.py <folder> <trials> <at once>.

Each trial is `preset=bench` with real processes, in real time. `guided`: the default mode, nothing
is sent, a simulated person moves the levers as the policy trained behind a person shows them.
`alone`: the other shipped policy commands the valves itself. Success is the strict one, from the
captured positions. `latched`: why the guard stopped a trial until the operator pressed again.
"""

from __future__ import annotations

import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

import hydra
import numpy as np
import torch
from hydra.utils import instantiate

from brokk_rl.kinematics import Kinematics
from deploy.recorder import capture_reader

SECONDS = {"guided": 55, "alone": 45}
"""Twice what the slowest one in twenty takes in training, and half a minute until everything has
started on busy cores."""
PORT = 43300
BROKK = (sys.executable, "-P", "-m", "brokk_rl")


def main(folder: Path, trials: int, at_once: int) -> None:
    with hydra.initialize_config_module("conf", version_base="1.3"):
        cfg = hydra.compose("config", overrides=["mode=evaluate"])
    machine, task = (
        instantiate(cfg.machine, _convert_="all"),
        instantiate(cfg.task, _convert_="all"),
    )
    starts = task.build(machine, 1, torch.device("cpu")).starts(trials, 12345)
    jobs = [(kind, n) for n in range(trials) for kind in SECONDS]

    def one(job: tuple[str, int]) -> dict[str, object]:
        kind, n = job
        hole, q = starts["scene"][n, :3].tolist(), starts["q"][n].tolist()
        out = folder / f"{kind}_{n:03d}"
        choice = ["bench=guided"] if kind == "guided" else ["deploy=auto"]
        command = [
            *BROKK, "preset=bench", *choice, f"link.start={q}", f"link.hole_in_base_m={hole}",
            f"target.center_in_base_m={hole}", f"bus.port={PORT + jobs.index(job)}", f"deploy.seconds={SECONDS[kind]}",
            "page=none", f"session.seed={n}", f"session.out={out}",
        ]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            return {"kind": kind, "trial": n, "error": done.stderr[-500:]}
        return {"kind": kind, "trial": n, **judged(out, machine, task, np.array(hole))}

    folder.mkdir(parents=True, exist_ok=True)
    results: list[dict[str, object]] = []
    with ThreadPoolExecutor(at_once) as pool:
        for done in as_completed([pool.submit(one, job) for job in jobs]):
            results.append(done.result())
            found = summary(results)
            (folder / "guided.json").write_text(json.dumps(found, indent=1) + "\n")
            sys.stdout.write(json.dumps({key: found[key] for key in ("summary", "ratio")}) + "\n")
            sys.stdout.flush()


def summary(results: list[dict[str, object]]) -> dict[str, object]:
    """Return what the trials so far come to."""
    found, rate = {}, {}
    for kind in SECONDS:
        good = [bool(one.get("success")) for one in results if one["kind"] == kind]
        rate[kind] = sum(good) / max(1, len(good))
        found[kind] = {"trials": len(good), "success_strict": rate[kind]}
    return {
        "summary": found,
        "ratio": rate["guided"] / rate["alone"] if rate["alone"] else None,
        "trials": results,
    }


def judged(out: Path, machine: object, task: object, hole: np.ndarray) -> dict[str, object]:
    contents = capture_reader.read_capture(out / "capture.mcap")
    positions = {}
    for messages in contents.messages.values():
        for name in machine.joint_names:
            if f"Position_{name}" in messages.names:
                positions[name] = np.stack(
                    [messages.series("t_s"), messages.series(f"Position_{name}")], 1
                )
    if len(positions) < machine.num_joints:
        return {"success": False, "error": "the twin was never heard"}
    t_s = next(iter(positions.values()))[:, 0]
    q = np.stack([np.interp(t_s, *positions[name].T) for name in machine.joint_names], 1)
    tip = Kinematics(machine).pose(torch.tensor(q, dtype=torch.float32)).tip_in_base_m.numpy()
    lateral = np.linalg.norm((tip - hole)[:, :2], axis=1)
    rules = task.success
    inside = (lateral <= task.hole.radius_m - rules.chisel_radius_m + rules.slack_m) & (
        hole[2] - tip[:, 2] >= rules.strict_depth_m
    )
    timing = json.loads((out / "timing.json").read_text())
    late = {one["process"]: one["late_p99_s"] for one in timing["processes"]}
    moved = t_s[np.abs(q - q[0]).max(1) > 0.01]
    first_s = float(t_s[inside.argmax()] - moved[0]) if inside.any() and len(moved) else None
    latched = [
        values["cause"]
        for _, values in contents.messages.get("guard", [])
        if values["state"] == "LATCHED"
    ]
    sent = any(values.get("sent") for _, values in contents.messages.get("ValveCmd", []))
    return {
        "success": bool(inside.any()),
        "time_to_insert_s": first_s,
        "late_p99_s": late,
        "commands_sent": sent,
        "latched": latched,
    }


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
