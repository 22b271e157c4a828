"""Replay of a policy on a log, as its contract says or with a change on the way.

The way has four places, and a change acts at one of them:

    signals (T, C) → windows of history (R, H, C) → observation vector (R, O) → command (T, J)

Axes: `T` rows of the log, `R` rows that are asked for, `H` samples of history (oldest first), `C`
columns of a term, `O` numbers of the vector, `J` joints.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from diagnosis.deployment.contract import LoadedPolicy, ObservationTerm
from diagnosis.deployment.run_log import RunLog

Transform = Callable[[np.ndarray], np.ndarray]
Network = Callable[[np.ndarray], np.ndarray]
"""Commands, `(B, J)`, of observation vectors, `(B, O)`."""
NUM_DRAWS = 24
"""Draws of the log's rounding by which its effect on the command is measured. Chosen by hand."""
SPREAD_FACTOR = 3.0
"""Multiple of the largest deviation among the draws that still counts as rounding; by hand."""
TOLERANCE = 2e-3
"""Difference of a command, of full, that is always rounding: twice the one at the export."""
VECTOR_TOLERANCE = 1e-3
"""The same for a number of the observation vector."""


@dataclass(frozen=True)
class Change:
    """A change on the way from log to command.

    Attributes:
        signals: By term: changes values `(T, C)`.
        windows: By term: changes history `(R, H, C)`.
        vector: Changes observation vectors `(R, O)`.
        command: Changes commands `(T, J)`.
        network: Takes the place of the policy's own.
        before: What stands before the first row, for all terms: `zero` in raw units, or
            `normalised`, zero after scaling; `None` as the contract says.
    """

    signals: Mapping[str, Transform] = field(default_factory=dict)
    windows: Mapping[str, Transform] = field(default_factory=dict)
    vector: Transform | None = None
    command: Transform | None = None
    network: Network | None = None
    before: str | None = None

    @property
    def is_after_network(self) -> bool:
        """True if it changes nothing that the network sees, and not the network."""
        is_input = self.signals or self.windows or self.vector or self.before
        return not is_input and self.network is None


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
        before = [change for change in changes if not change.is_after_network]
        if not any(change.command for change in changes):
            return self._answer(changes, rows) if changes else self.nominal[rows]
        commands = self._answer(before, self._all) if before else self.nominal
        return apply_commands(commands, changes)[rows]

    def deliver(self, changes: Sequence[Change], rows: np.ndarray) -> np.ndarray:
        """Return the policy's logged commands on their way to the valve, `(R, J)`."""
        assert self.log.commanded is not None, "a stage is judged where its beginning was logged"
        return apply_commands(self.log.commanded, changes)[rows]

    def _encode(self, changes: Sequence[Change], rows: np.ndarray) -> np.ndarray:
        parts = []
        for term in self.policy.contract.terms:
            values = self.log.signals[term.name]
            for change in changes:
                if term.name in change.signals:
                    values = change.signals[term.name](values)
            before = next((change.before for change in changes if change.before), None)
            window = cut_history(values, term, rows, before)
            for change in changes:
                if term.name in change.windows:
                    window = change.windows[term.name](window)
            normalised = (window - term.mean) / term.std
            if term.clip is not None:
                normalised = normalised.clip(-term.clip, term.clip)
            parts.append(normalised.reshape(len(rows), -1))
        vector = np.concatenate(parts, 1)
        for change in changes:
            if change.vector is not None:
                vector = change.vector(vector)
        return vector

    def _answer(self, changes: Sequence[Change], rows: np.ndarray) -> np.ndarray:
        network = self.policy.network.answer
        for change in changes:
            network = change.network or network
        if self.log.observed is not None:
            return network(self.log.observed[rows])
        return network(self.encode(changes, rows))

    @cached_property
    def spread(self) -> tuple[np.ndarray, np.ndarray]:
        """Largest effect of the log's rounding on observation vector and command, `(T, O)` and `(T, J)`."""
        answer, terms = self.policy.network.answer, self.policy.contract.terms
        nominal = answer(self.encoded)
        largest_vector, largest = np.zeros_like(self.encoded), np.zeros_like(nominal)
        for _ in range(NUM_DRAWS):
            change = Change(signals={term.name: self._draw_rounding(term) for term in terms})
            drawn = self._encode([change], self._all)
            largest_vector = np.maximum(largest_vector, np.abs(drawn - self.encoded))
            largest = np.maximum(largest, np.abs(answer(drawn) - nominal))
        return largest_vector, largest

    def _draw_rounding(self, term: ObservationTerm) -> Transform:
        """Return a change by what the log lost: its rounding, and the jitter of its clock."""
        units = np.array([self.log.units[name] for name in term.columns])
        share = self._generator.uniform(-0.5, 0.5, self.log.signals[term.name].shape)
        jitter = self._generator.uniform(-1.0, 1.0, share.shape) if self.log.is_measured else None

        def transform(values: np.ndarray) -> np.ndarray:
            moved = values + share * units
            if jitter is not None:
                # A captured row lies up to a period beside the moment at which the policy looked.
                motion = np.nan_to_num(np.diff(values, axis=0))
                ahead = np.concatenate([motion, motion[-1:]])
                behind = np.concatenate([motion[:1], motion])
                moved = moved + np.where(jitter > 0.0, jitter * ahead, jitter * behind)
            return moved

        return transform


def apply_commands(commands: np.ndarray, changes: Sequence[Change]) -> np.ndarray:
    """Return commands `(T, J)` after the changes of them."""
    for change in changes:
        if change.command is not None:
            commands = change.command(commands)
    return commands


def cut_history(
    values: np.ndarray, term: ObservationTerm, rows: np.ndarray, before: str | None = None
) -> np.ndarray:
    """Return the history of a term at rows of a log, `(R, H, C)`.

    Args:
        values: The term's columns, `(T, C)`.
        term: The term.
        rows: Rows of the decisions, `(R,)`.
        before: See `Change`.
    """
    index = rows[:, None] + term.newest + np.arange(1 - term.samples, 1)[None]
    window = values[np.maximum(index, 0)]
    early = (index < 0)[:, :, None]
    if before == "zero":
        return np.where(early, 0.0, window)
    if before == "normalised":
        return np.where(early, term.mean, window)
    return np.where(early, 0.0, window) if term.before == "zero" else window
