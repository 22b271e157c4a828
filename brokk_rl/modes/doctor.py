"""`brokk mode=doctor`: report which parts work on this computer, with advice for the others."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Literal, NamedTuple

from packaging.utils import canonicalize_name
from rich.text import Text

from brokk_rl import extras
from brokk_rl.console_table import print_table
from brokk_rl.session import read_output
from brokk_rl.sim import probe
from brokk_rl.spec import spec

COLORS = {"ok": "green", "warn": "yellow", "fail": "red"}
RUNS = Path("runs")
"""Folder into which runs are written unless a command names another."""
MIN_FREE_GIB = 5.0
"""Free disk space below which it warns. Chosen by hand: checkpoints of some trainings."""


class DoctorFinding(NamedTuple):
    """One line of the report.

    Attributes:
        level: `fail` if an essential part does not work, `warn` if an optional part does not.
        text: The finding.
        advice: How to correct it.
    """

    level: Literal["ok", "warn", "fail"]
    text: str
    advice: str = ""


@spec
class Doctor:
    """Report which parts work on this computer: GPU, CUDA graphs, rendering, disk, packages."""

    def run(self) -> None:
        """Print the report.

        Raises:
            SystemExit: With code 1 if an essential part does not work.
        """
        checks: dict[str, Callable[[], DoctorFinding]] = {
            "packages": check_packages,
            "torch": check_torch,
            "Warp": check_warp,
            "rendering": check_rendering,
            "disk": lambda: check_disk(RUNS, MIN_FREE_GIB),
        }
        rows = []
        has_failed = False
        for topic, check in checks.items():
            found = _run_check(check)
            has_failed |= found.level == "fail"
            advice = f"\n→ {found.advice}" if found.advice else ""
            rows.append([Text(found.level, COLORS[found.level]), topic, found.text + advice])
        print_table([], rows)
        if has_failed:
            raise SystemExit(1)


def _run_check(check: Callable[[], DoctorFinding]) -> DoctorFinding:
    """Return the finding of a check; one that fails by itself becomes a warning."""
    try:
        return check()
    except ModuleNotFoundError as error:
        text = extras.explain_missing_module(str(error.name), "this check")
        return DoctorFinding("warn", text or f"{error.name} is not installed", "make setup")
    # A failure inside another package must not hide the rest of the report.
    except Exception as error:
        return DoctorFinding("warn", f"cannot tell: {type(error).__name__}: {error}")


def check_packages() -> DoctorFinding:
    """Report the packages of each extra that are missing."""
    about = extras.read_metadata()
    if about is None:
        text = f"{extras.DISTRIBUTION} runs from its sources and is not installed"
        return DoctorFinding("warn", f"{text}; versions are not checked", "make setup")
    installed = {canonicalize_name(one.name) for one in metadata.distributions()}
    lacking = {}
    for extra, requirements in extras.read_extras().items():
        names = [one.name for one in requirements]
        lacking[extra] = [name for name in names if canonicalize_name(name) not in installed]
    if lacking[""]:
        return DoctorFinding("fail", f"{', '.join(lacking[''])}: missing", "make setup")
    complete = [extra or "base" for extra, names in lacking.items() if not names]
    partial = [f"{extra} (lacks {', '.join(names)})" for extra, names in lacking.items() if names]
    text = f"{extras.DISTRIBUTION} {about['Version']}; complete: {', '.join(complete)}"
    if partial:
        text += f"; not installed: {', '.join(partial)}"
    return DoctorFinding("ok", text)


def check_torch() -> DoctorFinding:
    """Report cores and threads of the processor, the GPUs that torch can use, and their driver."""
    import torch

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    threads = torch.get_num_threads()
    driver = read_output(["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"])
    driver = driver and driver.split()[0]  # a line for each GPU
    text = f"{torch.__version__}, {threads} threads on {cores} cores, "
    text += f"built for CUDA {torch.version.cuda or 'none'}, driver {driver or 'none'}"
    if torch.cuda.is_available():
        gpus = [torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count())]
        return DoctorFinding("ok", f"{text}: {', '.join(gpus)}")
    if driver:
        advice = "the driver may be too old for this CUDA, or CUDA_VISIBLE_DEVICES hides the GPU"
        return DoctorFinding("warn", f"{text}, but torch sees no GPU", advice)
    if threads > (cores or 1):
        advice = f"more threads than cores slow each other down: OMP_NUM_THREADS={cores}"
        return DoctorFinding("warn", text, advice)
    return DoctorFinding("ok", f"{text}: everything runs on the CPU")


def check_warp() -> DoctorFinding:
    """Report Warp, and whether a GPU captures a control step in a CUDA graph."""
    import torch

    text = f"Warp {metadata.version('warp-lang')}"
    if not torch.cuda.is_available():
        return DoctorFinding("ok", f"{text}; without a GPU no CUDA graphs are needed")
    try:
        return DoctorFinding("ok", f"{text}; captured a CUDA graph on {probe.capture_graph()}")
    except Exception as error:
        advice = "training works, several times slower; a newer driver usually mends it"
        return DoctorFinding("warn", f"{text}; cannot capture a CUDA graph: {error}", advice)


def check_rendering() -> DoctorFinding:
    """Check that MuJoCo can render, which only videos need."""
    if name := probe.find_renderer():
        return DoctorFinding("ok", f"MuJoCo draws with MUJOCO_GL={name}")
    text = f"MuJoCo cannot draw with any of {', '.join(probe.RENDERERS)}: no videos"
    return DoctorFinding("warn", text, "install libegl1 and libgl1, or libosmesa6")


def check_disk(folder: Path, min_free_gib: float) -> DoctorFinding:
    """Check that runs can be written, and report the free space."""
    place = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    try:
        tempfile.TemporaryFile(dir=place).close()
    except OSError as error:
        advice = "work in a folder of your own, or give session.out=<folder>"
        return DoctorFinding("fail", f"cannot write into {place}: {error.strerror}", advice)
    free_gib = shutil.disk_usage(place).free / 2**30
    text = f"{free_gib:.1f} GiB free for {folder}"
    if free_gib < min_free_gib:
        return DoctorFinding("warn", text, "checkpoints and recordings need more; free some space")
    return DoctorFinding("ok", text)
