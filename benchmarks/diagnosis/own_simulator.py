"""Faults of an arm, diagnosed with its own MJCF file as the simulator.

    python benchmarks/diagnosis/own_simulator.py benchmarks/diagnosis/own_simulator.json --seeds 0 1 2

Each case is one fault, four recordings of 40 s (`tests/arm.py`). Cases that the file holds are left out.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT)]

from arm import ARM, keep, make_machine, record_arm, rub, weaken  # noqa: E402

from diagnosis import api  # noqa: E402


def load_rotor(spec: Any) -> None:
    """Adds 0.03 kg m² at the elbow, three times its own armature."""
    spec.joint("elbow").armature = 0.04


def thicken(spec: Any) -> None:
    """Adds 0.8 Nms/rad of damping at the shoulder."""
    joint = spec.joint("shoulder")
    damping = joint.damping.copy()
    damping[0] += 0.8
    joint.damping = damping


Fault = tuple[Callable[[Any], None], int, float, tuple[str, ...], tuple[str, ...]]
FAULTS: dict[str, Fault] = {
    "none": (keep, 0, 0.0, (), ()),
    "delay of 60 ms": (keep, 3, 0.0, ("dead_time",), ("shoulder", "elbow")),
    "friction of 0.5 Nm": (rub, 0, 0.0, ("joint_friction",), ("elbow",)),
    "stiffness less by 0.4": (weaken, 0, 0.0, ("drive_gain",), ("shoulder",)),
    "play of 50 mrad": (keep, 0, 0.05, ("backlash",), ("elbow",)),
    "armature of 0.04 kg m²": (load_rotor, 0, 0.0, ("joint_armature",), ("elbow",)),
    "damping more by 0.8 Nms/rad": (thicken, 0, 0.0, ("joint_damping",), ("shoulder",)),
}
"""Change of the file, delay in periods, play in rad; effect and joints that are right."""


def diagnose_fault(name: str, seed: int) -> dict[str, Any]:
    """Returns the answer for one fault, and whether it is right."""
    change, delay, play_rad, effects, joints = FAULTS[name]
    machine = make_machine("shoulder", "elbow")
    recordings = []
    for run in range(4):
        recordings.append(record_arm(machine, change, delay, 10 * seed + run, 40.0, play_rad))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.xml"
        path.write_text(ARM)
        begun_s = time.process_time()
        field = api.RecordingSet(tuple(recordings), machine)
        found = api.diagnose(field, Path(folder) / "run", simulator=path, seed=seed).answer
        took_s = time.process_time() - begun_s
    selected = []
    for one in found.selected:
        numbers = {}
        for number, values in one.parameters.items():
            numbers[number] = {joint: value.mean for joint, value in values.items()}
        selected.append({"effect": one.effect, "joints": one.joints, "numbers": numbers})
    named = tuple(one["effect"] for one in selected)
    return {
        "fault": name,
        "seed": seed,
        "verdict": found.verdict,
        "selected": selected,
        "effect_right": named == effects,
        "joints_right": named == effects
        and all(set(one["joints"]) == set(joints) for one in selected),
        "cpu_s": took_s,
    }


def main() -> None:
    """Measures the cases that are not in the file yet."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("path", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    given = parser.parse_args()
    cases = json.loads(given.path.read_text())["cases"] if given.path.is_file() else []
    for seed in given.seeds:
        for name in FAULTS:
            if any((one["fault"], one["seed"]) == (name, seed) for one in cases):
                continue
            cases.append(diagnose_fault(name, seed))
            commit = subprocess.run(
                ["git", "describe", "--always", "--dirty"], cwd=ROOT, capture_output=True, text=True
            ).stdout.strip()
            content = {
                "command": "python benchmarks/diagnosis/own_simulator.py benchmarks/diagnosis/own_simulator.json",
                "machine": f"{platform.machine()}, {os.cpu_count()} cores, one used",
                "commit": commit,
                "cases": cases,
            }
            given.path.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
