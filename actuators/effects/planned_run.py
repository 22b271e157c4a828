"""A run of effects around a model whose commands are all known beforehand.

Axes: `T` commands of the run, `N` environments, `J` joints.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch

from actuators.contracts import PlannedRun
from actuators.effects.step_inputs import RunMemory
from brokk_rl.history import History


class ChainRun:
    """A run of effects around a model; see `actuators.contracts.PlannedRun`.

    Args:
        chain: The chain.
        inner: The run of the model inside.
        u: Commands as they come from outside, `(T, N, J)`.
        first: Number of the first position that is asked for.
    """

    def __init__(self, chain: Any, inner: PlannedRun, u: torch.Tensor, first: int) -> None:
        self._chain, self._inner, self._u, self._first = chain, inner, u, first
        self._memory = RunMemory()

    def step(self, k: int, q: torch.Tensor) -> torch.Tensor:
        """Return positions `k`, `(N, J)`."""
        past = slice(k - self._first, k)
        history = History(q=q[past].transpose(0, 1), u=self._u[past].transpose(0, 1))
        counter = self._chain.advance_draws()
        return self._chain.move(history, self._inner.step(k, q), counter, self._memory)


def change_run_commands(
    chain: Any, name: str, u: torch.Tensor, first: int, q: torch.Tensor | None
) -> torch.Tensor:
    """Return the commands of a run `(T, N, J)` after one effect; `q`: the positions before it."""
    effect, still, rows = chain.commands[name], torch.zeros_like(u[0]), u.transpose(0, 1)
    if effect.recent == 1 or effect.delays:
        now = chain.describe(name, History(q=rows, u=rows), still, None)
        if effect.delays:  # in a step no command is known before it is given
            earliest_s = -chain.inner.delay_s
            values = {key: torch.maximum(one, earliest_s) for key, one in now.value.items()}
            now = replace(now, value=values)
        now = replace(now, memory=effect.begin(now))
        return effect.commands(now)[0].transpose(0, 1).contiguous()
    assert effect.recent is not None, "a plannable effect says how far it looks back"
    changed, memory = u.clone(), RunMemory()
    for k in range(first, len(u) + 1):
        seen = rows[:, k - effect.recent : k]
        placed = seen if q is None or k > first else q[:first].transpose(0, 1)
        now = chain.describe(name, History(q=placed, u=seen), still, chain.advance_draws())
        result, kept = effect.commands(memory.recall(name, effect, now))
        memory.keep(name, kept)
        changed[k - 1] = result[:, -1]
    return changed
