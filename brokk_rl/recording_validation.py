"""The rules of the recording format, and every place where a file breaks one.

Reading stops at the first breach; inspecting a recording lists them all. Rows count from 0; `T` is
time.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from brokk_rl.errors import list_choices

SCHEMA = "1"
RATE_TOLERANCE = 0.2
"""Largest relative deviation of a period from the stated rate."""
COMMAND_TOLERANCE = 1e-6
"""Rounding of float32 that is still no command outside [-1, 1]."""


@dataclass(frozen=True)
class Breach:
    """A place where a recording breaks a rule.

    Attributes:
        text: What was expected and what is there.
        column: Column concerned, `None` where it is the file as a whole.
        row: First row concerned, `None` where it is the column or the file as a whole.
        num_rows: Number of rows on end that break the same rule.
    """

    text: str
    column: str | None = None
    row: int | None = None
    num_rows: int = 1

    def __str__(self) -> str:
        where = "" if self.row is None else f"row {self.row}, column '{self.column}': "
        more = f" ({self.num_rows} such rows on end)" if self.num_rows > 1 else ""
        return f"{where}{self.text}{more}"


def of_metadata(metadata: Mapping[str, str], machine: str) -> Iterator[Breach]:
    """Yields what is wrong with the metadata (without the prefix `brokk.`) of a recording made on the machine of that name."""
    for key in ("schema", "machine", "rate_hz"):
        if key not in metadata:
            yield Breach(
                f"metadata 'brokk.{key}' is missing; not a recording, or one made by another program"
            )
    if metadata.get("schema", SCHEMA) != SCHEMA:
        yield Breach(f"brokk.schema is '{metadata['schema']}', this version reads '{SCHEMA}'")
    if metadata.get("machine", machine) != machine:
        yield Breach(
            f"unknown machine '{metadata['machine']}', expected '{machine}'; choose it with machine=…"
        )
    if "rate_hz" in metadata and rate_hz(metadata) is None:
        yield Breach(f"brokk.rate_hz is '{metadata['rate_hz']}', expected a positive number")


def rate_hz(metadata: Mapping[str, str]) -> float | None:
    """Returns the stated rate, `None` where there is none or none that makes sense."""
    try:
        rate = float(metadata.get("rate_hz", ""))
    except ValueError:
        return None
    return rate if 0.0 < rate < float("inf") else None


def of_names(required: Sequence[str], present: Sequence[str]) -> Iterator[Breach]:
    """Yields the columns that are missing."""
    for name in required:
        if name not in present:
            yield Breach(f"column '{name}' is missing; {list_choices(name, present)}", name)


def of_columns(
    columns: Mapping[str, np.ndarray], required: Sequence[str], stated_hz: float
) -> Iterator[Breach]:
    """Yields what is wrong with the numbers.

    In an optional column NaN means "not measured"; everywhere else it is a breach.

    Args:
        columns: By name, each `(T,)`; missing ones are left out.
        required: Names of the columns that every recording has: time, commands, positions.
        stated_hz: Rate that the file states.
    """
    num_samples = max(map(len, columns.values()), default=0)
    if num_samples < 2:
        yield Breach(f"{num_samples} rows; a recording has at least 2")
    for name, values in columns.items():
        if len(values) != num_samples:
            yield Breach(f"column '{name}' has {len(values)} rows, others have {num_samples}", name)
        if name in required:
            for row, count in runs(~np.isfinite(values)):
                yield Breach(f"{values[row]} is not a number", name, row, count)
    for name, values in columns.items():
        if name.startswith("u_") and name in required:
            for row, count in runs(np.abs(values) > 1.0 + COMMAND_TOLERANCE):
                yield Breach(f"command {values[row]:g} lies outside [-1, 1]", name, row, count)
    if "t_s" in columns:
        yield from _of_time(columns["t_s"], stated_hz)


def _of_time(t_s: np.ndarray, stated_hz: float) -> Iterator[Breach]:
    period_s = np.diff(t_s)
    for row, count in runs(period_s <= 0):
        yield Breach(
            f"time does not increase ({t_s[row]:g} s, then {t_s[row + 1]:g} s)",
            "t_s",
            row + 1,
            count,
        )
    for row, count in runs((np.abs(period_s * stated_hz - 1.0) > RATE_TOLERANCE) & (period_s > 0)):
        text = (
            f"{period_s[row]:g} s after the row before, but brokk.rate_hz = {stated_hz:g} means {1.0 / stated_hz:g} s "
            f"({RATE_TOLERANCE:.0%} are allowed); split the recording at the gap or state its rate"
        )
        yield Breach(text, "t_s", row + 1, count)


def runs(condition: np.ndarray) -> list[tuple[int, int]]:
    """Returns first row and length of each stretch of rows on end where `condition`, `(T,)`, holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], condition, [False]]).astype(np.int8)))
    return [(int(begin), int(end - begin)) for begin, end in edges.reshape(-1, 2)]
