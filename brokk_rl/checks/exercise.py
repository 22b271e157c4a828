"""Parts of the checkers: environments, a history at rest, comparisons of tensors by name."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch

from brokk_rl.contracts.actuator import ActuatorModel, FollowerModel
from brokk_rl.history import History
from brokk_rl.machine import Machine

NUM_ENVS = 4
"""Environments of a check. Chosen by hand; not searched."""
Tensors = Mapping[str, torch.Tensor]


def build_rest_history(
    machine: Machine, device: torch.device, q: torch.Tensor | None = None
) -> History:
    """Return a history at rest at `q`, or in the middle of the travel."""
    if q is None:
        middle = torch.as_tensor((machine.lower + machine.upper) / 2, dtype=torch.float32)
        q = middle.to(device).repeat(NUM_ENVS, 1)
    still = q[:, None, :].repeat(1, machine.num_history, 1)
    return History(q=still, u=torch.zeros_like(still))


@contextmanager
def isolate_randomness() -> Iterator[None]:
    """Leave torch's global generators as they were."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        yield


def check_rows(tensors: Tensors, what: str) -> None:
    """Check that every tensor has one row per environment."""
    for name, value in tensors.items():
        shape = tuple(value.shape)
        assert len(value) == NUM_ENVS, f"{what} '{name}': expected {NUM_ENVS} rows, got {shape}"


def check_same(found: Any, expected: Any, text: str) -> None:
    """Check that tensors hold the expected numbers; NaN equals NaN. `text` names the promise."""
    torch.testing.assert_close(found, expected, rtol=0.0, atol=0.0, equal_nan=True, msg=text)


def check_in_place(tensors: Tensors, before: Tensors, what: str) -> None:
    """Check that all tensors lie where `view_tensors` saw them, in the same shape."""
    text = f"{what}: a tensor moved or changed its shape; write it in place"
    assert tensors.keys() == before.keys(), text
    for name, value in tensors.items():
        assert value.data_ptr() == before[name].data_ptr(), text
        assert value.shape == before[name].shape, text


def view_tensors(tensors: Tensors) -> dict[str, torch.Tensor]:
    """Return views of all tensors, which keep their memory from being given to others."""
    return {name: value.view_as(value) for name, value in tensors.items()}


def copy_tensors(tensors: Tensors) -> dict[str, torch.Tensor]:
    """Return copies of all tensors."""
    return {name: value.clone() for name, value in tensors.items()}


def is_same(a: torch.Tensor, b: torch.Tensor, tolerance: float = 0.0) -> bool:
    """Return whether two tensors hold the same numbers; NaN equals NaN."""
    return bool(torch.allclose(a.float(), b.float(), rtol=0.0, atol=tolerance, equal_nan=True))


def check_memory(
    model: ActuatorModel | FollowerModel,
    machine: Machine,
    device: torch.device,
    run: Callable[[bool], torch.Tensor],
) -> torch.Tensor:
    """Check results and memory of a model; return its results, `(T, N, J)`.

    Memory is in `state` and written in place, `reset` keeps to its mask, environments do not mix.

    Args:
        model: The model.
        machine: The machine.
        device: Where it computes.
        run: Returns its results over some control periods; told whether to treat environment 0
            otherwise.
    """
    model.reset(torch.ones(NUM_ENVS, dtype=torch.bool, device=device))
    check_rows(model.state, "state")
    place, begin = view_tensors(model.state), copy_tensors(model.state)
    first = run(False)
    shape = (NUM_ENVS, machine.num_joints)
    assert first.shape[1:] == shape, f"step: expected shape {shape}, got {tuple(first.shape[1:])}"
    is_kind = first.dtype == torch.float32 and first.device.type == device.type
    assert is_kind, f"step: expected float32 on {device}, got {first.dtype}"
    assert first.isfinite().all(), "step: not finite under full and random commands"
    check_in_place(model.state, place, "state")

    end = copy_tensors(model.state)
    model.reset(torch.arange(NUM_ENVS, device=device) == 0)
    for name, value in model.state.items():
        text = f"reset: state '{name}' changed in environments outside the mask"
        assert is_same(value[1:], end[name][1:]), text
    for alter in (False, True):
        for name, value in model.state.items():
            value.copy_(begin[name])
        again = run(alter)
        if not alter:
            text = "from the same state the same commands lead elsewhere; keep all memory in state"
            assert is_same(again, first), f"step: {text}"
        text = "step: what happens in environment 0 changes the others"
        assert is_same(again[:, 1:], first[:, 1:]), text
    return first
