"""Parts of the checkers: environments, a history at rest, comparisons of tensors by name."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Protocol

import torch

from brokk_rl.history import History
from brokk_rl.machine import Machine

NUM_ENVS = 4
"""Environments of a check. Chosen by hand; not searched."""


def build_rest_history(
    machine: Machine, device: torch.device, q: torch.Tensor | None = None
) -> History:
    """Return a history at rest at `q`, or in the middle of the travel."""
    if q is None:
        q = torch.as_tensor(
            (machine.lower + machine.upper) / 2, dtype=torch.float32, device=device
        ).repeat(NUM_ENVS, 1)
    shape = (NUM_ENVS, machine.num_history, machine.num_joints)
    return History(
        q=q[:, None, :].repeat(1, machine.num_history, 1), u=torch.zeros(shape, device=device)
    )


@contextmanager
def isolate_randomness() -> Iterator[None]:
    """Leave torch's global generators as they were."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        yield


def require(condition: bool, message: str) -> None:
    """Raise an `AssertionError` with `message` unless `condition` holds."""
    if not condition:
        raise AssertionError(message)


def require_rows(tensors: Mapping[str, torch.Tensor], what: str) -> None:
    """Check that every tensor has one row per environment."""
    for name, value in tensors.items():
        require(
            len(value) == NUM_ENVS,
            f"{what} '{name}': expected {NUM_ENVS} rows, got shape {tuple(value.shape)}",
        )


def view_tensors(tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return views of all tensors, which keep their memory from being given to others."""
    return {name: value.view_as(value) for name, value in tensors.items()}


def is_in_place(tensors: Mapping[str, torch.Tensor], before: Mapping[str, torch.Tensor]) -> bool:
    """Return whether all tensors lie where `view_tensors` saw them, in the same shape."""
    return tensors.keys() == before.keys() and all(
        value.data_ptr() == before[name].data_ptr() and value.shape == before[name].shape
        for name, value in tensors.items()
    )


def copy_tensors(tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return copies of all tensors."""
    return {name: value.clone() for name, value in tensors.items()}


def restore(tensors: Mapping[str, torch.Tensor], kept: Mapping[str, torch.Tensor]) -> None:
    """Write `kept` back in place."""
    for name, value in tensors.items():
        value.copy_(kept[name])


def is_same(a: torch.Tensor, b: torch.Tensor, tolerance: float = 0.0) -> bool:
    """Return whether two tensors hold the same numbers; NaN equals NaN."""
    return bool(torch.allclose(a.float(), b.float(), rtol=0.0, atol=tolerance, equal_nan=True))


class Stateful(Protocol):
    """A model that keeps its memory in `state` and forgets it by `reset`."""

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """Memory by name, each `(N, …)`."""
        ...

    def reset(self, mask: torch.Tensor) -> None:
        """Forget in the environments of `mask`, `(N,)` bool."""
        ...


def require_memory_in_state(
    model: Stateful,
    begin: Mapping[str, torch.Tensor],
    first: torch.Tensor,
    run: Callable[[bool], torch.Tensor],
) -> None:
    """Check that reset keeps to its mask, memory is in `state`, environments do not mix.

    Args:
        model: After the run that led to `first`.
        begin: Copies of its state before that run.
        first: Its results, `(T, N, …)`.
        run: Does it again; told whether to treat environment 0 otherwise.
    """
    end = copy_tensors(model.state)
    some = torch.zeros(NUM_ENVS, dtype=torch.bool, device=first.device)
    some[0] = True
    model.reset(some)
    for name, value in model.state.items():
        require(
            is_same(value[1:], end[name][1:]),
            f"reset: state '{name}' changed in environments outside the mask",
        )
    restore(model.state, begin)
    require(
        is_same(run(False), first),
        "step: from the same state the same commands lead elsewhere; all memory belongs in state",
    )
    restore(model.state, begin)
    require(
        is_same(run(True)[:, 1:], first[:, 1:]),
        "step: what happens in environment 0 changes the others",
    )
