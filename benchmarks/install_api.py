"""Call each function of `diagnosis.api` in the environment that runs this, and say what it lacks.

    uv venv env && uv pip install --python env 'brokk-rl[diagnose] @ .'
    env/bin/python benchmarks/install_api.py <case> benchmarks/cpu/install_api.json

The case is one of `mode=exam exam.do=make`, on `machine=brokk170`. Nothing of the working tree is imported.
"""

from __future__ import annotations

import argparse
import importlib.metadata as metadata
import json
import platform
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

ABSENT = ("mujoco", "mujoco_warp", "warp", "wandb", "rsl_rl", "tensordict", "cv2", "can", "onnx")
"""Packages of simulation, training and deployment, which the extra must not bring."""
T = TypeVar("T")


def main() -> None:
    """Call the functions, write times, versions and packages."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("case", type=Path)
    parser.add_argument("out", type=Path)
    asked = parser.parse_args()
    begun = time.process_time()
    from diagnosis import api

    seconds = {"import": round(time.process_time() - begun, 1)}

    def call(name: str, function: Callable[..., T], *arguments: Any, **options: Any) -> T:
        before = time.process_time()
        found = function(*arguments, **options)
        seconds[name] = round(time.process_time() - before, 1)
        return found

    machine = "brokk170"
    with tempfile.TemporaryDirectory() as folder:
        reference = call("load", api.load, str(asked.case / "reference" / "*.parquet"), machine)
        field = api.load(str(asked.case / "field" / "*.parquet"), reference.machine)
        fitted = call("identify", api.identify, reference, Path(folder) / "fit")
        paths = call("simulate", api.simulate, fitted, field)
        outcome = call("diagnose", api.diagnose, field, Path(folder) / "run", reference=reference)
        report = call("report", api.report, outcome, field, Path(folder) / "run")
        page_bytes = report.stat().st_size
    loaded = sorted(name for name in ABSENT if name in sys.modules)
    packages = {one.metadata["Name"] for one in metadata.distributions()}
    result = {
        "command": "python benchmarks/install_api.py <case> install_api.json",
        "cpu_s": seconds,
        "verdict": outcome.answer.verdict,
        "effects": [one.effect for one in outcome.answer.selected],
        "recordings": len(paths),
        "report_bytes": page_bytes,
        "packages": len(packages),
        "packages_without_cuda": sum(
            not name.startswith(("nvidia-", "cuda-", "triton")) for name in packages
        ),
        "loaded_that_must_not": loaded,
        "machine": f"{platform.machine()}, 2 shared cores, Python {platform.python_version()}",
        "torch": metadata.version("torch"),
    }
    asked.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
