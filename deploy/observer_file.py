"""Calibration of the observer: its file, and its alarms in recordings of a healthy machine.

The file holds a model and thresholds. The thresholds come from recordings of one machine that the
model was not fitted to; the file names their sources.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Interval

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording, read_recordings
from brokk_rl.registry import resolve_package_path
from brokk_rl.session import Session, write_json
from brokk_rl.spec import Positive, spec
from deploy.checks.observer import Observer
from deploy.checks.valve_model import SCHEMA, describe_sources, load_observer_file
from deploy.kernel.limits import GuardLimits

FILE, COUNTS = "observer.json", "observed.json"
SHIFT_S = 8 * 3600.0
"""A shift, to which alarms are extrapolated."""


@dataclass
class AlarmCounts:
    """Alarms of an observer in recordings.

    Attributes:
        seconds: Length of all recordings.
        faults: Alarms by joint and fault.
        num_runs: Number of runs.
    """

    seconds: float = 0.0
    num_runs: int = 0
    faults: Counter[str] = field(default_factory=Counter)

    @property
    def faults_a_shift(self) -> float:
        """Alarms extrapolated to a shift."""
        return self.faults.total() * SHIFT_S / max(self.seconds, 1e-9)


@spec
class ThresholdSettings:
    """Settings by which thresholds are taken from recordings; see `deploy.checks.observer`.

    Attributes:
        window_s: Time over which measured and predicted motion are compared.
        share: Difference between them that is borne, of the predicted way.
        least_slack_s: Least further difference, as the way in so much time at full speed.
        margin: Slack over the largest difference in the recordings.
    """

    window_s: Positive
    share: Annotated[float, Interval(gt=0, lt=1)]
    least_slack_s: Positive
    margin: Annotated[float, Ge(1)]


@spec
class ObserverCalibration:
    """Recordings of a healthy machine, and the observer's limits.

    Attributes:
        recordings: Glob or list of globs; recordings that the model was not fitted to.
        path: File of an observer whose alarms are counted; `null`: one is made.
        thresholds: How the thresholds of a new file are taken.
        limits: Of the guard, whose observer counts.
    """

    recordings: str | tuple[str, ...]
    path: str | None
    thresholds: ThresholdSettings
    limits: GuardLimits

    def run(self, machine: Machine, actuator: Any, session: Session) -> list[str]:
        """Write the files into the session's folder; return the result in words.

        Args:
            machine: The machine.
            actuator: The model; one whose numbers can be exported, such as `actuator=valve`.
            session: Folder.

        Raises:
            ConfigError: the model or the file is not one of this machine.
            RecordingError: nothing matches, or a recording cannot be read.
        """
        if self.limits.observer is None:
            raise ConfigError(
                "mode=observe: expected limits of the observer, got guard.observer=null"
            )
        recordings = read_recordings(self.recordings, machine)
        if self.path is None:
            if not hasattr(actuator, "export_tables"):
                raise ConfigError(
                    "mode=observe: expected actuator=valve or a fit of it, by actuator=@<file>"
                )
            tables = actuator.export_tables(machine)
            content: dict[str, Any] = {"schema": SCHEMA, "machine": machine.name}
            content |= {"fingerprint": machine.fingerprint(), "model": tables}
            content["sources"] = sorted({_find_source(one) for one in recordings})
            content["thresholds"] = find_thresholds(self.thresholds, content, machine, recordings)
        else:
            content = load_observer_file(resolve_package_path(self.path))
            machine.check_fingerprint(content["fingerprint"], self.path)
        counts = count_alarms(content, machine, recordings)
        minutes = f"{counts.seconds / 60:.0f} minutes of {counts.num_runs} runs"
        if self.path is None:
            write_json(session.folder / FILE, content)
            return _describe_file(content, machine, minutes)
        told = f"{counts.faults.total()} false alarms, {counts.faults_a_shift:.1f} a shift of 8 h"
        lines = [f"{minutes}: {told}"]
        lines += [f"  {name}: {number}" for name, number in counts.faults.most_common()]
        found = {"minutes": counts.seconds / 60, "runs": counts.num_runs}
        found |= {"faults": dict(counts.faults), "faults_a_shift": counts.faults_a_shift}
        write_json(session.folder / COUNTS, found)
        return lines


def find_thresholds(
    settings: ThresholdSettings,
    content: Mapping[str, Any],
    machine: Machine,
    recordings: Sequence[Recording],
) -> dict[str, Any]:
    """Return the thresholds of an observer's file, from recordings of a healthy machine."""
    thresholds = {"window_s": settings.window_s, "share": settings.share}
    # No alarm ends a window: all of them count.
    deaf = dict(content) | {"thresholds": thresholds | {"slack_s": [math.inf] * machine.num_joints}}
    observer = Observer(deaf, machine)
    needed, seconds = np.zeros(machine.num_joints), 0.0
    for recording in recordings:
        observer.forget()
        seconds += recording.duration_s
        for _ in _replay(observer, recording, machine):
            seen = observer.window
            off = np.abs(seen.moved - seen.wanted) - settings.share * seen.way
            needed = np.maximum(needed, off)
    needed_s = np.maximum(settings.margin * needed / machine.max_speed, settings.least_slack_s)
    slack_s = [round(one, 4) for one in needed_s.tolist()]
    return thresholds | {"slack_s": slack_s, "minutes": round(seconds / 60, 1)}


def count_alarms(
    content: dict[str, Any], machine: Machine, recordings: list[Recording]
) -> AlarmCounts:
    """Return the alarms of an observer in recordings; parts of one run follow each other.

    A named fault is cleared at once, as an operator would by letting go of the dead-man.
    """
    counts = AlarmCounts()
    runs: dict[str, list[Recording]] = {}
    for recording in recordings:
        runs.setdefault(recording.run, []).append(recording)
    for parts in runs.values():
        observer = Observer(content, machine)
        for part in parts:
            observer.forget()
            counts.seconds += part.duration_s
            for _ in _replay(observer, part, machine):
                found = observer.observation
                if found.joint >= 0:
                    counts.faults[f"{machine.joint_names[found.joint]} {found.fault.value}"] += 1
                    observer.clear()
        counts.num_runs += 1
    return counts


def _replay(observer: Observer, recording: Recording, machine: Machine) -> Iterator[None]:
    """Show a recording to an observer, and yield after each period."""
    # On a grid of its own: a log's times jitter, and its gaps have been split before.
    times_s = np.arange(recording.num_samples) * machine.period_s
    for row, t_s in enumerate(times_s):
        # The observer gets the flow of the period that has just ended.
        flow, q = recording.u[max(0, row - 1)].astype(float), recording.q[row].astype(float)
        observer.update(float(t_s), q, flow, may_touch=False)
        yield


def _find_source(recording: Recording) -> str:
    """Return what a recording was made of, without what was done with it."""
    return recording.metadata.get("source", "unknown").partition(",")[0]


def _describe_file(content: Mapping[str, Any], machine: Machine, minutes: str) -> list[str]:
    slack_s = content["thresholds"]["slack_s"]
    lines = [f"{FILE}: thresholds of {minutes}, {describe_sources(content)}"]
    for name, slack in zip(machine.joint_names, slack_s, strict=True):
        lines.append(f"  {name}: {slack:g} s of full speed")
    return [*lines, f"count its alarms in other recordings: observe.path={FILE}"]
