"""The architecture as rules over syntax trees: each takes the sources by module name and returns what breaks it."""

from __future__ import annotations

import ast
import functools
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

ROOMS = ("tasks", "actuators", "perception", "deploy", "diagnosis")
EXTENSIONS = ("exam", "study")
"""Packages that stand on all rooms, as a package from elsewhere would."""
ROOM_DOORS = {"diagnosis": ("actuators",)}
"""Rooms that a room may import: a diagnosis is about the models and recordings of actuators."""
MODE = 4
"""Floor of the modes: `brokk_rl.modes` and `<room>.modes`."""
FLOORS = (
    ("brokk_rl.cli", 5),
    ("brokk_rl.job", 5),
    ("brokk_rl.arguments", 5),
    ("brokk_rl.explain", 5),
    ("brokk_rl.__main__", 5),
    ("diagnosis.api", 5),
    ("brokk_rl.extensions", 5),
    ("brokk_rl.policy_choice", 5),
    ("conf", 5),
    *((f"{package}.modes", MODE) for package in ("brokk_rl", *ROOMS, *EXTENSIONS)),
    *((package, 3) for package in (*ROOMS, *EXTENSIONS)),
    ("brokk_rl.play", 3),
    ("brokk_rl.sim", 2),
    ("brokk_rl.rl", 2),
    ("brokk_rl.spec", 0),
    ("brokk_rl.errors", 0),
    ("brokk_rl", 1),
)
"""Floor of each package, the first that fits: roof, modes, rooms and diagnosis, sim and rl,
bedrock, and ground for the rest."""
COMPOSERS = (
    "brokk_rl.arguments",
    "brokk_rl.cli",
    "brokk_rl.job",
    "brokk_rl.explain",
    "brokk_rl.extensions",
    "brokk_rl.policy_choice",
)
"""Modules that compose the configuration or explain why it does not compose."""
DOORS = {
    "hydra": COMPOSERS,
    "omegaconf": COMPOSERS,
    "mujoco": ("brokk_rl.sim", "diagnosis.mjcf"),
    "mujoco_warp": ("brokk_rl.sim",),
    "warp": ("brokk_rl.sim", "diagnosis.engine"),
    "rsl_rl": ("brokk_rl.rl",),
    "tensordict": ("brokk_rl.rl",),
    "wandb": ("brokk_rl.rl",),
    "cv2": ("perception", "deploy.picture"),
    "mjviser": ("brokk_rl.play",),
    "viser": ("brokk_rl.play",),
    "trimesh": ("brokk_rl.sim",),
    "can": ("deploy", "actuators.recordings.can_log"),
    "cantools": ("deploy", "actuators.recordings.can_log"),
}
INPUT_AND_OUTPUT = ("torch", "os", "pathlib", "socket", "io", "time")
CLOSED = {
    "deploy": ("brokk_rl.sim", "brokk_rl.rl", "mujoco", "warp", "rsl_rl"),
    "deploy.kernel.guard": (*INPUT_AND_OUTPUT, "numpy", "deploy.checks"),
    "deploy.kernel.limits": (*INPUT_AND_OUTPUT, "numpy"),
    "deploy.kernel.plausibility": (*INPUT_AND_OUTPUT, "numpy"),
    "deploy.kernel.under_way": (*INPUT_AND_OUTPUT, "numpy"),
    "deploy.kernel.flow_check": (*INPUT_AND_OUTPUT, "numpy"),
    "deploy.kernel.target_check": INPUT_AND_OUTPUT,
    "deploy.kernel.receiver": (*INPUT_AND_OUTPUT, "deploy.checks"),
    "deploy.kernel.bus_logic": (*INPUT_AND_OUTPUT, "deploy.checks"),
    "deploy.checks.envelope": INPUT_AND_OUTPUT,
    "deploy.checks.observer": INPUT_AND_OUTPUT,
}
"""What a package must not import, whatever its floor: the machine's own computer has neither
simulator nor trainer."""
VAGUE = {"utils", "util", "helpers", "helper", "common", "base", "manager", "misc"}
HOOKS = {"check"}
"""Methods that mean the same everywhere and are explained where they are called: `check` in
`brokk_rl.spec`."""
OTHER_UNITS = ("_deg", "_mm", "_cm", "_ms", "_km_h", "_bar")


@dataclass(frozen=True)
class Import:
    """An import of `name` in line `line`."""

    name: str
    line: int


@functools.cache
def imports(tree: ast.Module) -> list[Import]:
    """Return what a module imports when it runs; what the type checker alone imports binds nothing."""
    found = []
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Import):
            found += [Import(alias.name, node.lineno) for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found += [Import(f"{node.module}.{alias.name}", node.lineno) for alias in node.names]
        elif isinstance(node, ast.stmt | ast.Module | ast.ExceptHandler | ast.match_case):
            waiting += [one for one in ast.iter_child_nodes(node) if not is_for_types(node)]
    return found


def is_for_types(node: ast.AST) -> bool:
    """Returns whether a statement is a block that only a type checker reads."""
    test = node.test if isinstance(node, ast.If) else None
    return isinstance(test, ast.Name) and test.id == "TYPE_CHECKING"


def floor(module: str) -> int | None:
    """Returns the floor of a module of ours, `None` for a foreign one."""
    return next((level for package, level in FLOORS if within(module, package)), None)


def within(module: str, package: str) -> bool:
    """Returns whether `module` is `package` or lies in it."""
    return module == package or module.startswith(f"{package}.")


def floors(sources: Mapping[str, str]) -> list[str]:
    """Imports go down only; `brokk_rl` imports no room, and rooms import each other by doors only."""
    found = []
    for module, tree in read_trees(sources):
        mine, room = floor(module), module.split(".")[0]
        for entry in imports(tree):
            other, top = floor(entry.name), entry.name.split(".")[0]
            if other is None or mine is None:
                continue
            up = other > mine
            into_room = top in (*ROOMS, *EXTENSIONS, "conf") and top != room
            into_room = into_room and not (room in EXTENSIONS and top in ROOMS)
            into_room = into_room and top not in ROOM_DOORS.get(room, ())
            if up or into_room:
                found.append(
                    f"{module}:{entry.line} imports {entry.name}, which is {'above it' if up else 'a room of its own'}"
                )
    return found


def doors(sources: Mapping[str, str]) -> list[str]:
    """Each foreign package has one door, and some packages stay out of others altogether."""
    found = []
    for module, tree in read_trees(sources):
        for entry in imports(tree):
            allowed = DOORS.get(entry.name.split(".")[0])
            if allowed and not any(within(module, package) for package in allowed):
                found.append(
                    f"{module}:{entry.line} imports {entry.name}; only {' and '.join(allowed)} may"
                )
            for package, closed in CLOSED.items():
                if within(module, package) and any(within(entry.name, name) for name in closed):
                    found.append(
                        f"{module}:{entry.line} imports {entry.name}, which {package} must do without"
                    )
    return found


def vague_names(sources: Mapping[str, str]) -> list[str]:
    """Modules and folders are nouns that say what is in them."""
    vague = [(module, part) for module in sources for part in VAGUE & set(module.split("."))]
    return [f"{module}: '{part}' says nothing" for module, part in vague]


def docstrings(sources: Mapping[str, str]) -> list[str]:
    """Every public method says what it is; ruff asks modules, classes and functions."""
    found = []
    for module, tree in read_trees(sources):
        for owner in tree.body:
            if isinstance(owner, ast.ClassDef) and not owner.name.startswith("_"):
                found += [
                    f"{module}:{one.lineno} {one.name} has no docstring" for one in _bare(owner)
                ]
    return found


def units(sources: Mapping[str, str]) -> list[str]:
    """Physical names carry SI units; counts are `num_…`."""
    found = []
    for module, tree in read_trees(sources):
        for node in ast.walk(tree):
            name = (
                node.target.id
                if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
                else None
            )
            name = node.arg if isinstance(node, ast.arg) else name
            if name and name.endswith(OTHER_UNITS):
                found.append(f"{module}: {name} is not in SI units")
            if name and name.startswith("n_"):
                found.append(f"{module}: {name} is a count: num_{name[2:]}")
    return found


PREDICATES = ("is", "has", "can", "does", "may", "needs", "as", "to", "from", "main")
"""First words of names that need no verb: predicates, conversions and the entry of a script."""
VERBS = frozenset(Path(__file__).with_name("verbs.txt").read_text().split())


def verb_names(sources: Mapping[str, str], exceptions: Collection[str] = ()) -> list[str]:
    """A function of a module begins with a verb."""
    found = []
    for module, tree in read_trees(sources):
        for node in tree.body:
            if not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                continue
            name = node.name.lstrip("_")
            if name.split("_")[0] not in (*VERBS, *PREDICATES) and node.name not in exceptions:
                found.append(f"{module}:{node.lineno} {node.name} does not begin with a verb")
    return found


def unique_classes(sources: Mapping[str, str]) -> list[str]:
    """The name of a public class exists once."""
    owners: dict[str, list[str]] = {}
    for module, tree in read_trees(sources):
        for node in tree.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                owners.setdefault(node.name, []).append(module)
    return [
        f"{name} is a class of {', '.join(modules)}"
        for name, modules in owners.items()
        if len(modules) > 1
    ]


def circles(sources: Mapping[str, str]) -> list[str]:
    """Modules do not import each other in a circle, not even for the type checker alone."""
    graph: dict[str, set[str]] = {}
    for module, tree in read_trees(sources):
        names = set()
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module and not node.level:
                inside = [f"{node.module}.{alias.name}" for alias in node.names]
                names |= {name if name in sources else node.module for name in inside}
        graph[module] = {name for name in names if name in sources and name != module}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return [" -> ".join(reversed(error.args[1]))]
    return []


def read_trees(sources: Mapping[str, str]) -> Iterator[tuple[str, ast.Module]]:
    """Yields each module's name and tree."""
    for module, text in sources.items():
        yield module, _parse(text)


@functools.cache
def _parse(text: str) -> ast.Module:
    """Return the tree of a source; each rule asks for all of them."""
    return ast.parse(text)


def _bare(owner: ast.ClassDef) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    """Yield the public methods without a docstring; a setter is explained where it is read."""
    for one in owner.body:
        if not isinstance(one, (ast.FunctionDef, ast.AsyncFunctionDef)):
            continue
        is_setter = any(getattr(mark, "attr", "") == "setter" for mark in one.decorator_list)
        is_public = not one.name.startswith("_") and one.name not in HOOKS
        if is_public and not is_setter and not ast.get_docstring(one):
            yield one


NUMBER = re.compile(r"(?:^|[\s:,\[{])-?\d[\d_]*\.?\d*(?:e[-+]?\d+)?(?=[\s,\]}]|$)")
"""A number in YAML: not a part of a word, an address or a command."""
WORDS = re.compile(r"\"[^\"]*\"|'[^']*'|\$\{[^}]*\}|_target_: [\w.]+")
"""Parts of a line of YAML that hold no numbers."""


def uncommented_numbers(files: Mapping[str, str]) -> list[str]:
    """Return the lines of YAML with a number that nobody explains.

    A number is explained by a comment on its line or above it, by the same of a block that it
    stands in, or by a field `source`.
    """
    found = []
    for name, text in files.items():
        blocks: list[tuple[int, bool]] = []  # indentation of the open blocks, and their comments
        above = False
        for count, line in enumerate(text.splitlines(), 1):
            code, mark, _ = WORDS.sub("", line).partition("#")
            if not code.strip():
                above = bool(mark) and bool(blocks)  # a comment at the top describes the file
                continue
            indent = len(code) - len(code.lstrip())
            while blocks and blocks[-1][0] >= indent:
                blocks.pop()
            explained = bool(mark) or above or "source:" in code or any(c for _, c in blocks)
            if not explained and NUMBER.search(code):
                found.append(f"{name}:{count}: a number without unit and source")
            blocks.append((indent, explained))
            above = False
    return found
