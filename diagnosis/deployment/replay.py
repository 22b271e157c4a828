"""Log of one run of a policy, and the replay of the policy on it, as its contract says or with changes on the way.

A change spoils values at points of the way, by their names:

    signal <term> (T, C) → scaled <term> (R, H, C) → vector (R, O) → answer (R, J) → command (T, J)

`network` takes the place of the policy's own.
Axes: `T` rows of the log, `R` rows that are asked for, `H` samples of history (oldest first), `C`
columns of a term, `O` numbers of the vector, `J` joints.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from brokk_rl.record import Recording, list_columns
from diagnosis.deployment.contract import (
    OBSERVATION_COLUMN,
    TARGET_COLUMNS,
    LoadedPolicy,
    ObservationTerm,
    PolicyContract,
    name_advice_column,
)

Change = Mapping[str, Callable[[np.ndarray], np.ndarray]]
"""By point of the way: makes wrong values of right ones."""
NUM_DRAWS = 24
"""Draws of the log's rounding by which its effect on the command is measured. Chosen by hand."""
SPREAD_FACTOR = 3.0
"""Multiple of the largest deviation among the draws that still counts as rounding; by hand."""
TOLERANCE = 2e-3
"""Difference of a command, of full, that is always rounding: twice the one at the export."""
VECTOR_TOLERANCE = 1e-3
"""The same for a number of the observation vector."""


class PolicyReplay:
    """A policy on a log, from what the log holds last before each part of the way.

    Args:
        policy: The policy.
        log: The log.
        generator: Draws the rounding of the log.
    """

    def __init__(self, policy: LoadedPolicy, log: RunLog, generator: np.random.Generator) -> None:
        self.policy, self.log = policy, log
        self._generator = generator
        self._all = np.arange(len(log.t_s))

    @cached_property
    def nominal(self) -> np.ndarray:
        """Commands as the contract says, `(T, J)`."""
        return self._answer((), self._all)

    def command(self, changes: Sequence[Change], rows: np.ndarray) -> np.ndarray:
        """Return commands, `(R, J)`: answers to the logged observation where there is one."""
        before = [change for change in changes if {*change} - {"command"}]
        if len(before) == len(changes) > 0:
            return self._answer(changes, rows)
        # A delay of commands needs all rows.
        commands = self._answer(before, self._all) if before else self.nominal
        return apply_changes(changes, "command", commands)[rows]

    def deliver(self, changes: Sequence[Change], rows: np.ndarray) -> np.ndarray:
        """Return the policy's logged commands on their way to the valve, `(R, J)`."""
        assert self.log.commanded is not None, "a stage is judged where its beginning was logged"
        return apply_changes(changes, "command", self.log.commanded)[rows]

    def encode(self, changes: Sequence[Change], rows: np.ndarray) -> np.ndarray:
        """Return observation vectors, `(R, O)`; the log is complete."""
        parts = []
        for term in self.policy.contract.terms:
            values = apply_changes(changes, f"signal {term.name}", self.log.signals[term.name])
            window = cut_history(values, term, rows)
            scaled = (window - term.mean) / term.std
            scaled = apply_changes(changes, f"scaled {term.name}", scaled)
            if term.clip is not None:
                scaled = scaled.clip(-term.clip, term.clip)
            parts.append(scaled.reshape(len(rows), -1))
        return apply_changes(changes, "vector", np.concatenate(parts, 1))

    def _answer(self, changes: Sequence[Change], rows: np.ndarray) -> np.ndarray:
        network = self.policy.network.answer
        for change in changes:
            network = change.get("network", network)
        observed = self.log.observed
        vectors = self.encode(changes, rows) if observed is None else observed[rows]
        return apply_changes(changes, "answer", network(vectors))

    @cached_property
    def spread(self) -> tuple[np.ndarray, np.ndarray]:
        """Largest effect of the log's rounding on observation vector and command, `(T, O)` and `(T, J)`."""
        answer, terms = self.policy.network.answer, self.policy.contract.terms
        encoded = self.encode((), self._all)
        nominal = answer(encoded)
        largest_vector, largest = np.zeros_like(encoded), np.zeros_like(nominal)
        for _ in range(NUM_DRAWS):
            change = {}
            for term in terms:
                shape = self.log.signals[term.name].shape
                share = self._generator.uniform(-0.5, 0.5, shape)
                jitter = self._generator.uniform(-1.0, 1.0, shape) if self.log.is_measured else None
                units = np.array([self.log.units[name] for name in term.columns])
                change[f"signal {term.name}"] = partial(_vary, share * units, jitter)
            drawn = self.encode([change], self._all)
            largest_vector = np.maximum(largest_vector, np.abs(drawn - encoded))
            largest = np.maximum(largest, np.abs(answer(drawn) - nominal))
        return largest_vector, largest


def _vary(rounding: np.ndarray, jitter: np.ndarray | None, values: np.ndarray) -> np.ndarray:
    """Return values as they may have been before the log lost something, `(T, C)`.

    Args:
        rounding: What rounding took.
        jitter: Distance to the moment at which the policy looked, in periods: a captured row lies up to one
            beside it; `None` where both are the same.
        values: Of the log.
    """
    if jitter is None:
        return values + rounding
    motion = np.nan_to_num(np.diff(values, axis=0))
    ahead = np.concatenate([motion, motion[-1:]])
    behind = np.concatenate([motion[:1], motion])
    return values + rounding + np.where(jitter > 0.0, jitter * ahead, jitter * behind)


def apply_changes(changes: Sequence[Change], point: str, values: np.ndarray) -> np.ndarray:
    """Return the values of a point after all changes there."""
    for change in changes:
        if point in change:
            values = change[point](values)
    return values


def cut_history(values: np.ndarray, term: ObservationTerm, rows: np.ndarray) -> np.ndarray:
    """Return the history of a term at rows of a log, `(R, H, C)`; the first row stands before itself.

    Args:
        values: The term's columns, `(T, C)`.
        term: The term.
        rows: Rows of the decisions, `(R,)`.
    """
    index = rows[:, None] + term.newest + np.arange(1 - term.samples, 1)[None]
    return values[np.maximum(index, 0)]


CAPTURED = "capture:"
"""Begins the source of recordings that `mode=convert` made of a capture of the loop."""
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
        observed: Observation vector as the network got it, `(T, O)`, or of another length; `None` where not logged.
        is_measured: The command in force is a measured valve feedback, not what was sent.
        units: Step to which each column was rounded, by name.
    """

    recording: Recording
    signals: Mapping[str, np.ndarray]
    missing: tuple[str, ...]
    commanded: np.ndarray | None
    in_force: np.ndarray | None
    observed: np.ndarray | None
    is_measured: bool
    units: Mapping[str, float]

    @property
    def t_s(self) -> np.ndarray:
        """Time of each row, `(T,)`, s."""
        return self.recording.t_s

    @property
    def is_complete(self) -> bool:
        """True if every term of the observation was logged."""
        return not self.missing


def read_run_log(
    recording: Recording, contract: PolicyContract, target_m: tuple[float, ...] | None
) -> RunLog:
    """Return the log of a recording in the terms of a contract.

    Args:
        recording: The recording.
        contract: The policy's contract.
        target_m: Target in the base frame where the log does not hold it; `None`: none is known.
    """
    columns = {"t_s": recording.t_s}
    for name, values in (list_columns(recording) | dict(recording.extra)).items():
        columns[name] = np.asarray(values, float)
    if target_m is not None:
        for name, value in zip(TARGET_COLUMNS, target_m, strict=True):
            columns.setdefault(name, np.full(recording.num_samples, value))
    signals, missing = {}, []
    for term in contract.terms:
        values = _stack(columns, term.columns)
        if values is None:
            missing += [name for name in term.columns if name not in columns]
        else:
            # A policy that gave no advice proposed nothing: its history holds zero there.
            signals[term.name] = np.nan_to_num(values) if term.name == "proposals" else values
    numbers = map(OBSERVATION_COLUMN.format, itertools.count())
    return RunLog(
        recording=recording,
        signals=signals,
        missing=tuple(missing),
        commanded=_stack(columns, [name_advice_column(name) for name in contract.joints]),
        in_force=_stack(columns, contract.commands),
        observed=_stack(columns, [*itertools.takewhile(columns.__contains__, numbers)]),
        is_measured=recording.metadata.get("source", "").startswith(CAPTURED),
        units={name: measure_resolution(values) for name, values in columns.items()},
    )


def _stack(columns: Mapping[str, np.ndarray], names: Sequence[str]) -> np.ndarray | None:
    """Return some columns, `(T, C)`; `None` where one is missing, or none was asked for."""
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
