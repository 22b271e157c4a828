"""Tables for the terminal: one that is wider than the terminal is split, not wrapped."""

from __future__ import annotations

import os

from rich.console import Console
from rich.table import Table

FILE_WIDTH = 120
"""Columns of a printed table where the output is a file or a pipe."""


def print_table(table: Table, num_keys: int = 1) -> None:
    """Print a table; one that is too wide is split into parts that stand below one another.

    Args:
        table: The table.
        num_keys: Leading columns that say what a row is; each part repeats them.
    """
    console = Console()
    if not (console.is_terminal or os.environ.get("COLUMNS")):
        console.width = FILE_WIDTH
    for part in split_table(table, num_keys, console):
        console.print(part)


def split_table(table: Table, num_keys: int, console: Console) -> list[Table]:
    """Return parts of a table, each with the leading columns and as many others as fit."""
    num_columns = len(table.columns)
    parts, first = [], num_keys
    while first < num_columns:
        last = first + 1
        while last < num_columns and _is_narrow(_take(table, num_keys, first, last + 1), console):
            last += 1
        parts.append(_take(table, num_keys, first, last))
        first = last
    return parts or [table]


def _take(table: Table, num_keys: int, first: int, last: int) -> Table:
    """Return a table of the leading columns and those from `first` to before `last`."""
    part = Table(
        title=table.title if first == num_keys else None,
        title_justify=table.title_justify,
        box=table.box,
        padding=table.padding,
        header_style=table.header_style,
        show_header=table.show_header,
    )
    columns = [*table.columns[:num_keys], *table.columns[first:last]]
    for column in columns:
        part.add_column(
            column.header,
            justify=column.justify,
            style=column.style,
            no_wrap=column.no_wrap,
            overflow=column.overflow,
            min_width=column.min_width,
        )
    for cells in zip(*(column.cells for column in columns), strict=True):
        part.add_row(*cells)
    return part


def _is_narrow(table: Table, console: Console) -> bool:
    unlimited = console.options.update(width=10_000)
    return table.__rich_measure__(console, unlimited).maximum <= console.width
