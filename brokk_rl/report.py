"""One self-contained HTML page a report: text, tables and figures in one file that needs no network.

A report is a Jinja template that extends `report.html.jinja`, fills its block `content`, and takes
tables and pictures from `report_parts.html.jinja`. Everything that is given is escaped, nothing is
taken as markup. The page forbids itself scripts and any request. Figures are drawn with
`brokk_rl.plot`.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from matplotlib.figure import Figure

from brokk_rl.errors import StorageError
from brokk_rl.plot import draw_png

Tone = Literal["good", "bad", "warn", "plain"]
"""Class of a summary: good news, bad news or a warning."""
BASE = Path(__file__).parent
"""Folder of the base template and its parts."""


def render_page(template: Path, values: Mapping[str, Any]) -> str:
    """Return a page by a template that extends `report.html.jinja`; `values` has its `title`."""
    made = f"{datetime.now().astimezone():%Y-%m-%d %H:%M %Z}"
    environment = Environment(
        loader=FileSystemLoader([template.parent, BASE]), autoescape=True, undefined=StrictUndefined
    )
    return environment.get_template(template.name).render(**values, made=made)


def embed_picture(source: Figure | Path) -> str:
    """Return a picture as an address that holds its data.

    Args:
        source: A matplotlib figure, drawn as PNG, or a PNG file.

    Raises:
        StorageError: The file cannot be read.
    """
    try:
        data = source.read_bytes() if isinstance(source, Path) else draw_png(source)
    except OSError as error:
        raise StorageError(f"cannot read picture {source}: {error.strerror or error}") from error
    return f"data:image/png;base64,{base64.b64encode(data).decode()}"
