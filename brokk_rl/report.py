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
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from urllib.parse import quote

from jinja2 import Environment, FileSystemLoader, Template

from brokk_rl.errors import StorageError
from brokk_rl.parallel import map_parallel
from brokk_rl.session import write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Tone = Literal["good", "bad", "warn", "plain"]
TEMPLATE_FILE = "report.html.jinja"
MISSING = "–"
"""Text of a missing value."""
PICTURE_TYPES = {
    ".png": "image/png",
    ".svg": "image/svg+xml",
    ".jpg": "image/jpeg",
    ".jpeg": "image/jpeg",
}
NUMBER = re.compile(r"\s*[<>±≈]?\s*[-+−]?\d")
"""Start of a text that counts as a number."""
BEST_MARK = "▸ "
"""Mark before the best of a kind; before, so that numbers stay aligned at the right."""
DPI = 150
"""Resolution of figures, dots an inch: sharp in print at page width; chosen by hand."""


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


Block = dict[str, Any]
"""An element of a report as the template takes it: its `kind` and the values to show."""


class Report:
    """A report that grows from top to bottom.

    Args:
        title: Subject of the report.
        summary: The answer in a sentence or two.
        tone: Sets the summary apart as good news, bad news or a warning.
    """

    def __init__(self, title: str, summary: str = "", tone: Tone = "plain") -> None:
        self._title = title
        self._blocks: list[Block] = []
        self._figures: list[tuple[Block, Figure]] = []
        if summary:
            self.add_text(summary, tone, "summary")

    def add_heading(self, text: str, level: int = 2) -> None:
        """Begin a section (level 2) or a part of one (level 3)."""
        self._blocks.append({"kind": "heading", "text": text, "level": level})

    def add_text(self, text: str, tone: Tone = "plain", style: str = "") -> None:
        """Add paragraphs, separated by empty lines; `tone` sets them apart."""
        classes = " ".join(name for name in (style, tone) if name not in ("", "plain"))
        for paragraph in text.split("\n\n"):
            if paragraph.strip():
                self._blocks.append(
                    {"kind": "paragraph", "text": paragraph.strip(), "classes": classes}
                )

    def add_list(self, texts: Sequence[str]) -> None:
        """Add a list of short texts."""
        self._blocks.append({"kind": "list", "texts": list(texts)})

    def add_links(self, files: Mapping[str, str]) -> None:
        """Add links to files beside the page: text and path, relative to the page's folder."""
        links = []
        for text, path in files.items():
            links.append({"text": text, "address": quote(path)})
        self._blocks.append({"kind": "links", "links": links})

    def add_code(self, text: str) -> None:
        """Add commands or a file unchanged."""
        self._blocks.append({"kind": "code", "text": text})

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
        for i in range(len(columns)):
            numeric.append(_is_numeric([row[i].value for row in cells]))
        shown = []
        for row in cells:
            shown.append(
                [
                    _prepare_cell(cell, is_number, digits)
                    for cell, is_number in zip(row, numeric, strict=True)
                ]
            )
        heads = []
        for name, is_number in zip(columns, numeric, strict=True):
            heads.append({"name": name, "is_number": is_number})
        self._blocks.append(
            {
                "kind": "table",
                "columns": heads,
                "has_head": any(columns),
                "rows": shown,
                "caption": caption,
            }
        )

    def add_facts(self, facts: dict[str, str | float | None]) -> None:
        """Add names and their values, one a line."""
        self.add_table(["", ""], [[name, Cell(value)] for name, value in facts.items()])

    def add_picture(self, source: Figure | Path, caption: str = "", description: str = "") -> None:
        """Add a picture; its data become part of the page.

        Args:
            source: A matplotlib figure, drawn as PNG, or a PNG, SVG or JPEG file.
            caption: Text below the picture.
            description: Content for those who cannot see it; the caption where it is empty.

        Raises:
            StorageError: the file cannot be read.
        """
        block: Block = {
            "kind": "picture",
            "address": "",
            "description": description or caption,
            "caption": caption,
        }
        if isinstance(source, Path):
            block["address"] = _embed(*_read_picture(source))
        else:
            self._figures.append((block, source))
        self._blocks.append(block)

    @contextmanager
    def add_details(self, summary: str, is_open: bool = False) -> Iterator[None]:
        """Fold everything that is added within the block behind a line; printed in full."""
        outer, inner = self._blocks, []
        self._blocks = inner
        try:
            yield
        finally:
            outer.append(
                {"kind": "details", "summary": summary, "is_open": is_open, "blocks": inner}
            )
            self._blocks = outer

    def render(self) -> str:
        """Return the whole page; figures are drawn now, as each takes half a second."""
        drawn = map_parallel(lambda one: _draw_png(one[1]), self._figures)
        for (block, _), picture in zip(self._figures, drawn, strict=True):
            block["address"] = _embed(*picture)
        self._figures.clear()
        made = f"{datetime.now().astimezone():%Y-%m-%d %H:%M %Z}"
        return _load_template().render(title=self._title, blocks=self._blocks, made=made)

    def write(self, path: Path) -> None:
        """Write the page in one step: readers see the old file or the whole new one.

        Raises:
            StorageError: it could not be written.
        """
        try:
            write_text(path, self.render())
        except OSError as error:
            raise StorageError(
                f"cannot write {path}: {error.strerror or error}; nothing was left behind"
            ) from error


def write_picture(figure: Figure, path: Path) -> None:
    """Write a figure as a PNG file.

    Raises:
        StorageError: it could not be written; nothing was left behind.
    """
    temporary = path.with_name(f".{path.name}.part")
    try:
        temporary.write_bytes(_draw_png(figure)[1])
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise StorageError(f"cannot write {path}: {error.strerror or error}") from error


@cache
def _load_template() -> Template:
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True, trim_blocks=False
    )
    return environment.get_template(TEMPLATE_FILE)


def _read_picture(path: Path) -> tuple[str, bytes]:
    """Return media type and data of a picture file."""
    kind = PICTURE_TYPES.get(path.suffix.lower())
    if kind is None:
        raise StorageError(f"picture {path}: expected one of {', '.join(PICTURE_TYPES)}")
    try:
        return kind, path.read_bytes()
    except OSError as error:
        raise StorageError(f"cannot read picture {path}: {error.strerror or error}") from error


def _embed(kind: str, data: bytes) -> str:
    """Return an address that holds the data itself."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def _draw_png(figure: Figure) -> tuple[str, bytes]:
    """Return media type and data of a matplotlib figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return PICTURE_TYPES[".png"], buffer.getvalue()


def _is_numeric(values: Sequence[str | float | None]) -> bool:
    """Return whether a column holds numbers, or texts that begin like one."""
    given = [value for value in values if value is not None and value != MISSING]
    return bool(given) and all(not isinstance(value, str) or NUMBER.match(value) for value in given)


def _prepare_cell(cell: Cell, is_number: bool, digits: int) -> Block:
    """Return a cell as the template takes it."""
    classes = " ".join(
        name for name, given in (("number", is_number), ("best", cell.best)) if given
    )
    return {"text": cell.format(digits), "note": cell.note, "classes": classes}
