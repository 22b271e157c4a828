"""The policy of a running training: its newest checkpoint, loaded anew while it learns."""

from __future__ import annotations

import logging
import time
from pathlib import Path

from brokk_rl.errors import CheckpointError
from brokk_rl.policy_folder import find_policy
from brokk_rl.rl.loop import ControlLoop
from brokk_rl.rl.policy import NetworkPolicy, load_policy

log = logging.getLogger(__name__)

POLL_S = 2.0
"""Seconds between two looks for a newer checkpoint. Chosen by hand."""


class CheckpointWatch:
    """A policy on disk, loaded anew whenever a training has written another one.

    Args:
        path: Run folder, policy folder or checkpoint.
        loop: Control loop in which the policy acts.
    """

    def __init__(self, path: str, loop: ControlLoop) -> None:
        self._path, self._loop = path, loop
        self._next_s = 0.0
        self._loaded: Path | None = None
        self.note = ""
        """Run and file of the checkpoint that was loaded last."""

    def load(self) -> NetworkPolicy:
        """Return the newest policy; errors as in `TrainedPolicy.build`."""
        stored = find_policy(self._path)
        policy = load_policy(stored, self._loop)
        self._loaded = stored.file
        self.note = f"{stored.file.parent.name}/{stored.file.name}"
        return policy

    def poll(self) -> NetworkPolicy | None:
        """Return a policy that is newer than the last one, else `None`.

        A checkpoint that cannot be read, because the training has just replaced it, is tried again.
        """
        now_s = time.monotonic()
        if now_s < self._next_s:
            return None
        self._next_s = now_s + POLL_S
        try:
            if find_policy(self._path).file == self._loaded:
                return None
            return self.load()
        except CheckpointError as error:
            log.warning("the newest checkpoint is left out: %s", error)
            return None
