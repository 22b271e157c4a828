"""Poses of the arm's last link from joint positions, and their sensitivity to errors."""

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

SPEED_INTERVAL_S = 0.1
"""Joint speeds are differences over this time; chosen by hand, several samples of a recording."""
MIN_TOOL_ACROSS = 0.1
"""Least part of the unit tool axis across the last joint that still defines the link's x axis."""
TRAVEL_SLACK = 0.1
"""Positions may exceed a joint's travel by this, rad or m; more means other units."""


@dataclass(frozen=True)
class LinkPoses:
    """The last link in `N` poses.

    Attributes:
        base_from_link: At the tool's tip; z along the last joint, x along the tool, `(N, 4, 4)`.
        joints: Motions of the link, in the base frame, for one unit of each joint, `(N, J, 6)`: a
            point at `p` goes by `v + w x p`.
    """

    base_from_link: np.ndarray
    joints: np.ndarray


def compute_link_poses(machine: Machine, q: np.ndarray) -> LinkPoses:
    """Return the last link at joint positions, `(N, J)`, rad or m.

    Raises:
        ConfigError: the machine's geometry is not known.
    """
    tool = compute_tool_kinematics(machine, q)
    origins, axes, along = tool.joints_in_base_m, tool.axes_in_base, tool.axis_in_base
    z = axes[:, -1]
    x = along - (along * z).sum(-1, keepdims=True) * z
    # a tool along its own joint defines no x axis: any fixed direction across the joint will do
    if np.linalg.norm(x, axis=-1).min() < MIN_TOOL_ACROSS:
        x = axes[:, 0] - (axes[:, 0] * z).sum(-1, keepdims=True) * z
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    rotation = np.stack([x, np.cross(z, x), z], -1)
    hinge = np.array([joint.kind == "hinge" for joint in machine.joints])[:, None]
    motions = np.concatenate(
        [np.where(hinge, np.cross(origins, axes), axes), np.where(hinge, axes, 0.0)], -1
    )
    return LinkPoses(transforms.make_transform(rotation, tool.tip_in_base_m), motions)


def build_wobble_motions(base_from_link: np.ndarray, shift_m: float, turn_rad: float) -> np.ndarray:
    """Return motions of links about their origins in six directions, `(N, 6, 6)`, base frame."""
    motions = np.zeros((len(base_from_link), 6, 6))
    for k, unit in enumerate(np.eye(3)):
        motions[:, k, :3] = shift_m * unit
        motions[:, 3 + k, :3] = turn_rad * np.cross(base_from_link[:, :3, 3], unit)
        motions[:, 3 + k, 3:] = turn_rad * unit
    return motions


def interpolate_columns(t_s: np.ndarray | float, times_s: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the rows of `q`, `(T, J)` at `times_s`, interpolated linearly at `t_s`."""
    return np.stack([np.interp(t_s, times_s, column) for column in q.T], -1)


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
        """Return the joint positions of a frame, `(J,)`; `None` where they are not known."""
        if self.names is not None:
            return self.q[self.names.index(name)] if name in self.names else None
        times = np.asarray(self.t_s)
        if not times[0] <= t_s <= times[-1]:
            return None
        return interpolate_columns(t_s, times, self.q)

    def speed(self, t_s: np.ndarray) -> np.ndarray:
        """Return joint speeds, `(N, J)`, at times; 0 where positions belong to frames."""
        if self.t_s is None:
            return np.zeros((len(t_s), self.q.shape[1]))
        begin = interpolate_columns(t_s + -SPEED_INTERVAL_S / 2, self.t_s, self.q)
        end = interpolate_columns(t_s + SPEED_INTERVAL_S / 2, self.t_s, self.q)
        return (end - begin) / SPEED_INTERVAL_S


def read_joint_positions(path: Path, machine: Machine) -> JointTrajectory:
    """Read a recording (Parquet), or YAML of `<stem of a frame>: [q1, …]`, rad or m.

    Raises:
        ConfigError: the file cannot be read as such.
        RecordingError: the recording breaks the format.
    """
    if path.suffix == ".parquet":
        recording = record.read_recording(path, machine)
        t_s, q = np.asarray(recording.t_s, float), np.asarray(recording.q, float)
        return JointTrajectory(t_s, q, None)
    try:
        data = yaml.safe_load(path.read_text())
        names, q = tuple(str(name) for name in data), np.array(list(data.values()), float)
    except (OSError, yaml.YAMLError, TypeError, ValueError, AttributeError) as error:
        raise ConfigError(
            f"{path}: expected a recording (*.parquet), or YAML of "
            f"'<stem of a frame>: [joint positions]' ({error})"
        ) from error
    if q.ndim != 2 or q.shape[1] != machine.num_joints or not np.isfinite(q).all():
        raise ConfigError(
            f"{path}: expected {machine.num_joints} joint positions for each frame, in machine "
            "order, rad or m"
        )
    outside = (q < machine.lower - TRAVEL_SLACK) | (q > machine.upper + TRAVEL_SLACK)
    if outside.any():
        row, column = np.argwhere(outside)[0]
        joint = machine.joints[column]
        raise ConfigError(
            f"{path}: {names[row]}: {joint.name} is {q[row, column]:g} {joint.unit}, its travel is "
            f"{joint.lower.value:g} to {joint.upper.value:g}; are these degrees?"
        )
    return JointTrajectory(None, q, names)
