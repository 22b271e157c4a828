"""Size of what an extra installs, and the processor time until its first import is done.

    python benchmarks/install_size.py diagnose diagnosis.api benchmarks/cpu/install_diagnose.json

Sizes are those of the files of this environment. torch from the CPU index brings none of the packages for
CUDA; `--torch <wheel>` takes its size from such a wheel.
"""

from __future__ import annotations

import argparse
import importlib.metadata as metadata
import json
import resource
import subprocess
import sys
import zipfile
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

CUDA = ("nvidia-", "cuda-", "triton")
"""Beginnings of the names of packages that only torch with CUDA needs."""


def list_sizes(extra: str) -> dict[str, float]:
    """Return the size of each package that the extra needs, MB."""
    todo, sizes = [("brokk-rl", frozenset({"", extra}))], {}
    while todo:
        name, extras = todo.pop()
        package = metadata.distribution(name)
        if name != "brokk-rl":
            paths = [Path(str(package.locate_file(file))) for file in package.files or []]
            sizes[name] = sum(path.stat().st_size for path in paths if path.is_file()) / 1e6
        for line in package.requires or []:
            need = Requirement(line)
            other = canonicalize_name(need.name)
            told = need.marker is None or any(need.marker.evaluate({"extra": e}) for e in extras)
            if told and other == "brokk-rl":
                todo.append((other, frozenset(need.extras)))
            elif told and other not in sizes:
                todo.append((other, frozenset({"", *need.extras})))
    return sizes


def measure_import_s(module: str) -> float:
    """Return the processor time of a process that imports the module, s."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", f"import {module}"], check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    """Measure, and write the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("extra")
    parser.add_argument("module")
    parser.add_argument("out", type=Path)
    parser.add_argument("--torch", type=Path, help="wheel of torch from the CPU index")
    asked = parser.parse_args()
    sizes = list_sizes(asked.extra)
    light = {name: size for name, size in sizes.items() if not name.startswith(CUDA)}
    if asked.torch is not None:
        with zipfile.ZipFile(asked.torch) as wheel:
            light["torch"] = sum(file.file_size for file in wheel.infolist()) / 1e6
    found = {
        "command": "python benchmarks/install_size.py "
        f"{asked.extra} {asked.module} {asked.out.name}"
        + " --torch <CPU wheel>"
        * (asked.torch is not None),
        "extra": asked.extra,
        "with_cuda_mb": sum(sizes.values()),
        "without_cuda_mb": sum(light.values()),
        "import_cpu_s": min(measure_import_s(asked.module) for _ in range(3)),
        "packages_mb": dict(sorted(light.items(), key=lambda one: -one[1])),
    }
    asked.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
