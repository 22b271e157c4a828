"""Mutants of the core: one small change each, to see whether the tests notice.

    python tests/mutants.py                          # all of the core, about half an hour
    python tests/mutants.py deploy.kernel.guard       # one module
    python tests/mutants.py 300                      # so many of the kernel, drawn by chance
    python tests/mutants.py science 200              # so many of what figures rest on

Comparisons turned, off by one boundary, negated conditions, arithmetic exchanged, constants
changed, statements dropped. Each mutant runs in a forked process. What survives stands in
`survivors.json` with the reason; anything else that survives is an error. A mutant that only
changes a text, a type or an error message is none.
"""

from __future__ import annotations

import ast
import copy
import gc
import importlib
import importlib.util
import io
import json
import os
import random
import signal
import sys
import types
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

TESTS = Path(__file__).parent
EXPLAINED = TESTS / "survivors.json"
CORE = {
    "deploy.kernel.protection": ["test_deploy_protection.py"],
    "deploy.kernel.clock": ["test_deploy_protection.py"],
    "deploy.kernel.guard": ["test_deploy_guard.py"],
    "deploy.kernel.plausibility": ["test_deploy_guard.py"],
    "deploy.kernel.under_way": ["test_deploy_guard.py"],
    "deploy.kernel.flow_check": ["test_deploy_checks.py"],
    "deploy.kernel.target_check": ["test_deploy_checks.py"],
    "deploy.kernel.receiver": ["test_deploy_receiver.py", "test_deploy_logic.py"],
    "deploy.kernel.bus_logic": ["test_deploy_logic.py"],
    "deploy.kernel.bus_process": ["test_deploy_bus_process.py"],
    "deploy.twin.gateway": ["test_deploy_gateway.py"],
    "deploy.policy.policy_process": ["test_deploy_adviser.py"],
    "deploy.checks.envelope": ["test_deploy_envelope.py"],
    "deploy.checks.shapes": ["test_deploy_envelope.py"],
    "deploy.checks.valve_model": ["test_deploy_observer.py"],
    "deploy.checks.observer": ["test_deploy_observer.py"],
}
"""Modules that decide what reaches the valves, and the tests of each."""
SCIENCE = {
    "brokk_rl.kinematics": ["test_kinematics.py"],
    "brokk_rl.observation": ["test_reward.py", "test_term_task.py"],
    "brokk_rl.statistics": ["test_compare.py"],
    "tasks.control": ["test_classical.py", "test_reward.py", "test_advice.py"],
    "tasks.terms": ["test_reward.py", "test_term_task.py"],
    "diagnosis.engine.decide": ["test_diagnosis_simulated.py", "test_servo_engine.py"],
    "diagnosis.engine.measure": ["test_diagnosis_simulated.py", "test_servo_engine.py"],
    "diagnosis.engine.rows": ["test_diagnosis_simulated.py", "test_servo_engine.py"],
    "diagnosis.engine.sizes": ["test_diagnosis_simulated.py", "test_servo_engine.py"],
    "diagnosis.repair_proof": ["test_diagnosis_simulated.py", "test_servo_engine.py"],
    "diagnosis.grown_effects": ["test_simulator_diagnosis.py"],
    "diagnosis.simulator_diagnosis": ["test_simulator_diagnosis.py"],
    "diagnosis.simulator_runs": ["test_simulator_diagnosis.py"],
    "diagnosis.simulator_search": ["test_simulator_diagnosis.py"],
    "exam.metrics": ["test_exam_marks.py", "test_exam.py"],
    "exam.score": ["test_exam_marks.py"],
}
"""Modules on which figures rest, and the tests of each."""
OURS = ("brokk_rl", "tasks", "actuators", "diagnosis", "deploy", "exam", "perception", "study")
PYTEST = ["-x", "-q", "--no-header", "--assert=plain"]
PYTEST += ["-p", "no:cacheprovider", "-p", "no:unraisableexception", "-p", "no:threadexception"]
LONGEST_S = 120
"""CPU time for the tests of one mutant."""
WAITING = 10
"""Time for them, in multiples of that."""
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
        kind = ARITHMETIC[type(node.op)]
        yield f"{type(node.op).__name__} -> {kind.__name__}", other(op=kind())
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield f"{node.value} -> {not node.value}", ast.Constant(not node.value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, (int, float)):
        yield f"{node.value} -> {node.value + 1}", ast.Constant(node.value + 1)
    elif isinstance(node, (ast.If, ast.IfExp)):
        yield "condition true", other(test=ast.Constant(True))
        yield "condition false", other(test=ast.Constant(False))
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in CALLED:
        name = CALLED[node.func.id]
        yield f"{node.func.id} -> {name}", other(func=ast.Name(name, ast.Load()))
    elif isinstance(node, (ast.Assign, ast.AugAssign)):
        yield "dropped", ast.Pass()


def _is_type(node: ast.BinOp) -> bool:
    return isinstance(node.op, ast.BitOr)


def mutants(tree: ast.Module, source: str) -> Iterator[tuple[str, ast.Module]]:
    """Yields every mutant of a module, and where and how it differs.

    A place is named by its line, not by its number: the list of survivors outlives other changes.
    """
    lines, seen = source.splitlines(), Counter[str]()
    for parent, field, index in list(find_places(tree)):
        value = getattr(parent, field)
        original = value[index] if isinstance(value, list) else value
        for words, changed in changes(original):
            number = getattr(original, "lineno", getattr(parent, "lineno", 0))
            name = f"{lines[number - 1].strip()} :: {words}"
            seen[name] += 1
            if seen[name] > 1:
                name += f" ({seen[name]})"
            _put(parent, field, index, changed)
            yield name, ast.fix_missing_locations(copy.deepcopy(tree))
            _put(parent, field, index, original)


def find_places(tree: ast.AST) -> Iterator[tuple[ast.AST, str, int]]:
    """Yields the parent, the field and the index in it of each node that may be changed."""
    nodes = [tree]
    for parent in nodes:
        for field, value in ast.iter_fields(parent):
            # what decorates a function is no part of what it decides
            if field == "decorator_list":
                continue
            for index, child in enumerate(value if isinstance(value, list) else [value]):
                if isinstance(child, ast.AST):
                    nodes.append(child)
                    # Of a module's own statements only the numbers of constants matter.
                    is_type = field in ("annotation", "returns", "bases")
                    if not is_type and not isinstance(parent, ast.Module):
                        yield parent, field, index


def _put(parent: ast.AST, field: str, index: int, child: ast.AST) -> None:
    value = getattr(parent, field)
    if isinstance(value, list):
        value[index] = child
    else:
        setattr(parent, field, child)


def list_names(module: str) -> list[str]:
    """Returns the names of all mutants of `module`."""
    source = Path(importlib.util.find_spec(module).origin).read_text()  # type: ignore[union-attr, arg-type]
    return [name for name, _ in mutants(ast.parse(source), source)]


def draw_sample(modules: Sequence[str], number: int) -> dict[str, set[str]]:
    """Draws so many mutants of the modules; those that are explained are left out."""
    explained = json.loads(EXPLAINED.read_text())
    places = []
    for module in modules:
        places += [
            (module, name) for name in list_names(module) if name not in explained.get(module, ())
        ]
    chosen: dict[str, set[str]] = {}
    for module, name in random.Random(number).sample(places, number):
        chosen.setdefault(module, set()).add(name)
    return chosen


def survivors(module: str, tests: Sequence[str], only: set[str] | None) -> tuple[list[str], int]:
    """Returns the mutants of `module` that `tests`, files, do not notice, and how many were tried.

    With `only` those mutants alone are tried.
    """
    import pytest

    source = Path(importlib.import_module(module).__file__ or "").read_text()
    found, count = [], 0
    # once as it is: it must pass, and everything that the tests import is then there for all
    # mutants
    if pytest.main([*PYTEST, *tests]):
        raise SystemExit(f"{tests} fail without any mutant")
    cache_slow_parts()
    forget_modules(module)
    if pytest.main([*PYTEST, *tests]):
        raise SystemExit(f"{tests} fail with the cache of slow parts, so that they would kill all")
    gc.freeze()
    for words, tree in mutants(ast.parse(source), source):
        if only is not None and words not in only:
            continue
        count += 1
        child = os.fork()
        if child == 0:
            # a mutant that loops or waits for ever is noticed, also where the cores are busy
            signal.setitimer(signal.ITIMER_PROF, LONGEST_S)
            signal.alarm(WAITING * LONGEST_S)
            os._exit(_killed(module, tree, tests, pytest))
        _, status = os.waitpid(child, 0)
        if os.waitstatus_to_exitcode(status) == 0:
            found.append(words)
            sys.stderr.write(f"survives: {words}\n")
    return found, count


def forget_modules(module: str) -> None:
    """Let the next import read a module's package and the tests anew, since they hold on to what they imported."""
    package = module.split(".")[0]
    packages = OURS if package == "brokk_rl" else (package,)
    for name, one in list(sys.modules.items()):
        file = getattr(one, "__file__", None) or ""
        is_test = file.startswith(str(TESTS)) and name not in ("__main__", "mutants")
        if name.split(".")[0] in packages or is_test:
            del sys.modules[name]


def cache_slow_parts() -> None:
    """Lets every mutant share what takes longest and depends on none of them: the DBC as read, composed options."""
    import cantools
    import hydra

    if not hasattr(hydra.compose, "cache"):
        hydra.compose = _cache(hydra.compose)
        cantools.database.load_file = _cache(cantools.database.load_file)


def _cache(function: Callable[..., Any]) -> Callable[..., Any]:
    cache: dict[str, Any] = {}

    def call(*args: Any, **kwargs: Any) -> Any:
        key = repr((args, kwargs))
        if key not in cache:
            cache[key] = function(*args, **kwargs)
        return cache[key]

    call.cache = cache  # type: ignore[attr-defined]
    return call


def _killed(module: str, tree: ast.Module, tests: Sequence[str], pytest: types.ModuleType) -> int:
    """Runs the tests against a mutant; 0 where they all pass."""
    made = types.ModuleType(module)
    forget_modules(module)
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        try:
            parent, _, name = module.rpartition(".")
            importlib.import_module(parent)
            sys.modules[module] = made
            exec(compile(tree, module, "exec"), made.__dict__)
            setattr(sys.modules[parent], name, made)
            return int(pytest.main([*PYTEST, *tests]))
        except BaseException:
            return 1


def main(asked: Sequence[str]) -> int:
    """Tries the mutants of the modules asked for, or a sample of the kernel's.

    Returns 1 where one survives that is not explained, or an explanation is of no use any more.
    """
    explained = json.loads(EXPLAINED.read_text())
    wrong, sample = 0, None
    known = CORE | SCIENCE
    modules = list(asked) or list(CORE)
    if asked and asked[-1].isdigit():
        kernel = [name for name in CORE if name.startswith(("deploy.kernel.", "deploy.checks."))]
        sample = draw_sample(list(SCIENCE) if asked[0] == "science" else kernel, int(asked[-1]))
        modules = list(sample)
    for module in modules:
        tests = [str(TESTS / "unit" / name) for name in known[module]]
        left, count = survivors(module, tests, sample[module] if sample else None)
        reasons = explained.get(module, {})
        new = [one for one in left if one not in reasons]
        gone = [] if sample else [one for one in reasons if one not in left]
        wrong += len(new) + len(gone)
        sys.stdout.write(
            f"{module}: {count} mutants, {len(left)} survive, {len(new)} unexplained\n"
        )
        for one in new:
            sys.stdout.write(f"  unexplained: {one}\n")
        for one in gone:
            sys.stdout.write(f"  explained, but does not survive: {one}\n")
        sys.stdout.flush()
    return int(wrong > 0)


if __name__ == "__main__":
    sys.path[:0] = [str(TESTS.parent), str(TESTS)]
    sys.exit(main(sys.argv[1:]))
