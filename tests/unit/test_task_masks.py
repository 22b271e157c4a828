"""The switch between positioning and approach in its three readings, and the masks that follow from it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from brokk_rl.machine import Machine, mask_exclusive_joints
from tasks.settings import ActionMapping, CommandBase, PhaseSwitch


def switch(rule: str) -> PhaseSwitch:
    return PhaseSwitch(rule=rule, reach_m=(1.7, 2.4), height_m=0.2)  # type: ignore[arg-type]


def seen(reach_m: float, reach_3d_m: float, tip_z_m: float) -> Any:
    numbers = {"reach_m": reach_m, "reach_3d_m": reach_3d_m, "tip_z_m": tip_z_m}
    return SimpleNamespace(**{name: torch.tensor([value]) for name, value in numbers.items()})


@pytest.mark.parametrize(
    ("reach_m", "reach_3d_m", "tip_z_m", "planar", "text", "equation"),
    [
        # in range, tool high: the equation goes on positioning, the text does not
        (2.0, 2.0, 1.0, False, False, True),
        (2.0, 2.0, 0.1, False, False, False),  # in range, tool low
        (3.0, 3.0, 1.0, True, True, True),  # too far, tool high
        # too far, tool low: the text rests q2 to keep the tool off the ground
        (3.0, 3.0, 0.1, False, False, True),
        (1.0, 1.0, 1.0, True, True, True),  # too near
        # q1 points elsewhere: in the plane in range, in space not
        (2.0, 3.5, 1.0, False, True, True),
        (1.7, 1.7, 0.1, False, False, False),  # the edges belong to the range
        (2.4, 2.4, 0.1, False, False, False),
    ],
)
def test_each_rule_of_the_switch(
    reach_m: float, reach_3d_m: float, tip_z_m: float, planar: bool, text: bool, equation: bool
) -> None:
    for rule, expected in (("planar", planar), ("text", text), ("equation", equation)):
        assert switch(rule).positioning(seen(reach_m, reach_3d_m, tip_z_m)).item() is expected, rule


def test_at_the_height_itself_the_tool_is_not_low() -> None:
    assert switch("text").positioning(seen(3.0, 3.0, 0.2)).item() is True
    assert switch("equation").positioning(seen(2.0, 2.0, 0.2)).item() is True


FREE = torch.ones(5)
"""No joint is near its end."""


@pytest.mark.parametrize(
    ("limits", "step", "least", "largest"),
    [
        (True, None, [-1.0, 0.0, -0.3, -1.0], [0.0, 1.0, 1.0, 0.4]),
        (False, 0.1, [-0.1, 0.4, -1.0, 0.8], [0.1, 0.6, -0.8, 1.0]),
        # before its end a joint is let go at once
        (True, 0.1, [-0.1, 0.4, -0.3, 0.4], [0.0, 0.6, -0.3, 0.4]),
    ],
)
def test_commands_stay_before_ends_and_within_a_step(
    limits: bool, step: float | None, least: list[float], largest: list[float]
) -> None:
    action = ActionMapping(kind="residual", scale=1.0, mask=False, limits=limits, step=step)
    lowest, highest = torch.tensor([[-1.0, 0.0, -0.3, -1.0]]), torch.tensor([[0.0, 1.0, 1.0, 0.4]])
    last = torch.tensor([[0.0, 0.5, -0.9, 0.9]])
    bounds = action.bound(lowest, highest, last)
    base = CommandBase(torch.full((1, 4), 0.1), *bounds, torch.tensor([False]))
    for output, expected in ((-3.0, least), (3.0, largest)):
        u = action.command(torch.full((1, 4), output), base, torch.zeros(4, dtype=torch.bool))
        torch.testing.assert_close(u, torch.tensor([expected]))


@pytest.mark.parametrize("kind", ["direct", "residual"])
def test_the_masks_are_the_papers_and_those_of_the_machine(kind: str, machine: Machine) -> None:
    action = ActionMapping(kind=kind, scale=0.5, mask=True, limits=False)  # type: ignore[arg-type]
    for positioning, paper in ((True, [0, 1, 0, 0, 0]), (False, [1, 0, 1, 1, 1])):
        flag = torch.tensor([positioning])
        base = CommandBase(torch.full((1, 5), 0.3), -FREE, FREE, flag)
        u = action.command(5 * torch.ones(1, 5), base, torch.as_tensor(machine.is_exclusive))
        machines = mask_exclusive_joints(machine.is_exclusive, positioning)
        assert u[0].tolist() == paper == machines.astype(int).tolist()


def test_direct_and_residual_actions_on_numbers(machine: Machine) -> None:
    output = torch.tensor([[0.4, 0.4, -0.4, 4.0, 0.0]])
    command = torch.tensor([[0.5, 0.5, 0.5, 0.5, -0.25]])
    base = CommandBase(command, -FREE, FREE, torch.tensor([False]))
    exclusive = torch.as_tensor(machine.is_exclusive)
    residual = ActionMapping(kind="residual", scale=0.5, mask=True, limits=False)
    direct = replace(residual, kind="direct").command(output, base, exclusive)
    unmasked = replace(residual, mask=False).command(output, base, exclusive)
    residual = residual.command(output, base, exclusive)
    np.testing.assert_allclose(direct[0], [0.2, 0.0, -0.2, 1.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(residual[0], [0.7, 0.0, 0.3, 1.0, -0.25], atol=1e-6)
    np.testing.assert_allclose(unmasked[0], [0.7, 0.7, 0.3, 1.0, -0.25], atol=1e-6)
