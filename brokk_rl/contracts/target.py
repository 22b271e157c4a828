"""Contract of target sensors: how the loop of a policy comes to know its target.

Without a sensor a task draws the errors of its target (`task.noise`). With one, the target is what
the sensor estimates, with its delay, its errors and its gaps.
Axes: `N` environments, `J` joints, `T` times of a plan.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    import numpy as np

    from brokk_rl.machine import Machine

MotionPlan = Callable[["np.ndarray", int, float], "np.ndarray"]
"""Returns the planned joint positions, `(N, T, J)`, towards targets, `(N, 3)`, at `T` times a step
of so many seconds apart, the first of them now."""


@dataclass(frozen=True)
class TargetReading:
    """Present estimates of a target sensor.

    Attributes:
        target_m: Estimated targets in the base frame, `(N, 3)`; anything finite where unknown.
        is_known: Whether there is an estimate, `(N,)` bool. The machine rests where there is none.
    """

    target_m: np.ndarray
    is_known: np.ndarray


class TargetSensor(Protocol):
    """Sensor of the targets of `N` environments; numpy."""

    def reset(self, mask: np.ndarray, start: dict[str, np.ndarray]) -> None:
        """Begin new episodes in the environments of `mask`, `(N,)` bool, at the task's starts."""

    def begin(self) -> None:
        """Forget all episodes, and sense in all environments from now on; before, nothing is sensed.

        What follows does not depend on what was.
        """

    def attend(self, mask: np.ndarray) -> None:
        """Sense in the environments of `mask`, `(N,)` bool, alone; the others do not count."""

    def read(self, q: np.ndarray, measured_q: np.ndarray, plan: MotionPlan) -> TargetReading:
        """Return the estimates; called once a control period, after `reset`.

        Args:
            q: True joint positions, `(N, J)`.
            measured_q: The same as the machine's sensors tell them.
            plan: Plan of the coming motion.
        """
        ...

    def summarize(self) -> dict[str, Any]:
        """Return figures of the episodes that ended since `begin`, as JSON data."""
        ...


class TargetSensorSpec(Protocol):
    """A spec in `conf/target` for simulated loops."""

    def sense(self, machine: Machine, num_envs: int, seed: int) -> TargetSensor:
        """Return a sensor for `num_envs` environments; the same seed gives the same errors."""
        ...
