"""Numbers in the cells of a table, whatever these hold: numbers, times, flags, text of them, or lists.

A list in column `positions` becomes the columns `positions[0]`, `positions[1]`, …; a time becomes seconds since
1970, a time of day seconds since midnight. pandas does the reading.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import pandas as pd

NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|[Nn]a[Nn]")
"""A number as text."""
MISSING_WORDS = "nan NaN NAN na NA N/A n/a null NULL None none - --"
MISSING = ("", *MISSING_WORDS.split())
"""Cells without a value."""
FLAGS = {"true": 1.0, "false": 0.0, "on": 1.0, "off": 0.0, "yes": 1.0, "no": 0.0}
ISO_TIME = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d([.,]\d+)?)?(Z|[+-]\d\d:?\d\d)?")
DAY_TIME = re.compile(
    r"\d\d?[./-](\d\d?|[A-Za-z]{3})[./-]\d{4}[T ]+\d\d?:\d\d(:\d\d([.,]\d+)?)?( ?[AaPp][Mm])?"
)
"""Day, month, year and time of day."""
CLOCK_TIME = re.compile(r"\d\d?:\d\d:\d\d([.,]\d+)?|\d\d?:\d\d[.,]\d+|\d+([.,]\d+)? (sec|min|hr)")
"""Time of day, minutes and seconds, or a time with its unit, as MATLAB writes it."""
NUMBER_SIGNS = str.maketrans({"D": "E", "d": "e"} | dict.fromkeys("'’\u00a0=\""))
"""Exponents of Fortran, signs between thousands, and those of a formula of Excel, `="0.5"`."""
CellKind = Literal["number", "time", "list", "flag", "text"]
SAMPLED_CELLS = 50
"""Cells, spread over a column, by which its kind is told."""
Labels = Mapping[str, list[str]]
"""Names of the items of columns of lists."""


def tell_kind(cell: Any, decimal: str) -> CellKind:
    """Return the kind of a cell; an empty cell counts as a number that is missing."""
    text = str(cell)
    if isinstance(cell, np.ndarray) or (text.startswith("[") and text.endswith("]")):
        return "list" if read_items(cell) else "text"
    if any(form.fullmatch(text) for form in (ISO_TIME, DAY_TIME, CLOCK_TIME)):
        return "time"
    if text.lower() in FLAGS:
        return "flag"
    plain = simplify_number(text, decimal)
    is_number = text in MISSING or read_number(plain) is not None
    return "number" if is_number else "text"


def tell_column(cells: Any, decimal: str) -> CellKind:
    """Return the kind of most of the cells of a column, a series of pandas; one of empty cells counts as text."""
    if cells.dtype.kind != "O":
        return "number"
    filled = cells.dropna()
    sample = filled[:: max(1, len(filled) // SAMPLED_CELLS)]
    shown = [cell for cell in sample if str(cell) not in MISSING]
    counts = Counter[CellKind](tell_kind(cell, decimal) for cell in shown)
    return counts.most_common(1)[0][0] if counts else "text"


def convert_frame(frame: Any, decimal: str, labels: Labels) -> dict[str, np.ndarray]:
    """Return the numbers of a frame of pandas by column, each `(T,)`, those of lists item by item.

    A column is of the kind of most of its cells; NaN stands for a cell of another kind, and for a list
    of another length. Columns of text are left out.

    Args:
        frame: The frame.
        decimal: Decimal sign of numbers in text.
        labels: Names of the items of columns of lists; items without, or of another number, are numbered.
    """
    found: dict[str, np.ndarray] = {}
    for name, cells in frame.items():
        kind = tell_column(cells, decimal)
        if kind == "list":
            items = _convert_lists(cells)
            given = labels.get(name, ())
            names = given if len({*given}) == items.shape[1] else range(items.shape[1])
            for label, values in zip(names, items.T, strict=True):
                found[f"{name}[{label}]"] = values
        elif kind != "text":
            found[name] = _convert_cells(cells, kind, decimal)
    return found


def _convert_cells(cells: Any, kind: CellKind, decimal: str) -> np.ndarray:
    """Return cells as numbers, `(T,)`; NaN for what is none."""
    if cells.dtype.kind in "biuf":
        return cells.to_numpy(dtype=float)
    if cells.dtype.kind == "m":
        return cells.dt.total_seconds().to_numpy(dtype=float)
    if cells.dtype.kind == "M":
        return _count_seconds(pd.to_datetime(cells, utc=True))
    texts = cells.astype(object).fillna("").astype(str).str.strip()
    if kind == "flag":
        return texts.str.lower().map(FLAGS).to_numpy(dtype=float)
    if kind == "time":
        return _convert_times(texts)
    plain = texts.map(lambda text: simplify_number(text, decimal))
    numbers: Any = pd.to_numeric(plain, errors="coerce")
    return numbers.to_numpy(dtype=float)


def _convert_lists(cells: Any) -> np.ndarray:
    """Return lists of numbers as `(T, K)`; NaN for another cell."""
    rows = [read_items(cell) for cell in cells]
    length = next((len(items) for items in rows if items), 0)
    found = np.full((len(rows), length), np.nan)
    for row, items in enumerate(rows):
        if len(items) == length:
            found[row] = items
    return found


def _convert_times(texts: Any) -> np.ndarray:
    """Return times as seconds since 1970, without a zone as if it were UTC, or as seconds of the day, `(T,)`."""
    first = next((text for text in texts if text), "")
    texts = texts.str.replace(",", ".", regex=False)
    if CLOCK_TIME.fullmatch(first):
        whole = "00:" + texts if first.count(":") == 1 else texts
        elapsed: Any = pd.to_timedelta(whole, errors="coerce")
        return elapsed.dt.total_seconds().to_numpy(dtype=float)
    form: Any = {"dayfirst": "/" not in first, "format": "mixed"}
    if ISO_TIME.fullmatch(first):
        form = {"format": "ISO8601"}
    return _count_seconds(pd.to_datetime(texts, utc=True, errors="coerce", **form))


def _count_seconds(stamps: Any) -> np.ndarray:
    """Return stamps of UTC as seconds since 1970, `(T,)`."""
    elapsed = stamps - pd.Timestamp(0, tz="UTC")
    return (elapsed / pd.Timedelta(seconds=1)).to_numpy(dtype=float)


def simplify_number(text: str, decimal: str) -> str:
    """Return a number as Python writes it; signs between thousands are told where a decimal sign follows."""
    plain = text.strip().translate(NUMBER_SIGNS)
    other = "," if decimal == "." else "."
    if re.fullmatch(rf"[-+]?\d{{1,3}}(\{other}\d{{3}})+\{decimal}\d+", plain):
        plain = plain.replace(other, "")
    return plain.replace(decimal, ".")


def read_items(cell: Any) -> list[float]:
    """Return the numbers of a list, an array or its text; none for anything else."""
    if isinstance(cell, np.ndarray):
        return cell.tolist() if cell.dtype.kind in "biuf" else []
    inner = str(cell).strip().strip("[]").strip()
    numbers = [read_number(part) for part in re.split(r"\s*,\s*|\s+", inner)]
    return [] if None in numbers else [one for one in numbers if one is not None]


def read_number(value: Any) -> float | None:
    """Return a number, also one that is written as text; `None` for anything else."""
    if isinstance(value, str) and NUMBER.fullmatch(value):
        return float(value)
    is_number = isinstance(value, (int, float, np.number)) and not isinstance(value, bool)
    return float(value) if is_number else None
