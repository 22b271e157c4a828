"""Specs: the typed, frozen data that every config node becomes."""

import math
import types
import typing
from collections.abc import Mapping
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from typing import Any, TypeVar, Union, dataclass_transform

from brokk_rl.errors import ConfigError

T = TypeVar("T")


@dataclass_transform(frozen_default=True, kw_only_default=True)
def spec(cls: type[T]) -> type[T]:
    """Turn `cls` into a spec: a frozen, keyword-only dataclass that checks its field types.

    A YAML list becomes a tuple. An integer given for a float becomes a float, and a whole number
    such as 48e6 given for an integer becomes an integer. NaN and any other mismatch raise a
    `ConfigError` that names the field, the expected type and the value. A spec may define
    `check(self)` for rules between fields. Specs are pure data: a number lives in one YAML file, so fields have no
    defaults here, but for what files from before a field existed mean.
    """
    cls.__post_init__ = _post_init  # type: ignore[attr-defined]
    return dataclass(frozen=True, kw_only=True)(cls)


def name_spec(value: object) -> str:
    """Return the name of a spec in reports and files: its `label`, else its class in lower case.

    A class attribute `label` keeps the name in files when the class is renamed.
    """
    return getattr(value, "label", type(value).__name__.lower())


def restore_spec(kind: type[T], values: Mapping[str, Any]) -> T:
    """Return the spec `kind` with plain values, as `dataclasses.asdict` gives them.

    The classes come from the annotations of `kind`, never from the values: a file of somebody else
    can choose numbers, but no code.

    Raises:
        ConfigError: A field is unknown, missing, or of another type.
    """
    hints = typing.get_type_hints(kind)
    names = {field.name for field in fields(kind)}  # type: ignore[arg-type]
    needed = {field.name for field in fields(kind) if _is_needed(field)}  # type: ignore[arg-type]
    if wrong := (values.keys() - names) | (needed - values.keys()):
        odd = ", ".join(sorted(wrong))
        raise ConfigError(f"{kind.__name__}: unknown or missing fields: {odd}")
    return kind(**{name: restore_value(hints[name], value) for name, value in values.items()})


def _is_needed(field: Field[Any]) -> bool:
    return field.default is MISSING and field.default_factory is MISSING


def restore_value(hint: Any, value: Any) -> Any:
    """Return a plain value as the annotation `hint` has it; see `restore_spec`."""
    if isinstance(value, Mapping):
        if typing.get_origin(hint) is dict:
            inner = typing.get_args(hint)[1]
            return {name: restore_value(inner, item) for name, item in value.items()}
        for kind in (hint, *typing.get_args(hint)):
            if isinstance(kind, type) and is_dataclass(kind):
                return restore_spec(kind, value)
    if isinstance(value, (list, tuple)):
        for kind in (hint, *typing.get_args(hint)):
            if typing.get_origin(kind) is tuple:
                return tuple(restore_value(typing.get_args(kind)[0], item) for item in value)
    return value


def _post_init(self: Any) -> None:
    hints = typing.get_type_hints(type(self))
    for field in fields(self):
        where = f"{type(self).__name__}.{field.name}"
        object.__setattr__(
            self, field.name, _convert(getattr(self, field.name), hints[field.name], where)
        )
    if check := getattr(self, "check", None):
        check()


def _convert(value: Any, hint: Any, where: str) -> Any:
    """Return `value` converted to the annotated type, or raise a `ConfigError`."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any:
        return value
    if origin in (Union, types.UnionType):
        return _convert_union(value, args, where)
    if origin is typing.Literal:
        if value not in args:
            raise ConfigError(
                f"{where}: expected one of {', '.join(map(repr, args))}, got {value!r}"
            )
        return value
    if origin is tuple and isinstance(value, (list, tuple)):
        inner = [args[0]] * len(value) if args[-1] is Ellipsis else list(args)
        if len(inner) != len(value):
            raise ConfigError(
                f"{where}: expected {len(inner)} values, got {len(value)}: {list(value)}"
            )
        items = []
        for i, (v, h) in enumerate(zip(value, inner, strict=True)):
            items.append(_convert(v, h, f"{where}[{i}]"))
        return tuple(items)
    if origin is dict and isinstance(value, dict):
        table = {}
        for k, v in value.items():
            table[_convert(k, args[0], where)] = _convert(v, args[1], f"{where}.{k}")
        return table
    plain = origin or hint
    if plain is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if plain is int and isinstance(value, float) and value.is_integer():
        return int(value)
    if plain is float and isinstance(value, float) and math.isnan(value):
        raise ConfigError(f"{where}: expected a number, got nan")
    protocol = getattr(plain, "_is_protocol", False)
    wrong_bool = isinstance(value, bool) and plain in (int, float)
    if not protocol and (wrong_bool or not isinstance(value, plain)):
        name = getattr(hint, "__name__", hint)
        raise ConfigError(f"{where}: expected {name}, got {type(value).__name__} {value!r}")
    return value


def _convert_union(value: Any, hints: tuple[Any, ...], where: str) -> Any:
    for hint in hints:
        if hint is type(None):
            if value is None:
                return None
            continue
        try:
            return _convert(value, hint, where)
        except ConfigError:
            continue
    expected = " or ".join(map(_name_hint, hints))
    raise ConfigError(f"{where}: expected {expected}, got {type(value).__name__} {value!r}")


def _name_hint(hint: Any) -> str:
    """Return a type as a message names it: the values of a literal, `null` for none."""
    if hint is type(None):
        return "null"
    if typing.get_origin(hint) is typing.Literal:
        return " or ".join(map(repr, typing.get_args(hint)))
    return str(hint) if typing.get_args(hint) else getattr(hint, "__name__", str(hint))
