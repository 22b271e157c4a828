"""Training that begins with what another policy knows."""

from __future__ import annotations

import torch

from brokk_rl.errors import CheckpointError
from brokk_rl.machine import Machine
from brokk_rl.rl.policy import located, read_bundle

OWN = "distribution."
"""Exploration belongs to the training that begins, not to the policy: one that has settled explores
no more."""


def begin_with(actor: torch.nn.Module, folder: str, machine: Machine) -> None:
    """Copies the network of the policy in `folder` into `actor`, whose exploration stays as it is.

    A bundle holds no critic: the one of the training that begins starts afresh.

    Args:
        actor: The network to be trained.
        folder: Run folder, or `package:path`; as in `policy.folder`.
        machine: The machine.

    Raises:
        CheckpointError: The bundle cannot be used, or its network has another shape.
    """
    _, weights = read_bundle(located(folder), machine)
    kept = {name: value for name, value in actor.state_dict().items() if name.startswith(OWN)}
    try:
        actor.load_state_dict(weights | kept)
    except RuntimeError as error:
        raise CheckpointError(
            f"start_from={folder}: the policy does not fit task, machine and rl.runner.actor "
            f"({str(error).splitlines()[-1].strip()}); train with those it was made with, or start_from=null"
        ) from error
