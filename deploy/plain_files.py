"""Files from elsewhere, read whole: plain ones of a bounded size, no pipes and devices."""

from __future__ import annotations

import errno
import json
from pathlib import Path
from typing import Any


def check_plain_file(path: Path, most_bytes: int) -> None:
    """Refuse what is no plain file, or too large to be what it should.

    Raises:
        FileNotFoundError: there is none.
        OSError: it is a pipe, a device or a folder, or larger than `most_bytes`.
    """
    size = path.stat().st_size
    if not path.is_file():
        raise OSError(
            errno.EINVAL, "expected a plain file, got a folder, pipe or device", str(path)
        )
    if size > most_bytes:
        text = f"expected at most {most_bytes} bytes, got {size}"
        raise OSError(errno.EFBIG, text, str(path))


def read_plain_file(path: Path, most_bytes: int) -> bytes:
    """Return the content of a plain file; see `check_plain_file`."""
    check_plain_file(path, most_bytes)
    return path.read_bytes()


def read_json(path: Path, most_bytes: int) -> dict[str, Any]:
    """Return the JSON object in a plain file.

    Raises:
        OSError: see `check_plain_file`.
        ValueError: it holds no JSON object, or one that is nested beyond reason.
    """
    try:
        content = json.loads(read_plain_file(path, most_bytes))
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
    if not isinstance(content, dict):
        raise ValueError(f"expected a JSON object, got {type(content).__name__}")
    return content
