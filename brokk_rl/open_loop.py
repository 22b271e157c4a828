"""Free runs: an actuator model is given the recorded commands and its own predictions, never the recorded positions.

One-step errors hardly separate models (a machine at 20 Hz moves little in a step); what counts is where a free run ends up.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from brokk_rl.contracts import Actuator
from brokk_rl.errors import RecordingError
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.record import Recording


@dataclass(frozen=True)
class Windows:
    """Windows of recordings for free runs.

    Attributes:
        u: Commands, shape `(W, H - 1 + K, J)`: the history, then those of the `K` steps to come; step `k` sees them
            up to `u[:, H - 1 + k]`.
        q: Positions, shape `(W, H + K, J)`; the free run starts at `q[:, H - 1]`.
        group: Recording that each window comes from, shape `(W,)`; windows of one recording are not independent.
        num_history: `H`.
    """

    u: np.ndarray
    q: np.ndarray
    group: np.ndarray
    num_history: int

    @property
    def measured(self) -> np.ndarray:
        """Measured positions after each step, shape `(W, K, J)`."""
        return self.q[:, self.num_history :]


def windows(recordings: Sequence[Recording], machine: Machine, horizon_s: float, stride_s: float) -> Windows:
    """Cuts recordings into windows of `horizon_s` after their history, one every `stride_s`.

    Raises:
        RecordingError: no recording is long enough.
    """
    history, steps = machine.num_history, round(horizon_s / machine.period_s)
    stride = max(1, round(stride_s / machine.period_s))
    u, q, group = [], [], []
    for number, recording in enumerate(recordings):
        for start in range(0, recording.num_samples - history - steps + 1, stride):
            u.append(recording.u[start : start + history + steps - 1])
            q.append(recording.q[start : start + history + steps])
            group.append(number)
    if not u:
        longest_s = max((recording.duration_s for recording in recordings), default=0.0)
        needed_s = (history + steps) * machine.period_s
        raise RecordingError(
            f"too little data: a free run of {horizon_s:g} s needs {needed_s:g} s of recording, the longest of {len(recordings)} "
            f"has {longest_s:.1f} s"
        )
    return Windows(np.stack(u), np.stack(q), np.array(group), history)


def free_run(actuator: Actuator, machine: Machine, cut: Windows, device: torch.device) -> np.ndarray:
    """Returns the positions of free runs through all windows at once, shape `(W, K, J)`."""
    count, steps = len(cut.q), cut.measured.shape[1]
    model = actuator.build(machine, count, device)
    u = torch.as_tensor(cut.u, dtype=torch.float32, device=device)
    q = torch.as_tensor(cut.q[:, : cut.num_history], dtype=torch.float32, device=device)
    history = History(q=q.clone(), u=u[:, : cut.num_history].roll(1, 1))  # before the first push_u the newest command is one back
    path = []
    with torch.inference_mode():
        model.reset(torch.ones(count, dtype=torch.bool, device=device))
        for k in range(steps):
            history.push_u(u[:, cut.num_history - 1 + k])
            position = model.step(history)
            history.push_q(position)
            path.append(position)
    return torch.stack(path, 1).cpu().numpy()


def errors(
    predicted: np.ndarray, cut: Windows, machine: Machine, horizons_s: Sequence[float], generator: np.random.Generator
) -> dict[str, dict[str, dict[str, float | list[float]]]]:
    """Returns the errors of free runs by joint and horizon.

    For each joint and horizon: `rmse` of the position at the end of the horizon, rad or m, with `ci95` from resampling whole
    recordings; `percent` of the joint's travel; `path_mean` and `end_mean`, the mean absolute error along the path and at its end.
    """
    error = np.abs(predicted - cut.measured)
    groups = [np.flatnonzero(cut.group == number) for number in np.unique(cut.group)]
    resampled = [np.concatenate([groups[i] for i in generator.integers(len(groups), size=len(groups))]) for _ in range(200)]
    table = {}
    for j, name in enumerate(machine.joint_names):
        rows = {}
        for horizon_s in horizons_s:
            step = round(horizon_s / machine.period_s) - 1
            end = error[:, step, j]
            rmse = float(np.sqrt(np.mean(end**2)))
            spread = [np.sqrt(np.mean(end[rows_] ** 2)) for rows_ in resampled]
            rows[f"{horizon_s:g}"] = {
                "rmse": rmse,
                "ci95": [float(bound) for bound in np.percentile(spread, (2.5, 97.5))],
                "percent": 100.0 * rmse / float(machine.upper[j] - machine.lower[j]),
                "path_mean": float(error[:, : step + 1, j].mean()),
                "end_mean": float(end.mean()),
            }
        table[name] = rows
    return table
