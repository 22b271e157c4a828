"""Episodes of several boreholes in a row, whose block gives way where it is struck.

The policy sees one hole at a time. Once the chisel is in, the target stands above the same hole
until the chisel is out of it; then the next hole is where the first one was, as seen from its block:
the block itself moves on by the spacing.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import torch

from brokk_rl.errors import ConfigError
from brokk_rl.history import History
from brokk_rl.machine import Machine
from tasks.borehole_insertion import BoreholeInsertion, HoleRow
from tasks.process import START
from tasks.starts import StartSearch
from tasks.terms import ToolState
from tasks.tool_pose import ToolPoseProcess

DRAWN_OUT = 0.5
"""Part of the lift after which the chisel counts as drawn out. Chosen by hand."""
MOST_DRAWS = 8
"""Draws of as many starts as are asked for, after which rows count as out of reach. Chosen by hand."""


class HoleRowProcess(ToolPoseProcess):
    """Episodes of `HoleRow`."""

    def __init__(
        self, task: BoreholeInsertion, machine: Machine, num_envs: int, device: torch.device
    ) -> None:
        assert task.row is not None
        self._row: HoleRow = task.row
        self._lift_m = torch.tensor([0.0, 0.0, task.aim_below_m + task.row.lift_m], device=device)
        self._moved = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self.moved = self._moved
        super().__init__(task, machine, num_envs, device)

    def _list_shapes(self) -> dict[str, tuple[int, ...]]:
        own = dict.fromkeys(("hole", "lifting", "struck", "strike_rad"), ())
        return super()._list_shapes() | own

    def starts(self, count: int, seed: int) -> dict[str, torch.Tensor]:
        """Draw starts from which each hole of the row can be reached; see `TaskProcess.starts`."""
        search, found = StartSearch(self.task, self._machine), []
        while sum(len(part["q"]) for part in found) < count:
            if len(found) == MOST_DRAWS:
                raise ConfigError(
                    f"task.row: expected {self._row.num_holes} holes within reach from 1 start in "
                    f"{MOST_DRAWS} at least, got fewer; change task.row.spacing_m or num_holes"
                )
            part = search.draw(count, seed + len(found))
            is_good = torch.ones(count, dtype=torch.bool)
            shifted = part
            for _ in range(1, self._row.num_holes):
                shift_m = self._find_next(shifted["target_m"])
                place = shifted["scene"].clone()
                place[:, :3] += shift_m
                shifted = shifted | {"target_m": shifted["target_m"] + shift_m, "scene": place}
                is_good &= search.check(shifted)[0][-1]
            found.append({name: value[is_good] for name, value in part.items()})
        drawn = {name: torch.cat([part[name] for part in found])[:count] for name in found[0]}
        return self._judge_starts(drawn)

    def _find_next(self, target_m: torch.Tensor) -> torch.Tensor:
        """Return the way from a hole to the next one, level and across the bearing, `(N, 3)`."""
        across = torch.stack((-target_m[:, 1], target_m[:, 0], 0 * target_m[:, 2]), 1)
        return self._row.spacing_m * across / across.norm(dim=1, keepdim=True)

    def _draw_errors(self, start: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        drawn = super()._draw_errors(start)
        return drawn | {"strike_rad": 2 * math.pi * torch.rand_like(drawn["closeness"])}

    def _make_state(self, history: History, force_n: torch.Tensor) -> ToolState:
        seen, state = super()._make_state(history, force_n), self.state
        is_last, lifting = state["hole"] == self._row.num_holes - 1, state["lifting"].bool()
        return dataclasses.replace(
            seen,
            inserted=seen.reached & ~lifting,
            success=seen.success & is_last,
            reached=seen.reached & is_last,
            paper_success=seen.paper_success & is_last,
            closeness=state["hole"] + seen.closeness.where(~lifting, 1.0),
        )

    def _remember(self, seen: Any) -> None:
        super()._remember(seen)
        row, state = self._row, self.state
        target_m = state[f"{START}target_m"]
        above_m = seen.tip_m[:, 2] - target_m[:, 2]
        goes_on = state["lifting"].bool() & (above_m > DRAWN_OUT * row.lift_m)
        is_struck = (seen.contact_force_n > row.strike_n) & ~state["struck"].bool() & ~goes_on
        has_next = state["hole"] < row.num_holes - 1
        lifts = (state["lifting"].bool() | (seen.inserted & has_next)) & ~goes_on
        turn = state["strike_rad"]
        away_m = row.strike_m * torch.stack((turn.cos(), turn.sin(), 0 * turn), 1)
        # seen at once, with the same error: it is the operator who names the next hole
        self.move_target(goes_on, self._find_next(target_m))
        # seen by the samples that follow only
        target_m += away_m * is_struck[:, None]
        state[f"{START}scene"][:, :3] += away_m * is_struck[:, None]
        self._moved.copy_(goes_on | is_struck)
        state["hole"] += goes_on
        state["struck"].copy_((state["struck"].bool() | is_struck) & ~goes_on)
        state["lifting"].copy_(lifts)

    def _estimate_target(self, shift_m: torch.Tensor | None) -> torch.Tensor:
        lift_m = self.state["lifting"][:, None] * self._lift_m
        return super()._estimate_target(shift_m) + lift_m
