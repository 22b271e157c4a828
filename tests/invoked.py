"""Commands of a newcomer, one after the other in a process of their own: they share the imports."""

from __future__ import annotations

import contextlib
import io
import json
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

TOO_LONG_S = 120
"""Time after which a command that nobody refused is ended, and with it the process."""


@dataclass(frozen=True)
class Refusal:
    """End of a command: exit code, what it said, and whether torch was loaded."""

    code: int
    told: str
    torch: bool


def refuse_all(commands: Sequence[tuple[str, ...]], desk: Path) -> dict[tuple[str, ...], Refusal]:
    """Runs commands that are to be refused in `desk`, whose modules can be imported."""
    paths = os.pathsep.join((str(Path(__file__).parents[1]), str(desk)))
    done = subprocess.run(
        [sys.executable, "-B", __file__],
        input=json.dumps(commands),
        capture_output=True,
        text=True,
        cwd=desk,
        env=os.environ | {"PYTHONPATH": paths, "COLUMNS": "200"},
    )
    assert done.returncode == 0, done.stderr
    found = [Refusal(**one) for one in json.loads(done.stdout)]
    return dict(zip(commands, found, strict=True))


def _run(words: Sequence[str]) -> Refusal:
    from brokk_rl import cli

    sys.argv = ["brokk", *words]
    signal.alarm(TOO_LONG_S)
    with contextlib.redirect_stdout(io.StringIO()) as told, contextlib.redirect_stderr(told):
        code = cli.main()
    return Refusal(code, told.getvalue(), "torch" in sys.modules)


def main() -> None:
    """Reads commands as JSON and writes how each ended."""
    from quick_compose import compose_once

    compose_once()
    found = [asdict(_run(words)) for words in json.load(sys.stdin)]
    json.dump(found, sys.stdout)


if __name__ == "__main__":
    main()
