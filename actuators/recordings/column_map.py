"""Logs of other machines: the meaning of their columns, and conversion to recordings.

A log is a CSV file, a parquet file (`.parquet`) or a MATLAB file up to version 7 (`.mat`).

A log is cut at its gaps and each piece is brought to the machine's rate: positions linearly between
samples, commands as the value in force (zero-order hold). Pieces of one log share the metadata
`run`, so that no split into fit and test goes through a log.

Rows in messages are those of the log's data, from 0 as in recordings, beside the line of the file
that an editor shows.
"""

import csv
import io
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy import io as matlab

from brokk_rl import record
from brokk_rl.errors import ConfigError, RecordingError, list_choices
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.spec import spec

log = logging.getLogger(__name__)


@spec
class Column:
    """A column of numbers: `scale * value + offset`.

    Attributes:
        column: Its name in the header.
        scale: Unit of the recording for one of the log.
        offset: Added after scaling, in the unit of the recording.
    """

    column: str
    scale: float
    offset: float


@spec
class CommandColumn:
    """A column of commands, linear on either side of neutral.

    Attributes:
        column: Its name in the header.
        neutral: Value without motion.
        full_plus: Value of full command towards larger positions; may lie below `neutral`, which
            turns the sign.
        full_minus: Value of full command towards smaller positions.
    """

    column: str
    neutral: float
    full_plus: float
    full_minus: float

    def check(self) -> None:
        if (self.full_plus - self.neutral) * (self.full_minus - self.neutral) >= 0:
            raise ConfigError(
                f"column '{self.column}': neutral {self.neutral:g} must lie between full_plus {self.full_plus:g} and full_minus "
                f"{self.full_minus:g}"
            )

    def command(self, values: np.ndarray) -> np.ndarray:
        """Return commands, full at -1 and 1, for values of the log; same shape."""
        away = values - self.neutral
        plus = away / (self.full_plus - self.neutral)
        return np.where(plus >= 0, plus, -away / (self.full_minus - self.neutral))


@spec
class TargetColumn:
    """A column of target positions whose speed is the command, for a servo that follows targets.

    Attributes:
        column: Its name in the header.
        scale: Unit of the recording for one of the log; negative turns the sign.
        full_speed: Speed of the target at full command, rad/s or m/s; that of the machine's
            `max_speed`, for a model that integrates commands to give the target.
    """

    column: str
    scale: float
    full_speed: float

    def check(self) -> None:
        if self.full_speed <= 0 or self.scale == 0:
            raise ConfigError(
                f"column '{self.column}': expected full_speed > 0 and a scale other than 0"
            )

    def command(self, values: np.ndarray, t_s: np.ndarray) -> np.ndarray:
        """Return the command in force from each sample to the next, 0 at the last; same shape."""
        speed = np.diff(self.scale * values) / np.diff(t_s)
        return np.append(speed, 0.0) / self.full_speed


@spec
class JointColumns:
    """The columns of one joint.

    Attributes:
        command: Its command: a column of commands, or the speed of a column of targets.
        position: Its position, to rad or m.
    """

    command: CommandColumn | TargetColumn
    position: Column


@spec
class ColumnMap:
    """Reads logs of another machine by a map of their columns.

    Attributes:
        delimiter: Between the cells of a line of a CSV file.
        decimal: Decimal sign of its numbers.
        time: Time, to s; its zero does not matter.
        joints: Columns of each joint of the machine, by joint name.
        optional: Further columns, by their name in the recording (`ee_x_m`, `force_n`, …);
            interpolated like positions.
        overrun: Command beyond full that is taken for rounding and cut to full; more is refused.
        longest_gap_s: A longer time between two rows splits the log.
        shortest_s: Shorter pieces are left out.
    """

    delimiter: Literal[",", ";", "\t", " "]
    decimal: Literal[".", ","]
    time: Column
    joints: dict[str, JointColumns]
    optional: dict[str, Column]
    overrun: float
    longest_gap_s: float
    shortest_s: float

    def check(self) -> None:
        if self.delimiter == self.decimal:
            raise ConfigError(
                f"column map: '{self.decimal}' cannot be both delimiter and decimal sign"
            )
        if self.overrun < 0 or self.longest_gap_s <= 0 or self.shortest_s < 0:
            raise ConfigError(
                "column map: expected overrun >= 0, longest_gap_s > 0 and shortest_s >= 0"
            )
        if self.time.scale <= 0:
            raise ConfigError(f"column map: time.scale {self.time.scale:g} must be positive")

    def read(self, path: Path, machine: Machine) -> list[Recording]:
        """Return the pieces of the log at `path` as recordings of `machine`.

        Raises:
            ConfigError: the map is not for this machine.
            RecordingError: the log cannot be used; names file, line, row and column.
        """
        if set(self.joints) != set(machine.joint_names):
            raise ConfigError(
                f"import: the map names the joints {', '.join(self.joints)}, machine '{machine.name}' has "
                f"{', '.join(machine.joint_names)}; choose machine=… and import=… that belong together"
            )
        table = _open_table(path, self.delimiter, self.decimal)
        t_s = table.numbers(self.time)
        if (row := _find_first(np.diff(t_s) <= 0)) is not None:
            where = table.where(row + 1, self.time.column)
            raise RecordingError(
                f"{where}: time does not increase ({t_s[row]:g} s, then {t_s[row + 1]:g} s)"
            )
        u = np.stack(
            [self._commands(table, self.joints[name].command, t_s) for name in machine.joint_names],
            1,
        )
        q = np.stack([table.numbers(self.joints[name].position) for name in machine.joint_names], 1)
        extra = {name: table.numbers(column, empty=True) for name, column in self.optional.items()}
        pieces = np.split(
            np.arange(len(t_s)), np.flatnonzero(np.diff(t_s) > self.longest_gap_s) + 1
        )
        kept = []
        for rows in pieces:
            if len(rows) > 1 and t_s[rows[-1]] - t_s[rows[0]] >= max(
                self.shortest_s, machine.period_s
            ):
                kept.append(rows)
        if not kept:
            raise RecordingError(
                f"{path}: no piece of {self.shortest_s:g} s or more without a gap of {self.longest_gap_s:g} s among its "
                f"{len(t_s)} rows; is import.time.scale right?"
            )
        if len(kept) < len(pieces):
            log.warning(
                "%s: %d pieces shorter than %g s left out",
                path,
                len(pieces) - len(kept),
                self.shortest_s,
            )
        found = []
        for p in kept:
            found.append(
                _resample(t_s[p], u[p], q[p], {k: v[p] for k, v in extra.items()}, path, machine)
            )
        return found

    def _commands(
        self, table: "_Table | _NumberTable", column: CommandColumn | TargetColumn, t_s: np.ndarray
    ) -> np.ndarray:
        values = table.numbers(Column(column=column.column, scale=1.0, offset=0.0))
        if isinstance(column, TargetColumn):
            u = column.command(values, t_s)
            # a gap between pieces is no motion of the target
            u[:-1][np.diff(t_s) > self.longest_gap_s] = 0.0
        else:
            u = column.command(values)
        if (row := _find_first(np.abs(u) > 1.0 + self.overrun)) is not None:
            raise RecordingError(
                f"{table.where(row, column.column)}: command {u[row]:g} is beyond full by more than {self.overrun:g}; "
                "mend full_plus, full_minus, neutral or full_speed of the column map, or the log"
            )
        return u.clip(-1.0, 1.0)


@dataclass(frozen=True)
class Cells:
    """The text of a CSV file.

    Attributes:
        header: Names of the columns.
        rows: Cells of each row of data.
        lines: Line of the file that each row ends on, from 1.
    """

    header: list[str]
    rows: list[list[str]]
    lines: list[int]


class _Table:
    """A CSV file whose cells become numbers when asked for."""

    def __init__(self, path: Path, delimiter: str, decimal: str) -> None:
        self._path, self._decimal = path, decimal
        self._cells = _read_cells(path, delimiter)

    def where(self, row: int, column: str) -> str:
        """Return file, line, row and column for a message."""
        return f"{self._path}: line {self._cells.lines[row]} (row {row}), column '{column}'"

    def numbers(self, column: Column, empty: bool = False) -> np.ndarray:
        """Return a column, shape `(T,)`; an empty cell is NaN where `empty` allows it."""
        header = self._cells.header
        if column.column not in header:
            raise RecordingError(
                f"{self._path}: column '{column.column}' is missing; {list_choices(column.column, header)}"
            )
        if header.count(column.column) > 1:
            raise RecordingError(
                f"{self._path}: {header.count(column.column)} columns are named '{column.column}'; rename them"
            )
        at = header.index(column.column)
        values = np.empty(len(self._cells.rows))
        for row, cells in enumerate(self._cells.rows):
            text = cells[at]
            try:
                values[row] = float(text.replace(self._decimal, ".") or ("nan" if empty else ""))
            except ValueError:
                raise RecordingError(
                    f"{self.where(row, column.column)}: '{text}' is not a number"
                ) from None
            if not (empty or np.isfinite(values[row])):
                raise RecordingError(f"{self.where(row, column.column)}: {text} is not a number")
        return column.scale * values + column.offset


class _NumberTable:
    """A log whose columns are numbers already: parquet or MATLAB."""

    def __init__(self, path: Path, columns: dict[str, np.ndarray]) -> None:
        self._path, self._columns = path, columns

    def where(self, row: int, column: str) -> str:
        """Return file, row and column for a message."""
        return f"{self._path}: row {row}, column '{column}'"

    def numbers(self, column: Column, empty: bool = False) -> np.ndarray:
        """Return a column, shape `(T,)`; NaN is refused unless `empty` allows it."""
        if column.column not in self._columns:
            raise RecordingError(
                f"{self._path}: column '{column.column}' is missing or holds no numbers; "
                f"{list_choices(column.column, self._columns)}"
            )
        values = self._columns[column.column]
        if not empty and (row := _find_first(~np.isfinite(values))) is not None:
            raise RecordingError(f"{self.where(row, column.column)}: {values[row]} is not a number")
        return column.scale * values + column.offset


def _open_table(path: Path, delimiter: str, decimal: str) -> _Table | _NumberTable:
    """Open a log by the ending of its name."""
    kind = path.suffix.lower()
    if kind == ".parquet":
        return _NumberTable(path, _read_parquet(path))
    if kind == ".mat":
        return _NumberTable(path, _read_matlab(path))
    return _Table(path, delimiter, decimal)


def _read_parquet(path: Path) -> dict[str, np.ndarray]:
    """Return the columns of numbers by name."""
    try:
        table = pq.read_table(path)
    except (OSError, pa.ArrowException) as error:
        raise RecordingError(f"{path}: cannot be read as parquet ({error})") from error
    found = {}
    for name in table.column_names:
        kind = table[name].type
        if pa.types.is_floating(kind) or pa.types.is_integer(kind):
            found[name] = table[name].to_numpy().astype(float)
    return found


def _read_matlab(path: Path) -> dict[str, np.ndarray]:
    """Return the real vectors of the most frequent length by name."""
    try:
        given = matlab.loadmat(path)
    except (OSError, ValueError, NotImplementedError) as error:
        raise RecordingError(
            f"{path}: cannot be read as a MATLAB file up to version 7 ({error})"
        ) from error
    vectors = {}
    for name, values in given.items():
        is_real = isinstance(values, np.ndarray) and values.dtype.kind in "fiu"
        if is_real and values.size > 1 and values.size == max(values.shape):
            vectors[name] = values.ravel().astype(float)
    sizes = [len(values) for values in vectors.values()]
    length = max(sizes, key=sizes.count, default=0)
    return {name: values for name, values in vectors.items() if len(values) == length}


def _find_first(condition: np.ndarray) -> int | None:
    """Return the first row where `condition` holds, or `None`."""
    rows = np.flatnonzero(condition)
    return int(rows[0]) if len(rows) else None


def _read_cells(path: Path, delimiter: str) -> Cells:
    """Read a CSV file; a last line that a crash may have cut off is left out with a warning."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: no such log") from error
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: not a text file that can be read ({error})") from error
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter)
    try:
        lines = [(reader.line_num, [cell.strip() for cell in cells]) for cells in reader if cells]
    except csv.Error as error:
        raise RecordingError(f"{path}: line {reader.line_num}: not CSV ({error})") from error
    if len(lines) < 2:
        raise RecordingError(
            f"{path}: {max(0, len(lines) - 1)} rows of data below the header; a log has at least 2"
        )
    (_, header), *body = lines
    number, last = body[-1]
    if len(last) < len(header) or not text.endswith(
        ("\n", "\r")
    ):  # a number may be cut off too, and still look like one
        log.warning(
            "%s: the last line, %d, is cut off or lacks its end (%d of %d cells): left out",
            path,
            number,
            len(last),
            len(header),
        )
        body.pop()
    for row, (number, cells) in enumerate(body):
        if len(cells) != len(header):
            raise RecordingError(
                f"{path}: line {number} (row {row}): {len(cells)} cells, the header has {len(header)}"
            )
    return Cells(header, [cells for _, cells in body], [number for number, _ in body])


def _resample(
    t_s: np.ndarray,
    u: np.ndarray,
    q: np.ndarray,
    extra: dict[str, np.ndarray],
    path: Path,
    machine: Machine,
) -> Recording:
    """Return a piece at the machine's rate."""
    ends_s = t_s - t_s[0]
    period_s = np.diff(t_s)
    was = f"{1.0 / np.median(period_s):.1f} Hz, periods of {period_s.min():.3f} to {period_s.max():.3f} s"
    grid_s = np.arange(int(ends_s[-1] / machine.period_s + 1e-6) + 1) * machine.period_s
    newest = np.searchsorted(ends_s, grid_s + 1e-6 * machine.period_s, side="right") - 1
    return Recording(
        machine=machine.name,
        joints=machine.joint_names,
        units=tuple(joint.unit for joint in machine.joints),
        rate_hz=1.0 / machine.period_s,
        t_s=grid_s,
        u=u[newest].astype(np.float32),
        q=np.stack([np.interp(grid_s, ends_s, values) for values in q.T], 1).astype(np.float32),
        extra={
            name: np.interp(grid_s, ends_s, values).astype(np.float32)
            for name, values in extra.items()
        },
        metadata={
            "source": f"log: {path.name}",
            "run": path.stem,
            "fingerprint": record.format_fingerprint(machine),
            "resampled_from": was,
        },
    )
