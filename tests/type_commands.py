"""Type the commands of pages as they stand there: python tests/type_commands.py [pages…]

The pages are README and the tutorials, where none is given. Each page has a folder of its own that
looks like the repository. Blocks are typed in their order by bash. A file that the page lets its
reader save is saved. Programs that run until they are stopped get Ctrl-C. Ends with 1 where a
command failed.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs/tutorials").glob("*.md")))
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.M | re.S)
SAVED = re.compile(r"as `(\w+\.(?:py|xml|yaml))`(?:, and run `([^`]+)`)?:?\s*$")
EXPECTED = re.compile(r"# exit code (\d+)")
SERVERS = re.compile(r"mode=(play|page|twin)|preset=(bench|study)")
STOPPED_S = 40
"""Seconds after which a program that runs until it is stopped gets Ctrl-C."""
SKIPPED = {
    "<": "a name of the reader's",
    "…": "values of the reader's",
    "make ": "typed by the tests of the environment and by `make` itself",
    "source ": "the environment is active",
    "pip install": "would change the environment; tests install wheel and example",
    "ssh ": "another computer",
    "brokk -m actuator=mlp,lag": "six trainings; sweeps have tests",
    "for run in": "the runs of that sweep",
    "mode=compare": "the runs of that sweep",
    "mode=deploy": "the bus of a machine",
    "runs/model": "the reader's own identification",
    "my_trace": "the example package, which a test installs and trains",
    "mine/": "the same",
    "-e mine": "the same",
    "grep my_": "the same",
    "package mine": "the same",
    "runs/mine": "13 minutes of training; `make train` takes 5",
    "machine=arm": "the same",
    "arm_trace": "the same",
    "runs/arm": "the same",
}
"""Parts of commands that are not typed here, and the reason."""


def find_blocks(page: Path) -> Iterator[tuple[str, str]]:
    """Yield the name of a file to save, or an empty name, and the text of each block."""
    text = page.read_text()
    for block in BLOCK.finditer(text):
        saved = SAVED.search(text[: block.start()][-200:].rstrip().replace("\n", " "))
        if saved and block[1]:
            yield saved[1], block[2]
            yield "", saved[2] or ""
        elif not block[1]:
            yield "", block[2]


def list_commands(block: str) -> Iterator[str]:
    """Yield the commands of a block; a loop of the shell is one command."""
    lines = block.replace("\\\n", " ")
    lines = re.sub(
        r"^(for .*?^done)$", lambda loop: loop[1].replace("\n", " "), lines, flags=re.M | re.S
    )
    yield from (line for line in lines.splitlines() if line.strip() and not line.startswith("#"))


def type_page(page: Path, folder: Path) -> int:
    """Type the commands of a page, print how each ended, and return how many failed."""
    # The folder looks like the repository; what a command writes stays in it.
    for path in ROOT.iterdir():
        if path.name not in ("runs", "multirun", ".git"):
            (folder / path.name).symlink_to(path)
    environment = os.environ | {"PYTHONPATH": f"{folder}{os.pathsep}{ROOT}"}
    environment["PATH"] = f"{ROOT / '.venv/bin'}{os.pathsep}{os.environ['PATH']}"
    num_failed = 0
    for name, block in find_blocks(page):
        if name:
            (folder / name).write_text(block)
            continue
        for command in list_commands(block):
            if any(part in command.split("  #")[0] for part in SKIPPED):
                continue
            expected = EXPECTED.search(command)
            typed, begun_s = command, time.monotonic()
            if SERVERS.search(command) and not command.startswith("timeout"):
                typed = f"timeout -s INT -k 20 {STOPPED_S} {command}"
            code = subprocess.run(["bash", "-c", typed], cwd=folder, env=environment).returncode
            if SERVERS.search(command) and code in (124, 130):
                code = 0
            if expected:
                code = int(code != int(expected[1]))
            seconds = time.monotonic() - begun_s
            state = "failed" if code else "ok"
            sys.stdout.write(f"{state:7}{seconds:6.0f} s  {page.name}: {command}\n")
            sys.stdout.flush()
            num_failed += bool(code)
    return num_failed


def main() -> int:
    """Type the pages and print a line for each command."""
    pages = [Path(name).resolve() for name in sys.argv[1:]] or PAGES
    num_failed = 0
    for page in pages:
        with tempfile.TemporaryDirectory() as folder:
            num_failed += type_page(page, Path(folder))
    return int(num_failed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
