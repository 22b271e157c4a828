"""Packages of other people, as a wheel would install them."""

from __future__ import annotations

from pathlib import Path


def install_package(folder: Path, name: str, files: dict[str, str]) -> None:
    """Put a package with an entry point where a wheel would put it."""
    for path, text in {"__init__.py": "", "conf/__init__.py": "", **files}.items():
        (folder / name / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / name / path).write_text(text)
    about = folder / f"{name}-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[brokk_rl.conf]\n{name} = {name}.conf\n")
