"""What was played when: the notes that recordings carry, and `plan.json`."""

from collections.abc import Iterable
from itertools import pairwise
from typing import Any

import numpy as np

from actuators.excite.plan.drive import Sample
from actuators.excite.plan.schedule import Plan
from brokk_rl.contracts.actuator import Segment
from brokk_rl.machine import Machine

BEFORE, PLAYING, AWAY, AFTER = range(4)
"""On the way to the start of a segment and resting there; in its program; brought home meanwhile;
after the last one."""
STAGE = np.array([BEFORE, BEFORE, PLAYING, AWAY, AWAY, AFTER])
"""By phase of the runner."""


class Track:
    """All samples of a run as arrays.

    Attributes:
        t_s: Time, `(T,)`.
        q: Positions, `(T, N, J)`.
        u: Commands, `(T, N, J)`.
        stage: `BEFORE`, `PLAYING`, `AWAY` or `AFTER`, `(T, N)`.
        segment: Number of the segment, `(T, N)`.
        played: Control periods since its program began, `(T, N)`.
    """

    def __init__(self, samples: Iterable[Sample]) -> None:
        kept = list(samples)
        self.t_s = np.array([sample.t_s for sample in kept])
        self.q, self.u = (
            np.stack([sample.q for sample in kept]),
            np.stack([sample.u for sample in kept]),
        )
        self.stage = STAGE[np.stack([sample.phase for sample in kept])]
        self.segment = np.stack([sample.segment for sample in kept])
        self.played = np.stack([sample.played for sample in kept])


def notes(
    track: Track, run: int, segments: tuple[Segment, ...], period_s: float
) -> list[dict[str, Any]]:
    """Returns what one run did on this track, in order, as plain JSON data; times count from the first sample.

    Each entry: `name` of the segment; `part`: `approach` (with the rest after it) or `program`;
    `start_s` and `end_s`; for programs `offset_s`, how far the program was at `start_s` (0 unless a
    file begins in the middle), `away_s`, pairs of times between which the machine was brought home
    instead, and `repeat_of` where it repeats another segment.
    """
    t_s, stage, number = track.t_s - track.t_s[0], track.stage[:, run], track.segment[:, run]
    ends_s = np.append(t_s[1:], t_s[-1] + period_s)
    found = []
    for begin, end in stretches(number * 2 + (stage != BEFORE)):
        if stage[begin] == AFTER:
            continue
        segment = segments[number[begin]]
        entry: dict[str, Any] = {
            "name": segment.name,
            "part": "approach" if stage[begin] == BEFORE else "program",
        }
        entry |= {"start_s": _ms(t_s[begin]), "end_s": _ms(ends_s[end - 1])}
        if stage[begin] != BEFORE:
            entry["offset_s"] = _ms(track.played[begin, run] * period_s)
            away = [
                (begin + i, begin + k)
                for i, k in stretches(stage[begin:end] == AWAY)
                if stage[begin + i] == AWAY
            ]
            entry["away_s"] = [[_ms(t_s[i]), _ms(ends_s[k - 1])] for i, k in away]
            if segment.repeat_of:
                entry["repeat_of"] = segment.repeat_of
        found.append(entry)
    return found


def summary(plan: Plan, track: Track, machine: Machine) -> dict[str, Any]:
    """Returns `plan.json`: for each run its segments with predicted times, travel and commands, and the time it leaves unused."""
    used = (track.stage != AFTER).sum(0)
    return {
        "schema": 1,
        "machine": machine.name,
        "excitation": list(plan.names),
        "run_s": plan.run_s,
        "num_runs": len(plan.runs),
        "predicted": "by a nominal machine: dead time, full speed times command",
        "runs": [_run(run, track, n, machine) for n, run in enumerate(plan.runs)],
        "run_time_unused_s": [_ms(plan.run_s - machine.period_s * count) for count in used],
    }


def _run(run: tuple[Segment, ...], track: Track, n: int, machine: Machine) -> list[dict[str, Any]]:
    """Returns the segments of one run; one that finds no time has no `start_s`."""
    period_s, found = machine.period_s, []
    for i, segment in enumerate(run):
        mine = track.segment[:, n] == i
        before, inside = (
            mine & (track.stage[:, n] == BEFORE),
            mine & np.isin(track.stage[:, n], (PLAYING, AWAY)),
        )
        rows, planned = np.flatnonzero(inside), len(segment.u)
        entry: dict[str, Any] = {
            "name": segment.name,
            "repeat_of": segment.repeat_of,
            "program_s": _ms(planned * period_s),
        }
        entry["approach_s"] = _ms(before.sum() * period_s)
        entry["start_s"] = _ms(track.t_s[rows[0]]) if len(rows) else None
        entry["end_s"] = _ms(track.t_s[rows[-1]] + period_s) if len(rows) else None
        entry["away_s"] = _ms(int((track.stage[inside, n] == AWAY).sum()) * period_s)
        entry["cut_s"] = _ms((planned - len(rows)) * period_s)
        entry["joints"] = {}
        for j, joint in enumerate(machine.joints):
            q = track.q[inside, n, j]
            entry["joints"][joint.name] = {
                f"travel_{joint.unit}": round(float(np.abs(np.diff(q)).sum()), 4),
                f"range_{joint.unit}": [round(float(q.min()), 4), round(float(q.max()), 4)]
                if len(q)
                else None,
                "commanded": round(float((track.u[inside, n, j] != 0).mean()), 4)
                if len(q)
                else 0.0,
            }
        found.append(entry)
    return found


def stretches(values: np.ndarray) -> list[tuple[int, int]]:
    """Returns begin and end of each stretch of equal values."""
    edges = [0, *(np.flatnonzero(values[1:] != values[:-1]) + 1).tolist(), len(values)]
    return list(pairwise(edges))


def _ms(value_s: Any) -> float:
    return round(float(value_s), 3)
