"""Splits of recordings into training, validation and test sets by whole runs.

Windows of one run are not independent (same oil, same operator, same load), so a run that is split
makes any model look good.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from itertools import chain

import numpy as np

from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording

COMMANDED = 0.02
"""A joint whose command stays below this is at rest, whatever its dead band."""


def group_by_run(recordings: Sequence[Recording]) -> dict[str, list[Recording]]:
    """Return the recordings of each run, by a name that is the run's alone.

    Two collections may give their runs the same names; the seed tells them apart. A recording that
    does not say which run it is a part of is one by itself.
    """
    runs: dict[str, list[Recording]] = {}
    for number, recording in enumerate(recordings):
        name, seed = recording.metadata.get("run"), recording.metadata.get("seed")
        if name:
            name = f"{name}, seed {seed}" if seed else name
        else:
            name = str(recording.path) if recording.path else f"recording {number}"
        runs.setdefault(name, []).append(recording)
    return runs


def list_sources(recordings: Sequence[Recording]) -> list[str]:
    """Return where recordings come from, each source once."""
    return sorted({recording.metadata.get("source", "unknown") for recording in recordings})


def measure_commanded_s(recordings: Sequence[Recording]) -> np.ndarray:
    """Return for how long each joint has a command in all recordings together, s, `(J,)`."""
    each = [(np.abs(one.u) > COMMANDED).sum(0) / one.rate_hz for one in recordings]
    return np.sum(each, 0)


def split_runs(
    runs: Mapping[str, Sequence[Recording]], shares: Mapping[str, float]
) -> dict[str, list[str]]:
    """Distribute runs over sets so that each joint's commanded time follows the shares.

    The joint that is commanded in the fewest runs comes first; its longest run goes to the set that
    lacks it, or else to the one that, over all joints of the run, is furthest from its share. Where
    names alone could decide, a hash of them does: the last runs of a collection are often the
    warmest, and must not all be in the same set. The same names always give the same split.

    Source: iterative stratification, Sechidis et al. 2011, with seconds in place of labels.

    Args:
        runs: Recordings by run, as `group_by_run` returns them.
        shares: Share of each set; their sum is 1.

    Returns:
        Names of the runs in each set, in the order of `runs`.
    """
    names = sorted(runs, key=lambda name: hashlib.sha256(name.encode()).hexdigest())
    # the last column, the length of the runs, distributes those in which nothing is commanded
    rows = []
    for name in names:
        duration_s = sum(one.duration_s for one in runs[name])
        rows.append(np.append(measure_commanded_s(runs[name]), duration_s))
    seconds = np.stack(rows)
    left = np.ones(len(names), dtype=bool)
    scale = np.maximum(seconds.sum(0), 1.0) ** 2
    need = np.array(list(shares.values()))[:, None] * seconds.sum(0)
    has = np.zeros_like(need, dtype=bool)
    chosen: dict[str, list[str]] = {part: [] for part in shares}
    while left.any():
        count = ((seconds > 0) & left[:, None]).sum(0)
        count[-1] = len(names) + 1 if count[:-1].any() else 1
        joint = int(np.where(count > 0, count, len(names) + 2).argmin())
        run = int(np.where(left, seconds[:, joint], -1.0).argmax())
        wish = (need * seconds[run] / scale).sum(1)
        part = min(range(len(shares)), key=lambda p: (has[p, joint], -wish[p]))
        chosen[list(shares)[part]].append(names[run])
        need[part] -= seconds[run]
        has[part] |= seconds[run] > 0
        left[run] = False
    return {part: [name for name in runs if name in members] for part, members in chosen.items()}


def check_commanded(
    runs: Mapping[str, Sequence[Recording]], machine: Machine, needed: int, why: str
) -> None:
    """Raise a `RecordingError` for a joint commanded in fewer than `needed` runs.

    `why` says for which purpose; the message advises on recordings.
    """
    moving = {name: measure_commanded_s(recordings) > 0 for name, recordings in runs.items()}
    minutes = sum(one.duration_s for one in chain.from_iterable(runs.values())) / 60.0
    for joint, name in enumerate(machine.joint_names):
        where = [run for run, commanded in moving.items() if commanded[joint]]
        if len(where) >= needed:
            continue
        found = f"in {len(where)} ({', '.join(where)})" if where else "in none"
        raise RecordingError(
            f"too little data: joint {name} is commanded (|u| > {COMMANDED:g}) {found} of {len(runs)} runs, {minutes:.1f} "
            f"minutes in all; it must be in {needed} or more: {why}. Record runs that move {name} over its whole travel, with "
            "small and large commands both ways (mode=collect excitation=sine moves one joint after another)"
        )
