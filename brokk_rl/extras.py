"""Extras of the installed distribution, and which of them holds a package that is missing.

`pip install brokk-rl` brings what every mode needs. An extra adds the packages of one kind of work:
`deploy` the computer on the machine, `diagnose` a desk, `train` everything around simulation.
"""

from __future__ import annotations

import re
from importlib import metadata

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

DISTRIBUTION = "brokk-rl"
DISTRIBUTION_NAMES = {
    "av": "aiortc",
    "can": "python-can",
    "cv2": "opencv-python-headless",
    "google": "protobuf",
    "hydra_plugins": "hydra-submitit-launcher",
    "mcap_protobuf": "mcap-protobuf-support",
    "rsl_rl": "rsl-rl-lib",
    "tensordict": "rsl-rl-lib",
    "warp": "warp-lang",
}
"""Distributions that are named otherwise than the module that they bring, and those that bring a
module of another one."""
EXTRA_OF_MODULE = (
    ("study", "study"),
    ("deploy", "deploy"),
    ("perception", "perception"),
    ("diagnosis", "diagnose"),
    ("exam", "diagnose"),
    ("actuators.recordings", "logs"),
    ("actuators.modes.import_logs", "logs"),
    ("", "train"),
)
"""The extra that all of a package's own work needs; the first prefix that fits decides."""


def read_metadata() -> metadata.PackageMetadata | None:
    """Return the metadata of the installed distribution; `None` where the sources run uninstalled."""
    try:
        return metadata.metadata(DISTRIBUTION)
    except metadata.PackageNotFoundError:
        return None


def read_extras(lines: list[str] | None = None) -> dict[str, list[Requirement]]:
    """Return the requirements of each extra, those of the base under the empty name.

    Extras that name other extras of this distribution hold their requirements too.

    Args:
        lines: Requirements as the metadata of a distribution states them; `None` for those of the
            installed one, which are none where the sources run uninstalled.
    """
    if lines is None:
        about = read_metadata()
        lines = (about.get_all("Requires-Dist") if about else None) or []
    stated: dict[str, list[Requirement]] = {"": []}
    for line in lines:
        requirement = Requirement(line)
        named = re.search(r"extra == ['\"]([\w-]+)['\"]", str(requirement.marker or ""))
        stated.setdefault(named[1] if named else "", []).append(requirement)
    return {extra: _expand(stated, extra) for extra in stated}


def _expand(stated: dict[str, list[Requirement]], extra: str) -> list[Requirement]:
    expanded = []
    for requirement in stated.get(extra, []):
        if canonicalize_name(requirement.name) != DISTRIBUTION:
            expanded.append(requirement)
            continue
        for inner in sorted(requirement.extras):
            expanded += _expand(stated, inner)
    return expanded


def find_extra(
    module: str, importer: str, extras: dict[str, list[Requirement]] | None = None
) -> str | None:
    """Return the extra that brings a module, `None` where none does.

    Args:
        module: Name of the missing module.
        importer: Module or target that could not be loaded. Of several extras with the module the
            one that its work needs is taken, so that one installation is enough, or the smallest.
        extras: Requirements of each extra, those of the installed distribution by default.
    """
    top = module.partition(".")[0]
    wanted = canonicalize_name(DISTRIBUTION_NAMES.get(top, top))
    holding = {}
    for extra, requirements in (read_extras() if extras is None else extras).items():
        if extra and wanted in {canonicalize_name(one.name) for one in requirements}:
            holding[extra] = len(requirements)
    for prefix, extra in EXTRA_OF_MODULE:
        if importer.startswith(prefix) and extra in holding:
            return extra
    return min(holding, key=lambda extra: holding[extra], default=None)


def explain_missing_module(module: str, importer: str) -> str | None:
    """Return the message about a missing package, `None` where no extra brings it."""
    extra = find_extra(module, importer)
    if extra is None:
        return None
    top = module.partition(".")[0]
    return f"{importer} needs the package '{top}', which is not installed: pip install '{DISTRIBUTION}[{extra}]'"
