"""Tables and lines of text for the terminal: the one place that decides how results look there."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

MISSING = "–"
"""Text of a missing value."""
NUMBER = re.compile(r"\s*[<>±≈]?\s*[-+−]?\d")
"""Start of a text that counts as a number."""
UNBOUNDED = 10_000
"""Columns of a file or a pipe, where a table has its natural width."""
LONGEST_WORD = 20
"""Characters of the longest word that is never broken: numbers are shorter, paths are not."""

TableCell = str | float | Text | None
"""Text, a number, text with a style, or `None` for a missing value."""


def print_table(
    headings: Sequence[str], rows: Iterable[Sequence[TableCell]], title: str | None = None
) -> None:
    """Print one whole table to stdout.

    A table that is wider than the terminal wraps its cells between words. In a file or a pipe it is as wide as
    its cells ask for.

    Args:
        headings: Heading of each column; empty for a table without headings.
        rows: One cell a column; the first cell says what the row is. Columns of numbers are
            aligned at the right.
        title: Text above the table.
    """
    texts = [[_format_cell(cell) for cell in row] for row in rows]
    table = Table(
        title=None if title is None else Text(title),
        title_justify="left",
        box=None,
        padding=(0, 2, 0, 0),
        show_header=bool(headings),
    )
    num_columns = len(headings) or max(map(len, texts), default=0)
    for column in range(num_columns):
        heading = Text(headings[column] if headings else "")
        cells = [row[column].plain for row in texts]
        given = [cell for cell in cells if cell not in (MISSING, "")]
        is_right = column > 0 and bool(given) and all(map(NUMBER.match, given))
        table.add_column(
            heading,
            justify="right" if is_right else "left",
            overflow="fold",
            min_width=min(LONGEST_WORD, max(map(len, " ".join(cells).split()), default=0)),
        )
    for row in texts:
        table.add_row(*row)
    console = Console()
    if not console.is_terminal:
        console.width = UNBOUNDED
    console.print(table)


def print_text(text: str, style: str = "") -> None:
    """Print a line of text to stdout as it is: not wrapped, nothing in it taken as markup."""
    Console().print(text, style=style, markup=False, highlight=False, soft_wrap=True)


def _format_cell(cell: TableCell) -> Text:
    if isinstance(cell, Text):
        return cell
    return Text(MISSING if cell is None else str(cell))
