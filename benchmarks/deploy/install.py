"""Size and start of `brokk-rl[deploy]`: [chrt -r 1] python benchmarks/deploy/install.py <file> [extras] [trials].

Builds the wheel, installs it with the extras into an empty environment, adds up what that
environment holds, lists heavy packages that must not be there, and measures the start as
`start.py` does. Needs uv and a package index.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
HEAVY = ("torch", "mujoco", "mujoco_warp", "warp", "wandb", "rsl_rl", "scipy", "pyarrow")
LARGEST = 8
"""Entries of the table of sizes."""


def add_sizes(folder: Path) -> int:
    """Return the bytes of all files below a folder, links and hard links counted once."""
    seen, total = set(), 0
    for path in folder.rglob("*"):
        status = path.lstat()
        if path.is_file() and (status.st_dev, status.st_ino) not in seen:
            seen.add((status.st_dev, status.st_ino))
            total += status.st_size
    return total


def main(file: Path, extras: str, trials: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder)
        subprocess.run(["uv", "build", "-q", "--wheel", "-o", folder, str(ROOT)], check=True)
        wheel = next(made.glob("*.whl"))
        subprocess.run(["uv", "venv", "-q", "-p", sys.executable, f"{folder}/venv"], check=True)
        python = made / "venv/bin/python"
        install = ["uv", "pip", "install", "-q", "--compile-bytecode", "--link-mode=copy"]
        subprocess.run([*install, "-p", str(python), f"{wheel}[{extras}]"], check=True)
        packages = next((made / "venv").glob("lib/*/site-packages"))
        sizes = {path.name: add_sizes(path) for path in packages.iterdir() if path.is_dir()}
        result = {
            "extras": extras,
            "wheel_mb": round(wheel.stat().st_size / 1e6, 1),
            "installed_mb": round(add_sizes(made / "venv") / 1e6, 1),
            "largest_mb": {
                name: round(size / 1e6, 1)
                for name, size in sorted(sizes.items(), key=lambda one: -one[1])[:LARGEST]
            },
            "heavy_packages": [name for name in HEAVY if (packages / name).exists()],
        }
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
        start = [str(python), str(ROOT / "benchmarks/deploy/start.py"), f"{folder}/start.json"]
        # Its working directory is not the sources, so that the installed package is measured.
        subprocess.run([*start, str(trials)], check=True, cwd=folder, env=environment)
        result["start"] = json.loads((made / "start.json").read_text())
    file.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    given = sys.argv[2:]
    main(
        Path(sys.argv[1]).absolute(),
        given[0] if given else "deploy",
        int(given[1]) if len(given) > 1 else 7,
    )
