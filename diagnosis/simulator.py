"""The simulator that is held against the field, and what it errs by on reference recordings that it was not fitted to."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from brokk_rl import open_loop
from brokk_rl.contracts.actuator import Actuator, ActuatorFit
from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis import discrepancy, noise, tuning
from diagnosis.candidates import Candidates
from diagnosis.case import HORIZON_S, Case, parts, running_s
from diagnosis.evidence import Evidence
from diagnosis.free_runs import FreeRuns
from diagnosis.noise import Noise

log = logging.getLogger(__name__)

FOLDS = 4
"""Times that a part of the reference is left out."""
TOGETHER = 3
"""Windows in a row on which the noise is fitted."""


@dataclass(frozen=True)
class Held:
    """A simulator held against recordings.

    Attributes:
        recordings: The recordings.
        evidence: Its errors there.
        source: Number of the recording of each window.
        row: Row of the first simulated position of each window.
    """

    recordings: Sequence[Recording]
    evidence: Evidence
    source: np.ndarray
    row: np.ndarray

    def with_base(self, actuator: Actuator) -> Held:
        """Returns another simulator held against the same recordings; its noise is still to be found."""
        evidence = self.evidence
        candidates = replace(evidence.candidates, base=actuator)
        return replace(self, evidence=Evidence(candidates, None, evidence.claims))

    def runs(self, paths: np.ndarray) -> FreeRuns:
        """Returns free runs `(W, K, J)` beside their recordings."""
        return FreeRuns(self.recordings, self.source, self.row, paths.astype(float))


@dataclass(frozen=True)
class Base:
    """The simulator, and its errors.

    Attributes:
        actuator: Fitted to the whole reference, or given.
        field: Against the field.
        nulls: Fits that left out a part of the reference, each against that part; without a
            reference flexible models that left out a part of the field; empty where there are too
            few recordings for either.
        is_flexible: `nulls` are flexible models of the field.
    """

    actuator: Actuator
    field: Held
    nulls: Sequence[Held]
    is_flexible: bool = False


Begun = Sequence[tuple[Recording, float]]
"""Recordings, and how long the machine had been running when each began, s."""


def held(actuator: Actuator, begun: Begun, machine: Machine, seed: int) -> Held:
    """Returns `actuator` held against all whole windows of recordings."""
    before, steps = open_loop.count_samples_before(machine), round(HORIZON_S / machine.period_s)
    cuts, source, row, running = [], [], [], []
    for number, (recording, begun_s) in enumerate(begun):
        if recording.num_samples < before + steps:
            continue
        cut = open_loop.cut_windows([recording], machine, HORIZON_S, HORIZON_S)
        rows = before + steps * np.arange(len(cut.q))
        cuts.append(replace(cut, run=np.full(len(cut.q), f"{number}")))
        source += [number] * len(rows)
        row += rows.tolist()
        running += (begun_s + recording.t_s[rows]).tolist()
    if not cuts:
        raise RecordingError(
            f"too little data: no recording is long enough for a free run of {HORIZON_S:g} s"
        )
    windows = open_loop.join_windows(cuts)
    claims = np.ones((len(windows.q), machine.num_joints), dtype=bool)
    candidates = Candidates(actuator, machine, windows, np.array(running), seed)
    return Held(
        [recording for recording, _ in begun],
        Evidence(candidates, None, claims),
        np.array(source),
        np.array(row),
    )


def fitted(
    case: Case,
    fit: ActuatorFit,
    folder: Path,
    seed: int,
    device: torch.device,
    refined: Callable[[Base], Base] = lambda base: base,
) -> Base:
    """Returns a simulator fitted to the reference, and fits that leave a part of it out.

    A fit that knows how to `refit` is fitted anew to each rest, all others once to two thirds: the
    price of a fit that takes long. `refined` may change the simulator before what it gets wrong is
    learned; see `already`.

    Raises:
        RecordingError: too little reference.
    """
    machine = case.machine
    reference = parts(case.reference)
    if len(reference) < 2:
        raise RecordingError(
            f"too little data: the reference lasts {sum(r.duration_s for r in case.reference):.0f} s; a simulator that is "
            "judged on recordings it was not fitted to needs several minutes"
        )
    actuator, nulls = _crosswise(case.reference, reference, fit, machine, folder, seed, device)
    field = held(actuator, _begun(case.field), machine, seed)
    if changes := tuning.changes([one.evidence for one in nulls]):
        actuator = tuning.changed(actuator, changes, machine)
        nulls = _noised(
            [
                one.with_base(tuning.changed(one.evidence.candidates.base, changes, machine))
                for one in nulls
            ],
            machine,
        )
        field = field.with_base(actuator)
    field = replace(field, evidence=replace(field.evidence, claims=_known(case, field)))
    return learned(refined(Base(actuator, field, nulls)), machine)


def learned(base: Base, machine: Machine) -> Base:
    """Returns the same simulator, with what it gets wrong on the reference taken off, and the noise of what is left."""
    biases, of_field = discrepancy.learned(
        [one.evidence for one in base.nulls], base.field.evidence
    )
    nulls = [
        replace(one, evidence=replace(one.evidence, bias=bias))
        for one, bias in zip(base.nulls, biases, strict=True)
    ]
    nulls = _noised(nulls, machine)
    widths = discrepancy.widths([one.evidence for one in nulls])
    nulls = [replace(one, evidence=replace(one.evidence, widths=widths)) for one in nulls]
    field = replace(
        base.field.evidence, noise=nulls[0].evidence.noise, bias=of_field, widths=widths
    )
    return replace(base, field=replace(base.field, evidence=field), nulls=nulls)


def given(
    case: Case, actuator: Actuator, fit: ActuatorFit, folder: Path, seed: int, device: torch.device
) -> Base:
    """Returns a configured simulator held against the field, and flexible models of the field that leave a part of it out.

    There is no reference that would tell how a machine errs that lacks nothing: what `fit` does not
    explain of recordings that it was not fitted to takes its place, as noise, price and floor.
    Where it cannot be fitted the noise is that of the simulator.
    """
    machine = case.machine
    field = held(actuator, _begun(case.field), machine, seed)
    pieces, nulls = parts(case.field), []
    try:
        if len(pieces) > 1 and not case.doubts():
            nulls = _crosswise(case.field, pieces, fit, machine, folder, seed, device)[1]
    except RecordingError as error:
        log.warning("no floor: a flexible model cannot be fitted to the field (%s)", error)
    known = nulls[0].evidence.noise if nulls else noises([field], machine)
    return Base(
        actuator,
        replace(field, evidence=replace(field.evidence, noise=known)),
        nulls,
        is_flexible=bool(nulls),
    )


def _crosswise(
    recordings: Sequence[Recording],
    pieces: Sequence[Recording],
    fit: ActuatorFit,
    machine: Machine,
    folder: Path,
    seed: int,
    device: torch.device,
) -> tuple[Actuator, list[Held]]:
    """Returns a fit, and fits that left out a part of the recordings' `pieces`, each held against that part, their noise known."""
    begun = _begun(pieces)
    fold = (
        np.arange(len(pieces)) % FOLDS
    )  # in turns: what is left out is of the same making as what is fitted to
    refit: Any = getattr(fit, "refit", None)
    nulls = []
    if refit:
        actuator = fit.fit(machine, recordings, [], folder, seed, device)
        for part in np.unique(fold):
            rest = [r for r, f in zip(pieces, fold, strict=True) if f != part]
            left = [one for one, f in zip(begun, fold, strict=True) if f == part]
            nulls.append(held(refit(actuator, machine, rest), left, machine, seed))
    else:
        last = fold == fold.max()
        rest = [r for r, out in zip(pieces, last, strict=True) if not out]
        actuator = fit.fit(machine, rest[: max(1, len(rest) - 1)], rest[-1:], folder, seed, device)
        left = [one for one, out in zip(begun, last, strict=True) if out]
        nulls.append(held(actuator, left, machine, seed))
    return actuator, _noised(nulls, machine)


def _noised(nulls: Sequence[Held], machine: Machine) -> list[Held]:
    known = noises(nulls, machine)
    return [replace(one, evidence=replace(one.evidence, noise=known)) for one in nulls]


def _begun(recordings: Sequence[Recording]) -> Begun:
    return list(zip(recordings, running_s(recordings), strict=True))


def noises(nulls: Sequence[Held], machine: Machine) -> list[Noise]:
    """Returns the noise of each joint from a simulator's errors on recordings that it was not fitted to."""
    found = []
    for j in range(machine.num_joints):
        error, way = (
            [_rows(getattr(one.evidence, name)[..., j]) for one in nulls]
            for name in ("error", "way")
        )
        found.append(noise.fit(np.concatenate(error), np.concatenate(way)))
    return found


def _rows(values: np.ndarray) -> np.ndarray:
    """Returns increments `(W, I)` with several windows in a row, `(W / TOGETHER, TOGETHER I)`."""
    together = min(TOGETHER, len(values))
    return values[: len(values) // together * together].reshape(-1, together * values.shape[1])


def _known(case: Case, field: Held) -> np.ndarray:
    """Returns which field windows stay within the poses and commands that the reference visited, `(W, J)` bool."""
    q, u = (np.concatenate([getattr(r, name) for r in case.reference]) for name in ("q", "u"))
    cut, travel = field.evidence.candidates.cut, case.machine.upper - case.machine.lower
    low, high = q.min(0) - 0.03 * travel, q.max(0) + 0.03 * travel
    outside = (cut.q < low) | (cut.q > high)
    most = np.abs(u).max(0) + 0.05
    beyond = np.abs(cut.u) > most
    return (outside.mean(1) < 0.1) & (beyond.mean(1) < 0.1)
