"""Checkpoints of actuators in safetensors with a JSON header, and files to resume fits from."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from brokk_rl.errors import CheckpointError, StorageError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording

SCHEMA = 1
"""Version of the format; another one is refused."""
SHIPPED = Path(__file__).parents[1] / "weights"
"""Folder of the checkpoints that come with the package."""


def find_checkpoint(checkpoint: str) -> Path:
    """Return the path of a checkpoint: a file, else the name of one in the package.

    Raises:
        CheckpointError: there is neither.
    """
    for path in (Path(checkpoint), SHIPPED / checkpoint):
        if path.is_file():
            return path
    shipped = ", ".join(sorted(path.name for path in SHIPPED.glob("*.safetensors"))) or "none"
    raise CheckpointError(
        f"actuator.checkpoint: there is no file '{checkpoint}' (seen from {Path.cwd()}), nor does one of that name ship with the "
        f"package ({shipped}). `brokk mode=identify` makes one."
    )


def write_checkpoint(
    path: Path,
    kind: str,
    machine: Machine,
    tensors: Mapping[str, torch.Tensor],
    facts: Mapping[str, Any],
) -> None:
    """Write a checkpoint in one step.

    Args:
        path: Where to.
        kind: Name of the model class that can load it, e.g. `mlp`.
        machine: The machine it is for.
        tensors: Weights and normalisation.
        facts: Anything else worth knowing; JSON.

    Raises:
        StorageError: the file could not be written.
    """
    header = {
        "schema": SCHEMA,
        "kind": kind,
        "machine": machine.name,
        "fingerprint": machine.fingerprint(),
        "joints": list(machine.joint_names),
        "rate_hz": 1.0 / machine.period_s,
        "num_history": machine.num_history,
        **facts,
    }
    _write(path, tensors, header, f"cannot write checkpoint {path}")


def read_checkpoint(
    path: Path, kind: str, machine: Machine
) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Return the tensors and the header of a checkpoint made for `machine`.

    Raises:
        CheckpointError: it is corrupt, of another kind, made for another machine, or holds numbers
            that are not finite.
    """
    try:
        tensors, header = _read(path)
    except (SafetensorError, OSError) as error:
        raise CheckpointError(
            f"{path}: corrupt or truncated ({error}); copy it again or make a new one with `brokk mode=identify`"
        ) from error
    except (KeyError, ValueError) as error:
        raise CheckpointError(
            f"{path}: a safetensors file, but not an actuator of ours (no 'brokk' header)"
        ) from error
    if header.get("schema") != SCHEMA or header.get("kind") != kind:
        raise CheckpointError(
            f"{path}: holds a '{header.get('kind')}' of schema {header.get('schema')}, expected a '{kind}' of schema {SCHEMA}; "
            "choose the actuator=… it was made for"
        )
    try:
        machine.check_fingerprint(header.get("fingerprint", {}), f"{path}")
    except CheckpointError as error:
        raise CheckpointError(
            f"{error} An actuator without weights fits any machine: actuator=lag."
        ) from error
    for name, value in tensors.items():
        if not bool(torch.isfinite(value).all()):
            raise CheckpointError(
                f"{path}: tensor '{name}' holds NaN or infinity; the fit diverged, make a new one with `brokk mode=identify`"
            )
    return tensors, header


def hash_recordings(recordings: Sequence[Recording]) -> str:
    """Return a short hash of the commands and positions of recordings, in their order."""
    found = hashlib.sha256()
    for recording in recordings:
        found.update(recording.u.tobytes())
        found.update(recording.q.tobytes())
    return found.hexdigest()[:16]


class ResumeFile:
    """The file from which an interrupted fit goes on.

    Args:
        path: The file; exists only while a fit is under way or interrupted.
        stamp: Settings, seed, machine and data; a fit with another stamp is another fit.
    """

    def __init__(self, path: Path, stamp: Mapping[str, Any]) -> None:
        self._path = path
        self._stamp = json.loads(json.dumps(stamp))

    def load(self, state: Mapping[str, torch.Tensor]) -> dict[str, Any] | None:
        """Restore `state` in place and return the saved progress; `None` without a file.

        Raises:
            CheckpointError: the file is corrupt, or belongs to a fit with other settings or data;
                says which.
        """
        if not self._path.is_file():
            return None
        try:
            tensors, header = _read(self._path)
            stamp, place = header["stamp"], header["place"]
        except (SafetensorError, OSError, KeyError, ValueError) as error:
            raise CheckpointError(
                f"{self._path}: corrupt ({error}); delete it to begin the fit again"
            ) from error
        differing = list(_list_differences(stamp, self._stamp))
        if differing or {name: value.shape for name, value in tensors.items()} != {
            n: v.shape for n, v in state.items()
        }:
            raise CheckpointError(
                f"{self._path}: an interrupted fit that cannot go on; these differ: {'; '.join(differing) or 'its tensors'}. "
                "Fit with what it began with, choose another folder (session.out=…), or delete the file to begin again."
            )
        with torch.no_grad():
            for name, value in state.items():
                value.copy_(tensors[name])
        return place

    def save(self, state: Mapping[str, torch.Tensor], place: Mapping[str, Any]) -> None:
        """Write `state` and `place` in one step: the file is the old or the new one.

        Raises:
            StorageError: the file could not be written; the one before it is untouched.
        """
        header = {"stamp": self._stamp, "place": dict(place)}
        _write(self._path, state, header, f"cannot write {self._path}")

    def remove(self) -> None:
        """Remove the file: the fit is done."""
        self._path.unlink(missing_ok=True)


def _list_differences(then: Any, now: Any, name: str = "") -> list[str]:
    """Return where two stamps differ, e.g. `fit.width (was 32, is 64)`."""
    if isinstance(then, dict) and isinstance(now, dict):
        keys = sorted({*then, *now})
        differences = []
        for key in keys:
            inner = f"{name}.{key}".strip(".")
            differences.extend(_list_differences(then.get(key), now.get(key), inner))
        return differences
    return [] if then == now else [f"{name} (was {then}, is {now})"]


def _read(path: Path) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Return the tensors and the header of a file of ours."""
    with safe_open(path, framework="pt") as file:
        header = json.loads((file.metadata() or {})["brokk"])
        return {name: file.get_tensor(name) for name in file.keys()}, header  # noqa: SIM118 (not a dict)


def _write(
    path: Path, tensors: Mapping[str, torch.Tensor], header: Mapping[str, Any], failure: str
) -> None:
    """Write a file in one step: it is the old or the new one."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    copies = {name: value.detach().cpu().clone().contiguous() for name, value in tensors.items()}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(save(copies, metadata={"brokk": json.dumps(header)}))
        part.replace(path)
    except OSError as error:
        raise StorageError(
            f"{failure}: {error.strerror or error}; the one before it is untouched"
        ) from error
    finally:
        part.unlink(missing_ok=True)
