"""A gap case: recordings of the machine as it was believed to be, and of the machine as it is."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np

from actuators import open_loop
from actuators.recordings.split import COMMANDED
from actuators.scales import choose_horizon_s
from brokk_rl import record
from brokk_rl.commands import view_recordings
from brokk_rl.errors import CheckpointError, RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording

# Chosen by hand, in free runs of `actuators.scales`: 60 s and 150 s where they last 5 s.
MIN_TOTAL_RUNS = 12
"""Field recordings of fewer free runs in all say nothing that holds beyond them."""
MIN_TRAVEL_SHARE = 0.01
"""A joint that moved less, of its travel, in all field recordings shows nothing."""
MAX_PART_RUNS = 30
"""Longest part of a recording that stays together when some are left out, in free runs."""
PAUSE_S = 4.0 * 3600.0
"""After so long without a recording the machine has been off."""


@dataclass(frozen=True)
class GapCase:
    """Recordings and machine of a diagnosis.

    Attributes:
        machine: The machine.
        reference: Recordings that the simulator was built from; empty where it is given.
        field: Recordings of the machine as it is.
    """

    machine: Machine
    reference: Sequence[Recording]
    field: Sequence[Recording]

    def doubts(self) -> list[str]:
        """Return reasons why these recordings cannot tell anything, in words for people; none where they can."""
        found = []
        total_s = sum(recording.duration_s for recording in self.field)
        horizon_s = choose_horizon_s(self.machine)
        least_s = MIN_TOTAL_RUNS * horizon_s
        if total_s < least_s:
            found.append(
                f"the field recordings last {total_s:.0f} s in all; {least_s:.0f} s or more are needed"
            )
        # Half a period forgives the rounding of durations.
        shortest_s = horizon_s - 0.5 * self.machine.period_s
        if open_loop.find_longest_horizon_s(self.field, self.machine) < shortest_s:
            found.append(f"no field recording is long enough for a free run of {horizon_s:g} s")
        if not self.reference and len(self.field) == 1:
            found.append(
                "there is one recording only, and no reference: nothing to judge by that it was not fitted to"
            )
        field = view_recordings(self.field, self.machine)
        u = np.concatenate([recording.u for recording in field])
        if not (np.abs(u) > COMMANDED).any():
            found.append("no joint is ever commanded in the field recordings")
        elif all(np.ptp(recording.u, axis=0).max() < COMMANDED for recording in self.field):
            found.append("the commands never change in the field recordings")
        return found


def load_case(folder: Path, machine: Machine) -> GapCase:
    """Read a gap case: `reference/*.parquet` and `field/*.parquet`.

    Raises:
        RecordingError: a part is missing, or a recording cannot be used (another machine, NaN,
            gaps, …).
    """
    parts = {name: folder / name for name in ("reference", "field")}
    for name, part in parts.items():
        if not any(part.glob("*.parquet")):
            why = "the simulator is fitted to it; without one give diagnosis.field=<glob> and actuator=<simulator>"
            raise RecordingError(
                f"{folder}: no {name}/*.parquet; a case has both"
                + (f" ({why})" if name == "reference" else "")
            )
    return GapCase(
        machine, *(read_recordings(str(part / "*.parquet"), machine) for part in parts.values())
    )


def read_recordings(where: str | tuple[str, ...], machine: Machine) -> list[Recording]:
    """Read recordings of the machine.

    Raises:
        RecordingError: there are none, or one cannot be used (another machine, NaN, gaps, …).
    """
    found = record.read_recordings(where, machine)
    for recording in found:
        if stamp := recording.metadata.get("fingerprint"):
            _check_stamp(stamp, recording, machine)
    return found


def _check_stamp(stamp: str, recording: Recording, machine: Machine) -> None:
    """Raise a `RecordingError` when a recording was made on a machine with other joints, limits or control rate."""
    try:
        machine.check_fingerprint(json.loads(stamp), str(recording.path))
    except (CheckpointError, ValueError) as error:
        raise RecordingError(f"{recording.path}: {error}") from error


def estimate_running_s(recordings: Sequence[Recording]) -> list[float]:
    """Return how long the machine had been running at the beginning of each recording, as far as their dates tell."""
    stamps, day = _read_stamps(recordings), number_days(recordings)
    return [float(stamp - stamps[day == own].min()) for stamp, own in zip(stamps, day, strict=True)]


def number_days(recordings: Sequence[Recording]) -> np.ndarray:
    """Return the day of each recording, `(R,)`: the machine was off between two; one day where no dates are known."""
    stamps = _read_stamps(recordings)
    begins = np.diff(np.sort(stamps), prepend=-np.inf) > PAUSE_S
    day = np.zeros(len(stamps), dtype=int)
    day[np.argsort(stamps, kind="stable")] = np.cumsum(begins)
    return day


def _read_stamps(recordings: Sequence[Recording]) -> np.ndarray:
    """Return when each recording was made, s; zeros where not all are known."""
    dates = [recording.metadata.get("created") for recording in recordings]
    if not all(dates):
        return np.zeros(len(recordings))
    return np.array([datetime.fromisoformat(date).timestamp() for date in dates if date])


def select_rows(recording: Recording, rows: np.ndarray | slice) -> Recording:
    """Return some rows of a recording."""
    extra = {name: values[rows] for name, values in recording.extra.items()}
    t_s, u, q = recording.t_s[rows], recording.u[rows], recording.q[rows]
    return replace(recording, t_s=t_s, u=u, q=q, extra=extra)


def split_recordings(recordings: Sequence[Recording], machine: Machine) -> list[Recording]:
    """Return the recordings, those longer than `MAX_PART_RUNS` cut into equal parts, each part a run by itself."""
    found, longest_s = [], MAX_PART_RUNS * choose_horizon_s(machine)
    for number, recording in enumerate(recordings):
        count = max(1, round(recording.duration_s / longest_s))
        for place, rows in enumerate(np.array_split(np.arange(recording.num_samples), count)):
            part = select_rows(recording, rows)
            begun_s = float(part.t_s[0])
            named = {**recording.metadata, "run": f"{number}.{place}"}
            if created := recording.metadata.get("created"):
                named["created"] = record.add_seconds(created, begun_s)
            found.append(replace(part, t_s=part.t_s - begun_s, metadata=named))
    return found
