"""Text logs: numbers, times and lists of numbers in rows, with or without a header.

The layout is told from the numbers: the rows of data are those that one delimiter cuts into equally
many numbers; the header is the last line of names before them, comments and a row of units aside. pandas
does the reading.
"""

from __future__ import annotations

import csv
import functools
import itertools
import logging
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import pandas as pd

from actuators.recordings.cells import MISSING, convert_frame, tell_kind
from actuators.recordings.log_tables import LogFile, Table
from actuators.recordings.name_evidence import is_unit

log = logging.getLogger(__name__)

SNIFFED_BYTES = 1 << 16
"""Bytes at the beginning of a file by which its layout is told."""
DELIMITERS = (",", ";", "\t", " ", "|")
COMMENT_MARKS = "#%;/!*"
"""Signs that begin a line of comment."""
FIRST_ROWS = 3
"""Rows on end from which data begin; a block of describing lines may hold some numbers too."""

COMMA_ADVICE = "; if the comma is both delimiter and decimal sign, export with a decimal point, or ; or tab between cells"
csv.field_size_limit(1 << 24)  # a cell may hold a long list


Signs = tuple[str, str] | None
"""Delimiter and decimal sign of a text file, where they are known."""


class CsvFolderLog(LogFile):
    """A folder with the CSV files of one run, each on its clock."""

    def read_tables(self, max_rows: int | None) -> dict[str, Table]:
        """Return the rows of each file."""
        logs = [TextLog(path, None, self.keep_whole) for path in sorted(self.path.glob("*.csv"))]
        return {one.path.stem: one.read_tables(max_rows)[""] for one in logs}


class TextLog(LogFile):
    """A text file as a log with one table; its layout is told from its beginning.

    Args:
        path: The file.
        signs: Its delimiter and decimal sign; `None` to tell them.
        keep_whole: As of a `LogFile`.

    Attributes:
        signs: Delimiter between the cells of a line, a space for any white space, and decimal sign.

    Raises:
        RecordingError: The file cannot be read, has no rows of numbers, or its header does not fit them.
    """

    def __init__(self, path: Path, signs: Signs = None, keep_whole: bool = False) -> None:
        super().__init__(path, keep_whole)
        head, self._encoding = self._read_head()
        # Excel writes the delimiter into a line of its own; quotes hold 0,5 between commas
        stated = re.match(r'"?sep=(.)"?\s*$', head[0]) if head else None
        pairs = itertools.product((stated[1],) if stated else DELIMITERS, ".,")
        candidates = []
        for delimiter, decimal in [signs] if signs else pairs:
            rows = [split_line(line, delimiter) for line in head]
            good = [at for at, row in enumerate(rows) if _is_data(row, decimal)]
            if not good:
                continue
            width = Counter(len(rows[at]) for at in good).most_common(1)[0][0]
            fitting = {at: rows[at] for at in good if len(rows[at]) == width}
            samples = [*fitting.values()]
            cells = itertools.chain.from_iterable(samples)
            score = sum(
                cell not in MISSING and tell_kind(cell, decimal) != "text" for cell in cells
            )
            begins = [at for at in fitting if all(at + k in fitting for k in range(FIRST_ROWS))]
            first = min(begins or fitting)
            candidates.append((score, (delimiter, decimal), first, samples))
        if not candidates:
            self._refuse_head(head)
        _, self.signs, self._first_line, samples = max(candidates, key=lambda one: one[0])
        names = self._find_names(head[: self._first_line], samples)
        self._names = _tell_apart(names)

    def _read_head(self) -> tuple[list[str], str]:
        """Return whole lines at the beginning of the file, and its encoding."""
        try:
            with self.path.open("rb") as file:
                head = file.read(SNIFFED_BYTES)
                is_all = not file.read(1)
        except OSError as error:
            self.refuse(f"cannot be read as text ({error})", error)
        encoding = "utf-16" if head[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
        try:
            text = head.decode(encoding, errors="strict" if is_all else "ignore")
        except UnicodeDecodeError:
            encoding = "cp1252"
            text = head.decode(encoding, errors="replace")
        if "\0" in text:
            self.refuse("neither text nor a kind of log that is known by its ending (bytes of 0)")
        lines = text.splitlines()
        return lines if is_all else lines[:-1], encoding

    def _refuse_head(self, head: list[str]) -> NoReturn:
        """Refuse a file without rows of numbers; `head`: its first lines."""
        filled = [line for line in head if line.strip()]
        if len(filled) < 2:
            self.refuse("0 rows of data below the header; a log has at least 2")
        expected = "expected rows of numbers between , ; tab, space or |"
        begin = f"the file begins with '{filled[0][:60]}'"
        self.refuse(f"no column of numbers can be read: {expected}, {begin}")

    def _find_names(self, above: list[str], samples: list[list[str]]) -> list[str]:
        """Return the names of the columns from the lines above the data, with their units."""
        delimiter, width = self.signs[0], len(samples[0])
        is_padded = all(row[-1] == "" for row in samples)
        units: list[str] = []
        filled = [line for line in above if line.strip()]
        for line in reversed(filled):
            mark = line.lstrip()[0]
            is_comment = mark in COMMENT_MARKS
            plain = line.lstrip().lstrip(COMMENT_MARKS) if is_comment else line
            cells = split_line(plain, delimiter)
            if len(cells) == 1 and delimiter == " ":
                cells = split_line(plain, ",")
            if len(cells) == width - 1 and is_padded:
                cells.append("")
            if len(cells) == width + 1 and cells[-1] == "Comment":  # LabVIEW leaves empty ones out
                cells.pop()
            if len(cells) != width:
                is_near = (
                    line is filled[-1] and not is_comment and width <= 2 * len(cells) <= 4 * width
                )
                if is_near and len(cells) > 1:
                    counts = f"{len(cells)} cells, the rows below it have {width}"
                    mend = f"mend the header, or the delimiter '{delimiter}'"
                    mend += COMMA_ADVICE if delimiter == "," else ""
                    self.refuse(f"the header has {counts}: '{line.strip()[:80]}'; {mend}")
                continue
            if not units and all(cell in MISSING or is_unit(cell) for cell in cells):
                units = [cell.strip("[](){}") for cell in cells]
                continue
            if not units:
                return cells
            pairs = zip(cells, units, strict=True)
            return [f"{name} [{unit}]" if unit not in MISSING else name for name, unit in pairs]
        return [f"column_{at + 1}" for at in range(width)]

    def read_tables(self, max_rows: int | None) -> dict[str, Table]:
        """Return the rows of the file with all columns of numbers, times, flags and lists.

        NaN stands for a cell that is none of them. A last line that a crash cut off is left out with a warning.

        Raises:
            RecordingError: The file is damaged; names the line.
        """
        columns = convert_frame(self._read_frame(max_rows), self.signs[1], {})
        return {"": Table(columns, find_line=self.find_line)}

    def find_line(self, row: int) -> tuple[int, dict[str, str]]:
        """Return number, from 1, and cells by column of the line of a row of data."""
        number, cells, _ = next(itertools.islice(self._iterate_lines(), row, None))
        return number, dict(zip(self._names, cells, strict=False))  # a damaged line may have fewer

    def _iterate_lines(self) -> Iterator[tuple[int, list[str], bool]]:
        """Yield number, from 1, and cells of each line of data, and whether the line has its end."""
        with self.path.open(encoding=self._encoding, errors="replace") as file:
            for number, line in enumerate(file, 1):
                if number > self._first_line and line.strip():
                    cells = split_line(line, self.signs[0])
                    yield number, cells, line.endswith("\n")

    def _read_frame(self, max_rows: int | None) -> Any:
        """Return the cells of all columns that have a name; numbers are numbers already where all of them are."""
        (delimiter, decimal), width = self.signs, len(self._names)
        read = functools.partial(
            pd.read_csv,
            self.path,
            sep=r"\s+" if delimiter == " " else delimiter,
            decimal=decimal,
            header=None,
            names=range(width),
            na_values=MISSING,
            keep_default_na=False,
            encoding=self._encoding,
            skiprows=self._first_line,
            low_memory=False,
            skipinitialspace=True,
            nrows=max_rows,
            index_col=False,
        )
        frame: Any
        try:
            frame = read(on_bad_lines="error")
        except pd.errors.ParserError as error:
            self._report_bad_line(width, error)
            frame = read(on_bad_lines="skip")
        except (OSError, ValueError) as error:
            self.refuse(f"cannot be read as text ({error})", error)
        if (max_rows is None or len(frame) < max_rows) and self._is_cut_off(width):
            frame = frame.iloc[:-1]
        if len(frame) < 2:
            self.refuse(f"{len(frame)} rows of data below the header; a log has at least 2")
        if frame[width - 1].isna().any() and self._names[-1]:
            self._report_bad_line(width, None)
        named = {at: name for at, name in enumerate(self._names) if name}
        return frame[[*named]].rename(columns=named)

    def _report_bad_line(self, width: int, error: Exception | None) -> None:
        """Report the first line that has another number of cells than the others."""
        for row, (number, cells, is_whole) in enumerate(self._iterate_lines()):
            if len(cells) != width and is_whole:
                text = f"{len(cells)} cells, the header has {len(self._names)}"
                self.report_damage(f"line {number} (row {row}): {text}", error)
                return

    def _is_cut_off(self, width: int) -> bool:
        """Return whether a crash cut off the last line, and warn: a number may be cut off too, and still look like one."""
        with self.path.open("rb") as file:
            file.seek(-min(self.path.stat().st_size, SNIFFED_BYTES), 2)
            tail = file.read().decode(self._encoding, errors="replace")
        cells = split_line((tail.splitlines() or [""])[-1], self.signs[0])
        if len(cells) >= width and tail.endswith(("\n", "\r")):
            return False
        text = f"is cut off or lacks its end ({len(cells)} of {width} cells): left out"
        log.warning("%s: the last line %s", self.path, text)
        return True


def _is_data(row: list[str], decimal: str) -> bool:
    """Return whether most of the cells of a row are numbers, times or lists."""
    filled = [cell for cell in row if cell not in MISSING]
    values = [cell for cell in filled if tell_kind(cell, decimal) not in ("text", "flag")]
    return bool(values) and 2 * len(values) > len(filled) and len(row) > 1


def _tell_apart(names: list[str]) -> tuple[str, ...]:
    """Return names of which none repeats."""
    counts, seen, found = Counter(names), Counter[str](), []
    for name in names:
        seen[name] += 1
        found.append(f"{name}#{seen[name]}" if name and counts[name] > 1 else name)
    return tuple(found)


def split_line(line: str, delimiter: str) -> list[str]:
    """Return the cells of a line."""
    if delimiter == " ":
        return line.split()
    cells = next(csv.reader([line.strip("\r\n")], delimiter=delimiter, skipinitialspace=True), [])
    return [cell.strip() for cell in cells]
