"""CSV logs: numbers, ISO 8601 times and lists of numbers in their cells.

A list in column `positions` becomes the columns `positions[0]`, `positions[1]`, …; a time becomes
seconds since 1970. The file is read in blocks. Only where a block is refused it is read again, line
by line, to find the place.
"""

from __future__ import annotations

import csv
import logging
import re
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
from pyarrow import compute
from pyarrow import csv as arrow_csv

from actuators.recordings.log_tables import LogFile, LogRun, StoredColumns, Table
from brokk_rl.errors import RecordingError

log = logging.getLogger(__name__)

pc: Any = compute
"""Its functions are made when it is imported, so a type checker does not know them."""

BLOCK_BYTES = 8 << 20
"""Bytes of text that are turned into numbers at once."""
LONGEST_LINE_BYTES = 1 << 20
"""Bytes at the end of a file in which its last line is looked for."""
SNIFFED_BYTES = 1 << 16
"""Bytes from the beginning of a file by which its delimiter is told."""
ISO_TIME = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d([.,]\d+)?)?(Z|[+-]\d\d:?\d\d)?")
ITEM = re.compile(r"(.*)\[([^\]]*)\]")
"""Name of an item of a list: column and label."""

csv.field_size_limit(1 << 24)  # a cell may hold a long list

CellKind = Literal["number", "time", "list", "text"]


@dataclass(frozen=True)
class CsvLayout:
    """Signs between and within the cells of a CSV file.

    Attributes:
        delimiter: Between the cells of a line.
        decimal: Decimal sign of the numbers.
    """

    delimiter: str
    decimal: str


@dataclass(frozen=True)
class CsvTable(Table):
    """Columns of a CSV file, whose lines are found again when a message names one."""

    path: Path
    delimiter: str

    def locate(self, row: int) -> str:
        """Return line and row."""
        return f"line {_find_row(self.path, self.delimiter, row)[0]} (row {row})"

    def show_cell(self, row: int, column: str) -> str:
        """Return the text of a cell, two quotes for an empty one."""
        header = _read_header(self.path, self.delimiter)
        cells = _find_row(self.path, self.delimiter, row)[1]
        indexed = ITEM.fullmatch(column)
        name = column if column in header or indexed is None else indexed[1]
        return cells[header.index(name)] or "''"


@contextmanager
def _hide_bad_text() -> Iterator[None]:
    """Hide the traceback of a bad line that is no text: pyarrow prints it before its own error."""
    before = sys.unraisablehook

    def hide(found: sys.UnraisableHookArgs) -> None:
        if found.exc_type is not UnicodeDecodeError:
            before(found)

    sys.unraisablehook = hide
    try:
        yield
    finally:
        sys.unraisablehook = before


class CsvLog(LogFile):
    """A CSV file as a log with one table."""

    def __init__(
        self, path: Path, layout: CsvLayout | None = None, labels: Sequence[str] = ()
    ) -> None:
        """Open a CSV file.

        Args:
            path: The file.
            layout: Its signs; `None` to tell them from its beginning.
            labels: Names for the items of lists of this length, instead of numbers.
        """
        super().__init__(path)
        self._labels = labels
        self._layout = layout or detect_layout(path)
        self._header = _read_header(path, self._layout.delimiter)
        self._first = _find_row(path, self._layout.delimiter, 0)[1]

    @property
    def layout(self) -> CsvLayout:
        """Signs of the file, as given or as told from its beginning."""
        return self._layout

    def list_tables(self) -> dict[str, list[str]]:
        """Return the columns whose first cell is a number, a time or a list."""
        found: list[str] = []
        for name, text in zip(self._header, self._first, strict=False):
            kind = tell_kind(text, self._layout.decimal)
            if kind == "list":
                found += [f"{name}[{label}]" for label in self._label_items(text)]
            elif name and kind != "text":
                found.append(name)
        return {"": found}

    def read_runs(
        self, wanted: Mapping[str, Collection[str]], max_rows: int | None
    ) -> Iterator[LogRun]:
        """Yield the file as one run; a last line that a crash cut off is left out with a warning.

        Raises:
            RecordingError: A cell cannot be read, or the file is damaged; names line and column.
        """
        cells: dict[str, list[str]] = {}
        for name in wanted.get("", ()):
            if name in self._header:
                cells.setdefault(name, []).append(name)
            elif (indexed := ITEM.fullmatch(name)) and indexed[1] in self._header:
                cells.setdefault(indexed[1], []).append(name)
        for column in cells:
            if self._header.count(column) > 1:
                raise RecordingError(
                    f"{self.path}: {self._header.count(column)} columns are named '{column}'; rename them"
                )
        columns = self._read(cells, max_rows)
        table = CsvTable(columns, self.path, self._layout.delimiter)
        yield LogRun(self.path.stem, str(self.path), {"": table})

    @_hide_bad_text()
    def _read(self, wanted: dict[str, list[str]], max_rows: int | None) -> StoredColumns:
        columns = StoredColumns(name for several in wanted.values() for name in several)
        skipped: list[int] = []
        row = 0
        try:
            for batch in self._open(list(wanted), skipped):
                for at, (column, several) in enumerate(wanted.items()):
                    numbers = self._convert(batch.column(at), column, row)
                    for name in several:
                        columns.add(name, self._pick(numbers, name, column))
                row += batch.num_rows
                if max_rows is not None and row >= max_rows:
                    break
        except (pa.ArrowInvalid, OSError) as error:
            self._refuse(error)
        if max_rows is not None and row >= max_rows:
            return columns
        self._drop_cut_line(columns, row, len(skipped))
        return columns

    def _open(self, columns: list[str], skipped: list[int]) -> Iterator[pa.RecordBatch]:
        """Yield blocks of the wanted columns as text."""
        lines = _count_header_lines(self.path, self._layout.delimiter)
        names = [f"{at}:{name}" for at, name in enumerate(self._header)]

        def note_bad_row(_row: arrow_csv.InvalidRow) -> str:
            skipped.append(1)
            return "skip"

        reader = arrow_csv.open_csv(
            self.path,
            arrow_csv.ReadOptions(
                use_threads=False, block_size=BLOCK_BYTES, skip_rows=lines, column_names=names
            ),
            arrow_csv.ParseOptions(
                delimiter=self._layout.delimiter,
                newlines_in_values=True,
                invalid_row_handler=note_bad_row,
            ),
            arrow_csv.ConvertOptions(
                include_columns=[names[self._header.index(name)] for name in columns],
                column_types=dict.fromkeys(names, pa.string()),
                strings_can_be_null=False,
            ),
        )
        yield from reader

    def _convert(self, cells: pa.StringArray, column: str, first_row: int) -> np.ndarray:
        """Return the numbers of a block, `(T,)`, or `(T, K)` for lists."""
        cells = pc.utf8_trim_whitespace(cells)
        first = self._first[self._header.index(column)]
        kind = tell_kind(first, self._layout.decimal)
        try:
            if kind == "list":
                return _convert_lists(cells, len(_split_list(first)))
            if kind == "time":
                return _convert_times(cells)
            return _convert_numbers(cells, self._layout.decimal)
        except (pa.ArrowInvalid, ValueError):
            row, text = self._find_bad_cell(cells, kind, first)
        place = _find_row(self.path, self._layout.delimiter, first_row + row)[0]
        what = {"list": f"a list of {len(_split_list(first))} numbers", "time": "an ISO time"}
        raise RecordingError(
            f"{self.path}: line {place} (row {first_row + row}), column '{column}': '{text}' is not "
            f"{what.get(kind, 'a number')}"
        )

    def _pick(self, numbers: np.ndarray, name: str, column: str) -> np.ndarray:
        """Return the numbers of column `name`, `(T,)`, of a block."""
        if numbers.ndim == 1:
            return numbers
        labels = self._label_items(self._first[self._header.index(column)])
        return numbers[:, labels.index(name.removeprefix(f"{column}[").removesuffix("]"))]

    def _label_items(self, text: str) -> list[str]:
        """Return the names of the items of a list."""
        length = len(_split_list(text))
        return [*self._labels] if len(self._labels) == length else [str(i) for i in range(length)]

    def _find_bad_cell(self, cells: pa.StringArray, kind: CellKind, first: str) -> tuple[int, str]:
        for row, cell in enumerate(cells):
            one = cells.slice(row, 1)
            try:
                if kind == "list":
                    _convert_lists(one, len(_split_list(first)))
                elif kind == "time":
                    _convert_times(one)
                else:
                    _convert_numbers(one, self._layout.decimal)
            except (pa.ArrowInvalid, ValueError):
                return row, cell.as_py()
        raise AssertionError("a block was refused, but none of its cells")

    def _drop_cut_line(self, columns: StoredColumns, num_rows: int, num_skipped: int) -> None:
        """Leave out a last line that is cut off; refuse other bad lines."""
        line, cells, is_ended = _read_last_line(self.path, self._layout.delimiter)
        is_cut = len(cells) < len(self._header)
        if num_skipped > int(is_cut):
            self._refuse(None)
        # a number may be cut off too, and still look like one
        if is_cut or not is_ended:
            log.warning(
                "%s: the last line, %d, is cut off or lacks its end (%d of %d cells): left out",
                self.path, line, len(cells), len(self._header),
            )  # fmt: skip
            num_rows -= int(not is_cut)  # the cut one has been skipped
            columns.cut(num_rows)
        if num_rows < 2:
            raise RecordingError(
                f"{self.path}: {num_rows} rows of data below the header; a log has at least 2"
            )

    def _refuse(self, error: Exception | None) -> None:
        """Find the line that cannot be read, and raise."""
        for row, (line, cells) in enumerate(_scan(self.path, self._layout.delimiter)):
            if len(cells) != len(self._header):
                raise RecordingError(
                    f"{self.path}: line {line} (row {row - 1}): {len(cells)} cells, the header has "
                    f"{len(self._header)}"
                ) from error
        raise RecordingError(f"{self.path}: not CSV ({error})") from error


def detect_layout(path: Path) -> CsvLayout:
    """Return delimiter and decimal sign, found from the beginning of a file.

    The delimiter is the sign that cuts all lines into the same number of cells, the most if several
    do.

    Raises:
        RecordingError: The file cannot be read, or no sign does.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = file.read(SNIFFED_BYTES).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: not a text file that can be read ({error})") from error
    lines = [line for line in lines if line.strip()][:50]
    best, most = ",", 1
    for delimiter in (",", ";", "\t", " "):
        counts = [len(cells) for cells in csv.reader(lines[:-1] or lines, delimiter=delimiter)]
        if counts and len(set(counts)) == 1 and counts[0] > most:
            best, most = delimiter, counts[0]
    if most == 1 and any(sign in line for line in lines for sign in ";\t,"):
        raise RecordingError(
            f"{path}: no delimiter of , ; tab and space cuts its first lines into as many cells as its header"
        )
    comma = re.compile(r"-?\d+,\d+")
    cells = [cell for row in csv.reader(lines[1:], delimiter=best) for cell in row]
    return CsvLayout(best, "," if best != "," and any(map(comma.fullmatch, cells)) else ".")


def tell_kind(text: str, decimal: str) -> CellKind:
    """Return the kind of a cell; an empty cell counts as a number that is missing."""
    if text.startswith("[") and text.endswith("]"):
        try:
            [float(part) for part in _split_list(text)]
        except ValueError:
            return "text"
        return "list"
    if ISO_TIME.fullmatch(text):
        return "time"
    try:
        float(text.replace(decimal, ".") or "nan")
    except ValueError:
        return "text"
    return "number"


def _split_list(text: str) -> list[str]:
    inner = text.strip("[]")
    return re.split(r"\s*,\s*|\s+", inner.strip()) if inner.strip() else []


def _convert_numbers(cells: pa.StringArray, decimal: str) -> np.ndarray:
    """Return the numbers of cells, `(T,)`; NaN for an empty cell."""
    if decimal != ".":
        cells = pc.replace_substring(cells, decimal, ".")
    cells = pc.if_else(pc.equal(cells, ""), pa.scalar("nan"), cells)
    return pc.cast(cells, pa.float64()).to_numpy(zero_copy_only=False)


def _convert_times(cells: pa.StringArray) -> np.ndarray:
    """Return seconds since 1970, `(T,)`; without a zone, as if it were UTC."""
    cells = pc.replace_substring(pc.if_else(pc.equal(cells, ""), None, cells), ",", ".")
    zoned = pc.any(pc.match_substring_regex(cells, r"(Z|[+-]\d\d:?\d\d)$")).as_py()
    kind = pa.timestamp("ns", "UTC" if zoned else None)
    nanoseconds = pc.cast(pc.cast(cells, kind), pa.int64())
    return nanoseconds.to_numpy(zero_copy_only=False).astype(np.float64) / 1e9


def _convert_lists(cells: pa.StringArray, length: int) -> np.ndarray:
    """Return the numbers of lists, `(T, K)`.

    Raises:
        ValueError: A list has another length.
    """
    inner = pc.utf8_trim_whitespace(pc.utf8_trim(cells, "[]"))
    parts = pc.split_pattern_regex(inner, r"\s*,\s*|\s+")
    if not pc.all(pc.equal(pc.list_value_length(parts), length)).as_py():
        raise ValueError("lists of different lengths")
    numbers = pc.cast(parts.flatten(), pa.float64()).to_numpy(zero_copy_only=False)
    return numbers.reshape(-1, length)


def _scan(path: Path, delimiter: str) -> Iterator[tuple[int, list[str]]]:
    """Yield line and cells of each row, the header first."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, delimiter=delimiter)
            try:
                for cells in reader:
                    if cells:
                        yield reader.line_num, [cell.strip() for cell in cells]
            except csv.Error as error:
                raise RecordingError(
                    f"{path}: line {reader.line_num}: not CSV ({error})"
                ) from error
            except UnicodeDecodeError as error:  # text is decoded some lines ahead
                raise RecordingError(
                    f"{path}: after line {reader.line_num}: not text in UTF-8 ({error.reason})"
                ) from error
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: no such log") from error
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: not a text file that can be read ({error})") from error


def _find_row(path: Path, delimiter: str, row: int) -> tuple[int, list[str]]:
    """Return line and cells of a row of data."""
    found = next(islice(_scan(path, delimiter), row + 1, None), None)
    if found is None:
        raise RecordingError(f"{path}: 0 rows of data below the header; a log has at least 2")
    return found


def _read_last_line(path: Path, delimiter: str) -> tuple[int, list[str], bool]:
    """Return number and cells of the last line that is not empty, and whether it has its end."""
    count, size = 0, path.stat().st_size
    with path.open("rb") as file:
        while block := file.read(BLOCK_BYTES):
            count += block.count(b"\n")
        file.seek(-min(size, LONGEST_LINE_BYTES), 2)
        tail = file.read().decode("utf-8", errors="replace")
    is_ended = tail.endswith(("\n", "\r"))
    lines = tail.splitlines()
    num_empty = 0
    while lines and not lines[-1].strip():
        lines.pop()
        num_empty += 1
    cells = next(csv.reader(lines[-1:], delimiter=delimiter), [])
    return count + int(not is_ended) - num_empty, cells, is_ended


def _read_header(path: Path, delimiter: str) -> list[str]:
    return next(_scan(path, delimiter), (0, [""]))[1]


def _count_header_lines(path: Path, delimiter: str) -> int:
    return next(_scan(path, delimiter), (0, [""]))[0]
