"""Specs: the typed, frozen data that every config node becomes.

A spec is a pydantic dataclass. The annotation of a field holds its type and its bounds (`Positive`,
`Count`, `Annotated[float, Interval(ge=0.1, le=10)]`); rules between fields stand in `check`, whose
messages begin with the field: `ConfigError("num_bins: expected …, got …")`.
"""

from __future__ import annotations

import functools
import inspect
import operator
import re
import reprlib
import types
import typing
from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, dataclass_transform

from annotated_types import Ge, Gt, Interval, Lt
from pydantic import (
    AfterValidator,
    AllowInfNan,
    BeforeValidator,
    ConfigDict,
    PlainValidator,
    Strict,
    TypeAdapter,
    ValidationError,
)
from pydantic import dataclasses as pydantic_dataclasses
from pydantic_core import ArgsKwargs, PydanticCustomError
from typing_extensions import get_protocol_members, is_protocol

from brokk_rl.errors import ConfigError, list_choices

T = TypeVar("T")
WORDS = {
    "be greater": "be a number greater",
    "be less": "be a number less",
    "Input should be": "expected",
    "String should match pattern": "expected",
    "dictionary": "table",
    "tuple": "list",
    "Tuple should have": "expected",
    " after validation": "",
}
"""Words of pydantic's messages, and those of the people who write YAML."""


def _require_order(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] > value[1]:
        raise PydanticCustomError("order", "expected (lowest, highest)")
    return value


Ordered = functools.partial(AfterValidator, _require_order)
"""Constraint of a range: its first value is not above its second."""
Finite = Annotated[float, AllowInfNan(False)]
Positive = Annotated[float, Gt(0), AllowInfNan(False)]
NonNegative = Annotated[float, Ge(0), AllowInfNan(False)]
NonZero = Positive | Annotated[float, Lt(0), AllowInfNan(False)]
Share = Annotated[float, Interval(ge=0, le=1)]
"""A part of a whole, 0 to 1."""
Count = Annotated[int, Ge(1)]
WorldCount = Annotated[int, Interval(ge=1, le=10**7)]
"""Worlds side by side; the largest that was measured is 65,536."""
Index = Annotated[int, Ge(0)]
"""A whole number of 0 or more: an index, a count that may be none."""
Port = Annotated[int, Interval(ge=1, le=65535)]
"""Port of UDP or TCP."""
Seed = Annotated[int, Interval(ge=0, le=10**9)]
"""Seed of random numbers; numpy takes it below 2**32."""
Range = Annotated[tuple[Finite, Finite], Ordered()]
"""Lowest and highest value."""
PositiveRange = Annotated[tuple[Positive, Positive], Ordered()]
NonNegativeRange = Annotated[tuple[NonNegative, NonNegative], Ordered()]


class SpecError(ConfigError):
    """Fields of a spec were refused.

    Attributes:
        problems: Key below the spec, and its fault in words, of each refused field.
    """

    def __init__(self, place: str, problems: Sequence[tuple[str, str]]) -> None:
        self.problems = tuple(problems)
        lines = []
        for key, text in problems:
            lines.append(f"{place}.{key}: {text}" if key else f"{place}: {text}")
        super().__init__("\n".join(lines))


@dataclass_transform(frozen_default=True, kw_only_default=True)
def spec(cls: type[T]) -> type[T]:
    """Turn `cls` into a spec: a frozen, keyword-only dataclass that checks its fields.

    A YAML list becomes a tuple. An integer given for a float becomes a float, and a whole number
    such as 48e6 given for an integer becomes an integer. A table becomes the spec that the
    annotation names. Any other mismatch, NaN and infinity raise a `SpecError` that names the field, the
    expected value and the given one. Of a field annotated with a protocol the members are compared.
    A spec may define `check(self)` for rules between fields. Specs are pure data: a number lives in
    one YAML file, so fields have no defaults here.
    """
    hints = typing.get_type_hints(cls, include_extras=True)
    for name in inspect.get_annotations(cls):
        cls.__annotations__[name] = _constrain(hints[name])
    if "__post_init__" not in cls.__dict__ and hasattr(cls, "check"):
        cls.__post_init__ = cls.check  # type: ignore[attr-defined]
    config = ConfigDict(arbitrary_types_allowed=True, extra="forbid", defer_build=True)
    made: Any = pydantic_dataclasses.dataclass(frozen=True, kw_only=True, config=config)(cls)

    def initialise(self: Any, **values: Any) -> None:
        if not made.__pydantic_complete__:
            pydantic_dataclasses.rebuild_dataclass(made)
            made.__init__ = initialise  # pydantic has put its own there
        try:
            made.__pydantic_validator__.validate_python(ArgsKwargs((), values), self_instance=self)
        except ValidationError as error:
            raise _explain(made, error, values) from None

    made.__init__ = initialise
    return made


def name_spec(value: object) -> str:
    """Return the name of a spec in reports and files: its `label`, else its class in lower case.

    A class attribute `label` keeps the name in files when the class is renamed.
    """
    return getattr(value, "label", type(value).__name__.lower())


def require_value(key: str, hint: Any, value: Any) -> Any:
    """Return a value as the annotation `hint` has it, as a field of a spec would.

    Raises:
        ConfigError: The value is refused; the message names `key`.
    """
    try:
        return TypeAdapter(_constrain(hint)).validate_python(value)
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        raise ConfigError(f"{key}: {_describe_problem(problem)}") from None


def _require_kind(kind: type, value: Any) -> Any:
    """Return an object of the class `kind`, or with the members of the protocol `kind`."""
    if not is_protocol(kind):
        if not isinstance(value, kind):
            raise PydanticCustomError("class", "expected {name}", {"name": kind.__name__})
        return value
    members = get_protocol_members(kind)
    if lacking := sorted(name for name in members if not _has_member(value, name)):
        text = f"expected an option of its group ({kind.__name__} with {', '.join(lacking)})"
        raise PydanticCustomError("members", "{text}", {"text": text})
    return value


def _has_member(value: object, name: str) -> bool:
    # A property is not read: it may compute something.
    return name in getattr(value, "__dict__", ()) or hasattr(type(value), name)


def _constrain(hint: Any) -> Any:
    """Return an annotation with the constraints that pydantic does not set by itself.

    Numbers, words and truth values are not converted into each other, NaN and infinity are no
    numbers, and every other class is compared by `isinstance` or, for a protocol, by its members.
    """
    arguments = typing.get_args(hint)
    origin = typing.get_origin(hint)
    if origin is Annotated:
        return Annotated[(_constrain(arguments[0]), *hint.__metadata__)]  # type: ignore[return-value]
    if origin in (Union, types.UnionType):
        return functools.reduce(operator.or_, map(_constrain, arguments))
    if origin in (tuple, dict, list):
        constrained: Any = tuple(item if item is ... else _constrain(item) for item in arguments)
        return types.GenericAlias(origin, constrained)
    if hint is int:
        return Annotated[int, Strict(), BeforeValidator(_read_whole)]
    if hint is float:
        return Annotated[float, Strict(), AllowInfNan(False)]
    if hint in (bool, str):
        return Annotated[hint, Strict()]
    kind = origin or hint
    plain = (
        hint in (Any, None, type(None), Path) or origin is Literal or kind in (tuple, dict, list)
    )
    if plain or not isinstance(kind, type) or hasattr(kind, "__pydantic_fields__"):
        return hint
    return Annotated[hint, PlainValidator(functools.partial(_require_kind, kind))]


def _read_whole(value: Any) -> Any:
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _explain(kind: type, error: ValidationError, given: Any) -> SpecError:
    """Return the error of a spec; its keys are those of the data that was given."""
    problems: dict[str, str] = {}
    lacking: dict[str, list[str]] = {}
    unknown: dict[str, tuple[str, Any]] = {}
    for problem in error.errors(include_url=False):
        *above, last = problem["loc"]
        table, fields_given = _follow(above, given)
        if problem["type"] == "missing" and isinstance(last, str):
            lacking.setdefault(table, []).append(last)
        elif problem["type"] == "unexpected_keyword_argument":
            unknown.setdefault(table, (str(last), fields_given))
        else:
            problems.setdefault(_follow(problem["loc"], given)[0], _describe_problem(problem))
    for key, names in lacking.items():
        problems[key] = f"no {', '.join(names)} was given"
    for key, (name, others) in unknown.items():  # a misspelt field is lacking too
        known = {*others, *lacking.get(key, ())} - {name}
        problems[key] = f"has no field '{name}'; {list_choices(name, known)}"
    return SpecError(kind.__name__, list(problems.items()))


def _follow(place: Sequence[int | str], given: Any) -> tuple[str, Any]:
    """Return the key of a place in the data that was given, and the data there.

    The place of a union goes on with names of its types, at which the key ends.
    """
    key = ""
    for part in place:
        try:
            given = given[part]
        except (KeyError, IndexError, TypeError):
            break
        key += f"[{part}]" if isinstance(part, int) else f".{part}"
    return key.lstrip("."), given


def _describe_problem(problem: Any) -> str:
    """Return what pydantic expected, in the words of YAML, and what came."""
    text, value = problem["msg"], problem["input"]
    if problem["type"] == "missing":
        return f"expected more than {problem['loc'][-1]} values, got {_show(value)}"
    for word, ours in WORDS.items():
        text = text.replace(word, ours)
    choices = re.findall(r"'(.+?)'", problem.get("ctx", {}).get("expected", ""))
    near = get_close_matches(str(value), choices, n=1)
    return f"{text}, got {_show(value)}" + (f"; did you mean '{near[0]}'?" if near else "")


def _show(value: Any) -> str:
    if value is None:
        return "null"
    if isinstance(value, (bool, int, float)):
        return str(value).lower()
    if isinstance(value, (str, list, tuple, dict)):
        return reprlib.repr(value)
    return type(value).__name__
