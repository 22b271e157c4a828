"""Words of the command line, as Hydra takes them: what it cannot read is quoted or refused."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import NoReturn

from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException

from brokk_rl import registry
from brokk_rl.errors import ConfigError

ROBOT_FILES = (".urdf", ".xml", ".mjcf", ".xacro")
NOTHING = ("none", "null")
"""Options that no group needs: they leave it out."""
PLACES = ("hydra.run", "hydra.sweep.", "hydra.output_subdir", "hydra.job.chdir")
"""Keys of Hydra's own folders, of which none is made."""
MEANINGFUL = frozenset(",[](){}'\"$\\")
"""Characters that may be meant as Hydra reads them: lists, tables, functions, quotes."""


def read_arguments(words: Sequence[str]) -> list[str]:
    """Return the words of a command in the order that Hydra takes: first those with dashes.

    A value that Hydra cannot read, but that has one meaning only, is quoted: `policy=runs/a=b`.

    Raises:
        ConfigError: A word cannot be read; the message says how to write what was meant.
    """
    parser = get_args_parser()
    parser.error = _refuse_option  # type: ignore[method-assign]
    given = parser.parse_intermixed_args(words)
    if (given.package or given.resolve) and not (given.cfg or given.info):
        _refuse_option("--package and --resolve are about what --cfg job prints")
    if given.shell_completion and len(given.overrides) != 1:
        _refuse_option("completion of words: brokk -sc install=bash, or uninstall=bash")
    if sum(word.startswith("mode=") for word in given.overrides) > 1:
        raise ConfigError("expected one mode, got several: for each a command of its own")
    options = [word for word in words if word not in given.overrides]
    offered = registry.list_options()
    return options + [_read_value(word, offered) for word in given.overrides]


def _refuse_option(message: str) -> NoReturn:
    raise ConfigError(f"{message}; values have no dashes, as in brokk mode=train session.seed=3")


def _read_value(word: str, options: Sequence[registry.Option]) -> str:
    """Return an override as Hydra can read it."""
    key, equals, value = word.partition("=")
    name = key.lstrip("~")
    offered = {option.name for option in options if option.group == name}
    is_nothing = word == f"~{name}" or value in NOTHING
    if is_nothing and offered and value not in offered and name != "mode":
        return f"{name}=[]" if is_list_group(name) else f"~{name}"
    if key.startswith(PLACES):
        raise ConfigError(f"{word}: folders are made by the command; give session.out=<folder>")
    if word.startswith("~"):
        return word
    if not equals or not key:
        raise ConfigError(_explain_word(word, options))
    if value.startswith("~/"):  # a shell leaves it after '='
        value = str(Path(value).expanduser())
    quoted = f"{key}={_quote(value)}"
    is_plain = MEANINGFUL.isdisjoint(value)
    if override := _parse_word(f"{key}={value}"):
        _refuse_empty(key, value, override, bool(offered) and not is_list_group(key))
        return f"{key}={value}"
    if is_plain and _parse_word(quoted):
        return quoted
    if _parse_word(quoted):
        raise ConfigError(
            f"{word} cannot be read: brackets do not match, a list stands in others than [], a "
            f"function has other arguments, or a text must be quoted: {shlex.quote(quoted)}"
        )
    raise ConfigError(
        f"'{key}' in '{word}' is no key; it is names with dots between, without spaces or dashes: "
        "session.seed=3, machine.joints.0.home=2"
    )


def _refuse_empty(key: str, value: str, override: Override, is_single: bool) -> None:
    """Refuse what Hydra reads and what chooses nothing; `is_single`: an option of its group is one."""
    if not value.strip():
        raise ConfigError(f"'{key}=' has no value; `brokk mode=<mode> --help` lists what it takes")
    if override.is_range_sweep() and not any(override.sweep_string_iterator()):
        raise ConfigError(f"{key}={value} holds no value: range(first, beyond the last, step)")
    options = override.value()
    if is_single and isinstance(options, list) and len(options) > 1:
        raise ConfigError(f"{key}={value}: expected one option, as in {key}={options[0]}")


def _explain_word(word: str, options: Sequence[registry.Option]) -> str:
    """Explain a word that is no `key=value`."""
    if word.endswith(ROBOT_FILES):
        return explain_robot(word)
    modes = [option.name for option in options if option.group == "mode"]
    near = get_close_matches(word, modes, n=1)
    hint = f"did you mean mode={near[0]}?" if near else "`brokk --help` says how to begin"
    return f"expected key=value without spaces, got '{word}'; {hint}"


def parse_words(words: Sequence[str]) -> list[Override]:
    """Return the overrides among the words of a command, read by Hydra."""
    plain = [word for word in words if word[:1] != "-" and ("=" in word or word[:1] == "~")]
    return OverridesParser.create().parse_overrides(plain)


def is_given_whole(words: Sequence[str]) -> bool:
    """Return whether a command runs a configuration that was composed before: a `resolved.yaml`."""
    return any(word.startswith(("--config-name", "-cn")) for word in words)


def list_names(override: Override) -> list[str]:
    """Return the texts that an override gives: its value, the items of a list, or all of a sweep."""
    if override.is_sweep_override():
        names: list[str] = []
        for text in override.sweep_string_iterator():
            names += list_names(*parse_words([f"x={text}"]))
        return names
    value = override.value()
    values = value if isinstance(value, list) else [value]
    return [item for item in values if isinstance(item, str)]


def is_list_group(group: str) -> bool:
    """Return whether several options of a group may be chosen: each has a place of its own."""
    places = [option.place or "" for option in registry.list_options(group)]
    return any(place.startswith(f"{group}.") for place in places)


def explain_robot(path: str) -> str:
    """Return the command that makes an option of `machine` from a robot's model."""
    return (
        "mode=check makes a machine from a robot's model: "
        f"brokk mode=check subject.model={shlex.quote(path.lstrip('@'))}"
    )


def _quote(value: str) -> str:
    """Return a text in quotes from which Hydra reads the same text."""
    escaped = re.sub(r'(\\*)"', r'\1\1\\"', value)
    escaped = re.sub(r"(\\+)$", r"\1\1", escaped)
    return '"' + escaped.replace("${", r"\${") + '"'


def _parse_word(word: str) -> Override | None:
    try:
        return OverridesParser.create().parse_override(word)
    except HydraException:
        return None
