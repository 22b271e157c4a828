"""Processes that train one policy together, one for each GPU.

rsl-rl averages gradients and normalisers over them. `TrainingGroup` adds the process group itself,
decisions that the first process makes for all, statistics over all environments, and a check that
all still hold the same policy.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import torch
import torch.distributed as dist

from brokk_rl import distributed
from brokk_rl.errors import DistributedError


class TrainingGroup:
    """Process group of a training, a context manager; without effect for a single process.

    Args:
        device: Where this process computes: NCCL between GPUs, gloo between CPUs and for data
            on the host.
    """

    def __init__(self, device: torch.device) -> None:
        self.device, self.rank = device, distributed.read_rank()

    @property
    def together(self) -> bool:
        """True when there is more than one process."""
        return self.rank.count > 1

    def __enter__(self) -> TrainingGroup:
        if self.device.type == "cuda":
            torch.cuda.set_device(self.device)
        if self.together:
            backend = "cpu:gloo,cuda:nccl" if self.device.type == "cuda" else "gloo"
            dist.init_process_group(backend, rank=self.rank.index, world_size=self.rank.count)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: object
    ) -> None:
        if not self.together:
            return
        if error is None:
            dist.barrier()
            dist.destroy_process_group()
            return
        # gloo's threads must end before the interpreter does, or it aborts. Between GPUs nothing is
        # destroyed after an error: NCCL would wait for processes that have ended.
        if self.device.type == "cpu":
            dist.destroy_process_group()

    def wait(self) -> None:
        """Wait until all processes have called this."""
        if self.together:
            dist.barrier()

    def broadcast_first(self, value: Any) -> Any:
        """Return the `value` of the first process, so that all act by the same clock."""
        if not self.together:
            return value
        box = [value]
        dist.broadcast_object_list(box, src=0)
        return box[0]

    def gather(self, value: Any) -> list[Any]:
        """Return the `value` (plain numbers and text) of all processes, in the order of ranks."""
        if not self.together:
            return [value]
        found: list[Any] = [None] * self.rank.count
        dist.all_gather_object(found, value)
        return found

    def gather_on_first(self, state: Any) -> list[Any]:
        """Return the `state` of all processes to the first one, an empty list to the others.

        A state is a mapping of tensors; they are copied to the host.
        """
        if not self.together:
            return [state]
        found: list[Any] = [None] * self.rank.count
        dist.gather_object(_copy_to_host(state), found if self.rank.first else None, dst=0)
        return found if self.rank.first else []

    def pool_statistics(self, figures: Mapping[str, float]) -> dict[str, float]:
        """Return the figures of all environments of all processes; see `ControlLoop.statistics`.

        Means over episodes weigh by the number of episodes; the fault rate by control steps, which
        are as many everywhere.
        """
        parts = self.gather(dict(figures))
        episodes = sum(part["episodes"] for part in parts)
        pooled = {}
        for name in figures:
            pooled[name] = sum(part[name] * part["episodes"] for part in parts) / max(1.0, episodes)
        return pooled | {
            "episodes": episodes,
            "fault_rate": sum(part["fault_rate"] for part in parts) / len(parts),
        }

    def check_same(self, state: Mapping[str, torch.Tensor]) -> None:
        """Compare the numbers of all processes, bit for bit.

        Raises:
            DistributedError: They differ; the message names the ranks that differ from the first.
        """
        if not self.together:
            return
        first, *others = self.gather(hash_tensors(state))
        differing = [str(rank) for rank, value in enumerate(others, 1) if value != first]
        if differing:
            raise DistributedError(
                f"the policy of rank {', '.join(differing)} is no longer that of rank 0: "
                "parameters or normalisers differ. "
                "Look for randomness or data-dependent code that runs on some ranks only, and "
                "for GPUs of different kinds."
            )


def hash_tensors(state: Mapping[str, torch.Tensor]) -> str:
    """Return the SHA-256 of names and bytes of tensors."""
    digest = hashlib.sha256()
    for name, value in state.items():
        digest.update(name.encode() + value.detach().cpu().numpy().tobytes())
    return digest.hexdigest()


def _copy_to_host(state: Any) -> Any:
    if isinstance(state, torch.Tensor):
        return state.detach().cpu()
    if isinstance(state, Mapping):
        return {name: _copy_to_host(value) for name, value in state.items()}
    return state
