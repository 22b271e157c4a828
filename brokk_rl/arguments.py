"""Words of the command line: read before Hydra sees them, and refused with the way to write them."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException

from brokk_rl import registry
from brokk_rl.errors import ConfigError, list_choices

SWITCHES = {"--help", "--hydra-help", "--version", "--resolve", "--run", "--multirun"}
SWITCHES |= {"-h", "-r", "-m", "--shell-completion", "-sc"}
"""Words with dashes that stand alone."""
COMPLETION = {"--shell-completion", "-sc"}
SETTINGS = {"--cfg", "--package", "--config-path", "--config-name", "--config-dir", "--info"}
SETTINGS |= {"-c", "-p", "-cp", "-cn", "-cd", "-i"}
"""Words with dashes that a value follows."""
SHOWN = ("job", "hydra", "all")
"""Parts of the configuration that `--cfg` prints."""
SWEEP = {"--multirun", "-m"}
ROBOT_FILES = (".urdf", ".xml", ".mjcf", ".xacro")
NOTHING = ("none", "null")
"""Options that no group needs: they leave it out."""
PLACES = ("hydra.run", "hydra.sweep.", "hydra.output_subdir", "hydra.job.chdir")
"""Keys of Hydra's own folders, of which none is made."""
KEY = r"\+{0,2}[\w/]+(?:[.@:][\w:]+)*"
"""A key as Hydra takes it: `+group@package`, `task.hole.radius_m`."""
MEANINGFUL = frozenset(",[](){}'\"$\\")
"""Characters that may be meant as Hydra reads them: lists, tables, functions, quotes."""


def read_arguments(words: Sequence[str]) -> list[str]:
    """Return the words of a command in the order that Hydra takes: first those with dashes.

    A value that Hydra cannot read, but that has one meaning only, is quoted: `policy=runs/a=b`.

    Raises:
        ConfigError: A word cannot be read; the message says how to write what was meant.
    """
    groups: dict[str, list[str]] = {}
    for option in registry.list_options():
        groups.setdefault(option.group, []).append(option.name)
    options, values = _split(words, groups)
    sweep = not SWEEP.isdisjoint(options)
    swept = ("search=", "hydra")
    if sweep and not any(re.search(r"[,(]", word) or word.startswith(swept) for word in values):
        raise ConfigError("a sweep needs values: brokk -m mode=train session.seed=0,1,2")
    shown = any(word.startswith(("--cfg", "-c", "--info", "-i")) for word in options)
    for word in options:
        if word.startswith(("--package", "-p", "--resolve")) and not shown:
            raise ConfigError(f"{word} is about what is printed: brokk mode=train --cfg job {word}")
    if not COMPLETION.isdisjoint(options) and len(values) != 1:
        raise ConfigError("completion of words: brokk -sc install=bash, or uninstall=bash")
    read = []
    for place, word in enumerate(values):
        key, _, value = word.lstrip("~").partition("=")
        is_nothing = word == f"~{key}" or value in NOTHING
        if is_nothing and key in groups and value not in groups[key] and key != "mode":
            word = f"{key}=[]" if is_list_group(key) else f"~{key}"
        if word[:1] == "~":
            read.append(word)
            continue
        if "=" not in word or word == "=":
            raise ConfigError(_explain_word(word, values[place + 1 :], groups))
        if word.startswith("mode=") and any(other.startswith("mode=") for other in values[:place]):
            raise ConfigError(f"expected one mode, got {word} and another before it")
        read.append(_read_value(word, sweep, groups))
    return options + read


def _split(words: Sequence[str], groups: Mapping[str, list[str]]) -> tuple[list[str], list[str]]:
    """Return the words with dashes and their values, and the other words."""
    options: list[str] = []
    values: list[str] = []
    rest = list(words)
    while rest:
        word = rest.pop(0)
        if not word.startswith("-"):
            values.append(word)
            continue
        name, given, _ = word.partition("=")
        if name not in SWITCHES | SETTINGS:
            raise ConfigError(_explain_option(word, groups))
        if name in SWITCHES and given:
            raise ConfigError(
                f"{word}: {name} takes no value; leave '={word.partition('=')[2]}' out"
            )
        options.append(word)
        if name in SETTINGS and not given:
            if not rest:
                raise ConfigError(f"{name} needs a value: brokk mode=train --cfg job")
            options.append(rest.pop(0))
        if name in ("--cfg", "-c") and (part := options[-1].rpartition("=")[2]) not in SHOWN:
            raise ConfigError(f"there is no --cfg {part}; {list_choices(part, SHOWN)}")
    return options, values


def _explain_option(word: str, groups: Mapping[str, list[str]]) -> str:
    """Explain a word with dashes that is none of the command's."""
    plain = word.lstrip("-")
    if "=" in plain:
        return f"{word}: values have no dashes: {plain}"
    names = sorted(name for name in SWITCHES | SETTINGS if name.startswith("--"))
    if plain in groups:
        return f"{word}: values have no dashes, and a '=': {plain}=<option>"
    if plain in groups["mode"]:
        return f"{word}: values have no dashes: mode={plain}"
    return f"there is no {word}; {list_choices(word, names)}. Values have no dashes: session.seed=3"


def _explain_word(word: str, following: Sequence[str], groups: Mapping[str, list[str]]) -> str:
    """Explain a word that is no `key=value`."""
    modes = groups["mode"]
    key, colon, value = word.partition(":")
    if following[:1] == ["="] or word == "=":
        return "a value is written without spaces around '=': mode=train"
    if word.endswith(ROBOT_FILES):
        return explain_robot(word)
    if word in modes:
        return f"'{word}' is a mode: brokk mode={word}"
    if word in groups:
        value = following[0] if following and "=" not in following[0] else "<option>"
        return f"'{word}' has no value: {word}={value}"
    if colon and key.strip():
        return f"a value is written with '=': {key.strip()}={value.strip()}"
    if Path(word).exists():
        return f"expected key=value, got the path {word}: which key takes it? For a policy: policy={word}"
    near = get_close_matches(word, modes, n=1)
    hint = f"did you mean mode={near[0]}?" if near else "`brokk --help` says how to begin"
    return f"expected key=value, got '{word}'; {hint}"


def _read_value(word: str, sweep: bool, groups: Mapping[str, list[str]]) -> str:
    """Return an override as Hydra can read it."""
    key, _, value = word.partition("=")
    if not re.fullmatch(KEY, key):
        likely = re.sub(r"\[(\w+)\]", r".\1", key.replace(" ", "").replace("-", "_"))
        if not re.fullmatch(KEY, likely):
            likely, value = "session.seed", "3"
        raise ConfigError(
            f"'{key}' in '{word}' is no key; it is names with dots between, without spaces or "
            f"dashes, as in {likely}={value.strip()}"
        )
    if value.startswith("~/"):  # a shell leaves it after '='
        value = str(Path(value).expanduser())
        word = f"{key}={value}"
    if key.startswith(PLACES):
        raise ConfigError(f"{word}: folders are made by the command; give session.out=<folder>")
    if not value.strip():
        offered = groups.get(key)
        end = list_choices("", offered) if offered else f"{key}=<value>, or {key}=null for none"
        if key == "policy":
            end += "; or the folder of a run or of a policy"
        raise ConfigError(f"'{word}' has no value: {end}")
    if key in groups and value.endswith(ROBOT_FILES):
        raise ConfigError(f"{word}: expected an option or a YAML file; {explain_robot(value)}")
    named = re.search(r"([^@,\[]+)\.ya?ml\b", value)
    if key in groups and named and "@" not in value:
        name = Path(named[1]).name
        raise ConfigError(
            f"{word}: an option has no ending, {key}={name}, and a file stands after @, "
            f"{key}=@{named[1]}.yaml"
        )
    try:
        override = OverridesParser.create().parse_override(word)
    except HydraException as error:
        if MEANINGFUL.isdisjoint(value) and not sweep:
            return f"{key}={_quote(value)}"
        if re.match(r"(choice|glob|interval|range|shuffle|sort|tag)\(", value):
            reason = str(error).partition("while evaluating ")[2].splitlines()
            raise ConfigError(f"{word}: {reason[0] if reason else 'cannot be read'}") from error
        raise ConfigError(_explain_characters(key, value)) from error
    if override.is_range_sweep() and not any(override.sweep_string_iterator()):
        raise ConfigError(f"{word} holds no value: range(first, beyond the last, step)")
    is_single = key in groups and not is_list_group(key)
    if override.is_sweep_override() and not sweep:
        raise ConfigError(_explain_several(key, value, key in groups, is_single))
    if is_single and value.startswith("[") and "," in value:
        raise ConfigError(_explain_several(key, value.strip("[]"), True, is_single))
    is_name = override.is_sweep_override() or isinstance(override.value(), (str, list))
    if key in groups and not is_name:
        return f"{key}='{value}'"  # so that Hydra looks for an option of that name
    is_sweep = override.is_sweep_override()
    names = list(override.sweep_string_iterator()) if is_sweep else list_names(override)
    for name in names:
        if key in groups and names.count(name) > 1:
            raise ConfigError(f"{word}: '{name}' stands in it twice; leave one out")
    return word


def parse_words(words: Sequence[str]) -> list[Override]:
    """Return the overrides among the words of a command, read by Hydra."""
    plain = [word for word in words if word[:1] != "-" and ("=" in word or word[:1] == "~")]
    return OverridesParser.create().parse_overrides(plain)


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
    for option in registry.list_options(group):
        if re.search(rf"^# @package {group}\.", option.path.read_text(), re.MULTILINE):
            return True
    return False


def explain_robot(path: str) -> str:
    """Return the command that makes an option of `machine` from a robot's model."""
    return (
        "mode=check makes a machine from a robot's model: "
        f"brokk mode=check subject.model={shlex.quote(path.lstrip('@'))}"
    )


def _explain_several(key: str, value: str, is_group: bool, is_single: bool) -> str:
    """Explain a value with commas, which is a sweep where one was meant."""
    ways = []
    if re.fullmatch(r"-?\d+,\d+", value) and not is_group:
        ways.append(f"one number: {key}={value.replace(',', '.')}")
    elif is_single:
        ways.append(f"one option: {key}={value.split(',')[0]}")
    elif not is_group:
        ways.append(f"one text: {_show(key, _quote(value))}")
    if "(" not in value and not is_single:
        ways.append(f"a list: {_show(key, f'[{value}]')}")
    ways.append(f"one run for each: brokk -m … {_show(key, value)}")
    return f"{key}={value} holds several values. If you mean {'; '.join(ways)}"


def _explain_characters(key: str, value: str) -> str:
    """Explain a value with characters that Hydra reads as something else, and how to write it."""
    ways = [value.strip(), value.rstrip(", ")]
    inner = value.strip("[]()")
    if value[0] in "[(" and inner:
        items = [item if _is_readable(f"x={item}") else _quote(item) for item in inner.split(",")]
        ways.append(f"[{','.join(items)}]")
    readable = [way for way in (*ways, _quote(value)) if _is_readable(f"x={way}")]
    return (
        f"{key}={value} cannot be read: a character must be quoted, or brackets do not match. "
        f"Write {_show(key, readable[0])}"
    )


def _quote(value: str) -> str:
    """Return a text in quotes from which Hydra reads the same text."""
    escaped = re.sub(r'(\\*)"', r'\1\1\\"', value)
    escaped = re.sub(r"(\\+)$", r"\1\1", escaped)
    return '"' + escaped.replace("${", r"\${") + '"'


def _show(key: str, value: str) -> str:
    """Return an override as it is typed into a shell."""
    return shlex.quote(f"{key}={value}")


def _is_readable(word: str) -> bool:
    try:
        OverridesParser.create().parse_override(word)
    except HydraException:
        return False
    return True
