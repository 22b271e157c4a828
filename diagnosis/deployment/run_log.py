"""Log of one run of a policy: what it saw, what it commanded, and what came into force.

Axes: `T` rows, `C` columns of a term, `J` joints, `O` numbers of the observation vector.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from brokk_rl.record import Recording, name_command_column, name_position_column
from diagnosis.deployment.contract import (
    OBSERVATION_COLUMN,
    TARGET_COLUMNS,
    ObservationTerm,
    PolicyContract,
    name_advice_column,
)

CAPTURED = "capture:"
"""Begins the source of recordings that `mode=convert` made of a capture of the loop."""
REST_SHARE = 0.002
"""Share of a joint's travel within which it counts as resting over the dead time at the start;
chosen by hand, 5 mrad on brokk170."""
MAX_STEPS, STEP_TOLERANCE = 8, 0.05
"""Multiples of a step by which a rounded column is recognised, and how exact they are, of a step."""


@dataclass(frozen=True)
class RunLog:
    """Log of one run, in the terms of a policy's contract.

    Attributes:
        recording: The recording.
        signals: Values by term, `(T, C)`; terms whose columns are missing are left out.
        missing: Columns that the contract asks for and the log lacks.
        commanded: Command that the policy gave, `(T, J)`; `None` where it was not logged.
        in_force: Command in force, `(T, J)`.
        observed: Observation vector as the network got it, `(T, O)`; `None` where not logged.
        num_observed: Numbers of the logged vector; 0 where it was not logged.
        is_measured: The command in force is a measured valve feedback, not what was sent.
    """

    recording: Recording
    signals: Mapping[str, np.ndarray]
    missing: tuple[str, ...]
    commanded: np.ndarray | None
    in_force: np.ndarray | None
    observed: np.ndarray | None
    num_observed: int
    is_measured: bool
    units: Mapping[str, float] = field(default_factory=dict)

    @property
    def t_s(self) -> np.ndarray:
        """Time of each row, `(T,)`, s."""
        return self.recording.t_s

    @property
    def is_complete(self) -> bool:
        """True if every term of the observation was logged."""
        return not self.missing

    def rests_at_start(self, dead_time_s: float, travel: np.ndarray) -> bool:
        """Return whether the machine rests over the first dead time: no command is on its way.

        Args:
            dead_time_s: Time from command to motion.
            travel: Travel of each joint, `(J,)`.
        """
        rows = max(2, round(dead_time_s * self.recording.rate_hz))
        return bool((np.ptp(self.recording.q[:rows], axis=0) <= REST_SHARE * travel).all())


def read_run_log(
    recording: Recording, contract: PolicyContract, target_m: tuple[float, ...] | None
) -> RunLog:
    """Return the log of a recording in the terms of a contract.

    Args:
        recording: The recording.
        contract: The policy's contract.
        target_m: Target in the base frame where the log does not hold it; `None`: none is known.
    """
    columns = _list_columns(recording)
    if target_m is not None:
        for name, value in zip(TARGET_COLUMNS, target_m, strict=True):
            columns.setdefault(name, np.full(recording.num_samples, value))
    signals, missing = {}, []
    for term in contract.terms:
        lacking = [name for name in term.columns if name not in columns]
        missing += lacking
        if not lacking:
            signals[term.name] = _read_term(term, columns)
    advice = _stack(columns, [name_advice_column(name) for name in contract.joints])
    in_force = _stack(columns, contract.commands)
    names = [OBSERVATION_COLUMN.format(number) for number in range(contract.size)]
    source = recording.metadata.get("source", "")
    num_observed = 0
    while OBSERVATION_COLUMN.format(num_observed) in columns:
        num_observed += 1
    return RunLog(
        recording=recording,
        signals=signals,
        missing=tuple(missing),
        commanded=advice,
        in_force=in_force,
        observed=_stack(columns, names) if num_observed == contract.size else None,
        num_observed=num_observed,
        is_measured=source.startswith(CAPTURED),
        units={name: measure_resolution(values) for name, values in columns.items()},
    )


def _list_columns(recording: Recording) -> dict[str, np.ndarray]:
    columns = {"t_s": recording.t_s}
    for j, (joint, unit) in enumerate(zip(recording.joints, recording.units, strict=True)):
        columns[name_command_column(joint)] = recording.u[:, j].astype(float)
        columns[name_position_column(joint, unit)] = recording.q[:, j].astype(float)
    for name, values in recording.extra.items():
        columns[name] = np.asarray(values, float)
    return columns


def _read_term(term: ObservationTerm, columns: Mapping[str, np.ndarray]) -> np.ndarray:
    values = np.stack([columns[name] for name in term.columns], 1)
    # A policy that gave no advice proposed nothing: its history holds zero there.
    return np.nan_to_num(values) if term.name == "proposals" else values


def _stack(
    columns: Mapping[str, np.ndarray], names: list[str] | tuple[str, ...]
) -> np.ndarray | None:
    if not names or any(name not in columns for name in names):
        return None
    return np.stack([columns[name] for name in names], 1)


def measure_resolution(values: np.ndarray) -> float:
    """Return the step to which a column was rounded when it was logged.

    A column that was not rounded has the resolution of float32.
    """
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 0.0
    exact = float(np.abs(finite).max()) * float(np.finfo(np.float32).eps)
    steps = np.diff(np.unique(finite))
    steps = steps[steps > 4 * exact]
    if len(steps) < 2:
        return exact
    # Float32 has relative steps: only the small multiples of a step are compared.
    step = float(steps.min())
    ratio = steps[steps < MAX_STEPS * step] / step
    is_rounded = np.abs(ratio - np.round(ratio)).max() < STEP_TOLERANCE and step > 100 * exact
    return step if is_rounded else exact
