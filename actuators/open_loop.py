"""Free runs: a model gets recorded commands and its own predictions, no recorded positions.

One-step errors hardly separate models (a machine at 20 Hz moves little in a step); the measure is
where a free run ends up.
Axes: `W` windows, `K` steps, `J` joints, `L` samples before the free run, of which `H` are the
first history.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from actuators.recordings.split import group_by_run
from brokk_rl.contracts.actuator import Actuator
from brokk_rl.errors import BrokkError, RecordingError
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.record import Recording

WARM_UP_S = 1.0
"""Before a free run a model sees recorded positions for so long: a model with a state of its own
(spool, pressure, commands on their way) would else begin each window as a machine at rest, although
the recorded one is moving."""


@dataclass(frozen=True)
class FreeRunWindows:
    """Windows of recordings for free runs; positions are NaN after the end of a recording.

    Attributes:
        u: Commands, shape `(W, L - 1 + K, J)`: those before, then those of the `K` steps to come;
            step `k` sees them up to `u[:, L - 1 + k]`.
        q: Positions, shape `(W, L + K, J)`; the free run starts at `q[:, L - 1]`.
        run: Run that each window comes from, shape `(W,)`; windows of one run are not independent.
        num_history: `H`.
        num_before: `L`.
    """

    u: np.ndarray
    q: np.ndarray
    run: np.ndarray
    num_history: int
    num_before: int

    @property
    def measured(self) -> np.ndarray:
        """Measured positions after each step, `(W, K, J)`, NaN after the recording's end."""
        return self.q[:, self.num_before :]


def find_longest_horizon_s(recordings: Sequence[Recording], machine: Machine) -> float:
    """Return the longest free run that fits into a recording, s; 0 or less if none."""
    longest = max((recording.num_samples for recording in recordings), default=0)
    return (longest - count_samples_before(machine)) * machine.period_s


def count_samples_before(machine: Machine) -> int:
    """Return the number of samples before a free run, `L`."""
    return machine.num_history + round(WARM_UP_S / machine.period_s)


def cut_windows(
    recordings: Sequence[Recording],
    machine: Machine,
    horizon_s: float,
    stride_s: float,
    shortest_s: float | None = None,
) -> FreeRunWindows:
    """Cut recordings into windows of `horizon_s` after their warm-up, one every `stride_s`.

    Args:
        recordings: Where from.
        machine: Gives period and history.
        horizon_s: Length of the free runs.
        stride_s: Distance between two beginnings.
        shortest_s: A window may end early with its recording, but not before this; `None`: all are
            whole.

    Raises:
        RecordingError: no recording is long enough.
    """
    before, steps = count_samples_before(machine), round(horizon_s / machine.period_s)
    least = steps if shortest_s is None else min(steps, round(shortest_s / machine.period_s))
    stride = max(1, round(stride_s / machine.period_s))
    u, q, run = [], [], []
    for name, parts in group_by_run(recordings).items():
        for recording in parts:
            for start in range(0, recording.num_samples - before - least + 1, stride):
                end = min(start + before + steps, recording.num_samples)
                missing = ((0, start + before + steps - end), (0, 0))
                u.append(np.pad(recording.u[start : end - 1], missing))
                q.append(np.pad(recording.q[start:end], missing, constant_values=np.nan))
                run.append(name)
    if not u:
        found_s = max((recording.duration_s for recording in recordings), default=0.0)
        raise RecordingError(
            f"too little data: a free run of {least * machine.period_s:g} s needs {(before + least) * machine.period_s:g} s of "
            f"recording, the longest of {len(recordings)} has {found_s:.1f} s"
        )
    return FreeRunWindows(np.stack(u), np.stack(q), np.array(run), machine.num_history, before)


def join_windows(cuts: Sequence[FreeRunWindows]) -> FreeRunWindows:
    """Return the windows of several cuts of the same shape as one, in their order."""
    u, q, run = (np.concatenate([getattr(cut, name) for cut in cuts]) for name in ("u", "q", "run"))
    return FreeRunWindows(u, q, run, cuts[0].num_history, cuts[0].num_before)


def roll_out(
    actuator: Actuator, machine: Machine, cut: FreeRunWindows, device: torch.device
) -> np.ndarray:
    """Return the positions of free runs through all windows at once, shape `(W, K, J)`.

    Raises:
        BrokkError: the model ran into NaN.
    """
    model = actuator.build(machine, len(cut.q), device)
    u, known = (torch.as_tensor(one, dtype=torch.float32, device=device) for one in (cut.u, cut.q))
    known = known[:, : cut.num_before].transpose(0, 1)
    path = run_freely(model, u.transpose(0, 1).contiguous(), known, cut.num_history)
    found = path.transpose(0, 1).cpu().numpy()
    if not np.isfinite(found).all():
        raise BrokkError(
            f"{type(actuator).__name__} ran into NaN in a free run; look at its fit, or fit it again with another seed"
        )
    return found


@torch.inference_mode()
def run_freely(model: Any, u: torch.Tensor, known: torch.Tensor, size: int) -> torch.Tensor:
    """Return the positions of free runs as sensors read them, `(K, N, J)`.

    Args:
        model: The model, of all runs side by side; it begins anew.
        u: Commands, time first, so that a step reads one piece of memory, `(T, N, J)`.
        known: Positions up to the beginning of the free runs, `(L, N, J)`.
        size: Length of the model's history.
    """
    is_measured = "measurement" in getattr(model, "sides", ())
    q = u.new_empty(len(u) + 1, *u.shape[1:])
    q[: len(known)] = model.truth(known.transpose(0, 1)).transpose(0, 1) if is_measured else known
    seen = torch.empty_like(q[len(known) :])
    model.reset(torch.ones(u.shape[1], dtype=torch.bool, device=u.device))
    plan = getattr(model, "plan_run", None)
    run = plan(u, size, q) if plan else None
    for k in range(size, len(q)):
        if run is None:
            past = slice(k - size, k)
            history = History(q=q[past].transpose(0, 1), u=u[past].transpose(0, 1))
            position = model.step(history)
        else:
            position = run.step(k, q)
        if k >= len(known):
            q[k] = position
            seen[k - len(known)] = model.measure(position) if is_measured else position
    return seen
