"""Mutants of a module: one small change each, to see whether the tests notice.

    python tests/mutants.py deploy.guard.guard tests/unit/test_deploy_guard.py

Comparisons turned, off by one boundary, negated conditions, arithmetic exchanged, constants
changed, statements dropped. Each mutant runs in a forked process; what survives is printed. A
mutant that only changes a text, a type or an error message is none.
"""

from __future__ import annotations

import ast
import copy
import importlib
import io
import os
import sys
import types
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

COMPARED = {
    ast.Lt: (ast.LtE, ast.Gt), ast.LtE: (ast.Lt, ast.Gt), ast.Gt: (ast.GtE, ast.Lt), ast.GtE: (ast.Gt, ast.Lt), ast.Eq:
    (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.Is: (ast.IsNot,), ast.IsNot: (ast.Is,), ast.In: (ast.NotIn,), ast.NotIn: (ast.In,),
}  # fmt: skip
ARITHMETIC = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Add,
    ast.Div: ast.Mult,
    ast.BitXor: ast.BitAnd,
    ast.Mod: ast.Add,
}
CALLED = {"min": "max", "max": "min", "all": "any", "any": "all"}


def changes(node: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    """Yields what `node` may be replaced by, and in which words."""

    def other(**fields: object) -> ast.AST:
        made = copy.deepcopy(node)
        for name, value in fields.items():
            setattr(made, name, value)
        return made

    if isinstance(node, ast.Compare):
        for index, operator in enumerate(node.ops):
            for kind in COMPARED[type(operator)]:
                operators = [kind() if i == index else one for i, one in enumerate(node.ops)]
                yield f"{type(operator).__name__} -> {kind.__name__}", other(ops=operators)
    elif isinstance(node, ast.BoolOp):
        yield "and <-> or", other(op=ast.Or() if isinstance(node.op, ast.And) else ast.And())
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.Not, ast.USub)):
        yield f"no {type(node.op).__name__}", node.operand
    elif isinstance(node, ast.BinOp) and type(node.op) in ARITHMETIC and not _is_type(node):
        yield (
            f"{type(node.op).__name__} -> {ARITHMETIC[type(node.op)].__name__}",
            other(op=ARITHMETIC[type(node.op)]()),
        )
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield f"{node.value} -> {not node.value}", ast.Constant(not node.value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, (int, float)):
        yield f"{node.value} -> {node.value + 1}", ast.Constant(node.value + 1)
    elif isinstance(node, (ast.If, ast.IfExp)):
        yield "condition true", other(test=ast.Constant(True))
        yield "condition false", other(test=ast.Constant(False))
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in CALLED:
        yield (
            f"{node.func.id} -> {CALLED[node.func.id]}",
            other(func=ast.Name(CALLED[node.func.id], ast.Load())),
        )
    elif isinstance(node, (ast.Assign, ast.AugAssign)):
        yield "dropped", ast.Pass()


def _is_type(node: ast.BinOp) -> bool:
    return isinstance(node.op, ast.BitOr)


def mutants(tree: ast.Module) -> Iterator[tuple[str, ast.Module]]:
    """Yields every mutant of a module, and where and how it differs."""
    dead = {
        id(one)
        for node in ast.walk(tree)
        for decorator in getattr(node, "decorator_list", ())
        for one in ast.walk(decorator)
    }
    places = [
        (parent, field, index)
        for parent in ast.walk(tree)
        if id(parent) not in dead
        for field, value in ast.iter_fields(parent)
        for index, child in enumerate(value if isinstance(value, list) else [value])
        if isinstance(child, ast.AST)
        and field not in ("annotation", "returns", "decorator_list", "bases")
    ]
    for parent, field, index in places:
        if isinstance(parent, ast.Module):
            continue
        value = getattr(parent, field)
        original = value[index] if isinstance(value, list) else value
        for words, changed in changes(original):
            _put(parent, field, index, changed)
            line = getattr(original, "lineno", getattr(parent, "lineno", 0))
            yield f"line {line}: {words}", ast.fix_missing_locations(copy.deepcopy(tree))
            _put(parent, field, index, original)


def _put(parent: ast.AST, field: str, index: int, child: ast.AST) -> None:
    value = getattr(parent, field)
    if isinstance(value, list):
        value[index] = child
    else:
        setattr(parent, field, child)


def survivors(module: str, tests: str) -> tuple[list[str], int]:
    """Returns the mutants of `module` that `tests`, a file, does not notice, and how many there were."""
    import pytest

    source = Path(importlib.import_module(module).__file__ or "").read_text()
    found, count = [], 0
    # once as it is: it must pass, and everything that the tests import is then there for all
    # mutants
    if pytest.main(["-x", "-q", "-p", "no:cacheprovider", "--no-header", tests]):
        raise SystemExit(f"{tests} fails without any mutant")
    for words, tree in mutants(ast.parse(source)):
        count += 1
        child = os.fork()
        if child == 0:
            os._exit(_killed(module, tree, tests, pytest))
        _, status = os.waitpid(child, 0)
        if os.waitstatus_to_exitcode(status) == 0:
            found.append(words)
            sys.stderr.write(f"survives: {words}\n")
    return found, count


def _killed(module: str, tree: ast.Module, tests: str, pytest: types.ModuleType) -> int:
    """Runs the tests against a mutant; 0 where they all pass."""
    made = types.ModuleType(module)
    for name in [
        name
        for name in sys.modules
        if name.startswith("deploy.") or name.split(".")[-1] == Path(tests).stem
    ]:
        del sys.modules[name]
    sys.modules[module] = made
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        try:
            exec(compile(tree, module, "exec"), made.__dict__)
            parent, _, name = module.rpartition(".")
            setattr(sys.modules[parent], name, made)
            return int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", "--no-header", tests]))
        except BaseException:
            return 1


if __name__ == "__main__":
    left, number = survivors(sys.argv[1], sys.argv[2])
    sys.stdout.write(
        "\n".join([*left, f"{len(left)} of {number} mutants of {sys.argv[1]} survive"]) + "\n"
    )
    sys.exit(bool(left))
