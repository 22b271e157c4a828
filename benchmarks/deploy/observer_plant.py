"""The shipped observer's thresholds and scores: python benchmarks/deploy/observer_plant.py <json> <hours> [--write].

The hydraulic plant works behind twin, bus and guard on a clock of its own (`tests/stage.py`): the
policy commands, and the borehole is another one every 20 s. What counts is what the bus process's
observer sees, with the delays of bus and sensors, in work. Half of the time is for the file, the
other half counts its alarms, in shifts of half an hour; `--write` writes the file.
"""

from __future__ import annotations

import json
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT)]

import numpy as np  # noqa: E402
from composed import option  # noqa: E402
from stage import Stage  # noqa: E402

from brokk_rl.machine import Machine  # noqa: E402
from brokk_rl.session import write_json  # noqa: E402
from brokk_rl.sim.link import SimulatedMachines  # noqa: E402
from deploy.guard.guard import GuardState  # noqa: E402
from deploy.guard.observer import Observer  # noqa: E402

OBSERVER = ROOT / "deploy" / "observers" / "brokk170.json"
HOLES_M = ((2.3, 2.8), (-0.6, 0.6), (0.6, 0.9))
"""Places of boreholes, x, y and z: within what the policy was trained for, as in `soak.py`."""
HOLE_S, SHIFT_S = 20.0, 60.0
MARGIN, LEAST_SLACK_S = 1.5, 0.06
"""Of the thresholds, as `conf/mode/observe.yaml` has them."""


@dataclass
class Work:
    """What an observer saw.

    Attributes:
        scores: Of the drift watch, of each joint.
        needed_s: Largest difference beyond the share of the way, `(J,)`, s of full speed.
        faults: Alarms of the observer.
        misfits: Alarms of the drift watch, by shift.
        seconds: Length.
    """

    scores: list[list[float]]
    needed_s: np.ndarray
    faults: list[str] = field(default_factory=list)
    misfits: list[str] = field(default_factory=list)
    seconds: float = 0.0


def watch_shift(machine: Machine, folder: Path, seed: int, work: Work) -> None:
    """Let the machine work for a shift, and note what its observer sees."""
    hydraulic = option("actuator", "hydraulic")
    plant = SimulatedMachines(actuator=hydraulic, noise=0.0003, one_machine=True)
    stage, draw = Stage(machine, "auto", folder, plant=plant), np.random.default_rng(seed)
    observer: Observer = stage.bus_process._logic._observer  # type: ignore[assignment]
    update = observer.update

    def note(now_s: float, q: np.ndarray, u: np.ndarray) -> None:
        before = observer.observation.fault
        observer.scores = []
        update(now_s, q, u)
        for joint, score in enumerate(observer.scores):
            if score is not None:
                work.scores[joint].append(score)
        seen = observer.window
        over = np.abs(seen.moved - seen.wanted) - (seen.limit - observer._slack)
        work.needed_s = np.maximum(work.needed_s, over / machine.max_speed)
        found = observer.observation
        if found.fault is not before and found.joint >= 0:
            work.faults.append(f"{machine.joint_names[found.joint]} {found.fault.value}")

    observer.update = note  # type: ignore[method-assign]
    while stage.ms < 1e3 * SHIFT_S:
        if stage.view.state is None or stage.view.state.guard is not GuardState.ACTIVE:
            stage.get_going()
        place_m = tuple(draw.uniform(*ends) for ends in HOLES_M)
        stage._write("target", t_s=stage.now_s, center_in_base_m=place_m)
        stage.go(HOLE_S)
    found = observer.observation
    if found.misfit_joint >= 0:
        work.misfits.append(f"{machine.joint_names[found.misfit_joint]} {found.misfit.value}")
    work.seconds += stage.ms / 1e3
    stage.close()


def watch(machine: Machine, seconds: float, seed: int) -> Work:
    """Return what the observer sees in shifts of `seconds` in all."""
    work = Work([[] for _ in machine.joints], np.zeros(machine.num_joints))
    with tempfile.TemporaryDirectory() as folder:
        for shift in range(round(seconds / SHIFT_S)):
            watch_shift(machine, Path(folder), seed + shift, work)
    return work


def main(path: Path, hours: float, writes: bool) -> None:
    machine = option("machine", "brokk170")
    content: dict[str, Any] = json.loads(OBSERVER.read_text())
    table: dict[str, object] = {}
    for name, seed in (("for the file", 1000), ("counted", 2000)):
        work = watch(machine, hours / 2 * 3600.0, seed)
        table[name] = {
            "minutes": round(work.seconds / 60, 1),
            "shifts": round(work.seconds / SHIFT_S),
            "false_alarms": work.faults,
            "drift_watch_alarms": work.misfits,
            "needed_slack_s": work.needed_s.round(4).tolist(),
            "scores": [len(own) for own in work.scores],
            "median_score": [round(float(np.median(own)), 3) if own else None for own in work.scores],
        }
        sys.stdout.write(f"{name}: {table[name]}\n")
        if name == "for the file" and writes:
            slack_s = np.maximum(MARGIN * work.needed_s, LEAST_SLACK_S).round(4).tolist()
            content["thresholds"] |= {"slack_s": slack_s, "minutes": round(work.seconds / 60, 1)}
            content["sources"] = ["simulator: Hydraulic, behind twin and bus"]
            content["scores"] = [sorted(round(one, 6) for one in own) for own in work.scores]
            write_json(OBSERVER, content)
    write_json(path, table)


if __name__ == "__main__":
    main(Path(sys.argv[1]), float(sys.argv[2]), "--write" in sys.argv)
