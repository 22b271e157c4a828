"""Forward kinematics of a serial machine: batched in torch, and over recordings in numpy.

`Kinematics` (torch, float32) serves every control step of a thousand machines.
`compute_tool_kinematics` (numpy, float64) serves computers without torch; therefore nothing here
imports torch before a `Kinematics` is built.

Consecutive joints with parallel axes (q2…q5 of a planar arm) turn about one direction, so their
angles add up. All points behind them are linear in the cosines and sines of the sums. One matrix
product serves all such groups at once, and one small product each group further out. A five-joint
machine thus needs a dozen tensor operations instead of five chained 4 x 4 products. That matters on
a CPU, where each operation costs some 8 us and this runs in every control step.

Axes: `T` time, `J` joints, `B` batch, `F` features, `P` points; anything may stand before `J`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.machine import Machine

if TYPE_CHECKING:
    import torch

PARALLEL_TOLERANCE = 1e-9
"""Largest difference of two unit axes' components that count as parallel: rounding of the file."""


class ToolPose(NamedTuple):
    """Pose of the tool; leading dimensions as those of the joint positions.

    Attributes:
        tip_in_base_m: Tip of the tool, `(…, 3)`.
        axis_in_base: Unit vector from the last joint to the tip, `(…, 3)`.
        pitch_rad: Angle of that axis below the horizontal in the plane of the arm, `(…,)`; pi/2
            points straight down (the paper's theta), in (-pi, pi].
        joints_in_base_m: Origins of the joints, `(…, J, 3)`.
        axes_in_base: Unit axes of the joints, `(…, J, 3)`.
    """

    tip_in_base_m: torch.Tensor
    axis_in_base: torch.Tensor
    pitch_rad: torch.Tensor
    joints_in_base_m: torch.Tensor
    axes_in_base: torch.Tensor


class Jacobian(NamedTuple):
    """Derivatives of tip and pitch by the joints; leading dimensions as the joint positions'.

    Attributes:
        tip: Velocity of the tip for unit speed of each joint, `(…, 3, J)`, m/rad or m/m.
        pitch: Change of the pitch for unit speed of each joint, `(…, J)`, rad/rad or rad/m.
    """

    tip: torch.Tensor
    pitch: torch.Tensor


class ToolKinematics(NamedTuple):
    """Pose of the tool and its derivatives by the joints, numpy, float64.

    Attributes:
        tip_in_base_m: Tip of the tool, `(…, 3)`.
        axis_in_base: Unit vector from the last joint to the tip, `(…, 3)`.
        jacobian: Motion of the tip for unit motion of each joint, `(…, 3, J)`, m/rad or m/m.
        turn: Motion of the axis likewise, `(…, 3, J)`, 1/rad.
        joints_in_base_m: Origins of the joints, `(…, J, 3)`.
        axes_in_base: Unit axes of the joints, `(…, J, 3)`.
    """

    tip_in_base_m: np.ndarray
    axis_in_base: np.ndarray
    jacobian: np.ndarray
    turn: np.ndarray
    joints_in_base_m: np.ndarray
    axes_in_base: np.ndarray


def compute_tool_kinematics(machine: Machine, q: np.ndarray) -> ToolKinematics:
    """Return the tool's pose and derivatives at joint positions `q`, `(…, J)`, rad or m.

    Raises:
        ConfigError: the machine's geometry is not known.
    """
    q = np.asarray(q, float)
    shape, num = q.shape[:-1], machine.num_joints
    rotation, at_m = np.broadcast_to(np.eye(3), (*shape, 3, 3)), np.zeros((*shape, 3))
    axes, origins = np.empty((*shape, num, 3)), np.empty((*shape, num, 3))
    for j, (joint, body) in enumerate(zip(machine.joints, machine.bodies, strict=True)):
        at_m = at_m + rotation @ np.array([d.value for d in body.origin_m])
        axes[..., j, :], origins[..., j, :] = rotation @ np.array(body.axis), at_m
        if joint.kind == "slide":
            at_m = at_m + axes[..., j, :] * q[..., j, None]
        else:
            rotation = rotation @ rotate_about_axis(np.array(body.axis), q[..., j])
    tip = at_m + rotation @ machine.tip_m
    axis = rotation @ (machine.tip_m / np.linalg.norm(machine.tip_m))
    hinge = np.array([joint.kind == "hinge" for joint in machine.joints])[:, None]
    jacobian = np.where(hinge, np.cross(axes, tip[..., None, :] - origins), axes)
    turn = np.where(hinge, np.cross(axes, axis[..., None, :]), 0.0)
    return ToolKinematics(
        tip, axis, np.swapaxes(jacobian, -1, -2), np.swapaxes(turn, -1, -2), origins, axes
    )


def compute_link_pose(machine: Machine, q: np.ndarray, joint: str) -> np.ndarray:
    """Return the frame of the link behind a joint in the base frame, `(…, 4, 4)`.

    Args:
        machine: The machine.
        q: Joint positions, `(…, J)`, rad or m.
        joint: Name of the joint.

    Raises:
        ConfigError: the machine has no such joint, or its geometry is not known.
    """
    if joint not in machine.joint_names:
        raise ConfigError(
            f"machine '{machine.name}' has no joint '{joint}'; "
            f"{list_choices(joint, machine.joint_names)}"
        )
    q = np.asarray(q, float)
    pose = np.broadcast_to(np.eye(4), (*q.shape[:-1], 4, 4))
    for j in range(machine.joint_names.index(joint) + 1):
        body, step = machine.bodies[j], np.zeros((*q.shape[:-1], 4, 4))
        step[...] = np.eye(4)
        step[..., :3, 3] = [dimension.value for dimension in body.origin_m]
        if machine.joints[j].kind == "slide":
            step[..., :3, 3] += q[..., j, None] * np.array(body.axis)
        else:
            step[..., :3, :3] = rotate_about_axis(np.array(body.axis), q[..., j])
        pose = pose @ step
    return pose


def rotate_about_axis(axis: np.ndarray, angle_rad: np.ndarray) -> np.ndarray:
    """Return rotations about a unit axis, `(…, 3, 3)`, by Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = angle_rad[..., None, None]
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)


class _ChainState(NamedTuple):
    """Points and directions of the chain, flat over the batch.

    Attributes:
        origins: Origins of the joints, then the tip, `(B, J + 1, 3)`.
        directions: Unit axes of the joints, then the tool's, `(B, J + 1, 3)`.
        heading: Horizontal direction of the arm's plane, `(B, 3)`.
    """

    origins: torch.Tensor
    directions: torch.Tensor
    heading: torch.Tensor


class Kinematics:
    """Kinematics of any serial chain of hinge and slide joints, in torch.

    No method synchronises with the host or copies to the device, so all can be captured in a CUDA
    graph; results are float32.

    Args:
        machine: Gives origins, axes and the tool point.
        device: Where the positions to come lie.
    """

    def __init__(self, machine: Machine, device: torch.device | str = "cpu") -> None:
        import torch

        self._num_joints = machine.num_joints
        groups = _split_parallel_groups(machine)
        features = _list_features(machine, groups)
        blocks, self._num_points = [], []
        for group in groups:
            block, num_points = _build_group_columns(
                machine, group, is_last=group is groups[-1], rows=features.rows
            )
            blocks.append(block)
            self._num_points.append(num_points)

        def to_constant(array: np.ndarray) -> torch.Tensor:
            return torch.tensor(array, dtype=torch.float32, device=device)

        self._phase, self._angle = to_constant(features.phase), to_constant(features.angle)
        self._slide = to_constant(features.slide) if features.slide.any() else None
        self._linear = to_constant(np.concatenate(blocks, axis=1))
        self._widths = [block.shape[1] for block in blocks]
        is_hinge = [joint.kind == "hinge" for joint in machine.joints]
        self._is_hinge = torch.tensor(is_hinge, device=device)
        # a slewing joint turns the arm's plane too and so leaves the pitch alone, as slides do
        turns_tool = [is_hinge[0] and not _is_slewing(machine, 0), *is_hinge[1:]]
        self._turns_tool = to_constant(np.array(turns_tool, dtype=float))
        self._up = to_constant(np.array([0.0, 0.0, 1.0]))

    def pose(self, q: torch.Tensor) -> ToolPose:
        """Return the pose of the tool for joint positions `q`, shape `(…, J)`, rad or m."""
        return self._read_pose(self._evaluate(q), q.shape[:-1])

    def jacobian(self, q: torch.Tensor) -> Jacobian:
        """Return the geometric Jacobians of tip and pitch at `q`, shape `(…, J)`, rad or m."""
        return self._read_jacobian(self._evaluate(q), q.shape[:-1])

    def pose_and_jacobian(self, q: torch.Tensor) -> tuple[ToolPose, Jacobian]:
        """Return both from one evaluation of the chain at `q`, shape `(…, J)`."""
        state = self._evaluate(q)
        return self._read_pose(state, q.shape[:-1]), self._read_jacobian(state, q.shape[:-1])

    def _read_pose(self, state: _ChainState, lead: torch.Size) -> ToolPose:
        axis = state.directions[:, -1]
        pitch = (-axis[:, 2]).atan2((axis * state.heading).sum(-1))
        return ToolPose(
            tip_in_base_m=state.origins[:, -1].reshape(*lead, 3),
            axis_in_base=axis.reshape(*lead, 3),
            pitch_rad=pitch.reshape(lead),
            joints_in_base_m=state.origins[:, :-1].reshape(*lead, self._num_joints, 3),
            axes_in_base=state.directions[:, :-1].reshape(*lead, self._num_joints, 3),
        )

    def _read_jacobian(self, state: _ChainState, lead: torch.Size) -> Jacobian:
        origins, heading = state.origins, state.heading
        axes, tool = state.directions[:, :-1], state.directions[:, -1]
        turning = axes.cross(origins[:, -1:] - origins[:, :-1], dim=-1)
        tip = turning.where(self._is_hinge[:, None], axes).transpose(1, 2)
        # d pitch = w . (tool x (heading * tool_z - up * tool.heading)) / (tool_z^2 +
        # (tool.heading)^2) for an angular velocity w
        down, ahead = tool[:, 2:3], (tool * heading).sum(-1, keepdim=True)
        lever = tool.cross(heading * down - self._up * ahead, dim=-1) / (
            down * down + ahead * ahead
        )
        pitch = multiply_small_matrices(axes, lever[:, :, None])[..., 0] * self._turns_tool
        return Jacobian(
            tip.reshape(*lead, 3, self._num_joints), pitch.reshape(*lead, self._num_joints)
        )

    def _evaluate(self, q: torch.Tensor) -> _ChainState:
        import torch

        q = q.reshape(-1, self._num_joints)
        features = torch.addmm(self._phase, q, self._angle).cos()
        if self._slide is not None:
            shifted = features[:, None, :] * (q @ self._slide).unflatten(1, (-1, 1))
            features = torch.cat((features, shifted.flatten(1)), 1)
        blocks = (features @ self._linear).split(self._widths, 1)
        heading = blocks[0][:, :3]
        count = self._num_points[-1]
        points = blocks[-1][:, -3 * count :].unflatten(1, (count, 3))
        # from the tool inwards: each group turns and shifts the points of those behind it
        for block, count in zip(blocks[-2::-1], self._num_points[-2::-1], strict=True):
            turn, shift = block[:, 3:12].unflatten(1, (3, 3)), block[:, None, 12:15]
            points = shift + multiply_small_matrices(points, turn)
            points = torch.cat((block[:, 15:].unflatten(1, (count, 3)), points), 1)
        pairs = points.unflatten(1, (-1, 2))
        origins = pairs[:, :, 0]
        return _ChainState(origins, pairs[:, :, 1] - origins, heading)


def multiply_small_matrices(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return the matrix products of small matrices, `(N, A, B)` and `(N, B, C)`, as `(N, A, C)`.

    On a GPU the product is written out. `torch.compile` fuses it with the operations around it,
    while cuBLAS's kernels for so many small matrices take a fifth of the whole control step.
    """
    return (a[:, :, :, None] * b[:, None]).sum(2) if a.is_cuda else a @ b


def _split_parallel_groups(machine: Machine) -> list[list[int]]:
    """Split the joints into runs of parallel hinges; a slide belongs to the run before it."""
    groups: list[list[int]] = []
    axis: tuple[float, float, float] | None = None
    for index, (joint, body) in enumerate(zip(machine.joints, machine.bodies, strict=True)):
        is_first = not groups or (
            joint.kind == "hinge"
            and axis is not None
            and not np.allclose(body.axis, axis, atol=PARALLEL_TOLERANCE)
        )
        if is_first:
            groups.append([])
            axis = None
        if joint.kind == "hinge":
            axis = body.axis
        groups[-1].append(index)
    return groups


class _Features(NamedTuple):
    """Functions of q in which all points of a group are linear: feature = cos(phase + q angle).

    They are 1, the cosines and sines of the summed angles, and those times each slide.

    Attributes:
        phase: `(F,)`, rad.
        angle: `(J, F)`, 1 where a joint belongs to the sum.
        slide: Selector of the slides, `(J, S)`.
        rows: Number of each feature: `"1"`, `("cos", j)` and `("sin", j)` for the sum of the angles
            up to and with joint j of its group, `(s, key)` for that of `key` times the position of
            slide s.
    """

    phase: np.ndarray
    angle: np.ndarray
    slide: np.ndarray
    rows: dict[object, int]


def _list_features(machine: Machine, groups: list[list[int]]) -> _Features:
    num = machine.num_joints
    phase, columns = [0.0], [np.zeros(num)]
    rows: dict[object, int] = {"1": 0}
    for group in groups:
        total = np.zeros(num)
        for j in group:
            if machine.joints[j].kind == "hinge":
                total[j] = 1.0
                for name, shift in (("cos", 0.0), ("sin", -np.pi / 2)):
                    rows[name, j] = len(phase)
                    phase.append(shift)
                    columns.append(total.copy())
    slides = [j for j, joint in enumerate(machine.joints) if joint.kind == "slide"]
    base = dict(rows)
    for position, s in enumerate(slides):
        rows |= {(s, key): row + len(phase) * (position + 1) for key, row in base.items()}
    return _Features(np.array(phase), np.array(columns).T, np.eye(num)[:, slides], rows)


def _is_slewing(machine: Machine, index: int) -> bool:
    """Return whether joint `index` turns about the vertical, so that the arm's plane turns too."""
    is_vertical = abs(machine.bodies[index].axis[2]) > 1.0 - PARALLEL_TOLERANCE
    return machine.joints[index].kind == "hinge" and is_vertical


class _LinearVector:
    """A 3-vector that is linear in the features: its coefficients, `(F, 3)`."""

    def __init__(self, rows: dict[object, int]) -> None:
        self.rows = rows
        self.table = np.zeros((len(rows), 3))

    def add(
        self, vector: np.ndarray, axis: np.ndarray, hinge: int | None, slide: int | None = None
    ) -> None:
        """Add a vector that turns with a hinge and grows with a slide.

        Args:
            vector: At zero joint positions, `(3,)`.
            axis: Unit axis of the hinge's group, `(3,)`.
            hinge: Joint whose summed angle turns it; `None` for a fixed direction.
            slide: Joint whose position it is multiplied by; `None` for a fixed length.
        """

        def find_row(key: object) -> int:
            return self.rows[key if slide is None else (slide, key)]

        if hinge is None:
            self.table[find_row("1")] += vector
            return
        along = axis * (axis @ vector)
        self.table[find_row("1")] += along
        self.table[find_row(("cos", hinge))] += vector - along
        self.table[find_row(("sin", hinge))] += np.cross(axis, vector)


def _build_group_columns(
    machine: Machine, group: list[int], is_last: bool, rows: dict[object, int]
) -> tuple[np.ndarray, int]:
    """Return the coefficients of one group's points, and the number of points `P`.

    The columns, `(F, 15 + 3 P)` (`(F, 3 + 3 P)` for the last group), are: the heading (3;
    meaningful for the first group alone); for all but the last group the rows of the transposed
    rotation behind it (9) and the shift (3); then `P` points: origin and origin + axis of each
    joint, for the last group also tip and tip + tool axis.
    """
    hinges = [j for j in group if machine.joints[j].kind == "hinge"]
    axis = np.array(machine.bodies[hinges[0]].axis) if hinges else np.array([0.0, 0.0, 1.0])
    place, hinge = _LinearVector(rows), None
    points: list[np.ndarray] = []

    def add_points(direction: np.ndarray) -> None:
        ahead = _LinearVector(rows)
        ahead.table[:] = place.table
        ahead.add(direction, axis, hinge)
        points.extend((place.table.copy(), ahead.table))

    for j in group:
        body = machine.bodies[j]
        place.add(np.array([d.value for d in body.origin_m]), axis, hinge)
        add_points(np.array(body.axis))
        if machine.joints[j].kind == "hinge":
            hinge = j
        else:
            place.add(np.array(body.axis), axis, hinge, slide=j)
    heading = _LinearVector(rows)
    first = group[0]
    heading.add(
        np.array([1.0, 0.0, 0.0]),
        np.array(machine.bodies[first].axis),
        first if _is_slewing(machine, first) else None,
    )
    blocks = [heading.table]
    if is_last:
        tool = machine.tip_m
        place.add(tool, axis, hinge)
        add_points(tool / np.linalg.norm(tool))
    else:
        for unit in np.eye(3):
            turned = _LinearVector(rows)
            turned.add(unit, axis, hinge)
            blocks.append(turned.table)
        blocks.append(place.table)
    return np.concatenate([*blocks, *points], axis=1), len(points)
