"""A run of effects around a model whose commands are all known beforehand.

Effects on commands are applied to the whole run before its first step, so that a step computes only
what depends on positions. Axes: `T` commands of the run, `N` environments, `J` joints.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Protocol

import torch

from actuators.contracts import PlannedRun
from actuators.effects.step_inputs import MachineTensors, Memory, StepInputs
from brokk_rl.history import History


class PlannableChain(Protocol):
    """Part of `EffectChain` that a run uses; attributes and methods are explained there."""

    inner: Any
    commands: dict[str, Any]
    motions: dict[str, Any]
    plant: MachineTensors
    is_weighed: bool

    @property
    def is_plannable(self) -> bool:
        """True if all commands of a run can be given to its effects beforehand."""
        ...

    def get_values(self, name: str) -> dict[str, torch.Tensor]:
        """Return the parameters of one effect."""
        ...

    def advance_draws(self) -> torch.Tensor | None:
        """Advance to the next draws and return their counter."""
        ...

    def salt_counter(self, name: str, counter: torch.Tensor | None) -> torch.Tensor | None:
        """Return the counter of one effect's draws."""
        ...

    def hold_in_travel(self, moved_to: torch.Tensor, predicted: torch.Tensor) -> torch.Tensor:
        """Return positions after the effects, within the travel."""
        ...


class ChainRun:
    """A run of effects around a model.

    Args:
        chain: The chain.
        inner: The run of the model inside.
        u: Commands as they come from outside, `(T, N, J)`.
        first: Number of the first position that is asked for.
    """

    def __init__(
        self, chain: PlannableChain, inner: PlannedRun, u: torch.Tensor, first: int
    ) -> None:
        self._chain, self._inner, self._u, self._first = chain, inner, u, first
        self._values = {name: chain.get_values(name) for name in chain.motions}
        self._memory: dict[str, Memory] = {}

    @classmethod
    def plan(
        cls, chain: PlannableChain, u: torch.Tensor, first: int, q: torch.Tensor | None
    ) -> PlannedRun | None:
        """Return the run; `None` where an effect or the model inside has to be stepped."""
        plan_inner = getattr(chain.inner, "plan_run", None)
        if plan_inner is None or not chain.is_plannable:
            return None
        if q is None and any(effect.placed for effect in chain.commands.values()):
            return None
        seen = u
        for name, effect in chain.commands.items():
            seen = _change_commands(chain, name, effect, seen, first, q)
        inner = plan_inner(seen, first, q)
        if inner is None or not chain.motions:
            return inner
        return cls(chain, inner, u, first)

    def step(self, k: int, q: torch.Tensor) -> torch.Tensor:
        """See `actuators.contracts.PlannedRun`."""
        chain, plant, newest = self._chain, self._chain.plant, q[k - 1]
        predicted = moved_to = self._inner.step(k, q)
        past = slice(k - self._first, k)
        history = History(q=q[past].transpose(0, 1), u=self._u[past].transpose(0, 1))
        counter = chain.advance_draws()
        weight = plant.weight(newest) if chain.is_weighed else None
        for name, effect in chain.motions.items():
            moved, salted = moved_to - newest, chain.salt_counter(name, counter)
            values = self._values[name]
            if k == self._first:
                begun = StepInputs(values, {}, history, plant, moved, salted, weight)
                self._memory[name] = effect.begin(begun)
            now = StepInputs(values, self._memory[name], history, plant, moved, salted, weight)
            extra, self._memory[name] = effect.extra(now)
            moved_to = moved_to + extra
        return chain.hold_in_travel(moved_to, predicted)


def _change_commands(
    chain: PlannableChain,
    name: str,
    effect: Any,
    u: torch.Tensor,
    first: int,
    q: torch.Tensor | None,
) -> torch.Tensor:
    """Return the commands of a run `(T, N, J)` after one effect; `q`: the positions before it."""
    values, still, rows = chain.get_values(name), torch.zeros_like(u[0]), u.transpose(0, 1)
    if effect.delays:  # in a step no command is known before it is given
        earliest_s = -chain.inner.delay_s
        values = {key: torch.maximum(value, earliest_s) for key, value in values.items()}
    if effect.pointwise or effect.delays:
        now = StepInputs(values, {}, History(q=rows, u=rows), chain.plant, still, None)
        now = StepInputs(values, effect.begin(now), now.history, chain.plant, still, None)
        return effect.commands(now)[0].transpose(0, 1).contiguous()
    assert effect.recent is not None, "a plannable effect says how far it looks back"
    changed, memory = u.clone(), {}
    for k in range(first, len(u) + 1):
        seen = rows[:, k - effect.recent : k]
        counter = chain.salt_counter(name, chain.advance_draws())
        now = StepInputs(values, memory, History(q=seen, u=seen), chain.plant, still, counter)
        if k == first:
            placed = seen if q is None else q[:first].transpose(0, 1)
            memory = effect.begin(replace(now, history=History(q=placed, u=seen)))
            now = StepInputs(values, memory, now.history, chain.plant, still, counter)
        result, memory = effect.commands(now)
        changed[k - 1] = result[:, -1]
    return changed
