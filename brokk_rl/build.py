"""Build the specs of a composed configuration: each node once, and what needs torch last.

A composed configuration is plain data. A table with `_target_` becomes a spec of that class, from
the inside out; the key `run` names the class of the mode, whose fields are the nodes.
"""

from __future__ import annotations

import importlib
import re
import sys
import traceback
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.spec import SpecError

TARGET = "_target_"
RUN = "run"
"""Key of the class of the mode; no mode has such a field, since `run` is its method."""
BESIDE = {"machine", "sim"}
"""Nodes that others are compared with."""
SUBJECT = "subject"
"""Node of a mode that tells what does not fit together, in place of a refusal."""
SLOW = "torch"
"""Package whose import takes seconds."""


def build_mode(values: Mapping[str, Any], shared: Collection[str] = ()) -> Any:
    """Return the mode of a composed configuration.

    Nodes whose classes do without torch are built first, so that their bad values are refused
    before torch is loaded. A spec with a method `check_machine` or `check_sim` is asked whether it
    fits the machine or the simulator beside it.

    Args:
        values: The configuration as plain data, with `run`.
        shared: Nodes that others take in, whole or in part. They are built here only if the mode has such
            a field.

    Raises:
        ConfigError: A class cannot be found, a key is unknown, or a value is refused.
    """
    built = build_quick_nodes(values, shared)
    kind = load_class(values[RUN], "")
    own = [field.name for field in fields(kind)]
    given: dict[str, Any] = {}
    for key, value in values.items():
        if key in own:
            given[key] = built[key] if key in built else build_node(value, key)
        elif key not in shared and key != RUN:
            raise ConfigError(
                f"the mode has no '{key}'; {list_choices(key, own)}. A preset or experiment that "
                "sets it is for other modes: leave it out"
            )
    return _call(kind, given, "")


def build_quick_nodes(values: Mapping[str, Any], shared: Collection[str] = ()) -> dict[str, Any]:
    """Return the nodes whose classes do without torch, but those that others take in.

    Raises:
        ConfigError: Classes cannot be found or refuse their values; all of them are named.
    """
    own = [key for key in values if key != RUN and key not in shared]
    built, refusals = _try_nodes(values, own)
    if refusals:  # of a value that others take in, the key is told as it is typed
        _, typed = _try_nodes(values, shared)
        refusals = typed or refusals
    for other in () if SUBJECT in values else built.keys() & BESIDE:
        for part in _list_parts(built):
            try:
                if check := getattr(part, f"check_{other}", None):
                    check(built[other])
            except ConfigError as error:
                refusals.append(error)
    if refusals:
        raise ConfigError("\n".join(map(str, refusals))) from refusals[0]
    return built


def _try_nodes(
    values: Mapping[str, Any], keys: Iterable[str]
) -> tuple[dict[str, Any], list[ConfigError]]:
    """Return those of some nodes that do without torch, and the refusals of the others."""
    built, refusals = {}, []
    for key in keys:
        try:
            # the mode itself says which package it lacks
            with defer_slow_import(), suppress(_SlowImport, _LackingPackageError):
                built[key] = build_node(values[key], key)
        except ConfigError as error:
            refusals.append(error)
    return built, refusals


def _list_parts(nodes: Mapping[str, Any]) -> Iterator[Any]:
    """Yield each node, of those that hold several parts by name the parts."""
    for node in nodes.values():
        yield from _list_parts(node) if isinstance(node, Mapping) else (node,)


def build_node(node: Any, place: str = "") -> Any:
    """Return plain data with a spec in the place of each table that has a `_target_`.

    Args:
        node: The data.
        place: Its key in the configuration, for messages.

    Raises:
        ConfigError: A class cannot be found, or refuses its values.
    """
    if isinstance(node, list):
        return [build_node(item, f"{place}[{index}]") for index, item in enumerate(node)]
    if not isinstance(node, Mapping):
        return node
    values = {}
    for key, value in node.items():
        if key != TARGET:
            values[key] = build_node(value, f"{place}.{key}" if place else str(key))
    if TARGET not in node:
        return values
    return _call(load_class(node[TARGET], place), values, place)


def describe_spec(value: Any) -> Any:
    """Return a spec as a node of the configuration: plain data with the class of each part."""
    if is_dataclass(value) and not isinstance(value, type):
        own = {field.name: describe_spec(getattr(value, field.name)) for field in fields(value)}
        return {TARGET: name_class(value)} | own
    if isinstance(value, Mapping):
        return {key: describe_spec(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [describe_spec(item) for item in value]
    return value


def drop_targets(node: Any, kept: Collection[str] = ()) -> Any:
    """Return plain data without the names of classes, but for those in `kept`."""
    if isinstance(node, Mapping):
        left = {key: value for key, value in node.items() if key != TARGET or value in kept}
        return {key: drop_targets(value, kept) for key, value in left.items()}
    if isinstance(node, list):
        return [drop_targets(value, kept) for value in node]
    return node


def name_class(value: object) -> str:
    """Return the dotted name of the class of an object, as `_target_` has it."""
    return f"{type(value).__module__}.{type(value).__qualname__}"


def load_class(target: object, place: str) -> Any:
    """Return the class that a dotted name stands for.

    Raises:
        ConfigError: There is no such class, or its module cannot be imported. An error in a module
            of this package is a defect and is raised as it is.
    """
    module, _, name = str(target).rpartition(".")
    try:
        return getattr(importlib.import_module(module), name)
    except Exception as error:
        if isinstance(error, ModuleNotFoundError):
            from brokk_rl import extras  # its parts take a while to import

            text = extras.explain_missing_module(str(error.name), str(target))
            if text:
                raise _LackingPackageError(text) from error
        where = ""
        for frame in traceback.extract_tb(error.__traceback__):
            is_import = frame.filename == __file__ or "importlib" in Path(frame.filename).parts
            if not frame.filename.startswith("<") and not is_import:
                where = f"{frame.filename}, line {frame.lineno}: "
        if where.startswith(str(Path(__file__).parents[1])) and "site-packages" not in where:
            raise
        reason = (
            f"{target} cannot be imported: {where}{type(error).__name__}: {error} (seen from "
            f"{Path.cwd()}); its package must be installed, or its folder be in PYTHONPATH"
        )
        raise ConfigError(_complete("", reason, place)) from error


def _call(kind: Any, values: dict[str, Any], place: str) -> Any:
    """Return the spec with these fields; an error names them as they are typed."""
    try:
        return kind(**values)
    except SpecError as error:
        named = [(".".join(filter(None, (place, key))), text) for key, text in error.problems]
        lines = [_complete(name, text, place) for name, text in named]
        raise ConfigError("\n".join(lines)) from error
    except ConfigError as error:
        found = re.fullmatch(r"([\w.]+(?:\[\w+\])?): (.+)", str(error), re.DOTALL)
        head, text = found.groups() if found else ("", str(error))
        if place and re.split(r"[.\[]", head)[0] in [field.name for field in fields(kind)]:
            head = f"{place}.{head}"
        raise ConfigError(_complete(head, text, place)) from error


def _complete(key: str, text: str, place: str) -> str:
    """Return a message with the argument that changes the value of `key`, a field of `place`."""
    message = f"{key}: {text}" if key else text
    if not place:
        return message
    typed = key.partition("[")[0]
    if typed == place or not typed.startswith(place):
        return f"{message} (in '{place}': change {place}.<field>=… or its file)"
    return f"{message} (change {typed}=… or its file)"


class _LackingPackageError(ConfigError):
    """A class needs a package that an extra brings and that is not installed."""


class _SlowImport(BaseException):
    """Code uses torch; no `Exception`, so that nothing takes it for a missing package."""


class _LateTorch(ModuleType):
    """Stands for torch in modules that import it, until one of them uses a member."""

    is_refusing = False

    def __getattr__(self, name: str) -> Any:
        if self.is_refusing:
            raise _SlowImport(name)
        real = importlib.import_module(SLOW)
        for module in list(sys.modules.values()):
            if getattr(module, "__dict__", {}).get(SLOW) is self:
                setattr(module, SLOW, real)
        return getattr(real, name)


_late_torch = _LateTorch(SLOW)


@contextmanager
def defer_slow_import() -> Iterator[None]:
    """Make the use of torch raise `_SlowImport`, but not its import.

    A package whose import was interrupted is forgotten whole. Otherwise its next import would find
    its finished modules, and they would not become members of it.
    """
    if SLOW in sys.modules:
        yield
        return
    before = set(sys.modules)
    sys.modules[SLOW] = _late_torch
    _late_torch.is_refusing = True
    try:
        yield
    finally:
        _late_torch.is_refusing = False
        del sys.modules[SLOW]
        for name in sorted(sys.modules.keys() - before):  # a package before its modules
            package = name.rpartition(".")[0]
            if package and package not in sys.modules:
                del sys.modules[name]
