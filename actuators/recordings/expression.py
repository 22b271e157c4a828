"""Arithmetic over the columns of a log, written as text: `target - q`, `0.01 * (a + b)`.

Only numbers, names of columns, `+ - * /` and brackets are taken from the text; nothing else of it is
compiled. A name with other characters stands in backticks, `` `Boom Cmd` - `Boom Ms` ``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import CodeType

import numpy as np

from brokk_rl.errors import ConfigError

LONGEST = 1000
"""Characters of an expression; a longer one is no formula of a person, and parsing recurses."""
TOKEN = re.compile(
    r"(?P<number>(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?)|`(?P<quoted>[^`]*)`|(?P<sign>[-+*/()])|\s+"
    r"|(?P<name>[^\W\d]\w*(\.[^\W\d]\w*|\[\w+\])*)"
)
"""Part of an expression: `header.stamp` and `positions[2]` are names."""
CALL = re.compile(r"[\w)] +\(")
"""A bracket that an operator should precede."""


@dataclass(frozen=True)
class Expression:
    """A parsed expression.

    Attributes:
        names: Columns that it needs, in order of their first use.
    """

    names: tuple[str, ...]
    _code: CodeType

    def evaluate(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the value, `(T,)`, for columns of one clock, each `(T,)`.

        A division by zero gives an infinite value or NaN, which the reader of a log refuses.
        """
        values = {f"_{at}": np.asarray(columns[name]) for at, name in enumerate(self.names)}
        with np.errstate(all="ignore"):
            return np.asarray(eval(self._code, {"__builtins__": {}}, values), dtype=float)


@lru_cache
def parse_expression(text: str) -> Expression:
    """Parse an expression.

    Raises:
        ConfigError: It holds anything but numbers, columns, `+ - * /` and brackets.
    """
    names: dict[str, str] = {}
    parts = []
    for token in TOKEN.finditer(text):
        name = token["name"] if token["quoted"] is None else token["quoted"]
        if name is not None:
            parts.append(names.setdefault(name, f"_{len(names)}"))
        else:
            parts.append(token["number"] or token["sign"] or "")
    plain = " ".join(part for part in parts if part)
    is_arithmetic = not TOKEN.sub("", text) and not CALL.search(plain)
    try:
        if not names or not is_arithmetic or len(text) > LONGEST:
            raise ValueError("it is none")
        code = compile(plain, "<expression>", "eval")
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise ConfigError(
            f"expression '{text[:80]}': expected numbers, columns, + - * / and brackets of at most {LONGEST} signs; "
            f"names with other signs in backticks ({error})"
        ) from error
    return Expression(tuple(names), code)
