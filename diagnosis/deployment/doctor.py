"""The doctor's answer over one log or several, and the file `doctor.json` that holds it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from brokk_rl.contracts.actuator import Actuator, Effect
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.session import write_json
from diagnosis.deployment.contract import LoadedPolicy
from diagnosis.deployment.examination import (
    NUM_RANKED,
    UNLISTED,
    DoctorVerdict,
    Finding,
    RunExamination,
    decide_verdict,
    examine_run,
)
from diagnosis.deployment.fault_search import StageResult
from diagnosis.deployment.motion_check import MotionEvidence, check_motion

SCHEMA = 1
ANSWER_FILE = "doctor.json"


@dataclass(frozen=True)
class DoctorAnswer:
    """Answer of the deployment doctor.

    Attributes:
        verdict: `code`, `actuator`, `task`, `nothing` or `cannot_tell`.
        reason: The verdict in a sentence or two.
        runs: Result of each log.
        motion: Motion of all logs against the simulator.
    """

    verdict: DoctorVerdict
    reason: str
    runs: tuple[RunExamination, ...]
    motion: MotionEvidence

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Mistakes of all logs."""
        return tuple(finding for run in self.runs for finding in run.findings)

    def to_json(self) -> dict[str, Any]:
        """Return the answer as plain JSON data, as `doctor.json` holds it."""
        return {
            "schema": SCHEMA,
            "verdict": self.verdict,
            "reason": self.reason,
            "named": bool(self.findings) and all(one.kind != UNLISTED for one in self.findings),
            "logs": [_describe_run(run) for run in self.runs],
            "actuator": {
                "horizon_s": self.motion.horizon_s,
                "cannot_tell": self.motion.cannot_tell or None,
                "joints": {one.joint: one.to_json() for one in self.motion.joints},
            },
        }  # fmt: skip

    def write(self, folder: Path) -> None:
        """Write `doctor.json` into a folder."""
        write_json(folder / ANSWER_FILE, self.to_json())


def examine_deployment(
    policy: LoadedPolicy,
    recordings: Sequence[Recording],
    machine: Machine,
    *,
    others: Mapping[str, LoadedPolicy],
    target_m: tuple[float, ...] | None,
    is_sent: bool,
    actuator: Actuator | None,
    effects: Mapping[str, Effect],
    seed: int,
) -> DoctorAnswer:
    """Return the doctor's answer.

    Args:
        policy: The policy that should have run.
        recordings: Logs of its run or runs.
        machine: The machine.
        others: Further policies that may have run instead, by name.
        target_m: Target where the logs do not hold it.
        is_sent: The commands in force are those that the policy's loop sent.
        actuator: The simulator's actuator; `None`: motion is not judged.
        effects: Effects that the training draws, by name.
        seed: Of all draws.
    """
    generator = np.random.default_rng(seed)
    runs = []
    for recording in recordings:
        runs.append(examine_run(policy, recording, machine, others, target_m, is_sent, generator))
    if any(run.findings for run in runs):
        motion = MotionEvidence((), 0.0, "the code is to be mended first")
    else:
        motion = check_motion(recordings, machine, actuator, effects, seed)
    verdict, reason = decide_verdict(runs, motion)
    return DoctorAnswer(verdict, reason, tuple(runs), motion)


def _describe_run(run: RunExamination) -> dict[str, Any]:
    path = run.log.recording.path
    return {
        "path": str(path) if path else None,
        "findings": [vars(finding) for finding in run.findings],
        "code": [_describe_stage(stage, run.log.t_s) for stage in run.stages],
        "task": {
            "blamed": run.task.blamed,
            "outside": [vars(one) for one in run.task.outside],
            "cannot_tell": run.task.cannot_tell or None,
        },
        "cannot_tell": run.cannot_tell,
        "notes": run.notes,
    }


def _describe_stage(result: StageResult, t_s: np.ndarray) -> dict[str, Any]:
    ranking = []
    for one in result.ranking[:NUM_RANKED]:
        ranking.append(
            {
                "kind": one.distortion.kind, "field": one.distortion.field,
                "value": one.value if one.distortion.parameter else None,
                "explained": one.explained, "removes": one.gain,
            }
        )  # fmt: skip
    departed = result.departed
    where = [
        {"number": label, "share": share} for label, share in result.rank_labels()[:NUM_RANKED]
    ]
    return {
        "stage": result.stage.name,
        "rows": result.num_rows,
        "departed": len(departed),
        "since_s": float(t_s[departed[0]]) if len(departed) else None,
        "where": where,
        "ranking": ranking,
    }
