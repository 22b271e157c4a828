"""Actuator evidence: whether the machine moves as one of those that the policy was trained with.

The simulator is driven with the recorded commands, once as it is and once with the effects of the
training drawn anew for each machine. A joint is blamed when it departs further from the simulator
than any drawn machine. Axes: `M` drawn machines, `W` windows, `K` steps, `J` joints.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from brokk_rl import open_loop
from brokk_rl.contracts.actuator import Actuator, ActuatorModel, Effect
from brokk_rl.errors import RecordingError
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.open_loop import FreeRunWindows
from brokk_rl.record import Recording
from brokk_rl.scales import choose_horizon_s

NUM_MACHINES = 200
"""Machines that are drawn; one that is as they are exceeds all of them in 1 of 201 cases a joint."""
BEYOND = 1.2
"""Multiple of the largest departure among them from which a joint is blamed. Chosen by hand: contact
and the noise of sensors add a little to the machine's own."""
MIN_TRAVEL_SHARE = 0.005
"""Part of its travel that a joint moves at least, recorded or simulated, to be judged; by hand."""


@dataclass(frozen=True)
class JointMotion:
    """Departure of a joint from the simulator, RMS over free runs, rad or m.

    Attributes:
        joint: Its name.
        recorded: Departure of the recorded machine.
        typical: Median departure of the machines of training.
        largest: Largest one.
        moves: Whether it moved enough to be judged.
    """

    joint: str
    recorded: float
    typical: float
    largest: float
    moves: bool

    @property
    def blamed(self) -> bool:
        """True if it departs further than any machine of the training."""
        return self.moves and self.recorded > BEYOND * self.largest


@dataclass(frozen=True)
class MotionEvidence:
    """Result of the comparison of motions.

    Attributes:
        joints: By joint, in machine order; empty where nothing can be said.
        horizon_s: Length of the free runs.
        cannot_tell: Why nothing can be said.
    """

    joints: tuple[JointMotion, ...]
    horizon_s: float
    cannot_tell: str

    @property
    def blamed(self) -> tuple[str, ...]:
        """Joints that are blamed."""
        return tuple(one.joint for one in self.joints if one.blamed)


def check_motion(
    recordings: Sequence[Recording],
    machine: Machine,
    actuator: Actuator | None,
    effects: Mapping[str, Effect],
    seed: int,
) -> MotionEvidence:
    """Compare recorded motion with the simulator and the machines of training.

    Args:
        recordings: The log or logs.
        machine: The machine.
        actuator: The simulator's actuator; `None`: none is known.
        effects: Effects that the training draws, by name.
        seed: Of the draws.
    """
    horizon_s = choose_horizon_s(machine)
    if actuator is None:
        return MotionEvidence((), horizon_s, "no simulator was given: actuator=<its actuator>")
    if not effects:
        return MotionEvidence(
            (), horizon_s, "no effects of the training were given: effect=[library]"
        )
    try:
        cut = open_loop.cut_windows(recordings, machine, horizon_s, horizon_s / 2)
    except RecordingError as error:
        return MotionEvidence((), horizon_s, str(error))
    torch.set_num_threads(1)  # the arrays are small: threads would only wait for each other
    cpu = torch.device("cpu")
    plain = open_loop.roll_out(actuator, machine, cut, cpu)
    many = _repeat_windows(cut, NUM_MACHINES)
    with torch.random.fork_rng([]):
        torch.manual_seed(seed)
        drawn = open_loop.roll_out(
            _DrawnMachines(actuator, effects, len(cut.q)), machine, many, cpu
        )
    drawn = drawn.reshape(NUM_MACHINES, *plain.shape)
    recorded = _measure_rms(cut.measured - plain)
    largest = _measure_rms(drawn - plain)
    travel = machine.upper - machine.lower
    moved = np.ptp(np.concatenate([plain, cut.measured], 1), axis=1).max(0)
    joints = []
    for j, name in enumerate(machine.joint_names):
        joints.append(
            JointMotion(
                joint=name,
                recorded=float(recorded[j]),
                typical=float(np.median(largest[:, j])),
                largest=float(largest[:, j].max()),
                moves=bool(moved[j] > MIN_TRAVEL_SHARE * travel[j]),
            )
        )
    return MotionEvidence(tuple(joints), horizon_s, "")


def _measure_rms(difference: np.ndarray) -> np.ndarray:
    """Return the root mean square over windows and steps, `(…, J)`."""
    return np.sqrt(np.nanmean(difference**2, axis=(-3, -2)))


def _repeat_windows(cut: FreeRunWindows, count: int) -> FreeRunWindows:
    """Return all windows `count` times, one machine after the other."""
    repeats = (count, 1, 1)
    return FreeRunWindows(
        np.tile(cut.u, repeats), np.tile(cut.q, repeats), np.tile(cut.run, count),
        cut.num_history, cut.num_before,
    )  # fmt: skip


@dataclass(frozen=True)
class _DrawnMachines:
    """An actuator with effects whose draws all windows of a machine share."""

    actuator: Actuator
    effects: Mapping[str, Effect]
    num_windows: int

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> ActuatorModel:
        model = self.actuator.build(machine, num_envs, device)
        for effect in self.effects.values():
            model = effect.wrap(model, machine, num_envs, device)
        return _SharedDraws(model, self.num_windows)


class _SharedDraws:
    def __init__(self, model: ActuatorModel, num_windows: int) -> None:
        self._model, self._num_windows = model, num_windows

    @property
    def state(self) -> dict[str, torch.Tensor]:
        return self._model.state

    def reset(self, mask: torch.Tensor) -> None:
        self._model.reset(mask)
        for path, value in self._model.state.items():
            if "drawn" in path.split("."):
                first = value[:: self._num_windows]
                value.copy_(first.repeat_interleave(self._num_windows, 0))

    def step(self, history: History) -> torch.Tensor:
        return self._model.step(history)
