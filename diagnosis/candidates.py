"""Free runs of a simulator with effects around it, many candidates side by side.

Axes: `C` candidates, `W` windows, `K` steps, `J` joints, `L` samples before the free run, `H` of
which are the history.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
import torch

from brokk_rl.contracts.actuator import Actuator
from brokk_rl.errors import BrokkError
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.open_loop import FreeRunWindows
from diagnosis.library import Kind

ROWS = 1536
"""Free runs simulated at once: enough to keep a core busy, few enough to stay in its cache."""

Values = Mapping[str, np.ndarray]
"""Numbers of an effect by name, each `(C, J)`, or `(C, 1)` for one that joints do not have."""


@dataclass(frozen=True)
class Candidates:
    """Free runs of one base through one cut, as a function of effects.

    Attributes:
        base: The simulator.
        machine: The machine.
        cut: Windows.
        running_s: Time since the machine was started at the beginning of each window, `(W,)`.
        seed: Of the random numbers that stochastic effects draw.
        fixed: Effects that all candidates have, with numbers `(1, J)`.
    """

    base: Actuator
    machine: Machine
    cut: FreeRunWindows
    running_s: np.ndarray
    seed: int
    fixed: Sequence[tuple[Kind, Values]] = ()

    def paths(
        self,
        effects: Sequence[tuple[Kind, Values]],
        count: int = 1,
        own: Values = MappingProxyType({}),
    ) -> np.ndarray:
        """Returns measured positions of free runs, `(C, W, K, J)`.

        Args:
            effects: Effects with the numbers of each candidate.
            count: Number of candidates, `C`.
            own: Numbers of the base itself that candidates change, of those in its `parameters`.

        Raises:
            BrokkError: the model ran into NaN.
        """
        fixed = [
            (kind, {name: np.repeat(value, count, 0) for name, value in values.items()})
            for kind, values in self.fixed
        ]
        effects = sorted([*effects, *fixed], key=lambda one: one[0].order)
        windows = len(self.cut.q)
        found = np.empty((count * windows, *self.cut.measured.shape[1:]), dtype=np.float32)
        for start in range(0, len(found), ROWS):
            rows = np.arange(start, min(start + ROWS, len(found)))
            found[rows] = self._run(effects, own, rows // windows, rows % windows)
        if not np.isfinite(found).all():
            names = ", ".join(kind.name for kind, _ in effects) or "no effect"
            raise BrokkError(
                f"the simulator ran into NaN in a free run with {names}; look at its fit"
            )
        return found.reshape(count, windows, *found.shape[1:])

    def _run(
        self,
        effects: Sequence[tuple[Kind, Values]],
        own: Values,
        candidate: np.ndarray,
        window: np.ndarray,
    ) -> np.ndarray:
        """Returns one free run a row, `(N, K, J)`."""
        cut, count, device = self.cut, len(window), torch.device("cpu")
        size, before = cut.num_history, cut.num_before
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(
                self.seed + int(candidate[0])
            )  # rows of other batches draw other numbers
            model: Any = self.base.build(self.machine, count, device)
            for name, value in own.items():
                model.parameters[name].copy_(torch.as_tensor(value[candidate], dtype=torch.float32))
            for kind, values in effects:
                model = kind.wrap(model, self.machine, count, device)
                for name, value in values.items():
                    model.parameters[name].copy_(
                        torch.as_tensor(value[candidate], dtype=torch.float32)
                    )
                if kind.running:
                    begun_s = self.running_s[window] - (before - size) * self.machine.period_s
                    model.parameters[kind.running].copy_(
                        torch.as_tensor(begun_s, dtype=torch.float32)[:, None]
                    )
        measure, truth = (getattr(model, name, None) for name in ("measure", "truth"))
        measure = measure if "measurement" in getattr(model, "sides", ()) else None
        u = torch.as_tensor(cut.u[window], dtype=torch.float32)
        q = torch.empty(count, before + cut.measured.shape[1], u.shape[2])
        q[:, :before] = torch.as_tensor(cut.q[window, :before])
        if measure and truth:
            q[:, :before] = truth(q[:, :before])
        seen = torch.empty_like(q[:, before:])
        with torch.inference_mode():
            model.reset(torch.ones(count, dtype=torch.bool))
            for k in range(size, q.shape[1]):
                position = model.step(History(q=q[:, k - size : k], u=u[:, k - size : k]))
                if k >= before:
                    q[:, k] = position
                    seen[:, k - before] = measure(position) if measure else position
        return seen.numpy()
