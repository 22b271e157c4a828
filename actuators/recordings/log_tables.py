"""Contents of a log: tables of columns, each table on a clock of its own, and arithmetic over columns.

A table is what one source sends: a CSV file, a topic, a message of the bus. The full name of a column
is `<table>:<column>`; a log with one table leaves the first part out.

Arithmetic is text, `target - q`, `0.01 * (a + b)`. Only numbers, names of columns, `+ - * /` and brackets
are taken from it; nothing else of it is compiled. A name with other characters stands in backticks,
`` `Boom Cmd` - `Boom Ms` ``.
"""

from __future__ import annotations

import functools
import logging
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import CodeType
from typing import NoReturn

import numpy as np

from actuators.recordings.guess import advise
from brokk_rl.errors import ConfigError, RecordingError

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Table:
    """Columns of a log that come from one source.

    Attributes:
        columns: Numbers by column, each `(T,)`; NaN for an empty cell.
        units: Units that the log itself states, by column.
        clock: Column whose values are seconds by the reader's own making; `None` without one.
        is_sparse: Rows need not have all columns: messages of one topic, pages of one CAN message.
        find_line: Returns the number of the line of a row, and the text of its cells by column; `None`
            for a file without lines.
    """

    columns: Mapping[str, np.ndarray]
    units: Mapping[str, str] = field(default_factory=dict)
    clock: str | None = None
    is_sparse: bool = False
    find_line: Callable[[int], tuple[int, Mapping[str, str]]] | None = None

    def select(self, rows: np.ndarray) -> Table:
        """Return the table with some of its rows, `(T,)` of truth values."""
        columns = {name: values[rows] for name, values in self.columns.items()}
        return replace(self, columns=columns)

    def locate(self, row: int) -> str:
        """Return the place of a row in its file, for a message."""
        if self.find_line is None:
            return f"row {row}"
        return f"line {self.find_line(row)[0]} (row {row})"

    def show_cell(self, row: int, column: str) -> str:
        """Return the value of a cell as its file has it, for a message; two quotes for an empty one."""
        if self.find_line is None:
            return f"{self.columns[column][row]:g}"
        cells = self.find_line(row)[1]
        cell = cells.get(column) or cells.get(column.rpartition("[")[0], "")  # an item of a list
        return f"'{cell}'"


@dataclass(frozen=True)
class LogRun:
    """One run of a machine as a log has it.

    Attributes:
        name: Name of the run: recordings of a run are never split into fit and test.
        where: File or folder, for messages.
        tables: Tables by name; the only table of a log has the empty name.
    """

    name: str
    where: str
    tables: Mapping[str, Table]

    @functools.cached_property
    def places(self) -> dict[str, tuple[str, str]]:
        """Table and column of each full name; a column of the only table, which has no name, is named alone."""
        found = {}
        for table, content in self.tables.items():
            for column in content.columns:
                found[f"{table}:{column}" if table else column] = (table, column)
        return found

    def refuse(self, text: str) -> NoReturn:
        """Raise a `RecordingError` that names the run."""
        raise RecordingError(f"{self.where}: {text}")


@functools.cache
def warn_once(text: str) -> None:
    """Warn of a damage; a log is read several times, and each time it is met again."""
    log.warning("%s", text)


def name_log(path: Path) -> str:
    """Return the first part of the names of a log's recordings."""
    return path.resolve().name if path.is_dir() else path.stem


class LogFile:
    """A log, which is read whole.

    Attributes:
        path: The log.
        keep_whole: Damaged parts are left out with a warning; otherwise a log with damage is refused.
    """

    def __init__(self, path: Path, keep_whole: bool = False) -> None:
        self.path = path
        self.keep_whole = keep_whole

    def refuse(self, text: str, error: Exception | None = None) -> NoReturn:
        """Raise a `RecordingError` that names the log; `error`: what a library raised."""
        raise RecordingError(f"{self.path}: {text}") from error

    def report_damage(self, text: str, error: Exception | None) -> None:
        """Raise a `RecordingError` for a damaged part, or warn that it is left out.

        Args:
            text: Place and kind of the damage.
            error: What a library raised.
        """
        if not self.keep_whole:
            self.refuse(f"{text}; {advise('damaged')}", error)
        warn_once(f"{self.path}: {text}: left out")

    def read_runs(self, max_rows: int | None) -> Iterator[LogRun]:
        """Yield each run; a log is one run unless its reader says otherwise.

        Args:
            max_rows: Rows of each table after which reading may stop; `None` for all.

        Raises:
            RecordingError: The log is damaged; names the place.
        """
        yield LogRun(name_log(self.path), str(self.path), self.read_tables(max_rows))

    def read_tables(self, max_rows: int | None) -> dict[str, Table]:
        """Return the tables of a log that is one run; see `read_runs`."""
        raise NotImplementedError


LONGEST = 1000
"""Characters of an expression; a longer one is no formula of a person, and parsing recurses."""
TOKEN = re.compile(
    r"(?P<number>(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?)|`(?P<quoted>[^`]*)`|(?P<sign>[-+*/()])|\s+"
    r"|(?P<name>[^\W\d]\w*(\.[^\W\d]\w*|\[\w+\])*)"
)
"""Part of an expression: `header.stamp` and `positions[2]` are names."""
CALL = re.compile(r"[\w)] +\(")
"""A bracket that an operator should precede."""


@dataclass(frozen=True)
class Expression:
    """A parsed expression.

    Attributes:
        names: Columns that it needs, in order of their first use.
    """

    names: tuple[str, ...]
    _code: CodeType

    def evaluate(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the value, `(T,)`, for columns of one clock, each `(T,)`.

        A division by zero gives an infinite value or NaN, which the reader of a log refuses.
        """
        values = {f"_{at}": np.asarray(columns[name]) for at, name in enumerate(self.names)}
        with np.errstate(all="ignore"):
            return np.asarray(eval(self._code, {"__builtins__": {}}, values), dtype=float)


@functools.lru_cache
def parse_expression(text: str) -> Expression:
    """Parse an expression.

    Raises:
        ConfigError: It holds anything but numbers, columns, `+ - * /` and brackets.
    """
    names: dict[str, str] = {}
    parts = []
    for token in TOKEN.finditer(text):
        name = token["name"] if token["quoted"] is None else token["quoted"]
        if name is not None:
            parts.append(names.setdefault(name, f"_{len(names)}"))
        else:
            parts.append(token["number"] or token["sign"] or "")
    plain = " ".join(part for part in parts if part)
    is_arithmetic = not TOKEN.sub("", text) and not CALL.search(plain)
    try:
        if not names or not is_arithmetic or len(text) > LONGEST:
            raise ValueError("it is none")
        code = compile(plain, "<expression>", "eval")
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise ConfigError(
            f"expression '{text[:80]}': expected numbers, columns, + - * / and brackets of at most {LONGEST} signs; "
            f"names with other signs in backticks ({error})"
        ) from error
    return Expression(tuple(names), code)
