"""Files from elsewhere, read whole: plain ones of a bounded size, no pipes and devices."""

from __future__ import annotations

import errno
import json
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

from brokk_rl.errors import ConfigError

MOST_JSON_BYTES = 1 << 28
"""Size beyond which no file of ours is. Chosen by hand: an evaluation of 10^5 episodes has 10 MB."""


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


def read_json(path: Path, most_bytes: int = MOST_JSON_BYTES) -> dict[str, Any]:
    """Return the JSON object in a plain file.

    Raises:
        OSError: see `check_plain_file`.
        ValueError: it holds no JSON object, or one that is nested beyond reason.
    """
    content = parse_json(read_plain_file(path, most_bytes))
    if not isinstance(content, dict):
        raise ValueError(f"expected a JSON object, got {type(content).__name__}")
    return content


def parse_json(text: str | bytes) -> Any:
    """Return the value that a JSON text holds.

    Raises:
        ValueError: it holds none, or one that is nested beyond reason.
    """
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def parse_model(path: Path) -> ElementTree.Element:
    """Return the root of a URDF or MJCF.

    Raises:
        ConfigError: there is no such file, or it is neither.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except OSError as error:
        raise ConfigError(
            f"model: cannot read {path}: {error.strerror} (seen from {Path.cwd()})"
        ) from error
    except (ElementTree.ParseError, UnicodeDecodeError) as error:
        hint = "; run xacro first" if "xacro" in path.name or "prefix" in str(error) else ""
        raise ConfigError(
            f"model: {path} is no XML, cannot read it as URDF or MJCF ({error}){hint}"
        ) from error
    if root.tag not in ("robot", "mujoco"):
        raise ConfigError(
            f"model: expected a URDF (<robot>) or an MJCF (<mujoco>), got <{root.tag}> in {path}; "
            "export it as one of these"
        )
    return root
