"""Actuator evidence: whether the machine moves as one of those that the policy was trained with.

The simulator is driven with the recorded commands, once as it is and once with the effects of the
training drawn anew for each machine. A joint is blamed when it departs clearly further from the simulator
than any of them. Axes: `M` drawn machines, `W` windows, `K` steps, `J` joints.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from actuators import open_loop
from actuators.scales import choose_horizon_s
from brokk_rl.contracts.actuator import Actuator, ActuatorModel, Effect
from brokk_rl.errors import RecordingError
from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis.deployment.contract import TARGET_COLUMNS

log = logging.getLogger(__name__)

NUM_MACHINES = 200
"""Machines that are drawn; one that is as they are exceeds all of them in 1 of 201 cases a joint."""
BEYOND = 1.4
"""Multiple of their largest departure from which a joint is blamed. Chosen on two makes of 24 clean logs: the
largest of these 240 joints has 1.35, and effects beyond the training's begin at 1.1."""
HORIZON_SHARE = 0.5
"""Length of the free runs, of those of the diagnosis: a run has few seconds without contact."""
WINDOWS_APART = 0.4
"""Time between two windows, of their length."""
END_SHARE = 0.01
"""Part of its travel within which a joint counts as being at its end."""
GROUND_M, NEAR_M, ABOVE_M = 0.1, 0.4, 0.05
"""The tool may touch: height above the ground, horizontal distance from the target, and height above it
within that distance; the block is the wider of the two. Chosen by hand."""
MIN_TRAVEL_SHARE = 0.005
"""Part of its travel that a joint moves at least, recorded or simulated, to be judged; by hand."""


@dataclass(frozen=True)
class JointMotion:
    """Departure of a joint from the simulator, RMS over free runs, rad or m.

    Attributes:
        joint: Its name.
        rmse: Departure of the recorded machine.
        training_median: Median departure of the machines of training.
        training_largest: The largest of theirs.
        moves: Whether it moved enough to be judged.
    """

    joint: str
    rmse: float
    training_median: float
    training_largest: float
    moves: bool

    @property
    def blamed(self) -> bool:
        """True if it departs further than the machines of the training."""
        return self.moves and self.rmse > BEYOND * self.training_largest

    def to_json(self) -> dict[str, Any]:
        """Return all but its name as plain JSON data, as `doctor.json` holds it."""
        figures = {key: value for key, value in vars(self).items() if key != "joint"}
        return figures | {"blamed": self.blamed}


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
    horizon_s = HORIZON_SHARE * choose_horizon_s(machine)
    if actuator is None:
        return MotionEvidence((), horizon_s, "no simulator was given: actuator=<its actuator>")
    if not effects:
        lacking = "no effects of the training were given: effect=[library]"
        return MotionEvidence((), horizon_s, lacking)
    try:
        apart_s = max(machine.period_s, WINDOWS_APART * horizon_s)
        free_parts = [_cut_out_contact(recording, machine) for recording in recordings]
        cut = open_loop.cut_windows(free_parts, machine, horizon_s, apart_s)
    except RecordingError as error:
        return MotionEvidence((), horizon_s, str(error))
    free = np.isfinite(cut.q).all((1, 2))
    if not free.any():
        lacking = f"no {horizon_s:g} s without an end of travel or possible contact"
        return MotionEvidence((), horizon_s, lacking)
    cut = replace(cut, u=cut.u[free], q=cut.q[free], run=cut.run[free])
    torch.set_num_threads(1)  # the arrays are small: threads would only wait for each other
    cpu = torch.device("cpu")
    plain = open_loop.roll_out(actuator, machine, cut, cpu)
    # A simulator of one's own can take minutes here.
    log.info("running the log on %d machines that the training draws", NUM_MACHINES)
    many = open_loop.join_windows([cut] * NUM_MACHINES)
    with torch.random.fork_rng([]):
        torch.manual_seed(seed)
        machines = _DrawnMachines(actuator, effects, len(cut.q))
        drawn = open_loop.roll_out(machines, machine, many, cpu)
    drawn = drawn.reshape(NUM_MACHINES, *plain.shape)
    rmse, of_training = _measure_rms(cut.measured - plain), _measure_rms(drawn - plain)
    moved = np.ptp(np.concatenate([plain, cut.measured], 1), axis=1).max(0)
    moves = moved > MIN_TRAVEL_SHARE * (machine.upper - machine.lower)
    joints = []
    for j, name in enumerate(machine.joint_names):
        median, largest = float(np.median(of_training[:, j])), float(of_training[:, j].max())
        joints.append(JointMotion(name, float(rmse[j]), median, largest, bool(moves[j])))
    return MotionEvidence(tuple(joints), horizon_s, "")


def _cut_out_contact(recording: Recording, machine: Machine) -> Recording:
    """Return a recording without positions where a joint is at its end or the tool may touch something."""
    margin = END_SHARE * (machine.upper - machine.lower)
    q = recording.q.astype(float)
    free = np.all((q > machine.lower + margin) & (q < machine.upper - margin), 1, keepdims=True)
    if machine.has_bodies:
        tip_m = compute_tool_kinematics(machine, q).tip_in_base_m
        touching = tip_m[:, 2] < GROUND_M
        if all(name in recording.extra for name in TARGET_COLUMNS):
            target_m = np.stack([recording.extra[name] for name in TARGET_COLUMNS], 1)
            near = np.hypot(*(tip_m - target_m)[:, :2].T) < NEAR_M
            touching |= near & (tip_m[:, 2] < target_m[:, 2] + ABOVE_M)
        free = free & ~touching[:, None]
    return replace(recording, q=np.where(free, recording.q, np.nan))


def _measure_rms(difference: np.ndarray) -> np.ndarray:
    """Return the root mean square over windows and steps, `(…, J)`."""
    return np.sqrt(np.nanmean(difference**2, axis=(-3, -2)))


@dataclass(frozen=True)
class _DrawnMachines:
    """An actuator with effects whose draws all windows of a machine share."""

    actuator: Actuator
    effects: Mapping[str, Effect]
    num_windows: int

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> Any:
        model = self.actuator.build(machine, num_envs, device)
        for effect in self.effects.values():
            model = effect.wrap(model, machine, num_envs, device)
        return _SharedDraws(model, self.num_windows)


class _SharedDraws:
    """A model whose draws are, after each reset, those of the first of some windows in a row."""

    def __init__(self, model: ActuatorModel, num_windows: int) -> None:
        self._model, self._num_windows = model, num_windows

    def __getattr__(self, name: str) -> Any:
        return getattr(self._model, name)

    def reset(self, mask: torch.Tensor) -> None:
        self._model.reset(mask)
        for path, value in self._model.state.items():
            if "drawn" in path.split("."):
                first = value[:: self._num_windows]
                value.copy_(first.repeat_interleave(self._num_windows, 0))
