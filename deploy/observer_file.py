"""Calibration of the observer: its file, and its alarms in recordings of a healthy machine."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording, read_recordings
from brokk_rl.registry import resolve_package_path
from brokk_rl.session import Session, write_json
from brokk_rl.spec import spec
from deploy.guard.limits import GuardLimits, ObserverLimits
from deploy.guard.observer import Observer
from deploy.guard.valve_model import SCHEMA, load_observer_file

FILE, COUNTS = "observer.json", "observed.json"
SHIFT_S = 8 * 3600.0
"""A shift, to which alarms are extrapolated."""


class ModelTables(Protocol):
    """An actuator whose numbers can be exported; `actuator=valve` can."""

    def export_tables(self, machine: Machine) -> dict[str, Any]:
        """Return all numbers by joint, as plain data."""
        ...


@dataclass
class AlarmCounts:
    """Alarms of an observer in recordings.

    Attributes:
        seconds: Length of all recordings.
        faults: Alarms by joint and fault.
        misfits: Alarms of the drift watch, one a run at most, by joint and effect.
        num_runs: Number of runs.
        scores: Scores of the drift watch, of each joint.
    """

    num_joints: int
    seconds: float = 0.0
    num_runs: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    misfits: Counter[str] = field(default_factory=Counter)
    scores: list[list[float]] = field(init=False)

    def __post_init__(self) -> None:
        self.scores = [[] for _ in range(self.num_joints)]

    @property
    def faults_a_shift(self) -> float:
        """Alarms extrapolated to a shift."""
        return self.faults.total() * SHIFT_S / max(self.seconds, 1e-9)


@spec
class ObserverCalibration:
    """Recordings of a healthy machine, and the observer's limits.

    Attributes:
        recordings: Glob or list of globs; recordings that the model was not fitted to.
        path: File of an observer whose alarms are counted; `null`: one is made.
        limits: Of the guard, whose observer counts.
    """

    recordings: str | tuple[str, ...]
    path: str | None
    limits: GuardLimits

    def run(self, machine: Machine, actuator: ModelTables, session: Session) -> list[str]:
        """Write the files into the session's folder; return the result in words.

        Raises:
            ConfigError: the model or the file is not one of this machine.
            RecordingError: nothing matches, or a recording cannot be read.
        """
        limits = self.limits.observer
        if limits is None:
            raise ConfigError(
                "mode=observe: expected limits of the observer, got guard.observer=null"
            )
        recordings = read_recordings(list(_list_patterns(self.recordings)), machine)
        if self.path is None:
            if not hasattr(actuator, "export_tables"):
                raise ConfigError(
                    "mode=observe: expected actuator=valve or a fit of it, by actuator=@<file>"
                )
            tables = actuator.export_tables(machine)
            content: dict[str, Any] = {"schema": SCHEMA, "machine": machine.name}
            content |= {"fingerprint": machine.fingerprint(), "model": tables}
            content["scores"] = [[] for _ in machine.joints]
        else:
            content = load_observer_file(resolve_package_path(self.path))
            machine.check_fingerprint(content["fingerprint"], self.path)
        counts = count_alarms(limits, content, machine, recordings, session.stream("observe"))
        lines = [
            f"{counts.seconds / 60:.0f} minutes of {counts.num_runs} runs: {counts.faults.total()} false alarms, "
            f"{counts.faults_a_shift:.1f} a shift of 8 h"
        ]
        lines += [f"  {name}: {number}" for name, number in counts.faults.most_common()]
        if self.path is None:
            content["scores"] = [sorted(round(one, 6) for one in own) for own in counts.scores]
            write_json(session.folder / FILE, content)
            numbers = ", ".join(str(len(own)) for own in counts.scores)
            lines.append(f"{FILE}: {numbers} scores of the joints for the drift watch")
        else:
            lines.append(
                f"drift watch: alarms in {counts.misfits.total()} of {counts.num_runs} runs"
            )
            lines += [f"  {name}: {number}" for name, number in counts.misfits.most_common()]
        found = {
            "minutes": counts.seconds / 60,
            "runs": counts.num_runs,
            "faults": dict(counts.faults),
        }
        found |= {"faults_a_shift": counts.faults_a_shift, "misfits": dict(counts.misfits)}
        write_json(session.folder / COUNTS, found)
        return lines


def count_alarms(
    limits: ObserverLimits,
    content: dict[str, Any],
    machine: Machine,
    recordings: list[Recording],
    seed: int,
) -> AlarmCounts:
    """Return the alarms of an observer in recordings; parts of one run follow each other.

    A named fault is cleared at once, as an operator would by letting go of the dead-man.
    """
    counts = AlarmCounts(machine.num_joints)
    runs: dict[str, list[Recording]] = {}
    for recording in recordings:
        runs.setdefault(recording.run, []).append(recording)
    for number, parts in enumerate(runs.values()):
        observer = Observer(limits, content, machine, seed + machine.num_joints * number)
        for part in parts:
            observer.forget()
            _replay(observer, part, machine, counts)
        counts.num_runs += 1
        found = observer.observation
        if found.misfit_joint >= 0:
            counts.misfits[f"{machine.joint_names[found.misfit_joint]} {found.misfit.value}"] += 1
    return counts


def _replay(
    observer: Observer, recording: Recording, machine: Machine, counts: AlarmCounts
) -> None:
    counts.seconds += recording.duration_s
    # On a grid of its own: a log's times jitter, and its gaps have been split before.
    times_s = np.arange(recording.num_samples) * machine.period_s
    for row, t_s in enumerate(times_s):
        # The observer gets the flow of the period that has just ended.
        flow = recording.u[max(0, row - 1)]
        observer.update(float(t_s), recording.q[row].astype(float), flow.astype(float))
        for joint, score in enumerate(observer.scores):
            if score is not None:
                counts.scores[joint].append(score)
        observer.scores = []
        found = observer.observation
        if found.joint >= 0:
            counts.faults[f"{machine.joint_names[found.joint]} {found.fault.value}"] += 1
            observer.clear()


def _list_patterns(patterns: str | tuple[str, ...]) -> tuple[str, ...]:
    return (patterns,) if isinstance(patterns, str) else tuple(patterns)
