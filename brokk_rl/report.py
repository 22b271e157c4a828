"""One self-contained HTML page: text, tables and pictures in a single file that opens without a network, on a phone or printed.

    page = Page("Identification of brokk170", "The network is better than the linear model on every
    joint.") page.add_heading("Errors")
    page.add_table(["joint", "mlp", "arx"], [["q1", Cell(0.012, best=True), 0.034]], "RMSE at 5 s, rad")
    page.add_picture(figure, "Measured and predicted position")
    page.write(folder / "identification.html")

Everything that is given is escaped; nothing is taken as markup. The page forbids itself scripts and
any request.
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from brokk_rl.errors import StorageError
from brokk_rl.session import write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Tone = Literal["good", "bad", "warn", "plain"]
MISSING = "–"
"""Stands for a figure that there is none of."""
PICTURE_TYPES = {
    ".png": "image/png",
    ".svg": "image/svg+xml",
    ".jpg": "image/jpeg",
    ".jpeg": "image/jpeg",
}
FIGURE = re.compile(r"\s*[<>±≈]?\s*[-+−]?\d")
"""How text begins that is read as a figure."""
MARK = "▸ "
"""Before the best of a kind; before, so that figures stay aligned at the right."""
DPI = 150
STYLE = """
:root { color-scheme: light dark; --ink: #1a1d21; --dim: #5c6570; --paper: #ffffff; --panel: #f4f6f8; --line: #d7dce1;
  --accent: #0b62a8; --good: #1a7f37; --bad: #b3261e; --warn: #8a5a00; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e9ec; --dim: #9aa4ae; --paper: #14171a; --panel: #1d2226; --line: #363d44;
  --accent: #6db8f2; --good: #5fd07f; --bad: #ff8a80; --warn: #e8b455; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 62rem; padding: 1.5rem 1rem 4rem; background: var(--paper); color: var(--ink);
  font: 1rem/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 0 0 .4rem; }
h2 { font-size: 1.25rem; margin: 2.4rem 0 .6rem; padding-bottom: .2rem; border-bottom: 1px solid var(--line); }
h3 { font-size: 1.05rem; margin: 1.6rem 0 .4rem; }
p { margin: .5rem 0; max-width: 46rem; overflow-wrap: anywhere; }
.summary { font-size: 1.1rem; }
.good, .bad, .warn { border-left: .3rem solid; padding: .35rem .8rem; background: var(--panel); }
.good { border-color: var(--good); } .bad { border-color: var(--bad); } .warn { border-color: var(--warn); }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums lining-nums; font-size: .92rem; }
figcaption, footer { color: var(--dim); font-size: .88rem; }
th, td { padding: .22rem .7rem; text-align: left; vertical-align: baseline; border-bottom: 1px solid var(--line); }
th { font-weight: 600; white-space: nowrap; } thead th { border-bottom: 2px solid var(--line); vertical-align: bottom; }
.number { text-align: right; white-space: nowrap; }
.best { font-weight: 700; color: var(--good); }
.note { display: block; color: var(--dim); font-size: .8rem; font-weight: 400; }
figure { margin: 1.2rem 0; } figcaption { margin-top: .3rem; max-width: 46rem; }
img { display: block; max-width: 100%; height: auto; background: #fff; border: 1px solid var(--line); border-radius: .3rem; }
pre { overflow-x: auto; background: var(--panel); padding: .7rem .9rem; border-radius: .3rem; font-size: .86rem; }
details { margin: .8rem 0; } summary { cursor: pointer; color: var(--accent); }
footer { margin-top: 3rem; border-top: 1px solid var(--line); padding-top: .5rem; }
@media print { :root { color-scheme: light; --ink: #000; --dim: #444; --paper: #fff; --panel: #f4f4f4; --line: #bbb; }
  body { max-width: none; font-size: 10pt; padding: 0; } figure, tr { break-inside: avoid; } h2, h3 { break-after: avoid; }
  .scroll, pre { overflow: visible; } pre { white-space: pre-wrap; }
  details::details-content { content-visibility: visible; height: auto; } }
"""


@dataclass(frozen=True)
class Cell:
    """A cell of a table that is more than its value.

    Attributes:
        value: Text, number, or `None` for a figure that there is none of.
        note: Said small below it: an interval, a reason.
        best: Marked as the best of its kind, by weight, colour and a sign (also for those who see
            no colour).
    """

    value: str | float | None
    note: str = ""
    best: bool = False


class Report:
    """A page that grows from top to bottom.

    Args:
        title: What the page is about.
        summary: The answer in a sentence or two, for those who read no further.
        tone: Whether the summary is good news.
    """

    def __init__(self, title: str, summary: str = "", tone: Tone = "plain") -> None:
        self._title = title
        self._parts: list[str] = []
        if summary:
            self.add_text(summary, tone, "summary")

    def add_heading(self, text: str, level: int = 2) -> None:
        """Begins a section (level 2) or a part of one (level 3)."""
        self._parts.append(f"<h{level}>{escape(text)}</h{level}>")

    def add_text(self, text: str, tone: Tone = "plain", style: str = "") -> None:
        """Adds paragraphs; an empty line separates them. `tone` sets one apart as good news, bad news or a warning."""
        classes = " ".join(filter(None, (style, tone if tone != "plain" else "")))
        for paragraph in filter(None, (part.strip() for part in text.split("\n\n"))):
            self._parts.append(
                f'<p class="{classes}">{escape(paragraph)}</p>'
                if classes
                else f"<p>{escape(paragraph)}</p>"
            )

    def add_list(self, texts: Sequence[str]) -> None:
        """Adds a list of short texts."""
        self._parts.append("<ul>" + "".join(f"<li>{escape(text)}</li>" for text in texts) + "</ul>")

    def add_code(self, text: str) -> None:
        """Adds commands or a file, as they are."""
        self._parts.append(f"<pre>{escape(text)}</pre>")

    def add_table(
        self,
        columns: Sequence[str],
        rows: Sequence[Sequence[str | float | Cell | None]],
        caption: str = "",
        digits: int = 3,
    ) -> None:
        """Adds a table.

        Args:
            columns: Headings.
            rows: One cell a column; the first cell of a row names it. Columns of numbers are
                aligned at the right.
            caption: What it shows, with the unit.
            digits: Significant digits of numbers; text is left as it is, so give text where a
                column wants fixed decimals.
        """
        cells = [[cell if isinstance(cell, Cell) else Cell(cell) for cell in row] for row in rows]
        for row in cells:
            if len(row) != len(columns):
                raise ValueError(f"expected {len(columns)} cells a row, got {len(row)}: {row}")
        numeric = [_is_numeric([row[i].value for row in cells]) for i in range(len(columns))]
        kinds = [' class="number"' if number else "" for number in numeric]
        head = "".join(
            f'<th scope="col"{kind}>{escape(name)}</th>'
            for name, kind in zip(columns, kinds, strict=True)
        )
        body = "".join(
            "<tr>"
            + "".join(_format_cell(row[i], numeric[i], i == 0, digits) for i in range(len(row)))
            + "</tr>"
            for row in cells
        )
        top = f"<thead><tr>{head}</tr></thead>" if any(columns) else ""
        title = (
            f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
        )  # outside of what scrolls sideways on a phone
        self._parts.append(
            f'<figure>{title}<div class="scroll"><table>{top}<tbody>{body}</tbody></table></div></figure>'
        )

    def add_facts(self, facts: dict[str, str | float | None]) -> None:
        """Adds names and what is known of them, one a line."""
        self.add_table(["", ""], [[name, Cell(value)] for name, value in facts.items()])

    def add_picture(self, source: Figure | Path, caption: str = "", description: str = "") -> None:
        """Adds a picture; its data become part of the page.

        Args:
            source: A matplotlib figure, drawn as PNG, or a PNG, SVG or JPEG file.
            caption: Said below it.
            description: What it shows, for those who cannot see it; the caption where there is
                none.

        Raises:
            StorageError: the file cannot be read.
        """
        if isinstance(source, Path):
            kind = PICTURE_TYPES.get(source.suffix.lower())
            if kind is None:
                raise StorageError(f"picture {source}: expected one of {', '.join(PICTURE_TYPES)}")
            try:
                data = source.read_bytes()
            except OSError as error:
                raise StorageError(
                    f"cannot read picture {source}: {error.strerror or error}"
                ) from error
        else:
            kind, buffer = PICTURE_TYPES[".png"], io.BytesIO()
            source.savefig(buffer, format="png", dpi=DPI)
            data = buffer.getvalue()
        text = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
        address = f"data:{kind};base64,{base64.b64encode(data).decode()}"
        self._parts.append(
            f'<figure><img src="{address}" alt="{escape(description or caption)}">{text}</figure>'
        )

    @contextmanager
    def add_details(self, summary: str, is_open: bool = False) -> Iterator[None]:
        """Puts what is added within the block behind a line to click on; printed in full."""
        self._parts.append(
            f"<details{' open' if is_open else ''}><summary>{escape(summary)}</summary>"
        )
        try:
            yield
        finally:
            self._parts.append("</details>")

    def render(self) -> str:
        """Returns the whole page."""
        head = (
            '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
            "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; img-src data:; style-src 'unsafe-inline'\">"
            f"<title>{escape(self._title)}</title><style>{STYLE}</style>"
        )
        made = f"<footer>made by brokk-rl, {datetime.now().astimezone():%Y-%m-%d %H:%M %Z}</footer>"
        body = "\n".join([f"<h1>{escape(self._title)}</h1>", *self._parts, made])
        return f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body>\n{body}\n</body></html>\n'

    def write(self, path: Path) -> None:
        """Writes the page in one step: readers see the old file or the whole new one.

        Raises:
            StorageError: it could not be written.
        """
        try:
            write_text(path, self.render())
        except OSError as error:
            raise StorageError(
                f"cannot write {path}: {error.strerror or error}; nothing was left behind"
            ) from error


def _is_numeric(values: Sequence[str | float | None]) -> bool:
    """Says whether a column holds figures: numbers, or texts that begin like one."""
    given = [value for value in values if value is not None and value != MISSING]
    return bool(given) and all(not isinstance(value, str) or FIGURE.match(value) for value in given)


def _format_cell(cell: Cell, is_numeric: bool, is_name: bool, digits: int) -> str:
    value = cell.value
    if value is None:
        text = MISSING
    elif isinstance(value, str):
        text = value
    elif isinstance(value, int):
        text = str(value)
    else:
        text = f"{value:.{digits}g}"
    classes = " ".join(
        name for name, given in (("number", is_numeric), ("best", cell.best)) if given
    )
    attribute = f' class="{classes}"' if classes else ""
    note = f'<span class="note">{escape(cell.note)}</span>' if cell.note else ""
    tag = 'th scope="row"' if is_name else "td"
    return f"<{tag}{attribute}>{MARK if cell.best else ''}{escape(text)}{note}</{tag[:2]}>"
