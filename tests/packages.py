"""Packages of other people, as a wheel would install them."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

from brokk_rl import extensions

EXAMPLE = Path(__file__).parents[1] / "examples/my_package/my_package"


def install_package(
    folder: Path, name: str, files: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Put a package with an entry point where a wheel would put it, on the import path.

    Modules of another test's package of the same name are forgotten first.
    """
    for module in [one for one in sys.modules if one.split(".")[0] == name]:
        del sys.modules[module]
    for path, text in {"__init__.py": "", "conf/__init__.py": "", **files}.items():
        (folder / name / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / name / path).write_text(text)
    about = folder / f"{name}-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[brokk_rl.conf]\n{name} = {name}.conf\n")
    monkeypatch.syspath_prepend(str(folder))
    importlib.invalidate_caches()


def install_example(folder: Path, monkeypatch: pytest.MonkeyPatch, **more: str) -> Path:
    """Install `examples/my_package`, with `more` files by path, into a folder; return it."""
    files = {}
    for path in EXAMPLE.rglob("*.*"):
        if path.suffix in (".py", ".yaml", ".xml"):
            files[str(path.relative_to(EXAMPLE))] = path.read_text()
    install_package(folder, "my_package", files | more, monkeypatch)
    extensions.register_options([])
    return folder
