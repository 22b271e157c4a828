"""An interrupted fit on disk: state and place in one file, and what it must agree with to go on."""

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
from brokk_rl.record import Recording


def digest(recordings: Sequence[Recording]) -> str:
    """Returns a short hash of the commands and positions of recordings, in their order."""
    found = hashlib.sha256()
    for recording in recordings:
        found.update(recording.u.tobytes())
        found.update(recording.q.tobytes())
    return found.hexdigest()[:16]


class Interruption:
    """The file from which an interrupted fit goes on.

    Args:
        path: The file; exists only while a fit is under way or interrupted.
        stamp: Settings, seed, machine and data; a fit with another stamp is another fit.
    """

    def __init__(self, path: Path, stamp: Mapping[str, Any]) -> None:
        self._path = path
        self._stamp = json.loads(json.dumps(stamp))

    def load(self, state: Mapping[str, torch.Tensor]) -> dict[str, Any] | None:
        """Restores `state` in place and returns the place that was saved with it; `None` where there is nothing to go on from.

        Raises:
            CheckpointError: the file is corrupt, or belongs to a fit with other settings or data;
                says which.
        """
        if not self._path.is_file():
            return None
        try:
            with safe_open(self._path, framework="pt") as file:
                header = json.loads((file.metadata() or {})["brokk"])
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
            stamp, place = header["stamp"], header["place"]
        except (SafetensorError, OSError, KeyError, ValueError) as error:
            raise CheckpointError(
                f"{self._path}: corrupt ({error}); delete it to begin the fit again"
            ) from error
        differing = list(_differences(stamp, self._stamp))
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
        """Writes `state` and `place` in one step: the file is the old or the new one, never half of one.

        Raises:
            StorageError: the file could not be written; the one before it is untouched.
        """
        part = self._path.with_name(f".{self._path.name}.{os.getpid()}.part")
        content = save(
            {name: value.detach().cpu().clone() for name, value in state.items()},
            metadata={"brokk": json.dumps({"stamp": self._stamp, "place": dict(place)})},
        )
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            part.write_bytes(content)
            part.replace(self._path)
        except OSError as error:
            raise StorageError(
                f"cannot write {self._path}: {error.strerror or error}; the one before it is untouched"
            ) from error
        finally:
            part.unlink(missing_ok=True)

    def remove(self) -> None:
        """Removes the file: the fit is done."""
        self._path.unlink(missing_ok=True)


def _differences(then: Any, now: Any, name: str = "") -> list[str]:
    """Returns where two stamps differ, e.g. `fit.width (was 32, is 64)`."""
    if isinstance(then, dict) and isinstance(now, dict):
        keys = sorted({*then, *now})
        return [
            found
            for key in keys
            for found in _differences(then.get(key), now.get(key), f"{name}.{key}".strip("."))
        ]
    return [] if then == now else [f"{name} (was {then}, is {now})"]
