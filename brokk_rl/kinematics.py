"""Forward kinematics and weight of a serial machine, in numpy and in torch.

`LinkChain` is the chain itself, link by link. It serves computers without torch; therefore nothing
here imports torch before it is asked for. `Kinematics` (torch, float32) gives the same points in
fewer operations, because it runs in every control step of a thousand machines.

Consecutive joints with parallel axes (q2…q5 of a planar arm) turn about one direction, so their
angles add up. All points behind them are linear in the cosines and sines of the sums. The
coefficients are solved for once, from poses of the chain. One matrix product then serves all such
groups at once, and one small product each group further out. A five-joint machine thus needs a
dozen tensor operations instead of five chained products. That matters on a CPU, where each
operation costs some 8 us.

Axes: `T` time, `J` joints, `B` batch, `F` features, `P` points; anything may stand before `J`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.machine import Joint, Machine

if TYPE_CHECKING:
    import torch

GRAVITY_M_S2 = 9.81
"""Gravity, m/s²: standard gravity (9.80665), rounded."""
PARALLEL_TOLERANCE = 1e-9
"""Largest difference of two unit axes' components that count as parallel: rounding of the file."""
TABLE_DECIMALS = 12
"""Decimals of the coefficients that are solved for, m: far below float32, above the rounding of
the solution, so that what is zero is exactly zero."""
POSES_PER_FEATURE = 4
"""Poses from which the coefficients are solved for, over their number; two would do."""


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


class LinkPlaces(NamedTuple):
    """Places of all links in the base frame; leading dimensions as those of the joint positions.

    Attributes:
        rotation: Rotation of each link, `(…, J, 3, 3)`.
        place_m: Origin of each link, `(…, J, 3)`; behind a slide it moves with the joint.
        axis: Unit axis of each joint, `(…, J, 3)`.
    """

    rotation: Any
    place_m: Any
    axis: Any


class LinkChain:
    """Serial chain of hinge and slide joints.

    Args:
        joints: The joints, from the base on; their links are known.
        device: Where tensors (torch, float32) lie; `None` for arrays (numpy, float64).
    """

    def __init__(self, joints: Sequence[Joint], device: torch.device | str | None = None) -> None:
        self.library: Any = np
        convert: Any = np.array
        if device is not None:
            import torch

            self.library = torch
            convert = partial(torch.tensor, dtype=torch.float32, device=device)
        self.convert = convert
        bodies = [joint.body for joint in joints if joint.body is not None]
        x, y, z = np.array([body.axis for body in bodies]).T
        zero = np.zeros_like(x)
        cross = np.stack((zero, -z, y, z, zero, -x, -y, x, zero), 1).reshape(-1, 3, 3)
        self._cross, self._cross_twice = convert(cross), convert(cross @ cross)
        self._axis = convert([body.axis for body in bodies])
        self._origin_m = convert([[d.value for d in body.origin_m] for body in bodies])
        self.hinge = convert([float(joint.kind == "hinge") for joint in joints])
        """1 for a hinge, 0 for a slide, `(J,)`."""
        self._eye = convert(np.eye(3))

    def place(self, q: Any) -> LinkPlaces:
        """Return the links at joint positions `q`, `(…, J)`, rad or m."""
        library = self.library
        angle = (q * self.hinge)[..., None, None]
        # Rodrigues' rotation formula
        turn = self._eye + library.sin(angle) * self._cross
        turn = turn + (1.0 - library.cos(angle)) * self._cross_twice
        step_m = self._origin_m + (q * (1.0 - self.hinge))[..., None] * self._axis
        rotation = library.broadcast_to(self._eye, (*q.shape[:-1], 3, 3))
        place_m = 0.0 * step_m[..., 0, :]
        rotations, places_m, axes = [], [], []
        for j in range(q.shape[-1]):
            axes.append(rotation @ self._axis[j])
            place_m = place_m + (rotation @ step_m[..., j, :, None])[..., 0]
            rotation = rotation @ turn[..., j, :, :]
            rotations.append(rotation)
            places_m.append(place_m)
        return LinkPlaces(
            library.stack(rotations, -3), library.stack(places_m, -2), library.stack(axes, -2)
        )


def compute_tool_kinematics(machine: Machine, q: np.ndarray) -> ToolKinematics:
    """Return the tool's pose and derivatives at joint positions `q`, `(…, J)`, rad or m.

    Raises:
        ConfigError: the machine's geometry is not known.
    """
    q = np.asarray(q, float)
    chain = _build_chain(machine)
    rotation, place_m, axes = chain.place(q)
    tip = place_m[..., -1, :] + rotation[..., -1, :, :] @ machine.tip_m
    axis = rotation[..., -1, :, :] @ (machine.tip_m / np.linalg.norm(machine.tip_m))
    origins = place_m - (q * (1.0 - chain.hinge))[..., None] * axes
    is_hinge = chain.hinge[:, None] > 0
    jacobian = np.where(is_hinge, np.cross(axes, tip[..., None, :] - origins), axes)
    turn = np.where(is_hinge, np.cross(axes, axis[..., None, :]), 0.0)
    return ToolKinematics(
        tip, axis, np.swapaxes(jacobian, -1, -2), np.swapaxes(turn, -1, -2), origins, axes
    )


def solve_joint_step(
    tool: ToolKinematics, wanted: np.ndarray, scale: np.ndarray, damping: float
) -> np.ndarray:
    """Return the step of the joints, over `scale`, that moves the tool as wanted, `(…, J)`.

    Damped least squares (Nakamura and Hanafusa 1986), repeated they are inverse kinematics.

    Args:
        tool: Present pose and derivatives.
        wanted: Motion of the tip, m, then of the axis, `(…, 6)`.
        scale: Unit of each joint's step, such as its top speed; 0 keeps a joint at rest, `(J,)`.
        damping: Bounds the step where the arm is stretched, in the unit of `wanted`.
    """
    jacobian = np.concatenate((tool.jacobian, tool.turn), -2) * scale
    across = np.swapaxes(jacobian, -1, -2)
    square = across @ jacobian + damping**2 * np.eye(len(scale))
    return np.linalg.solve(square, across @ wanted[..., None])[..., 0]


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
    q, j = np.asarray(q, float), machine.joint_names.index(joint)
    links = _build_chain(machine).place(q)
    pose = np.zeros((*q.shape[:-1], 4, 4))
    pose[..., :3, :3], pose[..., :3, 3] = links.rotation[..., j, :, :], links.place_m[..., j, :]
    pose[..., 3, 3] = 1.0
    return pose


def _build_chain(machine: Machine) -> LinkChain:
    machine.bodies  # noqa: B018  refuses a machine whose links are not known
    return LinkChain(machine.joints)


class Gravity:
    """Generalised force of gravity on each joint of a serial machine that stands level.

    Args:
        machine: Axes, origins, masses and centres of mass.
        device: Where tensors (torch, float32) lie; `None` for arrays (numpy, float64).

    Raises:
        ConfigError: Geometry and masses of the machine are not known.
    """

    def __init__(self, machine: Machine, device: torch.device | None = None) -> None:
        bodies = machine.bodies
        self._chain = LinkChain(machine.joints, device)
        self._com_m = self._chain.convert([body.com_m for body in bodies])
        self._mass_kg = self._chain.convert([body.mass_kg.value for body in bodies])
        self._carried_kg = self._sum_inwards(self._mass_kg, -1)

    def load(self, q: Any) -> Any:
        """Return the gravity load in the positive direction at `q`, `(N, J)`, Nm or N."""
        links = self._chain.place(q)
        moments = self._weigh_links(links)
        # mass times place of all that a joint carries
        carried = self._sum_inwards(moments, -2)
        lever = carried - self._carried_kg[:, None] * links.place_m
        # z component of axis x lever arm, times mass
        turning = links.axis[..., 0] * lever[..., 1] - links.axis[..., 1] * lever[..., 0]
        lifting = self._carried_kg * links.axis[..., 2]
        hinge = self._chain.hinge
        return -GRAVITY_M_S2 * (hinge * turning + (1.0 - hinge) * lifting)

    def overturn(self, q: Any) -> Any:
        """Return the moment of the arm's weight about the base frame's origin, `(N, 3)`, Nm."""
        moment = self._weigh_links(self._chain.place(q)).sum(-2)
        x, y = moment[:, 0], moment[:, 1]
        return GRAVITY_M_S2 * self._chain.library.stack((-y, x, 0.0 * x), 1)

    def _sum_inwards(self, values: Any, axis: int) -> Any:
        """Return the sums of all values from each joint to the tool."""
        flip = self._chain.library.flip
        return flip(flip(values, (axis,)).cumsum(axis), (axis,))

    def _weigh_links(self, links: LinkPlaces) -> Any:
        """Return mass times centre of mass of each link in the base frame, `(N, J, 3)`, kg m."""
        com_m = (links.rotation @ self._com_m[:, :, None])[..., 0]
        return self._mass_kg[:, None] * (links.place_m + com_m)


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
        # the points of each group, and of the last one the tool
        self._num_points = [2 * len(group) for group in groups]
        self._num_points[-1] += 2
        tables = _solve_tables(machine, groups, features)

        def to_constant(array: np.ndarray) -> torch.Tensor:
            return torch.tensor(array, dtype=torch.float32, device=device)

        self._phase, self._angle = to_constant(features.phase), to_constant(features.angle)
        self._slide = to_constant(features.slide) if features.slide.any() else None
        self._linear = to_constant(np.concatenate(tables, axis=1))
        self._widths = [table.shape[1] for table in tables]
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
    """

    phase: np.ndarray
    angle: np.ndarray
    slide: np.ndarray

    def evaluate(self, q: np.ndarray) -> np.ndarray:
        """Return the features at `q`, `(B, J)`, `(B, F (1 + S))`."""
        waves = np.cos(self.phase + q @ self.angle)
        factors = np.hstack((np.ones((len(q), 1)), q @ self.slide))
        return (factors[:, :, None] * waves[:, None]).reshape(len(q), -1)


def _list_features(machine: Machine, groups: list[list[int]]) -> _Features:
    num = machine.num_joints
    phase, columns = [0.0], [np.zeros(num)]
    for group in groups:
        total = np.zeros(num)
        for j in group:
            if machine.joints[j].kind == "hinge":
                total[j] = 1.0
                phase += [0.0, -np.pi / 2]
                columns += [total.copy(), total.copy()]
    slides = [j for j, joint in enumerate(machine.joints) if joint.kind == "slide"]
    return _Features(np.array(phase), np.array(columns).T, np.eye(num)[:, slides])


def _is_slewing(machine: Machine, index: int) -> bool:
    """Return whether joint `index` turns about the vertical, so that the arm's plane turns too."""
    is_vertical = abs(machine.bodies[index].axis[2]) > 1.0 - PARALLEL_TOLERANCE
    return machine.joints[index].kind == "hinge" and is_vertical


def _solve_tables(
    machine: Machine, groups: list[list[int]], features: _Features
) -> list[np.ndarray]:
    """Return the coefficients of the columns of each group in the features, `(F, C)` each."""
    num_features = len(features.phase) * (1 + features.slide.shape[1])
    q = np.random.default_rng(0).uniform(
        -np.pi, np.pi, (POSES_PER_FEATURE * num_features, machine.num_joints)
    )
    seen = features.evaluate(q)
    tables = []
    for group in groups:
        columns = _list_columns(machine, group, q[:, group], is_last=group is groups[-1])
        tables.append(np.linalg.lstsq(seen, columns)[0].round(TABLE_DECIMALS))
    return tables


def _list_columns(machine: Machine, group: list[int], q: np.ndarray, is_last: bool) -> np.ndarray:
    """Return the columns of a group at the positions `q` of its joints, `(B, C)`, in its own base.

    The columns are: the heading (3; meaningful for the first group alone); for all but the last
    group the rows of the transposed rotation behind it (9) and the shift (3); then `P` points:
    origin and origin + axis of each joint, for the last group also tip and tip + tool axis.
    """
    chain = LinkChain([machine.joints[j] for j in group])
    rotation, place_m, axis = chain.place(q)
    end, end_m = rotation[:, -1], place_m[:, -1]
    heading = np.broadcast_to([1.0, 0.0, 0.0], (len(q), 3))
    columns = [rotation[:, 0, :, 0] if _is_slewing(machine, group[0]) else heading]
    if not is_last:
        columns += [end.swapaxes(1, 2).reshape(-1, 9), end_m]
    origins = place_m - (q * (1.0 - chain.hinge))[..., None] * axis
    columns.append(np.stack((origins, origins + axis), 2).reshape(len(q), -1))
    if is_last:
        tip = end_m + end @ machine.tip_m
        columns += [tip, tip + end @ (machine.tip_m / np.linalg.norm(machine.tip_m))]
    return np.hstack(columns)
