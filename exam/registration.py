"""Registration of an exam before anyone sits it: hash of the labels, identity of the engine.

`registration.jsonl` in the folder of an exam grows by a line an event: `made`, `registered`,
`opened`. `run` compares the engine with the last one that was registered. The ledger, a file that
is kept, gets the same events of all exams, and the results.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import util
from pathlib import Path
from typing import Any, Literal

from brokk_rl import record, registry
from brokk_rl.errors import ConfigError, RecordingError, StorageError
from brokk_rl.session import describe_commit, read_versions

REGISTRATION_FILE = "registration.jsonl"
ENGINE_PACKAGES = ("diagnosis", "actuators", "brokk_rl")
"""Packages whose files make an answer; of `brokk_rl` only the modules at its top."""
ENGINE_GROUPS = (
    "certainty", "effect", "excitation", "fit", "machine", "mode", "prices", "search", "thresholds",
)  # fmt: skip
"""Groups of options that `mode=diagnose` reads: penalties, calibration, effects, fits."""
ENGINE_MODES = ("diagnose",)
ENGINE_SUFFIXES = (".py", ".yaml", ".json", ".npz", ".pt", ".onnx")
"""Source, options, and weights that ship with the source."""

Event = Literal["made", "registered", "opened", "scored"]


def compute_engine_id() -> str:
    """Return the SHA-256 over source, weights and calibration of the diagnosis, hexadecimal.

    A changed line changes it, and so does another package's option of a group that it reads.
    """
    found = hashlib.sha256()
    for name, path in sorted(_list_engine_files().items()):
        found.update(f"{name}\0".encode())
        found.update(hashlib.sha256(path.read_bytes()).digest())
    return found.hexdigest()


def _list_engine_files() -> dict[str, Path]:
    """Return the files of the engine by a name that does not depend on where it is installed."""
    files = {}
    for package in ENGINE_PACKAGES:
        place = util.find_spec(package)
        assert place is not None, "packages of this distribution"
        folder = Path(next(iter(place.submodule_search_locations or ())))
        inside = folder.glob("*") if package == "brokk_rl" else folder.rglob("*")
        for path in inside:
            if path.suffix in ENGINE_SUFFIXES:
                files[f"{package}/{path.relative_to(folder).as_posix()}"] = path
    for option in registry.list_options():
        if option.group not in ENGINE_GROUPS:
            continue
        if option.group != "mode" or option.name in ENGINE_MODES:
            files[f"{option.package}:{option.group}/{option.name}"] = option.path
    return files


@dataclass(frozen=True)
class RegistrationState:
    """State of an exam and of the engine before a run.

    Attributes:
        engine: The engine that runs now.
        registered: The engine that was registered last; `None` without a registration.
        is_opened: Whether the labels were opened already.
    """

    engine: str
    registered: str | None
    is_opened: bool

    def describe(self) -> dict[str, Any]:
        """Return the same as plain JSON data, for the folder of the answers."""
        return {
            "engine": self.engine,
            "registered": self.engine == self.registered,
            "after_opening": self.is_opened,
        }


def read_state(folder: Path) -> RegistrationState:
    """Return the state of the exam in `folder`."""
    registered, is_opened = None, False
    for line in _read_lines(folder / REGISTRATION_FILE):
        if line["event"] in ("made", "registered"):
            registered = line["engine"]
        is_opened = is_opened or line["event"] == "opened"
    return RegistrationState(compute_engine_id(), registered, is_opened)


def check_engine(folder: Path, is_sealed: bool) -> RegistrationState:
    """Return the state of an exam before a run.

    Raises:
        ConfigError: the exam is sealed, and the engine is not the registered one.
    """
    state = read_state(folder)
    if is_sealed and state.engine != state.registered:
        known = "no engine" if state.registered is None else f"engine {state.registered[:12]}"
        raise ConfigError(
            f"exam.do=run: {folder} has {known} registered, and this one is {state.engine[:12]}: source, weights or "
            f"calibration differ; commit to this engine first, exam.do=register exam.folder={folder}"
        )
    return state


def append_event(folder: Path, event: Event, facts: Mapping[str, Any], ledger: str | None) -> None:
    """Append an event to the registration of an exam, and to the ledger.

    Args:
        folder: Of the exam.
        event: What happened.
        facts: Seed, number of cases, hash of the labels, and more.
        ledger: File of all exams; `None`: none.

    Raises:
        StorageError: it cannot be written.
    """
    line = {
        "when": record.format_now(),
        "event": event,
        "engine": compute_engine_id(),
        "commit": describe_commit(),
        **facts,
    }
    if event in ("made", "registered"):
        line["versions"] = read_versions()
    append_line(folder / REGISTRATION_FILE, line)
    if ledger is not None:
        append_line(Path(ledger), line)


def note_opening(folder: Path, facts: Mapping[str, Any], ledger: str | None) -> None:
    """Note that the labels of an exam were opened, once."""
    if not any(line["event"] == "opened" for line in _read_lines(folder / REGISTRATION_FILE)):
        append_event(folder, "opened", facts, ledger)


def list_warnings(run: Path, engines: Sequence[str]) -> list[str]:
    """Return the reasons why answers are less than answers to a sealed exam, in words.

    Args:
        run: What `exam.do=run` noted in the folder of the answers.
        engines: Engines that gave them.
    """
    found = []
    if len(engines) > 1:
        found.append(f"{len(engines)} engines gave these answers")
    try:
        facts = json.loads(run.read_text())
    except (OSError, ValueError):
        return [*found, "nothing says which engine was registered for these answers"]
    if not facts["registered"]:
        found.append("this engine was not registered before it sat")
    if facts["after_opening"]:
        found.append("the labels were open before these answers were given")
    return found


def append_line(path: Path, line: Mapping[str, Any]) -> None:
    """Append a line of JSON.

    Raises:
        StorageError: it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a") as file:
            file.write(json.dumps(line, allow_nan=False) + "\n")
    except OSError as error:
        raise StorageError(f"cannot append to {path}: {error.strerror}") from error


def _read_lines(path: Path) -> list[dict[str, Any]]:
    try:
        return [json.loads(line) for line in path.read_text().splitlines()]
    except FileNotFoundError:
        return []
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path} cannot be read: {error}") from error
