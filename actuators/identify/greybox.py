"""Grey-box fits: physical parameters of an actuator model from free runs, with intervals."""

import dataclasses
import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import qmc

from actuators import open_loop
from actuators.identify.gauss_newton import (
    CandidateRuns,
    ParameterUncertainty,
    estimate_uncertainty,
    get_parameters,
    take_step,
)
from actuators.identify.option_file import round_by_joint, write_option
from actuators.recordings.split import COMMANDED
from brokk_rl import record
from brokk_rl.contracts.actuator import Actuator
from brokk_rl.errors import ConfigError, RecordingError
from brokk_rl.machine import Machine
from brokk_rl.progress import ItemProgress
from brokk_rl.record import Recording
from brokk_rl.spec import Count, Positive, spec

log = logging.getLogger(__name__)


TOLD = 0.5
"""A number whose interval is wider than this part of its range is one that the recordings do not
tell."""
TANGLED = 0.95
"""Correlation from which on two numbers stand for each other."""


def tabulate_parameters(
    found: dict[str, dict[str, float]],
    runs: CandidateRuns,
    x: np.ndarray,
    sure: ParameterUncertainty,
) -> dict[str, Any]:
    """Return each parameter with standard error, interval and whether it is determined."""
    low = runs.values(np.clip(x - sure.half, 0.0, 1.0))
    high = runs.values(np.clip(x + sure.half, 0.0, 1.0))
    width = runs.values(np.ones_like(x)) - runs.values(np.zeros_like(x))
    parameters = {}
    for p, (name, row) in enumerate(found.items()):
        parameters[name] = {
            joint: {
                "value": value,
                "standard_error": float(sure.deviation[p, j] * width[p, j]),
                "ci95": [float(low[p, j]), float(high[p, j])],
                "told": bool(2.0 * sure.half[p, j] <= TOLD),
                "at_bound": bool(x[p, j] <= 0.0 or x[p, j] >= 1.0),
                "runs": int(sure.runs[j]),
            }
            for j, (joint, value) in enumerate(row.items())
        }
    return parameters


def find_correlated_pairs(
    machine: Machine, runs: CandidateRuns, sure: ParameterUncertainty
) -> list[dict[str, Any]]:
    """Return the pairs of parameters whose correlation exceeds `TANGLED`."""
    labels = [" ".join(pair) for pair in product(runs.names, machine.joint_names)]
    correlated = []
    for a, b in np.argwhere(np.triu(np.abs(sure.correlation), 1) > TANGLED):
        correlation = round(float(sure.correlation[a, b]), 3)
        correlated.append({"pair": [labels[a], labels[b]], "correlation": correlation})
    return correlated


def describe_option(fitted: Any, facts: dict[str, Any]) -> str:
    """Return the comment of a fitted option: data, errors of free runs and intervals."""
    errors = []
    for joint, value in facts["validation_rmse"].items():
        errors.append(f"{joint} {'-' if value is None else f'{value:.4f}'}")
    lines = [
        f"{type(fitted).__name__} fitted to {facts['recordings']} recordings ({facts['runs']} runs, {facts['minutes']:g} min) of "
        f"machine '{facts['machine']}', {facts['created']}.",
        "Use: actuator=@<this file>. A number that the recordings do not tell has its whole range as interval.",
        f"Error of free runs of {facts['horizon_s']:g} s on the validation recordings, at their end, rad or m: {', '.join(errors)}",
        "95 % intervals:",
    ]
    for name, row in facts["parameters"].items():
        cells = []
        for joint, cell in row.items():
            low, high = cell["ci95"]
            cells.append(f"{joint} {low:.4g} to {high:.4g}{'' if cell['told'] else ' (not told)'}")
        lines.append(f"  {name}: {', '.join(cells)}")
    return "\n".join(lines)


def log_undetermined(facts: dict[str, Any]) -> None:
    """Log the parameters that the recordings do not determine."""
    for name, row in facts["parameters"].items():
        vague = [joint for joint, cell in row.items() if not cell["told"]]
        # A number that ended at 0 is not needed: no wider range would make sense.
        stuck = [joint for joint, cell in row.items() if cell["at_bound"] and cell["value"] != 0.0]
        if vague:
            text = "%s: the recordings do not tell it for %s (interval over half of fit.free.%s)"
            log.warning(text, name, ", ".join(vague), name)
        if stuck:
            text = "%s: at the end of fit.free.%s for %s; widen it if that makes sense"
            log.warning(text, name, name, ", ".join(stuck))
    for pair in facts["tangled"]:
        text = "%s and %s stand for each other (correlation %.2f)"
        log.warning(text, *pair["pair"], pair["correlation"])


ACTIVE_SHARE = 0.1
"""A window says something about a joint that is commanded for so much of it."""


@spec
class GreyBoxFit:
    """Fits physical parameters by free runs: search over ranges, then Gauss-Newton steps.

    Attributes:
        name: Name of the model in tables and of its files: `<name>.yaml`, an option for
            `actuator=@…`, and `<name>.json`.
        actuator: The model; numbers that are not free keep the values they have here.
        free: Lower and upper bound of each number that is fitted, joint by joint, by name.
        horizon_s: Length of the free runs.
        windows: Free runs a joint, taken evenly from the runs of the machine, where the joint is
            commanded.
        validation_windows: The same from the recordings by which the start is chosen.
        candidates: Points of the Latin hypercube over the ranges from which the best starts are
            taken; the actuator's own numbers compete with them.
        starts: Gauss-Newton runs from the best candidates.
        iterations: Most steps of each.
        tolerance: Relative gain in loss below which a run ends.
        robust: Errors beyond so many times the typical one count with their size instead of its
            square.
    """

    name: str
    actuator: Actuator
    free: dict[str, tuple[float, float]]
    horizon_s: Positive
    windows: Count
    validation_windows: Count
    candidates: Count
    starts: Count
    iterations: Count
    tolerance: Positive
    robust: Positive

    def check(self) -> None:
        if not self.free:
            raise ConfigError("free: expected at least one number to fit")
        for name, (low, high) in self.free.items():
            if not low < high:
                raise ConfigError(
                    f"free.{name}: expected [low, high] with low < high, got [{low}, {high}]"
                )
        if self.starts > self.candidates + 1:
            raise ConfigError(
                f"starts: {self.starts} of {self.candidates} candidates; raise candidates"
            )

    def fit(
        self,
        machine: Machine,
        train: Sequence[Recording],
        validation: Sequence[Recording],
        folder: Path,
        seed: int,
        device: torch.device,
    ) -> Actuator:
        """Fit to `train`, choose the start by `validation`, and write the result into `folder`.

        The files are `<name>.yaml` and `<name>.json`.

        Raises:
            ConfigError: a bound makes no sense, or the actuator has no such number.
            RecordingError: too little data.
            StorageError: a file could not be written.
        """
        began = time.monotonic()
        nominal = self._nominal(machine, device)
        random = np.random.default_rng(seed)
        runs = self._free_runs(machine, train, self.windows, random, device)
        if (idle := np.flatnonzero(~runs.active.any(0))).size:
            joint = machine.joint_names[idle[0]]
            raise RecordingError(
                f"too little data: joint {joint} is never commanded in the {len(train)} recordings to fit to"
            )
        judged = validation or train  # a fit to all recordings has none left to choose a start by
        held = self._free_runs(machine, judged, self.validation_windows, random, device)
        search = _Search(self, runs)
        x = search.choose(search.run(nominal, seed), held)
        sure = estimate_uncertainty(runs, x, self.robust)
        found = self._rounded(machine, runs, x)
        fitted: Any = dataclasses.replace(self.actuator, **found)  # pyright: ignore[reportArgumentType, reportCallIssue]
        facts = {
            "schema": 1,
            "machine": machine.name,
            "recordings": len(train),
            "runs": len({recording.run for recording in train}),
            "minutes": round(sum(recording.duration_s for recording in train) / 60.0, 1),
            "windows": len(runs.active),
            "horizon_s": self.horizon_s,
            "validation_rmse": dict(zip(machine.joint_names, held.end_rmse(x), strict=True)),
            "seconds": round(time.monotonic() - began, 1),
            "created": record.format_now(),
            "parameters": tabulate_parameters(found, runs, x, sure),
            "tangled": find_correlated_pairs(machine, runs, sure),
        }
        write_option(folder, self.name, fitted, describe_option(fitted, facts), facts)
        log_undetermined(facts)
        return fitted

    def _nominal(self, machine: Machine, device: torch.device) -> np.ndarray:
        """Return the actuator's own parameters in units of their ranges, `(P, J)`.

        Also checks the bounds.
        """
        names = tuple(self.free)
        parameters = get_parameters(self.actuator.build(machine, 1, device), names)
        for side in (0, 1):
            ends: Any = {name: bounds[side] for name, bounds in self.free.items()}
            try:
                dataclasses.replace(self.actuator, **ends).build(machine, 1, device)  # pyright: ignore[reportArgumentType]
            except ConfigError as error:
                raise ConfigError(
                    f"fit.free: with every number at its {('lower', 'upper')[side]} bound: {error}"
                ) from error
        own = np.stack([parameters[name][0].cpu().numpy().astype(np.float64) for name in names])
        low, high = np.array([self.free[name] for name in names]).T[:, :, None]
        return np.clip((own - low) / (high - low), 0.0, 1.0)

    def _free_runs(
        self,
        machine: Machine,
        recordings: Sequence[Recording],
        num_windows: int,
        random: np.random.Generator,
        device: torch.device,
    ) -> CandidateRuns:
        cut = open_loop.cut_windows(recordings, machine, self.horizon_s, self.horizon_s)
        active = (np.abs(cut.u) > COMMANDED).mean(1) >= ACTIVE_SHARE
        rows = _select_windows(active, cut.run, num_windows, random)
        cut = dataclasses.replace(cut, u=cut.u[rows], q=cut.q[rows], run=cut.run[rows])
        return CandidateRuns(self.actuator, self.free, machine, cut, active[rows], device)

    def _rounded(
        self, machine: Machine, runs: CandidateRuns, x: np.ndarray
    ) -> dict[str, dict[str, float]]:
        rows = zip(runs.names, runs.values(x), strict=True)
        return {name: round_by_joint(machine, row) for name, row in rows}


@dataclass
class _Search:
    """Search from several starts."""

    config: GreyBoxFit
    runs: CandidateRuns

    def run(self, nominal: np.ndarray, seed: int) -> np.ndarray:
        """Return where each start leads, `(S, P, J)`."""
        config, found = self.config, []
        total = config.starts * config.iterations
        with ItemProgress(f"{config.name}: search", total) as progress:
            for start, x in enumerate(self._starts(nominal, seed)):
                for step in range(config.iterations):
                    note = f"{config.name}: start {start + 1} of {config.starts}, step {step + 1}"
                    progress.reach(start * config.iterations + step, note)
                    x, gain = take_step(self.runs, x, config.robust)
                    if gain < config.tolerance:
                        break
                found.append(x)
        return np.stack(found)

    def choose(self, stacked: np.ndarray, held: CandidateRuns) -> np.ndarray:
        """Return the parameters `(P, J)` with the best validation runs, joint by joint."""
        score, fallback = (
            _average_rmse(runs.squares(stacked), runs.active) for runs in (held, self.runs)
        )
        # The fallback is for a joint that the validation never moves.
        score = np.where(np.isfinite(score), score, fallback)
        return np.stack([stacked[best][:, j] for j, best in enumerate(score.argmin(0))], 1)

    def _starts(self, nominal: np.ndarray, seed: int) -> np.ndarray:
        """Return the best starts of a Latin hypercube and the nominal point, `(S, P, J)`."""
        num, joints = nominal.shape
        points = qmc.LatinHypercube(num, rng=np.random.default_rng(seed)).random(
            self.config.candidates
        )
        candidates = np.concatenate([np.repeat(points[:, :, None], joints, 2), nominal[None]])
        some = np.arange(0, len(self.runs.active), 4 if len(self.runs.active) >= 16 * joints else 1)
        order = _average_rmse(self.runs.squares(candidates, some), self.runs.active[some]).argsort(
            0
        )[: self.config.starts]  # (S, J)
        return np.stack([candidates[order[:, j], :, j] for j in range(joints)], 2)


def _select_windows(
    active: np.ndarray, run: np.ndarray, count: int, random: np.random.Generator
) -> np.ndarray:
    """Return rows with each joint active in about `count` of them, evenly over the runs."""
    chosen = np.zeros(len(active), dtype=bool)
    for j in range(active.shape[1]):
        rows = random.permutation(np.flatnonzero(active[:, j]))
        turn = np.zeros(len(rows), dtype=int)
        for name in np.unique(run[rows]):
            mine = run[rows] == name
            turn[mine] = np.arange(mine.sum())
        rows = rows[np.argsort(turn, kind="stable")]
        wanted = max(0, count - int(chosen[rows].sum()))
        chosen[rows[~chosen[rows]][:wanted]] = True
    return np.flatnonzero(chosen)


def _average_rmse(squares: np.ndarray, active: np.ndarray) -> np.ndarray:
    """Return mean RMS errors over active windows, `(C, J)`; NaN for an inactive joint."""
    count = np.where(active.any(0), active.sum(0), np.nan)
    return np.sqrt(squares).sum(1) / count
