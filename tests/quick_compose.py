"""Composing without what is done twice: Hydra reads some sixty files for a command, and most are the same."""

from __future__ import annotations

import functools
import io
import pickle
from pathlib import Path
from typing import Any

from hydra._internal.hydra import Hydra
from omegaconf import OmegaConf
from yaml import YAMLError

load = OmegaConf.load
find_run_mode = Hydra.get_mode


@functools.cache
def parse(text: str) -> bytes:
    """Returns the parsed text as it is stored: loading that is faster than a copy."""
    return pickle.dumps(load(io.StringIO(text)))


def load_cached(file: Any) -> Any:
    """Does what `OmegaConf.load` does; a broken file is read by that, whose message names it."""
    try:
        if hasattr(file, "read"):
            return pickle.loads(parse(file.read()))
        return pickle.loads(parse(Path(file).read_text()))
    except (YAMLError, UnicodeDecodeError):
        if hasattr(file, "seek"):
            file.seek(0)
        return load(file)


def get_run_mode(self: Hydra, config_name: str | None, overrides: list[str]) -> Any:
    """Does what `Hydra.get_mode` does, which composes all only to read a setting of searches."""
    if any(word.startswith(("search", "hydra", "+hydra")) for word in overrides):
        return find_run_mode(self, config_name, overrides)
    return None


def compose_once() -> None:
    """Let all that is composed in this process share the parsed files and be composed once."""
    OmegaConf.load = staticmethod(load_cached)
    Hydra.get_mode = get_run_mode
