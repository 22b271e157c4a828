"""One self-contained HTML report: text, tables and figures in one file that needs no network.

    report = Report("Identification of brokk170", "The network beats the linear model.", "good")
    report.add_heading("Errors")
    report.add_table(["joint", "mlp", "arx"], [["q1", Cell(0.012, best=True), 0.034]], "RMSE, rad")
    report.add_picture(figure, "Measured and predicted position")
    report.write(folder / "identification.html")

All reports share the template `report.html.jinja`. Everything that is given is escaped, nothing is
taken as markup. The page forbids itself scripts and any request. Figures are drawn with
`brokk_rl.plot`.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Any, Literal

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from matplotlib.figure import Figure

from brokk_rl.console_table import MISSING, is_numeric
from brokk_rl.errors import StorageError
from brokk_rl.plot import draw_png
from brokk_rl.session import write_text

Tone = Literal["good", "bad", "warn", "plain"]
TEMPLATE = Path(__file__).with_name("report.html.jinja")
PNG = "image/png"
PICTURE_TYPES = {".png": PNG, ".svg": "image/svg+xml", ".jpg": "image/jpeg", ".jpeg": "image/jpeg"}
BEST_MARK = "▸ "
"""Mark before the best of a kind; before, so that numbers stay aligned at the right."""


@dataclass(frozen=True)
class Cell:
    """A cell of a table with more than its value.

    Attributes:
        value: Text, number, or `None` for a missing number.
        note: Small text below the value: an interval, a reason.
        best: Marks the best of its kind by weight, colour and a sign (colour alone does not reach
            every reader).
    """

    value: str | float | None
    note: str = ""
    best: bool = False

    def format(self, digits: int) -> str:
        """Return the text of the cell; numbers get `digits` significant digits."""
        if self.value is None:
            text = MISSING
        elif isinstance(self.value, (str, int)):
            text = str(self.value)
        else:
            text = f"{self.value:.{digits}g}"
        return BEST_MARK + text if self.best else text


class Report:
    """A report that grows from top to bottom.

    Args:
        title: Subject of the report.
        summary: The answer in a sentence or two.
        tone: Sets the summary apart as good news, bad news or a warning.
    """

    def __init__(self, title: str, summary: str = "", tone: Tone = "plain") -> None:
        self._title = title
        self._blocks: list[dict[str, Any]] = []
        self.add_text(summary, tone, "summary")

    def add_heading(self, text: str, level: int = 2) -> None:
        """Begin a section (level 2) or a part of one (level 3)."""
        self._add("heading", text=text, level=level)

    def add_text(self, text: str, tone: Tone = "plain", style: str = "") -> None:
        """Add paragraphs, separated by empty lines; `tone` sets them apart."""
        classes = f"{style} {tone}".replace("plain", "").strip()
        for paragraph in text.split("\n\n"):
            if paragraph.strip():
                self._add("paragraph", text=paragraph.strip(), classes=classes)

    def add_list(self, texts: Sequence[str]) -> None:
        """Add a list of short texts."""
        self._add("list", texts=texts)

    def add_code(self, text: str) -> None:
        """Add commands or a file unchanged."""
        self._add("code", text=text)

    def add_table(
        self,
        columns: Sequence[str],
        rows: Sequence[Sequence[str | float | Cell | None]],
        caption: str = "",
        digits: int = 3,
    ) -> None:
        """Add a table.

        Args:
            columns: Headings.
            rows: One cell a column; the first cell of a row names it. Columns of numbers are
                aligned at the right.
            caption: Content of the table, with the unit.
            digits: Significant digits of numbers. Text stays as it is, so give text where a column
                needs fixed decimals.
        """
        cells = [[cell if isinstance(cell, Cell) else Cell(cell) for cell in row] for row in rows]
        for row in cells:
            if len(row) != len(columns):
                raise ValueError(f"expected {len(columns)} cells a row, got {len(row)}: {row}")
        numeric = []
        for column in range(len(columns)):
            numeric.append(is_numeric([row[column].value for row in cells]))
        self._add(
            "table", columns=columns, rows=cells, numeric=numeric, caption=caption, digits=digits
        )

    def add_picture(self, source: Figure | Path, caption: str = "", description: str = "") -> None:
        """Add a picture; its data become part of the page.

        Args:
            source: A matplotlib figure, drawn as PNG, or a PNG, SVG or JPEG file.
            caption: Text below the picture.
            description: Content for those who cannot see it; the caption where it is empty.

        Raises:
            StorageError: The file cannot be read.
        """
        address = embed_picture(source)
        self._add("picture", address=address, description=description or caption, caption=caption)

    @contextmanager
    def add_details(self, summary: str, is_open: bool = False) -> Iterator[None]:
        """Fold everything that is added within the block behind a line; printed in full."""
        outer, self._blocks = self._blocks, []
        try:
            yield
        finally:
            inner, self._blocks = self._blocks, outer
            self._add("details", summary=summary, is_open=is_open, blocks=inner)

    def render(self) -> str:
        """Return the whole page."""
        return render_page(TEMPLATE, {"title": self._title, "blocks": self._blocks})

    def write(self, path: Path) -> None:
        """Write the page in one step: readers see the old file or the whole new one.

        Raises:
            StorageError: It could not be written.
        """
        write_text(path, self.render())

    def _add(self, kind: str, **values: Any) -> None:
        """Add an element as the template takes it."""
        self._blocks.append({"kind": kind, **values})


def render_page(template: Path, values: Mapping[str, Any]) -> str:
    """Return a page by a template that is, or extends, `report.html.jinja`; `values` has its `title`."""
    made = f"{datetime.now().astimezone():%Y-%m-%d %H:%M %Z}"
    return _load_template(template).render(**values, made=made)


def embed_picture(source: Figure | Path) -> str:
    """Return a picture as an address that holds its data; see `Report.add_picture`."""
    kind, data = _read_picture(source) if isinstance(source, Path) else (PNG, draw_png(source))
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


@cache
def _load_template(path: Path) -> Template:
    folders = [path.parent, TEMPLATE.parent]
    environment = Environment(
        loader=FileSystemLoader(folders), autoescape=True, undefined=StrictUndefined
    )
    return environment.get_template(path.name)


def _read_picture(path: Path) -> tuple[str, bytes]:
    """Return media type and data of a picture file."""
    kind = PICTURE_TYPES.get(path.suffix.lower())
    if kind is None:
        raise StorageError(f"picture {path}: expected one of {', '.join(PICTURE_TYPES)}")
    try:
        return kind, path.read_bytes()
    except OSError as error:
        raise StorageError(f"cannot read picture {path}: {error.strerror or error}") from error
