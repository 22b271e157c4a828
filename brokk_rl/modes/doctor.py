"""`brokk mode=doctor`: report which parts work on this computer, with advice for the others."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import metadata, util
from pathlib import Path
from typing import Literal

from packaging.specifiers import SpecifierSet
from rich.console import Console
from rich.markup import escape
from rich.table import Table

import brokk_rl
from brokk_rl import extras, registry
from brokk_rl.errors import BrokkError
from brokk_rl.sim import probe
from brokk_rl.spec import spec

IMPORT_NAMES = (
    "brokk_rl",
    "conf",
    "tasks",
    "actuators",
    "perception",
    "deploy",
    "diagnosis",
    "exam",
)
COLORS = {"ok": "green", "warn": "yellow", "fail": "red"}


@dataclass(frozen=True)
class DoctorFinding:
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
class DoctorLimits:
    """Folder and limits of the checks.

    Attributes:
        folder: Folder in which runs will be written.
        min_free_gib: Free disk space below which it warns.
    """

    folder: str
    min_free_gib: float


@spec
class Doctor:
    """Report which parts work on this computer: GPU, CUDA graphs, rendering, disk, packages."""

    doctor: DoctorLimits

    def run(self) -> None:
        """Print the report.

        Raises:
            SystemExit: With code 1 if an essential part does not work.
        """
        table = Table(box=None, show_header=False, padding=(0, 1, 0, 0))
        failed = False
        for topic, finding in self.findings():
            advice = f"\n[dim]→ {escape(finding.advice)}[/dim]" if finding.advice else ""
            table.add_row(
                f"[{COLORS[finding.level]}]{finding.level}[/]", topic, escape(finding.text) + advice
            )
            failed |= finding.level == "fail"
        Console().print(table)
        if failed:
            raise SystemExit(1)

    def findings(self) -> Iterator[tuple[str, DoctorFinding]]:
        """Yield topic and finding, the most basic first; a failing probe becomes a warning."""
        probes: tuple[tuple[str, Callable[[], Iterator[DoctorFinding]]], ...] = (
            ("Python", check_python),
            ("packages", check_packages),
            ("processor", check_processor),
            ("torch", check_torch_devices),
            ("CUDA graphs", check_cuda_graphs),
            ("Warp", check_warp),
            ("rendering", check_rendering),
            ("disk", lambda: check_disk(Path(self.doctor.folder), self.doctor.min_free_gib)),
            ("import names", check_import_names),
            ("extensions", check_extensions),
        )
        for topic, examine in probes:
            try:
                for finding in examine():
                    yield topic, finding
            except ModuleNotFoundError as error:
                extra = extras.find_extra(str(error.name), __name__)
                advice = f"pip install '{extras.DISTRIBUTION}[{extra}]'" if extra else "make setup"
                yield topic, DoctorFinding("warn", f"{error.name} is not installed", advice)
            # A failure inside another package must not hide the rest of the report.
            except Exception as error:
                yield topic, DoctorFinding("warn", f"cannot tell: {type(error).__name__}: {error}")


def check_python() -> Iterator[DoctorFinding]:
    """Compare the Python version with the required one."""
    text = f"{platform.python_version()} on {platform.platform(terse=True)}"
    about = _read_metadata()
    wanted = SpecifierSet(about["Requires-Python"] if about else "")
    if wanted.contains(platform.python_version()):
        yield DoctorFinding("ok", text)
    else:
        yield DoctorFinding(
            "fail",
            f"{text}, but the project wants {wanted}",
            "make the environment again with such a Python: make clean setup",
        )


def check_packages() -> Iterator[DoctorFinding]:
    """Compare installed packages with the required versions."""
    about = _read_metadata()
    if about is None:
        yield DoctorFinding(
            "warn",
            f"{extras.DISTRIBUTION} runs from its sources and is not installed; versions are not checked",
            "make setup",
        )
        return
    wanted = extras.read_extras()
    complete, partial = [], []
    for extra, requirements in wanted.items():
        missing = []
        for requirement in requirements:
            try:
                version = metadata.version(requirement.name)
            except metadata.PackageNotFoundError:
                missing.append(requirement.name)
                continue
            if not requirement.specifier.contains(version, prereleases=True):
                yield DoctorFinding(
                    "warn",
                    f"{requirement.name} {version} is installed, the project wants {requirement.specifier}",
                    "make setup",
                )
        if extra == "":
            for name in missing:
                yield DoctorFinding("fail", f"{name} is missing", "make setup")
        elif missing:
            partial.append(f"{extra} (lacks {', '.join(missing[:3])}{' …' * (len(missing) > 3)})")
        else:
            complete.append(extra)
    yield DoctorFinding(
        "ok",
        f"{extras.DISTRIBUTION} {about['Version']}; extras: {', '.join(complete) or 'none'}; "
        f"not installed: {', '.join(partial) or 'none'}",
    )


def check_processor() -> Iterator[DoctorFinding]:
    """Report the cores of this process and the threads of torch."""
    import torch

    cores = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    text = f"{cores} cores ({os.cpu_count()} in all), torch uses {torch.get_num_threads()} threads"
    if torch.get_num_threads() > cores:
        yield DoctorFinding(
            "warn", text, f"more threads than cores slow each other down: OMP_NUM_THREADS={cores}"
        )
    else:
        yield DoctorFinding("ok", text)


def check_torch_devices() -> Iterator[DoctorFinding]:
    """GPUs that torch can use, and the driver behind them."""
    import torch

    built = f"{torch.__version__}, built for CUDA {torch.version.cuda or 'none'}"
    driver = read_driver_version()
    if torch.cuda.is_available():
        names = ", ".join(
            torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count())
        )
        yield DoctorFinding("ok", f"{built}, driver {driver or 'unknown'}: {names}")
    elif driver:
        advice = "the driver may be too old for this CUDA, or CUDA_VISIBLE_DEVICES hides the GPU"
        yield DoctorFinding(
            "warn", f"{built}: there is a driver {driver}, but torch sees no GPU", advice
        )
    else:
        yield DoctorFinding("ok", f"{built}; no NVIDIA GPU here, everything runs on the CPU")


def read_driver_version() -> str | None:
    """Return the version of the NVIDIA driver, `None` without one."""
    query = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    try:
        lines = subprocess.run(
            query, capture_output=True, text=True, check=True, timeout=20
        ).stdout.split()
    except (OSError, subprocess.SubprocessError):
        return None
    return lines[0] if lines else None


def check_cuda_graphs() -> Iterator[DoctorFinding]:
    """Check that a control step can be captured; without CUDA graphs a GPU is several times slower."""
    import torch

    if not torch.cuda.is_available():
        yield DoctorFinding("ok", "not needed without a GPU")
        return
    try:
        yield DoctorFinding("ok", f"captured and replayed one on {probe.capture_graph()}")
    except Exception as error:
        advice = "training works, several times slower; a newer driver usually mends it"
        yield DoctorFinding("warn", f"cannot capture: {error}", advice)


def check_warp() -> Iterator[DoctorFinding]:
    """Report the version of Warp and its kernel cache, which saves minutes of compilation."""
    cache = probe.find_kernel_cache()
    size = (
        sum(path.stat().st_size for path in cache.rglob("*") if path.is_file())
        if cache.exists()
        else 0
    )
    yield DoctorFinding(
        "ok", f"{probe.get_warp_version()}, kernel cache {cache} ({size / 2**20:.1f} MiB)"
    )


def check_rendering() -> Iterator[DoctorFinding]:
    """Check that MuJoCo can render, which only videos need."""
    name = probe.find_renderer()
    if name:
        yield DoctorFinding("ok", f"MuJoCo draws with MUJOCO_GL={name}")
    else:
        yield DoctorFinding(
            "warn",
            f"MuJoCo cannot draw with any of {', '.join(probe.RENDERERS)}: no videos",
            "install libegl1 and libgl1, or libosmesa6",
        )


def check_disk(folder: Path, min_free_gib: float) -> Iterator[DoctorFinding]:
    """Check that runs can be written, and report the free space."""
    place = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    try:
        with tempfile.TemporaryFile(dir=place):
            pass
    except OSError as error:
        yield DoctorFinding(
            "fail",
            f"cannot write into {place}: {error.strerror}",
            "work in a folder of your own, or give session.out=<folder>",
        )
        return
    free_gib = shutil.disk_usage(place).free / 2**30
    text = f"{free_gib:.1f} GiB free for {folder}"
    yield (
        DoctorFinding("ok", text)
        if free_gib >= min_free_gib
        else DoctorFinding("warn", text, "checkpoints and recordings need more; free some space")
    )


def check_import_names() -> Iterator[DoctorFinding]:
    """Check that names such as `tasks` and `conf` import this package, not another one."""
    home = Path(brokk_rl.__file__).parents[1]
    owned = 0
    for name in IMPORT_NAMES:
        found = util.find_spec(name)
        folder = (
            Path(next(iter(found.submodule_search_locations)))
            if found and found.submodule_search_locations
            else None
        )
        if folder != home / name:
            place = folder or (found.origin if found else None)
            yield DoctorFinding(
                "fail",
                f"'{name}' is {place or 'missing'}, not {home / name}",
                "install the project in an environment of its own",
            )
        else:
            owned += 1
    for distribution in metadata.distributions():
        name = distribution.metadata["Name"]
        tops = set()
        for path in distribution.files or ():
            if path.parts:
                tops.add(path.parts[0].removesuffix(".py"))
        if name != extras.DISTRIBUTION and (clash := sorted(tops.intersection(IMPORT_NAMES))):
            yield DoctorFinding(
                "warn",
                f"the package {name} also installs {', '.join(clash)}",
                f"pip uninstall {name}, or use separate environments",
            )
    yield DoctorFinding("ok", f"{owned} of {len(IMPORT_NAMES)} come from {home}")


def check_extensions() -> Iterator[DoctorFinding]:
    """Report installed packages that add options by entry point."""
    try:
        others = []
        for package in registry.find_packages():
            if package != registry.CORE:
                others.append(package)
        registry.list_options()
    except BrokkError as error:
        yield DoctorFinding("fail", str(error))
        return
    yield DoctorFinding("ok", ", ".join(others) or "none installed")


def _read_metadata() -> metadata.PackageMetadata | None:
    try:
        return metadata.metadata(extras.DISTRIBUTION)
    except metadata.PackageNotFoundError:
        return None
