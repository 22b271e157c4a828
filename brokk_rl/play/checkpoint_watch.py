"""The newest checkpoint of a training, as a policy: a run is watched while it learns."""

from __future__ import annotations

import logging
import time
from pathlib import Path

from brokk_rl.errors import CheckpointError
from brokk_rl.rl.loop import ControlLoop
from brokk_rl.rl.policy import NetworkPolicy, make_actor
from brokk_rl.rl.runner import list_checkpoints, read_checkpoint
from brokk_rl.task_description import TaskDescription

log = logging.getLogger(__name__)

POLL_S = 2.0
"""Seconds between two looks for a newer checkpoint. Chosen by hand."""


def find_newest(path: Path) -> Path:
    """Return `path` if it is a checkpoint, else the newest one of the run folder `path`.

    Raises:
        CheckpointError: There is none.
    """
    if path.suffix == ".pt":
        return path
    found = list_checkpoints(path) if path.is_dir() else []
    if found:
        return found[-1]
    if not path.is_dir():
        raise CheckpointError(
            f"checkpoint={path}: there is no such run folder; `ls runs` lists those of this folder"
        )
    raise CheckpointError(
        f"checkpoint={path}: the folder holds no checkpoint (model_<iteration>.pt). A training "
        "writes the first after rl.save_interval iterations; a folder with policy.json is played "
        f"by policy.folder={path}"
    )


def read_task(path: Path) -> TaskDescription:
    """Return the description of the task that the checkpoint `path` was trained in.

    Raises:
        CheckpointError: The checkpoint cannot be read, or does not say.
    """
    content = read_checkpoint(path, "cpu")
    if "task" not in content:
        raise CheckpointError(
            f"{path} is of a version whose checkpoints do not describe their task; export it with "
            "that version and play the folder: policy.folder=<folder>"
        )
    return TaskDescription.from_json(content["task"], str(path))


class CheckpointWatch:
    """Newest checkpoint of a run folder, loaded anew whenever the training has written one.

    Args:
        path: Run folder, or one checkpoint.
        loop: Control loop in which the policy acts.
    """

    def __init__(self, path: Path, loop: ControlLoop) -> None:
        self._path, self._loop = path, loop
        self._next_s = 0.0
        self.loaded: Path | None = None
        """Checkpoint that was loaded last."""

    def load(self) -> NetworkPolicy:
        """Return the policy of the newest checkpoint.

        Raises:
            CheckpointError: There is none, it is of another machine or task, or it is corrupt.
        """
        path = find_newest(self._path)
        content = read_checkpoint(path, self._loop.device)
        self._loop.machine.check_fingerprint(content.get("fingerprint", {}), str(path))
        network = content["network"]
        observations = self._loop.get_observations()
        actor = make_actor(
            network["actor"], network["obs_groups"], observations, self._loop.num_actions
        )
        try:
            actor.load_state_dict(content["actor_state_dict"])
        except RuntimeError as error:
            raise CheckpointError(
                f"{path}: the network does not fit task and machine "
                f"({str(error).splitlines()[-1].strip()}); play it with those of its run"
            ) from error
        self.loaded = path
        return NetworkPolicy(actor, self._loop)

    def poll(self) -> NetworkPolicy | None:
        """Return the policy of a checkpoint that is newer than the last one, else `None`.

        A checkpoint that cannot be read, because the training has just replaced it, is tried again.
        """
        now_s = time.monotonic()
        if now_s < self._next_s:
            return None
        self._next_s = now_s + POLL_S
        try:
            if find_newest(self._path) == self.loaded:
                return None
            return self.load()
        except CheckpointError as error:
            log.warning("the newest checkpoint is left out: %s", error)
            return None
