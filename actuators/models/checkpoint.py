"""Checkpoints of actuators in safetensors with a JSON header."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from brokk_rl.errors import CheckpointError
from brokk_rl.machine import Machine
from brokk_rl.session import write_bytes

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
    copies = {name: value.detach().cpu().clone().contiguous() for name, value in tensors.items()}
    write_bytes(path, save(copies, metadata={"brokk": json.dumps(header)}))


def read_checkpoint(
    name: str, kind: str, machine: Machine
) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Return the tensors and the header of a checkpoint made for `machine`; see `find_checkpoint`.

    Raises:
        CheckpointError: it is missing, corrupt, of another kind, made for another machine, or holds numbers
            that are not finite.
    """
    path = find_checkpoint(name)
    try:
        with safe_open(path, framework="pt") as file:
            header = json.loads((file.metadata() or {})["brokk"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        raise CheckpointError(
            f"{path}: corrupt, truncated, or no actuator of ours ({error}); copy it again, or make one with `brokk mode=identify`"
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
