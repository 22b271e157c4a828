"""The checkers find broken promises."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from composed import MACHINE, option

from brokk_rl.checks import check_actuator, check_finder, check_task
from brokk_rl.contracts.vision import FrameDetections, HolePose
from brokk_rl.history import History
from brokk_rl.machine import Machine


class Filter:
    """A first-order actuator that keeps every promise; each test breaks one."""

    def __init__(self, machine: Machine, num_envs: int, device: torch.device) -> None:
        self._scale = torch.as_tensor(
            machine.max_speed * machine.period_s, dtype=torch.float32, device=device
        )
        self.state = {"u": torch.zeros(num_envs, machine.num_joints, device=device)}

    def reset(self, mask: torch.Tensor) -> None:
        self.state["u"].masked_fill_(mask[:, None], 0.0)

    def step(self, history: History) -> torch.Tensor:
        self.state["u"].lerp_(history.u[:, -1], 0.5)
        return history.q[:, -1] + self.state["u"] * self._scale


def spec_of(kind: type[Filter]) -> Any:
    return SimpleNamespace(build=lambda machine, num_envs, device: kind(machine, num_envs, device))


def test_a_proper_actuator_passes() -> None:
    check_actuator(spec_of(Filter), MACHINE)


def move_state(own: Any, history: History) -> torch.Tensor:
    own.state["u"] = own.state["u"].clone()
    return Filter.step(own, history)


def remember(own: Any, history: History) -> torch.Tensor:
    own.count = getattr(own, "count", 0) + 1
    return Filter.step(own, history) + 1e-4 * own.count


def write_history(own: Any, history: History) -> torch.Tensor:
    history.u[:, -1].clamp_(-0.5, 0.5)
    return Filter.step(own, history)


@pytest.mark.parametrize(
    ("name", "method", "message"),
    [
        ("reset", lambda own, mask: own.state["u"].zero_(), "outside the mask"),
        ("step", move_state, "moved"),
        ("step", remember, "same commands lead elsewhere"),
        ("step", write_history, "changed the history"),
        ("step", lambda own, h: Filter.step(own, h) + 1e-3 * h.u[:, -1].mean(0), "changes the others"),
        ("step", lambda own, h: Filter.step(own, h).double(), "float32"),
        ("step", lambda own, h: Filter.step(own, h) + 1.0, "at rest"),
    ],
)  # fmt: skip
def test_a_broken_actuator_is_found(name: str, method: Any, message: str) -> None:
    with pytest.raises(AssertionError, match=message):
        check_actuator(spec_of(type("Broken", (Filter,), {name: method})), MACHINE)


NOWHERE = torch.zeros(4, dtype=torch.bool)


def overriding(**parts: Any) -> Any:
    """Returns the shipped task with parts of its process replaced; a method gets the original as its first argument."""

    def build(machine: Machine, num_envs: int, device: torch.device) -> Any:
        process = option("task", "borehole_insertion").build(machine, num_envs, device)
        for name, part in parts.items():
            new = partial(part, getattr(process, name)) if callable(part) else part
            setattr(process, name, new)
        return process

    return SimpleNamespace(build=build)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"reasons": ("time_limit",)}, "expected 'fault'"),
        ({"state": {}}, "state: expected an entry 'steps'"),
        ({"episode": {}}, "expected an entry 'success_"),
        ({"command": lambda original, action: action}, "leaves"),
        ({"starts": lambda original, count, seed: original(count, 7)}, "another seed"),
        ({"step": lambda original, *a: replace(original(*a), reward=torch.full((4,), torch.nan))}, "not finite"),
        ({"step": lambda original, *a: replace(original(*a), timed_out=NOWHERE)}, "reason must be|no time-out"),
        ({"reset": lambda original, mask, start: original(torch.ones_like(mask), start)}, "outside the mask"),
    ],
)  # fmt: skip
def test_a_broken_task_is_found(parts: dict[str, Any], message: str) -> None:
    with pytest.raises(AssertionError, match=message):
        check_task(overriding(**parts), MACHINE)


def finder_of(answer: Any) -> Any:
    """Returns the spec of a finder that always answers the same."""
    return SimpleNamespace(build=lambda: SimpleNamespace(find=lambda frame: answer))


HOLE = HolePose(
    np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0]), 0.05, np.eye(3), np.eye(3), "camera", 0.5, 0.0
)  # fmt: skip


def test_a_proper_finder_passes() -> None:
    check_finder(finder_of(FrameDetections([HOLE])))
    check_finder(finder_of(FrameDetections([])))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"axis": np.array([0.0, 0.0, 2.0])}, "unit vector"),
        ({"center_m": np.array([0.0, np.nan, 1.0])}, "no point"),
        ({"cov_m2": -np.eye(3)}, "cov_m2 has negative variances"),
        ({"axis_cov_rad2": np.eye(2)}, "axis_cov_rad2 is not symmetric"),
        ({"score": 3.0}, "score"),
        ({"frame": "world"}, "camera or base"),
        ({"radius_m": 0.0}, "radius"),
    ],
)
def test_a_finder_with_an_impossible_hole_is_found(change: dict[str, Any], message: str) -> None:
    with pytest.raises(AssertionError, match=message):
        check_finder(finder_of(FrameDetections([replace(HOLE, **change)])))


def test_a_finder_that_answers_something_else_is_found() -> None:
    with pytest.raises(AssertionError, match=r"expected FrameDetections .*, got NoneType"):
        check_finder(finder_of(None))
    with pytest.raises(AssertionError, match="no method find"):
        check_finder(SimpleNamespace(build=lambda: SimpleNamespace(look=None)))  # type: ignore[arg-type,return-value]
    unsorted = FrameDetections([replace(HOLE, score=0.2), HOLE])
    with pytest.raises(AssertionError, match="surest first"):
        check_finder(finder_of(unsorted))
