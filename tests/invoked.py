"""Commands of a newcomer, each in a forked process: they share the imports, and nothing else."""

from __future__ import annotations

import contextlib
import gc
import importlib
import io
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

MODULES = ".modules"
"""Suffix of the file that lists the modules which a command has loaded."""
TOO_LONG_S = 60
"""CPU time after which a command that nobody refused is ended."""


@dataclass(frozen=True)
class Refusal:
    """End of a command: exit code, what it said, CPU time, whether torch was loaded."""

    code: int
    told: str
    cpu_s: float
    torch: bool


def refuse_all(commands: Sequence[tuple[str, ...]], desk: Path) -> dict[tuple[str, ...], Refusal]:
    """Runs commands that are to be refused in `desk`, whose modules can be imported."""
    paths = os.pathsep.join((str(Path(__file__).parents[1]), str(desk)))
    done = subprocess.run(
        [sys.executable, __file__],
        input=json.dumps(commands),
        capture_output=True,
        text=True,
        cwd=desk,
        env=os.environ | {"PYTHONPATH": paths, "COLUMNS": "200"},
    )
    assert done.returncode == 0, done.stderr
    found = [Refusal(**one) for one in json.loads(done.stdout)]
    return dict(zip(commands, found, strict=True))


def _run_forked(words: Sequence[str], told: Path) -> int:
    """Starts the command in a process of its own; returns its number."""
    number = os.fork()
    if number:
        return number
    import resource

    from brokk_rl import cli

    resource.setrlimit(resource.RLIMIT_CPU, (TOO_LONG_S, TOO_LONG_S))
    file = os.open(told, os.O_WRONLY | os.O_CREAT)
    os.dup2(file, 1)
    os.dup2(file, 2)
    sys.argv = ["brokk", *words]
    code = 3
    try:
        code = cli.main()
    except SystemExit as left:
        code = left.code if isinstance(left.code, int) else 1
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        told.with_suffix(MODULES).write_text("\n".join(sys.modules))
        os._exit(code)


def _wait(number: int, told: Path) -> Refusal:
    _, status, used = os.wait4(number, 0)
    listed = told.with_suffix(MODULES)
    modules = listed.read_text().split() if listed.exists() else []
    cpu_s = used.ru_utime + used.ru_stime
    if "torch" not in modules:
        _import_all(modules)
    return Refusal(os.waitstatus_to_exitcode(status), told.read_text(), cpu_s, "torch" in modules)


def _import_all(modules: Sequence[str]) -> None:
    """Imports what a command has imported, so that the next ones need not."""
    for name in modules:
        if name not in sys.modules:
            with contextlib.suppress(Exception):
                importlib.import_module(name)


def _warm_up() -> None:
    """Runs a refused command here, so that what every command does first is done for all."""
    from brokk_rl import cli

    sys.argv = ["brokk", "rl.num_envs=0"]
    with contextlib.redirect_stderr(io.StringIO()):
        assert cli.main() == 2
    assert "torch" not in sys.modules
    gc.disable()


def main() -> None:
    """Reads commands as JSON and writes how each ended."""
    from quick_compose import compose_once, load_cached

    import brokk_rl.cli  # for all that are forked

    compose_once()
    for path in Path(brokk_rl.cli.__file__).parents[1].glob("conf/**/*.yaml"):
        load_cached(path)

    _warm_up()
    commands = json.load(sys.stdin)
    found = []
    with tempfile.TemporaryDirectory() as folder:
        running: list[tuple[int, Path]] = []
        for place, words in enumerate(commands):
            told = Path(folder) / str(place)
            running.append((_run_forked(words, told), told))
            if len(running) == 2:
                found.append(_wait(*running.pop(0)))
        found += [_wait(*one) for one in running]
    json.dump([asdict(one) for one in found], sys.stdout)


if __name__ == "__main__":
    main()
