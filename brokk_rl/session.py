"""Session of one run: folder, seed, device, and the record in `session.json`."""

from __future__ import annotations

import hashlib
import json
import os
import random
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import StringConstraints

from brokk_rl import distributed
from brokk_rl.errors import BrokkError, DeviceError, StorageError
from brokk_rl.plain_files import read_json
from brokk_rl.spec import Seed, spec

if TYPE_CHECKING:
    import numpy as np
    import torch

Device = Annotated[str, StringConstraints(pattern=r"^(auto|cpu|cuda|cuda:\d+)$")]
RECORD = "session.json"
RESOLVED = "resolved.yaml"
STAMPED = (
    "brokk-rl",
    "hydra-core",
    "torch",
    "numpy",
    "rsl-rl-lib",
    "mujoco",
    "mujoco-warp",
    "warp-lang",
    "onnxruntime",
)
"""Packages whose versions stand in `session.json`."""


@spec
class Session:
    """Folder, seed and device of one run.

    Attributes:
        out: Run folder.
        seed: Seed from which every stream of random numbers is derived.
        device: `auto` (a GPU if there is one), `cpu`, `cuda` or `cuda:<index>`.
    """

    out: str
    seed: Seed
    device: Device

    @property
    def folder(self) -> Path:
        """Run folder; `start` makes it."""
        return Path(self.out)

    def torch_device(self) -> torch.device:
        """Return the device to compute on; each of several processes has the GPU of its local rank.

        Raises:
            DeviceError: A GPU was asked for and is missing. `auto` never raises in a single
                process.
        """
        import torch

        kind, _, index = self.device.partition(":")
        rank = distributed.read_rank()
        if kind == "cpu" or (kind == "auto" and not torch.cuda.is_available()):
            return torch.device("cpu")
        number = rank.local if rank.count > 1 else int(index or 0)
        count = torch.cuda.device_count()
        if number >= count:
            raise DeviceError(
                f"session.device={self.device} asks for GPU {number}, but torch {torch.__version__} sees {count}, "
                "numbered from 0. Use session.device=cpu or auto, and with torchrun no more processes than GPUs; `brokk "
                "mode=doctor` says what is missing."
            )
        return torch.device("cuda", number)

    def stream(self, name: str) -> int:
        """Return the seed of the stream `name`, below 2**32.

        It depends on the session seed and the name only. The first of several processes has the
        streams of a single process, each other process has streams of its own.
        """
        rank = distributed.read_rank().index
        key = f"{self.seed}/{name}" + (f"/rank{rank}" if rank else "")
        return int.from_bytes(hashlib.sha256(key.encode()).digest()[:4], "little")

    def generator(self, name: str) -> np.random.Generator:
        """Return a numpy generator for the stream `name`, independent of all other streams."""
        import numpy as np

        return np.random.default_rng(self.stream(name))

    def seed_all(self) -> None:
        """Seed the global generators of Python, numpy and torch (all devices)."""
        import numpy as np

        random.seed(self.stream("python"))
        np.random.seed(self.stream("numpy"))
        try:
            import torch
        except ImportError:  # The machine's own computer has no torch.
            return
        torch.manual_seed(self.stream("torch"))

    @contextmanager
    def start(
        self, resolved: str, facts: dict[str, Any], resume: bool = False
    ) -> Iterator[dict[str, Any]]:
        """Make the run folder, write `resolved.yaml`, and keep `session.json` current in the block.

        Only the first of several processes writes. The block gets the record, in which it may put
        more fields.

        Args:
            resolved: Text of `resolved.yaml`.
            facts: Further fields of `session.json`: mode, choices, overrides, machine, fingerprint.
            resume: True if the folder may hold a run, which then goes on.

        Raises:
            StorageError: The folder holds a run and `resume` is false, or it cannot be written.
        """
        if not distributed.read_rank().first:
            yield {}
            return
        before = read_record(self.folder)
        if not resume:
            require_new_folder(self.folder)
        record = {
            "schema": 1, "outcome": "running", "objective": None, "started": _format_now(), "ended": None,
            "command": ["brokk", *sys.argv[1:]], **facts,
            "seed": self.seed, "device": self.device, "commit": describe_commit(), "versions": read_versions(), "pid": os.getpid(),
        }  # fmt: skip
        if before:
            record["started"] = before.get("started", record["started"])
            record["resumed"] = [*before.get("resumed", []), _format_now()]
        new_folders = list_missing_folders(self.folder)
        own = (self.folder / RESOLVED, self.folder / RECORD)
        earlier = {path: path.read_bytes() if path.is_file() else None for path in own}
        write_text(self.folder / RESOLVED, resolved)
        write_json(self.folder / RECORD, record)
        outcome: str | None = "failed"
        try:
            yield record
            outcome = "finished"
        except KeyboardInterrupt:
            outcome = "interrupted"
            raise
        except BaseException as error:
            record["error"] = f"{type(error).__name__}: {error}"
            if isinstance(error, BrokkError) and self._take_back(earlier, new_folders):
                outcome = None  # Refused before any work.
            raise
        finally:
            if outcome:
                record |= {"outcome": outcome, "ended": _format_now()}
                write_json(self.folder / RECORD, record)

    def _take_back(self, earlier: Mapping[Path, bytes | None], new: Sequence[Path]) -> bool:
        """Leave the folder as `start` found it and return true, unless the run has written something.

        Without that a refused resume would give its options to the next one, by the record.
        """
        begun_ns = (self.folder / RECORD).stat().st_mtime_ns
        others = set(self.folder.rglob("*")) - earlier.keys()
        if any(path.stat().st_mtime_ns >= begun_ns for path in others):
            return False
        for path, content in earlier.items():
            path.unlink()
            if content is not None:
                write_bytes(path, content)
        remove_empty_folders(new)
        return True


def read_record(folder: Path) -> dict[str, Any] | None:
    """Return the content of `session.json` in a run folder, `None` where there is none."""
    try:
        return read_json(folder / RECORD)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except ValueError as error:
        raise StorageError(f"{folder / RECORD} is not readable as JSON: {error}") from error


def require_new_folder(folder: Path) -> None:
    """Refuse a folder that holds a run or that cannot be made.

    Raises:
        StorageError: It does, or it cannot be written.
    """
    missing = list_missing_folders(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise StorageError(
            f"cannot write into {folder}: {error.strerror}. Choose session.out=<folder>."
        ) from error
    finally:
        remove_empty_folders(missing)
    before, checkpoints = read_record(folder), list(folder.glob("model_*.pt"))
    if before is not None or checkpoints:
        before = before or {}
        mode, outcome = before.get("mode", "?"), before.get("outcome", "no record of it")
        advice = "Give another folder with session.out=<folder>, or delete this one."
        if mode == "train" and checkpoints:
            newest = max(checkpoints, key=lambda path: path.stat().st_mtime)
            advice += (
                f" To go on from {newest}: brokk mode=train policy={folder} session.out={folder}"
            )
        raise StorageError(f"{folder} already holds a run ({mode}, {outcome}). {advice}")


def read_earlier_job(folder: Path, resolved: str) -> dict[str, Any] | None:
    """Return the record of the same job in an earlier run of the same sweep, or `None`.

    A sweep that is run again into the same `session.out` thus skips finished jobs.

    Args:
        folder: The job's folder.
        resolved: Expected text of its `resolved.yaml`.

    Raises:
        StorageError: The folder holds another job.
    """
    before = read_record(folder)
    if before and (folder / RESOLVED).is_file() and (folder / RESOLVED).read_text() != resolved:
        raise StorageError(
            f"{folder} already holds a job of another sweep: its {RESOLVED} differs. Run that sweep as it was, or give this one a "
            "folder of its own with session.out=<folder>."
        )
    return before


def write_json(path: Path, value: Any) -> None:
    """Write `value` as JSON in one step: a reader sees the old or the new file, never a part."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a text as `write_bytes` does."""
    write_bytes(path, text.encode())


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file in one step, and the folders above it: readers see the old file or the new one.

    Raises:
        StorageError: It cannot be written; nothing is left behind.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(data)
        part.replace(path)
    except OSError as error:
        with suppress(OSError):
            part.unlink()
        raise StorageError(
            f"cannot write {path}: {error.strerror or error}; nothing was left behind. Choose "
            "another place, for a run session.out=<folder>."
        ) from error


def list_missing_folders(folder: Path) -> list[Path]:
    """Return `folder` and its parents that do not exist yet, the innermost first."""
    return [path for path in (folder, *folder.parents) if not path.exists()]


def remove_empty_folders(folders: Sequence[Path]) -> None:
    """Remove folders, the innermost first, as far as they are there and empty."""
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


def read_versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that influence results."""
    found = {"python": ".".join(map(str, sys.version_info[:3]))}
    for name in STAMPED:
        with suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


def describe_commit() -> str | None:
    """Return the commit of this checkout, with `-dirty` if files differ; `None` outside a checkout."""
    root = Path(__file__).parents[1]
    if not (root / ".git").exists():  # A wheel may be installed inside another checkout.
        return None
    git = ["git", "-C", str(root)]
    return read_output([*git, "describe", "--always", "--abbrev=40", "--dirty", "--exclude=*"])


def read_output(command: list[str]) -> str | None:
    """Return what a short program prints; `None` where it is missing, fails or takes too long."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=20)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def _format_now() -> str:
    return datetime.now().astimezone().isoformat(timespec="seconds")
