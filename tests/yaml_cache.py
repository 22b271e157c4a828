"""Each text of YAML is parsed once: Hydra reads some sixty files for a command, and most are the same."""

from __future__ import annotations

import copy
import functools
import io
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from yaml import YAMLError

load = OmegaConf.load


@functools.cache
def parse(text: str) -> Any:
    return load(io.StringIO(text))


def load_cached(file: Any) -> Any:
    """Does what `OmegaConf.load` does; a broken file is read by that, whose message names it."""
    try:
        if hasattr(file, "read"):
            return copy.deepcopy(parse(file.read()))
        return copy.deepcopy(parse(Path(file).read_text()))
    except (YAMLError, UnicodeDecodeError):
        if hasattr(file, "seek"):
            file.seek(0)
        return load(file)


def parse_once() -> None:
    """Let all that is composed in this process share the parsed files."""
    OmegaConf.load = staticmethod(load_cached)
