"""Signals of a log on their own clocks, and recordings made of them at the machine's rate."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from actuators.recordings.expression import Expression, parse_expression
from actuators.recordings.log_tables import LogRun, join_names
from actuators.recordings.whole_rows import HOW_TO_SKIP
from brokk_rl import record
from brokk_rl.errors import ConfigError, RecordingError, list_choices
from brokk_rl.machine import Machine
from brokk_rl.record import Recording

TICK_TOLERANCE = 1e-3
"""Part of a period by which a sample may lie after its tick and still count for it. Seconds since
1970 are rounded to 0.2 µs, and no logger is as punctual as this."""


SLICE = 1 << 18
"""Samples that are computed at once: temporary arrays of a long column would fill the memory."""


def compute_by_slices(
    compute: Callable[[np.ndarray], np.ndarray], values: np.ndarray
) -> np.ndarray:
    """Return `compute(values)` for a function of each value, `(T,)`."""
    found = np.empty(len(values))
    for begin in range(0, len(values), SLICE):
        found[begin : begin + SLICE] = compute(values[begin : begin + SLICE])
    return found


@dataclass(frozen=True)
class Signal:
    """A signal on the clock of one table.

    Attributes:
        table: Name of the table whose rows it has.
        t_s: Times, `(T,)`.
        values: `(T,)`.
        text: Column or arithmetic that it comes from.
    """

    table: str
    t_s: np.ndarray
    values: np.ndarray
    text: str

    def hold(self, ticks_s: np.ndarray, period_s: float) -> np.ndarray:
        """Return the value in force at each tick: that of the newest sample."""
        newest = np.searchsorted(self.t_s, ticks_s + TICK_TOLERANCE * period_s, "right") - 1
        return self.values[newest.clip(0)]

    def average(self, ticks_s: np.ndarray, period_s: float) -> np.ndarray:
        """Return the mean over the period that begins at each tick, of values held between samples.

        A force acts by its mean over a period; samples between two ticks would else be lost.
        """
        held_s = np.diff(self.t_s, append=self.t_s[-1] + period_s)
        impulse = np.concatenate([[0.0], np.cumsum(self.values * held_s)])
        edges_s = np.append(self.t_s, self.t_s[-1] + period_s)
        begin, end = (np.interp(ticks_s + later_s, edges_s, impulse) for later_s in (0.0, period_s))
        return (end - begin) / period_s

    def interpolate(self, ticks_s: np.ndarray) -> np.ndarray:
        """Return the value at each tick, linear between samples."""
        return np.interp(ticks_s, self.t_s, self.values)


Places = Mapping[str, tuple[str, str]]
"""Table and column of each full name."""


class RunClocks(Mapping[str, np.ndarray]):
    """Times of the tables of a run, one of them in memory at a time.

    Args:
        run: The run.
        read: Returns the times of a table, `(T,)` s, by its name.
    """

    def __init__(self, run: LogRun, read: Callable[[str], np.ndarray]) -> None:
        self._run, self._read = run, read
        self._newest: tuple[str, np.ndarray] | None = None

    def __getitem__(self, table: str) -> np.ndarray:
        if self._newest is None or self._newest[0] != table:
            self._newest = None  # before the next one is read
            self._newest = (table, self._read(table))
        return self._newest[1]

    def __iter__(self) -> Iterator[str]:
        return iter(self._run.tables)

    def __len__(self) -> int:
        return len(self._run.tables)


class RunSignals:
    """The signals of a run, each on the clock of its table.

    Args:
        run: The run.
        sources: Column or arithmetic of each text.
        places: Table and column of each full name.
        clocks: Times of each table, `(T,)` s.
    """

    def __init__(
        self,
        run: LogRun,
        sources: Mapping[str, Expression | str],
        places: Places,
        clocks: Mapping[str, np.ndarray],
    ) -> None:
        self.run = run
        self._sources, self._places, self._clocks = sources, places, clocks

    def find_table(self, text: str) -> str:
        """Return the table whose clock a column or arithmetic has."""
        source = self._sources[text]
        return self._places[source if isinstance(source, str) else source.names[0]][0]

    def read(self, text: str, empty: bool = False) -> Signal:
        """Return a column or arithmetic over columns; NaN is refused unless `empty` allows it.

        Raises:
            RecordingError: It holds what is no number; names row and column.
        """
        source = self._sources[text]
        names = (source,) if isinstance(source, str) else source.names
        table = self.find_table(text)
        t_s = self._clocks[table]
        columns: dict[str, np.ndarray] = {}
        for name in names:
            other, inner = self._places[name]
            values = np.asarray(self.run.tables[other].columns[inner], dtype=float)
            if not empty and (row := find_first(values, np.isfinite)) is not None:
                cell = self.run.tables[other].show_cell(row, inner)
                raise RecordingError(
                    f"{locate(self.run, other, row, name)}: {cell} is not a number; {HOW_TO_SKIP}"
                )
            columns[name] = (
                values if other == table else np.interp(t_s, self._clocks[other], values)
            )
        if isinstance(source, str):
            return Signal(table, t_s, columns[source], text)
        values = source.evaluate(columns)
        if not empty and (row := find_first(values, np.isfinite)) is not None:
            raise RecordingError(
                f"{locate(self.run, table, row, text)}: the value is {values[row]}, no number"
            )
        return Signal(table, t_s, values, text)


def index_columns(tables: Mapping[str, Sequence[str]]) -> dict[str, tuple[str, str]]:
    """Return table and column of each full name."""
    places = {}
    for table, columns in tables.items():
        for column in columns:
            places[join_names(table, column)] = (table, column)
    return places


def resolve_column(text: str, places: Places, where: object) -> Expression | str:
    """Return the column that a text names, or its arithmetic.

    Raises:
        RecordingError: A column is missing.
        ConfigError: It is neither.
    """
    if text in places:
        return text
    try:
        expression = parse_expression(text)
    except ConfigError:
        refuse_missing(text, places, where)
        raise
    for name in expression.names:
        refuse_missing(name, places, where)
    return expression


def refuse_missing(name: str, places: Places, where: object) -> None:
    """Raise a `RecordingError` where a column is missing."""
    if name not in places:
        raise RecordingError(
            f"{where}: column '{name}' is missing or holds no numbers; {list_choices(name, places)}"
        )


def locate(run: LogRun, table: str, row: int, column: str) -> str:
    """Return file, row and column for a message."""
    inside = f"table '{table}', " if table and not column.startswith(f"{table}:") else ""
    return f"{run.where}: {run.tables[table].locate(row)}, {inside}column '{column}'"


def find_first(values: np.ndarray, is_good: Callable[[np.ndarray], np.ndarray]) -> int | None:
    """Return the first row whose value is not good, or `None`."""
    for begin in range(0, len(values), SLICE):
        rows = np.flatnonzero(~is_good(values[begin : begin + SLICE]))
        if len(rows):
            return begin + int(rows[0])
    return None


class Piece:
    """A piece of a run without gaps, at the machine's rate.

    Attributes:
        ticks_s: Times of the rows by the clock of the log, `(T,)`.
        u: Commands, `(T, J)`, to be filled.
        q: Positions, `(T, J)`, to be filled.
        extra: Optional columns, to be filled.
    """

    def __init__(self, begin_s: float, end_s: float, machine: Machine) -> None:
        self._machine = machine
        self._end_s = end_s
        num_rows = int((end_s - begin_s) / machine.period_s + TICK_TOLERANCE) + 1
        self._grid_s = np.arange(num_rows) * machine.period_s
        self.ticks_s = begin_s + self._grid_s
        self.u = np.empty((num_rows, machine.num_joints), dtype=np.float32)
        self.q = np.empty((num_rows, machine.num_joints), dtype=np.float32)
        self.extra: dict[str, np.ndarray] = {}

    def make_recording(self, run: LogRun, clock_s: np.ndarray) -> Recording:
        """Return the filled piece; `clock_s` is the clock that it was resampled from."""
        metadata = {
            "source": f"log: {Path(run.where).name}",
            "run": run.name,
            "fingerprint": record.format_fingerprint(self._machine),
        }
        period_s = np.diff(clock_s[(clock_s >= self.ticks_s[0]) & (clock_s <= self._end_s)])
        if len(period_s):
            metadata["resampled_from"] = (
                f"{1.0 / np.median(period_s):.1f} Hz, periods of {period_s.min():.3f} to {period_s.max():.3f} s"
            )
        return Recording(
            machine=self._machine.name,
            joints=self._machine.joint_names,
            units=tuple(joint.unit for joint in self._machine.joints),
            rate_hz=1.0 / self._machine.period_s,
            t_s=self._grid_s,
            u=self.u,
            q=self.q,
            extra=self.extra,
            metadata=metadata,
        )
