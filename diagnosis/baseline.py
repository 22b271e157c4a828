"""The simulator that is held against the field, and its errors on reference recordings left out of its fit.

The simulator is fitted to the reference and cross-validated there. Its own numbers are then tuned
by free runs, because a fit and a diagnosis weigh errors differently.
Axes: `F` parts of the reference, `P` numbers of the simulator, `J` joints, `E` entries (whitened
increments).
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from actuators import open_loop
from actuators.contracts import ActuatorFit
from actuators.scales import choose_horizon_s
from brokk_rl.commands import view_recordings
from brokk_rl.contracts.actuator import Actuator
from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from brokk_rl.parallel import map_parallel
from brokk_rl.record import Recording
from diagnosis import residual_model
from diagnosis.case import GapCase, estimate_running_s, split_recordings
from diagnosis.effect_library import EffectSimulator
from diagnosis.error_covariance import (
    ErrorCovariance,
    compute_loss,
    fit_joint_noise,
    weigh_residuals,
)
from diagnosis.free_runs import WindowedRuns
from diagnosis.number_faults import list_number_faults
from diagnosis.residuals import Residuals

log = logging.getLogger(__name__)


# Chosen by hand; not searched.
TUNING_STEPS = 3
"""Gauss-Newton steps."""
TUNING_PRIOR = 4.0
"""Prior standard deviation of a number, over its error from day to day; see `number_faults`."""


def tune_parameters(parts: Sequence[Residuals]) -> dict[str, np.ndarray]:
    """Return by how much the simulator's numbers should change, by name, each `(J,)`; empty where they cannot be set."""
    first = parts[0].simulator
    model: Any = first.base.build(first.machine, 1, torch.device("cpu"))
    if not (own := getattr(model, "parameters", None)):
        return {}
    names = list(own)
    start = np.stack([own[name][0].numpy().astype(float) for name in names])  # (P, J)
    size = list_number_faults(names, first.machine)  # (P, J)
    reach = first.machine.num_history * first.machine.period_s - 2.0 * first.machine.period_s
    most = np.where(np.array([name.endswith("_s") for name in names])[:, None], reach, np.inf)
    now, best, lowest = start.copy(), start.copy(), np.full(start.shape[1], np.inf)
    for _ in range(TUNING_STEPS + 1):
        errors, slopes = _linearise_parameters(parts, names, now, size)
        total = compute_loss(errors, 1) + 0.5 * np.square((now - start) / size / TUNING_PRIOR).sum(
            0
        )
        # Joint by joint: a step that fails on one joint is halved there alone.
        better = total < lowest
        best, lowest = np.where(better, now, best), np.minimum(total, lowest)
        step = np.zeros_like(now)
        for j in range(now.shape[1]):
            weighted = slopes[j] * weigh_residuals(errors[j])
            normal = weighted @ slopes[j].T + np.eye(len(names)) / TUNING_PRIOR**2
            step[:, j] = np.linalg.solve(
                normal, weighted @ errors[j] - (now - start)[:, j] / size[:, j] / TUNING_PRIOR**2
            )
        now = np.clip(
            np.where(better, now + step * size, (now + best) / 2),
            np.minimum(start, 0.0),
            np.maximum(start, most),
        )
    found = {}
    for name, row in zip(names, best - start, strict=True):
        if np.abs(row).max() > 0:
            found[name] = row
    return found


def apply_changes(actuator: Actuator, by: dict[str, np.ndarray], machine: Machine) -> Actuator:
    """Return `actuator` with its numbers changed, within the bounds of `tune_parameters`: only a negative one stays so."""
    model: Any = actuator.build(machine, 1, torch.device("cpu"))
    tables: Any = {}
    for name, row in by.items():
        start = model.parameters[name][0].numpy()
        values = np.maximum(start + row, np.minimum(start, 0.0)).tolist()
        tables[name] = dict(zip(machine.joint_names, values, strict=True))
    return dataclasses.replace(actuator, **tables)  # pyright: ignore[reportArgumentType, reportCallIssue]


def _linearise_parameters(
    parts: Sequence[Residuals], names: list[str], now: np.ndarray, size: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return whitened residuals of all parts, `(J, E)`, and their decrease by a finite difference of each number, `(J, P, E)`."""
    count = len(names)
    varied = np.repeat(now[None], count + 1, 0)  # (P + 1, P, J)
    for p in range(count):
        varied[p + 1, p] += size[p]
    values = {name: varied[:, p] for p, name in enumerate(names)}

    def whiten(part: Residuals) -> np.ndarray:
        return part.whiten(part.compute_error(part.simulator.simulate([], count + 1, values)))

    for part in parts:
        part.z  # noqa: B018  # made once, before other processes need it
    every = map_parallel(whiten, parts)
    slopes = [z[:, :1] - z[:, 1:] for z in every]
    return np.concatenate([z[:, 0] for z in every], 1), np.concatenate(slopes, 2)


# Chosen by hand; not searched.
FOLDS = 4
"""Cross-validation folds of the reference; a fit takes time for each."""


@dataclass(frozen=True)
class SimulatorComparison:
    """A simulator held against recordings.

    Attributes:
        recordings: The recordings, their commands as speeds.
        residuals: Its errors there.
        source: Number of the recording of each window.
        row: Row of the first simulated position of each window.
    """

    recordings: Sequence[Recording]
    residuals: Residuals
    source: np.ndarray
    row: np.ndarray

    def with_base(self, actuator: Actuator) -> SimulatorComparison:
        """Return another simulator held against the same recordings; its noise is still to be found."""
        residuals = self.residuals
        simulator = replace(residuals.simulator, base=actuator)
        return replace(self, residuals=Residuals(simulator, None, residuals.valid_mask))

    def runs(self, paths: np.ndarray) -> WindowedRuns:
        """Return free runs `(W, K, J)` beside their recordings."""
        return WindowedRuns(self.recordings, self.source, self.row, paths.astype(float))


@dataclass(frozen=True)
class Baseline:
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
    field: SimulatorComparison
    left_out: Sequence[SimulatorComparison]
    is_flexible: bool = False


StartedRecordings = Sequence[tuple[Recording, float]]
"""Recordings, and how long the machine had been running when each began, s."""


def compare_simulator(
    actuator: Actuator, begun: StartedRecordings, machine: Machine, seed: int
) -> SimulatorComparison:
    """Return `actuator` held against all whole windows of recordings."""
    before, horizon_s = open_loop.count_samples_before(machine), choose_horizon_s(machine)
    steps = round(horizon_s / machine.period_s)
    cuts, source, row, running = [], [], [], []
    for number, (recording, begun_s) in enumerate(begun):
        if recording.num_samples < before + steps:
            continue
        cut = open_loop.cut_windows([recording], machine, horizon_s, horizon_s)
        rows = before + steps * np.arange(len(cut.q))
        cuts.append(replace(cut, run=np.full(len(cut.q), f"{number}")))
        source += [number] * len(rows)
        row += rows.tolist()
        running += (begun_s + recording.t_s[rows]).tolist()
    if not cuts:
        raise RecordingError(
            f"too little data: no recording is long enough for a free run of {horizon_s:g} s"
        )
    windows = open_loop.join_windows(cuts)
    valid_mask = np.ones((len(windows.q), machine.num_joints), dtype=bool)
    simulator = EffectSimulator(actuator, machine, windows, np.array(running), seed)
    recordings = view_recordings([one for one, _ in begun], machine)
    residuals = Residuals(simulator, None, valid_mask)
    return SimulatorComparison(recordings, residuals, np.array(source), np.array(row))


def fit_baseline(
    case: GapCase, fit: ActuatorFit, folder: Path, seed: int, device: torch.device
) -> Baseline:
    """Return a simulator fitted to the reference, and fits that leave a part of it out.

    A fit with `refit` is fitted again without each fold. Any other fit is slow, so it is fitted
    once, without the last fold.

    Raises:
        RecordingError: too little reference.
    """
    machine = case.machine
    reference = split_recordings(case.reference, machine)
    if len(reference) < 2:
        raise RecordingError(
            f"too little data: the reference lasts {sum(r.duration_s for r in case.reference):.0f} s; a simulator that is "
            "judged on recordings it was not fitted to needs several minutes"
        )
    actuator, left_out = _cross_validate(
        case.reference, reference, fit, machine, folder, seed, device
    )
    field = compare_simulator(actuator, _list_started(case.field), machine, seed)
    if tuned := tune_parameters([one.residuals for one in left_out]):
        actuator = apply_changes(actuator, tuned, machine)
        changed = [apply_changes(one.residuals.simulator.base, tuned, machine) for one in left_out]
        left_out = [one.with_base(base) for one, base in zip(left_out, changed, strict=True)]
        left_out = set_covariances(left_out, machine)
        field = field.with_base(actuator)
    field = replace(
        field, residuals=replace(field.residuals, valid_mask=_find_known_windows(case, field))
    )
    return learn_errors(Baseline(actuator, field, left_out), machine)


def learn_errors(base: Baseline, machine: Machine) -> Baseline:
    """Return the same simulator with its discrepancy on the reference subtracted, and the noise of the remaining residuals."""
    biases, of_field = residual_model.learn_discrepancy(
        [one.residuals for one in base.left_out], base.field.residuals
    )
    left_out = [
        replace(one, residuals=replace(one.residuals, bias=bias))
        for one, bias in zip(base.left_out, biases, strict=True)
    ]
    left_out = _set_fault_scales(set_covariances(left_out, machine))
    known = left_out[0].residuals
    field = replace(base.field.residuals, noise=known.noise, bias=of_field, widths=known.widths)
    return replace(base, field=replace(base.field, residuals=field), left_out=left_out)


def accept_simulator(
    case: GapCase,
    actuator: Actuator,
    fit: ActuatorFit,
    folder: Path,
    seed: int,
    device: torch.device,
) -> Baseline:
    """Return a configured simulator held against the field, and flexible models of the field that leave a part of it out.

    There is no reference here. The residuals of `fit` on recordings left out of its fit replace it:
    they give noise, penalty and floor. Where `fit` fails, the noise is that of the simulator.
    Their own numbers may be far off, so their errors in these are estimated; else an effect would
    have to pay for them.
    """
    machine = case.machine
    field = compare_simulator(actuator, _list_started(case.field), machine, seed)
    pieces, left_out = split_recordings(case.field, machine), []
    try:
        if len(pieces) > 1 and not case.doubts():
            left_out = _cross_validate(case.field, pieces, fit, machine, folder, seed, device)[1]
    except RecordingError as error:
        log.warning("no floor: a flexible model cannot be fitted to the field (%s)", error)
    left_out = _set_fault_scales(left_out) if left_out else []
    known = left_out[0].residuals.noise if left_out else fit_covariances([field], machine)
    return Baseline(
        actuator,
        replace(field, residuals=replace(field.residuals, noise=known)),
        left_out,
        is_flexible=bool(left_out),
    )


def _cross_validate(
    recordings: Sequence[Recording],
    pieces: Sequence[Recording],
    fit: ActuatorFit,
    machine: Machine,
    folder: Path,
    seed: int,
    device: torch.device,
) -> tuple[Actuator, list[SimulatorComparison]]:
    """Return a fit, and fits that left out a part of the recordings' `pieces`, each held against that part, their noise known."""
    begun = _list_started(pieces)
    # In turns: the pieces left out are then of the same making as the others.
    fold = np.arange(len(pieces)) % FOLDS
    refit: Any = getattr(fit, "refit", None)
    left_out = []
    if refit:
        actuator = fit.fit(machine, recordings, [], folder, seed, device)
        parts = [fold == part for part in np.unique(fold)]
        rests = [[r for r, out in zip(pieces, part, strict=True) if not out] for part in parts]
        refits = map_parallel(lambda rest: refit(actuator, machine, rest), rests)
        for part, one in zip(parts, refits, strict=True):
            left = [piece for piece, out in zip(begun, part, strict=True) if out]
            left_out.append(compare_simulator(one, left, machine, seed))
    else:
        last = fold == fold.max()
        rest = [r for r, out in zip(pieces, last, strict=True) if not out]
        actuator = fit.fit(machine, rest[: max(1, len(rest) - 1)], rest[-1:], folder, seed, device)
        left = [one for one, out in zip(begun, last, strict=True) if out]
        left_out.append(compare_simulator(actuator, left, machine, seed))
    return actuator, set_covariances(left_out, machine)


def set_covariances(
    left_out: Sequence[SimulatorComparison], machine: Machine
) -> list[SimulatorComparison]:
    """Return the same with the noise of their residuals."""
    known = fit_covariances(left_out, machine)
    return [replace(one, residuals=replace(one.residuals, noise=known)) for one in left_out]


def _set_fault_scales(left_out: Sequence[SimulatorComparison]) -> list[SimulatorComparison]:
    """Return the same with the errors of the simulators' own numbers, as the recordings show them."""
    widths = residual_model.estimate_fault_scales([one.residuals for one in left_out])
    return [replace(one, residuals=replace(one.residuals, widths=widths)) for one in left_out]


def _list_started(recordings: Sequence[Recording]) -> StartedRecordings:
    return list(zip(recordings, estimate_running_s(recordings), strict=True))


def fit_covariances(
    left_out: Sequence[SimulatorComparison], machine: Machine
) -> list[ErrorCovariance]:
    """Return the noise of each joint from a simulator's errors on recordings that it was not fitted to."""
    pairs = [(one.residuals.error, one.residuals.increments) for one in left_out]

    def fit(j: int) -> ErrorCovariance:
        errors, motions = zip(
            *((error[..., j], moved[..., j]) for error, moved in pairs), strict=True
        )
        return fit_joint_noise(errors, motions, machine)

    return map_parallel(fit, range(machine.num_joints))


def _find_known_windows(case: GapCase, field: SimulatorComparison) -> np.ndarray:
    """Return which field windows stay within the poses and commands that the reference visited, `(W, J)` bool."""
    q = np.concatenate([one.q for one in case.reference])
    u = np.concatenate([one.u for one in case.reference])
    cut, travel = field.residuals.simulator.cut, case.machine.upper - case.machine.lower
    # Beyond them the simulator extrapolates, and its errors say nothing about the machine.
    low, high = q.min(0) - 0.03 * travel, q.max(0) + 0.03 * travel
    outside = (cut.q < low) | (cut.q > high)
    most = np.abs(u).max(0) + 0.05
    beyond = np.abs(cut.u) > most
    return (outside.mean(1) < 0.1) & (beyond.mean(1) < 0.1)
