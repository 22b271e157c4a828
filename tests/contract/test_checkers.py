"""The checkers find broken promises."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from composed import option

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


class ResetsEverybody(Filter):
    def reset(self, mask: torch.Tensor) -> None:
        self.state["u"].zero_()


class MovesItsState(Filter):
    def step(self, history: History) -> torch.Tensor:
        self.state["u"] = self.state["u"].lerp(history.u[:, -1], 0.5)
        return history.q[:, -1] + self.state["u"] * self._scale


class HasHiddenMemory(Filter):
    count = 0

    def step(self, history: History) -> torch.Tensor:
        self.count += 1
        return super().step(history) + 1e-4 * self.count


class WritesHistory(Filter):
    def step(self, history: History) -> torch.Tensor:
        history.u[:, -1].clamp_(-0.5, 0.5)
        return super().step(history)


class MixesEnvironments(Filter):
    def step(self, history: History) -> torch.Tensor:
        return super().step(history) + 1e-3 * history.u[:, -1].mean(0)


class IsDouble(Filter):
    def step(self, history: History) -> torch.Tensor:
        return super().step(history).double()


class JumpsAtRest(Filter):
    def step(self, history: History) -> torch.Tensor:
        return super().step(history) + 1.0


def test_a_proper_actuator_passes(machine: Machine) -> None:
    check_actuator(spec_of(Filter), machine)


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (ResetsEverybody, "outside the mask"),
        (MovesItsState, "moved"),
        (HasHiddenMemory, "same commands lead elsewhere"),
        (WritesHistory, "changed the history"),
        (MixesEnvironments, "changes the others"),
        (IsDouble, "float32"),
        (JumpsAtRest, "at rest"),
    ],
)
def test_a_broken_actuator_is_found(broken: type[Filter], message: str, machine: Machine) -> None:
    with pytest.raises(AssertionError, match=message):
        check_actuator(spec_of(broken), machine)


def overriding(**methods: Callable[..., Any]) -> Any:
    """Returns the shipped task with some methods of its process replaced; each gets the original as its first argument."""

    def build(machine: Machine, num_envs: int, device: torch.device) -> Any:
        process = option("task", "borehole_insertion").build(machine, num_envs, device)
        for name, method in methods.items():
            setattr(process, name, partial(method, getattr(process, name)))
        return process

    return SimpleNamespace(build=build)


@pytest.mark.parametrize(
    ("methods", "message"),
    [
        ({"command": lambda original, action: action}, "leaves"),
        ({"starts": lambda original, count, seed: original(count, 7)}, "another seed"),
        (
            {
                "step": lambda original, history, world: replace(
                    original(history, world), reward=torch.full((4,), torch.nan)
                )
            },
            "not finite",
        ),
        (
            {
                "step": lambda original, *a: replace(
                    original(*a), timed_out=torch.zeros(4, dtype=torch.bool)
                )
            },
            "reason must be|no time-out",
        ),
        (
            {"reset": lambda original, mask, start: original(torch.ones_like(mask), start)},
            "outside the mask",
        ),
    ],
)
def test_a_broken_task_is_found(
    methods: dict[str, Callable[..., Any]], message: str, machine: Machine
) -> None:
    with pytest.raises(AssertionError, match=message):
        check_task(overriding(**methods), machine)


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
