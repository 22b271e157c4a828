"""Arithmetic over the columns of a log, written as text: `target - q`, `0.01 * (a + b)`.

The text is parsed and walked, never executed: numbers, names of columns, `+ - * /` and brackets are
all there is. A name with other characters stands in backticks, `` `Boom Cmd` - `Boom Ms` ``.
"""

from __future__ import annotations

import ast
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from brokk_rl.errors import ConfigError

LONGEST = 1000
"""Characters of an expression; a longer one is no formula of a person, and parsing recurses."""
QUOTED = re.compile(r"`([^`]*)`")
OPERATORS: dict[type[ast.operator], Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
}
"""Operators that an expression may hold."""


@dataclass(frozen=True)
class Expression:
    """A parsed expression.

    Attributes:
        text: The text as it was given.
        names: Columns that it needs, in order of their first use.
    """

    text: str
    names: tuple[str, ...]
    _tree: ast.expr
    _quoted: tuple[str, ...]

    def evaluate(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the value, `(T,)`, for columns of one clock, each `(T,)`.

        A division by zero gives an infinite value or NaN, which the reader of a log refuses.
        """
        with np.errstate(all="ignore"):
            return np.asarray(self._value(self._tree, columns), dtype=float)

    def _value(self, node: ast.expr, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        if isinstance(node, ast.BinOp):
            left, right = self._value(node.left, columns), self._value(node.right, columns)
            return OPERATORS[type(node.op)](left, right)
        if isinstance(node, ast.UnaryOp):
            value = self._value(node.operand, columns)
            return -value if isinstance(node.op, ast.USub) else value
        if isinstance(node, ast.Constant):
            return np.float64(node.value)  # type: ignore[arg-type]
        return np.asarray(columns[_read_name(node, self._quoted)], dtype=float)


@lru_cache
def parse_expression(text: str) -> Expression:
    """Parse an expression.

    Raises:
        ConfigError: It holds anything but numbers, columns, `+ - * /` and brackets.
    """
    quoted = tuple(QUOTED.findall(text))
    numbers = iter(range(len(quoted)))
    plain = QUOTED.sub(lambda _: f" _quoted_{next(numbers)} ", text).strip()
    expected = "numbers, columns, + - * / and brackets; names with other signs in backticks"
    if len(text) > LONGEST:
        raise ConfigError(f"expression of {len(text)} signs: expected at most {LONGEST}")
    try:
        tree = ast.parse(plain, mode="eval").body
        names: dict[str, None] = {}
        _collect_names(tree, quoted, names)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise ConfigError(f"expression '{text}': expected {expected} ({error})") from error
    if not names:
        raise ConfigError(f"expression '{text}': expected at least one column")
    return Expression(text, tuple(names), tree, quoted)


def _collect_names(node: ast.expr, quoted: tuple[str, ...], names: dict[str, None]) -> None:
    """Add the columns below a node; raise a `ValueError` for a node that is no arithmetic."""
    if isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
        _collect_names(node.left, quoted, names)
        _collect_names(node.right, quoted, names)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.UAdd, ast.USub)):
        _collect_names(node.operand, quoted, names)
    elif not (isinstance(node, ast.Constant) and type(node.value) in (int, float)):
        names[_read_name(node, quoted)] = None


def _read_name(node: ast.expr, quoted: tuple[str, ...]) -> str:
    """Return the column that a node names: `q`, `header.stamp`, `positions[2]` or quoted."""
    if isinstance(node, ast.Name):
        number = re.fullmatch(r"_quoted_(\d+)", node.id)
        if number and int(number[1]) < len(quoted):
            return quoted[int(number[1])]
        return node.id
    if isinstance(node, ast.Attribute):
        return f"{_read_name(node.value, quoted)}.{node.attr}"
    if isinstance(node, ast.Subscript) and isinstance(node.slice, (ast.Constant, ast.Name)):
        index = node.slice.id if isinstance(node.slice, ast.Name) else node.slice.value
        return f"{_read_name(node.value, quoted)}[{index}]"
    raise ValueError(f"{ast.unparse(node)} is none of these")
