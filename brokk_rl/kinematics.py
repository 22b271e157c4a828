"""Forward kinematics of a serial machine, batched in torch.

Consecutive joints with parallel axes (q2…q5 of a planar arm) turn about one direction, so their
angles add up and everything behind
them is linear in the cosines and sines of the sums: one matrix product for all such groups at once,
then one small product for each group further out. A five-joint machine needs a dozen tensor
operations instead of a chain of five 4 x 4 products; that matters on a CPU, where each operation
costs some 8 us and this runs in every control step.
"""

from typing import NamedTuple

import numpy as np
import torch

from brokk_rl.machine import Machine


class ToolPose(NamedTuple):
    """Where the tool is; leading dimensions as those of the joint positions.

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
    """How tip and pitch move with the joints; leading dimensions as those of the joint positions.

    Attributes:
        tip: Velocity of the tip for unit speed of each joint, `(…, 3, J)`, m/rad or m/m.
        pitch: Change of the pitch for unit speed of each joint, `(…, J)`, rad/rad or rad/m.
    """

    tip: torch.Tensor
    pitch: torch.Tensor


class Kinematics:
    """Kinematics of any serial chain of hinge and slide joints.

    No method synchronises with the host or copies to the device, so all can be captured in a CUDA
    graph; results are float32.

    Args:
        machine: Gives origins, axes and the tool point.
        device: Where the positions to come lie.
    """

    def __init__(self, machine: Machine, device: torch.device | str = "cpu") -> None:
        self._num_joints = machine.num_joints
        groups = _parallel_groups(machine)
        phase, angle, slide, rows = _features(machine, groups)
        columns = [
            _group_columns(machine, group, is_last=group is groups[-1], rows=rows)
            for group in groups
        ]

        def constant(array: np.ndarray) -> torch.Tensor:
            return torch.tensor(array, dtype=torch.float32, device=device)

        self._phase, self._angle = constant(phase), constant(angle)
        self._slide = constant(slide) if slide.any() else None
        self._linear = constant(np.concatenate([block for block, _ in columns], axis=1))
        self._widths = [block.shape[1] for block, _ in columns]
        self._num_points = [count for _, count in columns]
        self._is_hinge = torch.tensor(
            [joint.kind == "hinge" for joint in machine.joints], device=device
        )
        # a slewing joint carries the arm's plane with it and so leaves the pitch alone, as slides
        # do
        turns = [joint.kind == "hinge" for joint in machine.joints]
        turns[0] = turns[0] and not _turns_heading(machine, 0)
        self._turns_tool = constant(np.array(turns, dtype=float))
        self._up = constant(np.array([0.0, 0.0, 1.0]))

    def pose(self, q: torch.Tensor) -> ToolPose:
        """Returns the pose of the tool for joint positions `q`, shape `(…, J)`, rad or m."""
        return self._pose(self._chain(q.reshape(-1, self._num_joints)), q.shape[:-1])

    def jacobian(self, q: torch.Tensor) -> Jacobian:
        """Returns the geometric Jacobians of tip and pitch at `q`, shape `(…, J)`, rad or m."""
        return self._jacobian(self._chain(q.reshape(-1, self._num_joints)), q.shape[:-1])

    def pose_and_jacobian(self, q: torch.Tensor) -> tuple[ToolPose, Jacobian]:
        """Returns both for the price of little more than one, at `q`, shape `(…, J)`."""
        chain = self._chain(q.reshape(-1, self._num_joints))
        return self._pose(chain, q.shape[:-1]), self._jacobian(chain, q.shape[:-1])

    def _pose(
        self, chain: tuple[torch.Tensor, torch.Tensor, torch.Tensor], lead: torch.Size
    ) -> ToolPose:
        origins, directions, heading = chain
        axis = directions[:, -1]
        pitch = torch.atan2(-axis[:, 2], (axis * heading).sum(-1))
        return ToolPose(
            tip_in_base_m=origins[:, -1].reshape(*lead, 3),
            axis_in_base=axis.reshape(*lead, 3),
            pitch_rad=pitch.reshape(lead),
            joints_in_base_m=origins[:, :-1].reshape(*lead, self._num_joints, 3),
            axes_in_base=directions[:, :-1].reshape(*lead, self._num_joints, 3),
        )

    def _jacobian(
        self, chain: tuple[torch.Tensor, torch.Tensor, torch.Tensor], lead: torch.Size
    ) -> Jacobian:
        origins, directions, heading = chain
        axes, tool = directions[:, :-1], directions[:, -1]
        turning = torch.linalg.cross(axes, origins[:, -1:] - origins[:, :-1])
        tip = torch.where(self._is_hinge[:, None], turning, axes).transpose(1, 2)
        # d pitch = w . (tool x (heading * tool_z - up * tool.heading)) / (tool_z^2 +
        # (tool.heading)^2) for an angular velocity w
        down, ahead = tool[:, 2:3], (tool * heading).sum(-1, keepdim=True)
        lever = torch.linalg.cross(tool, heading * down - self._up * ahead) / (
            down * down + ahead * ahead
        )
        pitch = product(axes, lever[:, :, None])[..., 0] * self._turns_tool
        return Jacobian(
            tip.reshape(*lead, 3, self._num_joints), pitch.reshape(*lead, self._num_joints)
        )

    def _chain(self, q: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Returns origins `(B, J + 1, 3)` (joints, then tip), unit axes likewise (last: the tool's) and the heading `(B, 3)`."""
        features = torch.addmm(self._phase, q, self._angle).cos()
        if self._slide is not None:
            features = torch.cat(
                (
                    features,
                    (features[:, None, :] * (q @ self._slide).unflatten(1, (-1, 1))).flatten(1),
                ),
                1,
            )
        blocks = (features @ self._linear).split(self._widths, 1)
        heading = blocks[0][:, :3]
        count = self._num_points[-1]
        points = blocks[-1][:, -3 * count :].unflatten(1, (count, 3))
        for block, count in zip(blocks[-2::-1], self._num_points[-2::-1], strict=True):
            turn, shift = block[:, 3:12].unflatten(1, (3, 3)), block[:, None, 12:15]
            points = shift + product(points, turn)
            points = torch.cat((block[:, 15:].unflatten(1, (count, 3)), points), 1)
        pairs = points.unflatten(1, (-1, 2))
        origins = pairs[:, :, 0]
        return origins, pairs[:, :, 1] - origins, heading


def product(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Returns the matrix products of small matrices, `(N, A, B)` and `(N, B, C)`, as `(N, A, C)`.

    On a GPU multiplied out: `torch.compile` fuses that with what stands around it, and cuBLAS's
    kernels for so many small matrices take a fifth of the whole control step.
    """
    return (a[:, :, :, None] * b[:, None]).sum(2) if a.is_cuda else a @ b


def _parallel_groups(machine: Machine) -> list[list[int]]:
    """Splits the joints into runs of hinges about one direction; slides belong to the run before them."""
    groups: list[list[int]] = []
    axis: tuple[float, float, float] | None = None
    for index, (joint, body) in enumerate(zip(machine.joints, machine.bodies, strict=True)):
        starts = not groups or (
            joint.kind == "hinge"
            and axis is not None
            and not np.allclose(body.axis, axis, atol=1e-9)
        )
        if starts:
            groups.append([])
            axis = None
        if joint.kind == "hinge":
            axis = body.axis
        groups[-1].append(index)
    return groups


def _features(
    machine: Machine, groups: list[list[int]]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[object, int]]:
    """Lists the functions of q in which all points are linear: 1, cos and sin of the summed angles, and those times each slide.

    Returns phase `(F,)` and angle `(J, F)` with feature = cos(phase + q angle), the selector of the
    slides `(J, S)`, and the number
    of each row: `"1"`, `("cos", j)` and `("sin", j)` for the sum of the angles up to and with joint
    j of its group, `(s, key)` for the row of `key` times the position of slide s.
    """
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
    return np.array(phase), np.array(columns).T, np.eye(num)[:, slides], rows


def _turns_heading(machine: Machine, first: int) -> bool:
    """Returns whether joint `first` slews the arm, so that its plane turns with it."""
    return machine.joints[first].kind == "hinge" and abs(machine.bodies[first].axis[2]) > 1.0 - 1e-9


class _Linear:
    """A 3-vector that is linear in the features: its coefficients, `(F, 3)`."""

    def __init__(self, rows: dict[object, int]) -> None:
        self.rows = rows
        self.table = np.zeros((len(rows), 3))

    def add(
        self, vector: np.ndarray, axis: np.ndarray, hinge: int | None, slide: int | None = None
    ) -> None:
        """Adds `vector`, turned about `axis` by the summed angle of joint `hinge`, times the position of joint `slide`."""

        def row(key: object) -> int:
            return self.rows[key if slide is None else (slide, key)]

        if hinge is None:
            self.table[row("1")] += vector
            return
        along = axis * (axis @ vector)
        self.table[row("1")] += along
        self.table[row(("cos", hinge))] += vector - along
        self.table[row(("sin", hinge))] += np.cross(axis, vector)


def _group_columns(
    machine: Machine, group: list[int], is_last: bool, rows: dict[object, int]
) -> tuple[np.ndarray, int]:
    """Returns the coefficients of what one group contributes, `(F, 15 + 3 P)` (`3 + 3 P` for the last group), and `P`.

    Heading (only meaningful for the first group, 3), for all but the last group the rows of the
    transposed rotation behind the group (9) and the shift (3), then `P` points: origin and origin +
    axis of each joint; for the last group also tip and tip + tool axis.
    """
    hinges = [j for j in group if machine.joints[j].kind == "hinge"]
    axis = np.array(machine.bodies[hinges[0]].axis) if hinges else np.array([0.0, 0.0, 1.0])
    place, hinge = _Linear(rows), None
    points: list[np.ndarray] = []

    def with_arrow(vector: np.ndarray) -> None:
        arrow = _Linear(rows)
        arrow.table[:] = place.table
        arrow.add(vector, axis, hinge)
        points.extend((place.table.copy(), arrow.table))

    for j in group:
        body = machine.bodies[j]
        place.add(np.array([d.value for d in body.origin_m]), axis, hinge)
        with_arrow(np.array(body.axis))
        if machine.joints[j].kind == "hinge":
            hinge = j
        else:
            place.add(np.array(body.axis), axis, hinge, slide=j)
    heading = _Linear(rows)
    first = group[0]
    heading.add(
        np.array([1.0, 0.0, 0.0]),
        np.array(machine.bodies[first].axis),
        first if _turns_heading(machine, first) else None,
    )
    blocks = [heading.table]
    if is_last:
        tool = machine.tip_m
        place.add(tool, axis, hinge)
        with_arrow(tool / np.linalg.norm(tool))
    else:
        for unit in np.eye(3):
            turned = _Linear(rows)
            turned.add(unit, axis, hinge)
            blocks.append(turned.table)
        blocks.append(place.table)
    return np.concatenate([*blocks, *points], axis=1), len(points)
