"""Replay of a policy on a log, as its contract says or with changes on the way.

A change spoils values at points of the way, by their names:

    signal <term> (T, C) → scaled <term> (R, H, C) → vector (R, O) → answer (R, J) → command (T, J)

`before` are the values `(C,)` that stand before the first row of all terms, made of the mean, and `network`
takes the place of the policy's own.
Axes: `T` rows of the log, `R` rows that are asked for, `H` samples of history (oldest first), `C`
columns of a term, `O` numbers of the vector, `J` joints.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial

import numpy as np

from diagnosis.deployment.contract import LoadedPolicy, ObservationTerm
from diagnosis.deployment.run_log import RunLog

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
    def encoded(self) -> np.ndarray:
        """Observation vectors as the contract says, `(T, O)`; the log is complete."""
        return self._encode((), self._all)

    @cached_property
    def nominal(self) -> np.ndarray:
        """Commands as the contract says, `(T, J)`."""
        return self._answer((), self._all)

    def encode(self, changes: Sequence[Change], rows: np.ndarray) -> np.ndarray:
        """Return observation vectors, `(R, O)`."""
        return self._encode(changes, rows) if changes else self.encoded[rows]

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

    def _encode(self, changes: Sequence[Change], rows: np.ndarray) -> np.ndarray:
        parts = []
        for term in self.policy.contract.terms:
            values = apply_changes(changes, f"signal {term.name}", self.log.signals[term.name])
            window = cut_history(values, term, rows, changes)
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
        nominal = answer(self.encoded)
        largest_vector, largest = np.zeros_like(self.encoded), np.zeros_like(nominal)
        for _ in range(NUM_DRAWS):
            change = {}
            for term in terms:
                shape = self.log.signals[term.name].shape
                share = self._generator.uniform(-0.5, 0.5, shape)
                jitter = self._generator.uniform(-1.0, 1.0, shape) if self.log.is_measured else None
                units = np.array([self.log.units[name] for name in term.columns])
                change[f"signal {term.name}"] = partial(_vary, share * units, jitter)
            drawn = self._encode([change], self._all)
            largest_vector = np.maximum(largest_vector, np.abs(drawn - self.encoded))
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


def cut_history(
    values: np.ndarray, term: ObservationTerm, rows: np.ndarray, changes: Sequence[Change]
) -> np.ndarray:
    """Return the history of a term at rows of a log, `(R, H, C)`.

    Args:
        values: The term's columns, `(T, C)`.
        term: The term.
        rows: Rows of the decisions, `(R,)`.
        changes: Changes on the way.
    """
    index = rows[:, None] + term.newest + np.arange(1 - term.samples, 1)[None]
    window = values[np.maximum(index, 0)]
    if any("before" in change for change in changes):
        first = apply_changes(changes, "before", term.mean)
    elif term.before == "zero":
        first = np.zeros_like(term.mean)
    else:
        return window
    return np.where((index < 0)[:, :, None], first, window)
