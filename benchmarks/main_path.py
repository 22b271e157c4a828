"""Files and functions that run from `brokk mode=train` to the end of the first PPO update.

    python benchmarks/main_path.py [overrides…]

Trains sixteen worlds on a CPU and prints each file of the project with the functions that it ran.
"""

from __future__ import annotations

import inspect
import sys
import tempfile
from collections import defaultdict
from pathlib import Path
from types import FrameType
from typing import Any

ROOT = Path(__file__).parents[1]
WORDS = (
    "mode=train",
    "session.device=cpu",
    "sim=native",
    "rl.num_envs=16",
    "rl.num_starts=64",
    "rl.budget.max_env_steps=384",
    "evaluation.video=false",
)


class FirstUpdate(BaseException):
    """Ends the measurement."""


class PathRecorder:
    """Profiler that notes files and their functions."""

    def __init__(self) -> None:
        self.functions: dict[str, set[str]] = defaultdict(set)

    def __call__(self, frame: FrameType, event: str, argument: Any) -> None:
        """Note one event of `sys.setprofile`."""
        code = frame.f_code
        if event not in ("call", "return") or not code.co_filename.startswith(f"{ROOT}/"):
            return
        file = code.co_filename.removeprefix(f"{ROOT}/")
        # the bodies of modules and classes run at import, comprehensions with their function
        is_function = code.co_flags & inspect.CO_OPTIMIZED and not code.co_name.startswith("<")
        if file.startswith((".venv", "benchmarks")) or not is_function:
            return
        if event == "return":
            if file == "brokk_rl/rl/ppo.py" and code.co_name == "update":
                raise FirstUpdate
            return
        self.functions[file].add(code.co_qualname)

    def print_table(self) -> None:
        """Print the files, most functions first."""
        for file, names in sorted(self.functions.items(), key=lambda item: -len(item[1])):
            print(f"{len(names):4d} functions  {file}")
        print(f"{len(self.functions)} files, {sum(map(len, self.functions.values()))} functions")


def main() -> None:
    """Run a training until its first update has ended."""
    sys.path.insert(0, str(ROOT))
    from brokk_rl import cli

    recorder = PathRecorder()
    with tempfile.TemporaryDirectory() as folder:
        sys.argv = ["brokk", *WORDS, f"session.out={folder}/run", *sys.argv[1:]]
        sys.setprofile(recorder)
        try:
            cli.main()
        except FirstUpdate:
            pass
        finally:
            sys.setprofile(None)
    recorder.print_table()


if __name__ == "__main__":
    main()
