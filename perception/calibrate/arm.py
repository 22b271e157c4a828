"""Where joint positions put the last link, and how it moves when they are not what they seem."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from brokk_rl import record
from brokk_rl.errors import ConfigError
from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.machine import Machine
from perception.calibrate import transforms


@dataclass(frozen=True)
class LinkPoses:
    """The last link in `N` poses.

    Attributes:
        base_from_link: At the tool's tip; z along the last joint, x along the tool, `(N, 4, 4)`.
        joints: Motions of the link, in the base frame, for one unit of each joint, `(N, J, 6)`: a
            point at `p` goes by `v + w x p`.
        tip_in_base_m: Tip of the tool, `(N, 3)`.
    """

    base_from_link: np.ndarray
    joints: np.ndarray
    tip_in_base_m: np.ndarray


def compute_link_poses(machine: Machine, q: np.ndarray) -> LinkPoses:
    """Returns the last link at joint positions, `(N, J)`, rad or m.

    Raises:
        ConfigError: the machine's geometry is not known.
    """
    found = compute_tool_kinematics(machine, q)
    origins, axes, along, tip = (
        found.joints_in_base_m,
        found.axes_in_base,
        found.axis_in_base,
        found.tip_in_base_m,
    )
    z = axes[:, -1]
    x = along - (along * z).sum(-1, keepdims=True) * z
    if (
        np.linalg.norm(x, axis=-1).min() < 0.1
    ):  # a tool along its own joint: any direction across will do
        x = axes[:, 0] - (axes[:, 0] * z).sum(-1, keepdims=True) * z
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    turn = np.stack([x, np.cross(z, x), z], -1)
    hinge = np.array([joint.kind == "hinge" for joint in machine.joints])[:, None]
    motions = np.concatenate(
        [np.where(hinge, np.cross(origins, axes), axes), np.where(hinge, axes, 0.0)], -1
    )
    return LinkPoses(transforms.make_transform(turn, tip), motions, tip)


def build_wobble_motions(base_from_link: np.ndarray, shift_m: float, turn_rad: float) -> np.ndarray:
    """Returns motions of links about themselves in all six directions, `(N, 6, 6)` in the base frame."""
    found = np.zeros((len(base_from_link), 6, 6))
    for k, unit in enumerate(np.eye(3)):
        found[:, k, :3] = shift_m * unit
        found[:, 3 + k, :3], found[:, 3 + k, 3:] = (
            turn_rad * np.cross(base_from_link[:, :3, 3], unit),
            turn_rad * unit,
        )
    return found


@dataclass(frozen=True)
class JointTrajectory:
    """Joint positions over time, or of single frames by name.

    Attributes:
        t_s: Times, `(T,)`; `None` where positions belong to frames by name.
        q: `(T, J)`.
        names: Stems of the frames, `None` where there are times.
    """

    t_s: np.ndarray | None
    q: np.ndarray
    names: tuple[str, ...] | None

    def at(self, name: str, t_s: float) -> np.ndarray | None:
        """Returns the joint positions of a frame, `(J,)`; `None` where nobody knows them."""
        if self.names is not None:
            return self.q[self.names.index(name)] if name in self.names else None
        times = np.asarray(self.t_s)
        if not times[0] <= t_s <= times[-1]:
            return None
        return np.array([np.interp(t_s, times, column) for column in self.q.T])

    def speed(self, t_s: np.ndarray, over_s: float = 0.1) -> np.ndarray:
        """Returns joint speeds, `(N, J)`, at times; nothing moves where positions belong to frames."""
        if self.t_s is None:
            return np.zeros((len(t_s), self.q.shape[1]))
        ends = [
            np.stack([np.interp(t_s + half, self.t_s, column) for column in self.q.T], 1)
            for half in (-over_s / 2, over_s / 2)
        ]
        return (ends[1] - ends[0]) / over_s


def read_joint_positions(path: Path, machine: Machine) -> JointTrajectory:
    """Returns joint positions from a recording (Parquet), or from YAML: `<stem>: [q1, …]`, rad or m.

    Raises:
        ConfigError: the file cannot be read as such.
        RecordingError: the recording breaks the format.
    """
    if path.suffix == ".parquet":
        recording = record.read_recording(path, machine)
        return JointTrajectory(
            np.asarray(recording.t_s, float), np.asarray(recording.q, float), None
        )
    try:
        told = yaml.safe_load(path.read_text())
        names, q = tuple(str(name) for name in told), np.array(list(told.values()), float)
    except (OSError, yaml.YAMLError, TypeError, ValueError, AttributeError) as error:
        raise ConfigError(
            f"{path}: expected a recording (*.parquet), or YAML of '<stem of a frame>: [joint positions]' ({error})"
        ) from error
    if q.ndim != 2 or q.shape[1] != machine.num_joints or not np.isfinite(q).all():
        raise ConfigError(
            f"{path}: expected {machine.num_joints} joint positions for each frame, in machine order, rad or m"
        )
    outside = (q < machine.lower - 0.1) | (q > machine.upper + 0.1)
    if outside.any():
        row, column = np.argwhere(outside)[0]
        joint = machine.joints[column]
        raise ConfigError(
            f"{path}: {names[row]}: {joint.name} is {q[row, column]:g} {joint.unit}, its travel is "
            f"{joint.lower.value:g} to {joint.upper.value:g}; are these degrees?"
        )
    return JointTrajectory(None, q, names)
