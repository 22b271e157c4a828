"""One measurement: its commands, the code that it measures, and the table that comes of it."""

from __future__ import annotations

import ast
import functools
import hashlib
import json
import re
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks/results"
Table = list[dict[str, Any]]


@dataclass(frozen=True)
class Measurement:
    """A figure of the project that one can make again.

    Attributes:
        name: Name of its file in `benchmarks/results`.
        title: Heading of its table on the page.
        conditions: What was simulated or recorded, how often, and what the baseline is.
        commands: Commands in their order, run in the root of the repository; `{out}` is an empty
            folder.
        code: Files and folders that the figures depend on.
        read: Reads the rows of the table from that folder.
        where: Computer that it needs and time that it takes there, in words.
    """

    name: str
    title: str
    conditions: str
    commands: tuple[str, ...]
    code: tuple[str, ...]
    read: Callable[[Path], Table]
    where: str


def load_json(path: Path) -> Any:
    """Return the content of a JSON file."""
    return json.loads(path.read_text())


def run_git(*words: str) -> str:
    """Return what git answers."""
    done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout


def hash_code(paths: Sequence[str]) -> str:
    """Return the SHA-256 over names and contents of files, without comments and docstrings."""
    found = hashlib.sha256()
    for name in sorted(run_git("ls-files", "--", *paths).splitlines()):
        if (ROOT / name).is_file():
            found.update(name.encode() + normalize_source(name, (ROOT / name).read_bytes()))
    return found.hexdigest()


@functools.cache
def normalize_source(name: str, content: bytes) -> bytes:
    """Return a file without what changes no figure."""
    if name.endswith(".yaml"):
        return re.sub(rb"(^| +)# (?!@package).*$", b"", content, flags=re.M)
    if not name.endswith(".py"):
        return content
    tree = ast.parse(content)
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [one for one in body if not is_text(one)]  # pyright: ignore
    return ast.dump(tree).encode()


def is_text(node: ast.AST) -> bool:
    """Return whether a statement is a string alone."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def read_evaluation(path: Path, head: dict[str, Any]) -> Table:
    """Return a row for each policy of an `evaluation.json`."""
    rows: Table = []
    for policy, one in load_json(path)["policies"].items():
        strict, (low, high) = one["success_strict"]["mean"], one["success_strict"]["ci95"]
        time_s = one["time_to_insert_s"]["median"]
        row = head | {
            "policy": policy,
            "strict success": round(strict, 3),
            "95 %": f"{low:.3f} to {high:.3f}",
            "inserted": round(one.get("success_reached", {"mean": strict})["mean"], 3),
            "paper's criterion": round(one["success_paper"]["mean"], 3),
            "median time, s": None if time_s is None else round(time_s, 1),
            "peak force, kN": round(one["peak_force_n"] / 1000.0, 1),
            "valve travel, 1/s": round(one["valve_travel"], 1),
            "episodes": one["episodes"],
        }
        rows.append(row)
    return rows
