"""Objects of a scene beside the block: slabs, pipes and drilled blocks that stand still.

A task made of terms lists them by name (`task.scene`), and the simulators build them into their
model. All worlds have them at the same place. The specs need neither torch nor MuJoCo.
"""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Protocol

import numpy as np

from brokk_rl.bounds import require_number
from brokk_rl.errors import ConfigError
from brokk_rl.spec import name_spec, spec

if TYPE_CHECKING:
    from brokk_rl.contracts.task import Task
    from brokk_rl.contracts.world import Simulator

PIPE_SIDES = 8
"""Sides of the prism that stands for a pipe; its corners are 8 % further out than its faces."""
POST_SHARE = 0.22
"""Half width of the posts that cut a hole's corners, in radii; more than (sqrt(2) - 1) / 2, so that
they reach the corners of the square."""

Boxes = list[tuple[tuple[float, float, float], tuple[float, float, float], np.ndarray]]
"""Half sizes, centre and axis of a turn in the object's frame, `(3,)` each; the axis is as long as
the angle in rad."""
NO_TURN = np.zeros(3)


class SceneObject(Protocol):
    """An object that stands still; its frame is at `place_m`."""

    @property
    def place_m(self) -> tuple[float, float, float]:
        """Origin of its frame in the base frame."""
        ...

    @property
    def yaw_rad(self) -> float:
        """Turn about the vertical."""
        ...

    @property
    def tilt_rad(self) -> float:
        """Turn about its own y axis after that: positive lowers the end of its x axis."""
        ...

    def list_boxes(self) -> Boxes:
        """Return the boxes that it is made of."""
        ...


@spec
class SlabObject:
    """A wall, a block or a table: one box.

    Attributes:
        place_m: Its centre in the base frame.
        size_m: Lengths along its own x, y and z.
        yaw_rad: Turn about the vertical.
        tilt_rad: Turn about its own y axis after that.
    """

    place_m: tuple[float, float, float]
    size_m: tuple[float, float, float]
    yaw_rad: float
    tilt_rad: float

    def check(self) -> None:
        _check_place(self)
        for length_m in self.size_m:
            require_number("size_m of a SlabObject", length_m, above=0)

    def list_boxes(self) -> Boxes:
        """Return the only box; see `SceneObject`."""
        x, y, z = self.size_m
        return [((x / 2, y / 2, z / 2), (0.0, 0.0, 0.0), NO_TURN)]


@spec
class PipeObject:
    """A pipe or a pole along its own x axis, solid, as a prism of eight sides.

    Attributes:
        place_m: Its middle in the base frame.
        length_m: Its length.
        radius_m: Radius of the circle within the prism.
        yaw_rad: Turn about the vertical.
        tilt_rad: Turn about its own y axis after that; -1.57 stands it up.
    """

    place_m: tuple[float, float, float]
    length_m: float
    radius_m: float
    yaw_rad: float
    tilt_rad: float

    def check(self) -> None:
        _check_place(self)
        for name in ("length_m", "radius_m"):
            require_number(f"{name} of a PipeObject", getattr(self, name), above=0)

    def list_boxes(self) -> Boxes:
        """Return four crossing boxes; see `SceneObject`."""
        half = (self.length_m / 2, self.radius_m, self.radius_m * np.tan(np.pi / PIPE_SIDES))
        boxes: Boxes = []
        for side in range(PIPE_SIDES // 2):
            turn = np.array([2.0 * np.pi * side / PIPE_SIDES, 0.0, 0.0])
            boxes.append((half, (0.0, 0.0, 0.0), turn))
        return boxes


@spec
class DrilledObject:
    """A block with a row of holes along its own x axis; tilted, an inclined block.

    Each hole is a regular octagon around the drilled circle, as that of the shipped block.

    Attributes:
        place_m: Middle of its upper face in the base frame.
        size_m: Lengths along its own x, y and z.
        holes_x_m: Place of each hole's axis along x from the middle, in ascending order.
        radius_m: Radius of the holes.
        depth_m: Depth of the holes.
        yaw_rad: Turn about the vertical.
        tilt_rad: Turn about its own y axis after that.
    """

    place_m: tuple[float, float, float]
    size_m: tuple[float, float, float]
    holes_x_m: tuple[float, ...]
    radius_m: float
    depth_m: float
    yaw_rad: float
    tilt_rad: float

    def check(self) -> None:
        _check_place(self)
        require_number("radius_m of a DrilledObject", self.radius_m, above=0)
        for length_m in self.size_m:
            require_number("size_m of a DrilledObject", length_m, above=0)
        require_number("depth_m of a DrilledObject", self.depth_m, above=0)
        wall_m = self.radius_m * (1 + 2 * POST_SHARE)
        ends = (-self.size_m[0] / 2 - wall_m, *self.holes_x_m, self.size_m[0] / 2 + wall_m)
        apart_m = np.diff(ends)
        if not self.holes_x_m or apart_m.min() <= 2 * wall_m or self.size_m[1] <= 2 * wall_m:
            raise ConfigError(
                f"holes_x_m of a DrilledObject: expected holes in ascending order, {wall_m:.3f} m from "
                f"the sides and twice that from each other, got {list(self.holes_x_m)} in a block of "
                f"{self.size_m[0]:g} x {self.size_m[1]:g} m"
            )
        if self.depth_m >= self.size_m[2]:
            raise ConfigError(
                f"depth_m of a DrilledObject: expected less than its height of {self.size_m[2]:g} m, "
                f"got {self.depth_m:g}"
            )

    def list_boxes(self) -> Boxes:
        """Return slabs around the holes, posts in their corners and what lies below them."""
        length, width, height = self.size_m
        radius, depth, post = self.radius_m, self.depth_m, self.radius_m * POST_SHARE
        boxes: Boxes = []

        def add(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> None:
            ranges = np.array([x, y, z])
            half = tuple((ranges[:, 1] - ranges[:, 0]) / 2)
            boxes.append((half, tuple(ranges.mean(1)), NO_TURN))

        add((-length / 2, length / 2), (-width / 2, width / 2), (-height, -depth))
        edges = [-length / 2]
        for x_m in self.holes_x_m:
            edges += [x_m - radius, x_m + radius]
        edges.append(length / 2)
        for begin, end in zip(edges[::2], edges[1::2], strict=True):
            add((begin, end), (-width / 2, width / 2), (-depth, 0.0))
        for x_m in self.holes_x_m:
            across = (x_m - radius, x_m + radius)
            add(across, (radius, width / 2), (-depth, 0.0))
            add(across, (-width / 2, -radius), (-depth, 0.0))
            for corner in range(4):
                angle = np.pi / 4 + corner * np.pi / 2
                out = radius + post
                center = (x_m + out * np.cos(angle), out * np.sin(angle), -depth / 2)
                half = (post, radius * np.tan(np.pi / 8) + post, depth / 2)
                boxes.append((half, center, np.array([0.0, 0.0, angle])))
        return boxes


def _check_place(placed: SceneObject) -> None:
    name = type(placed).__name__
    for value in (*placed.place_m, placed.yaw_rad, placed.tilt_rad):
        require_number(f"place_m, yaw_rad, tilt_rad of a {name}", value)


def list_objects(task: Task, sim: Simulator) -> tuple[SceneObject, ...]:
    """Return the objects of a task's `scene`; a task without that field has none.

    Raises:
        ConfigError: The task has objects, and the simulator cannot build them.
    """
    scene: dict[str, SceneObject | None] = getattr(task, "scene", {})
    found = tuple(placed for placed in scene.values() if placed is not None)
    if found and "objects" not in inspect.signature(sim.build).parameters:
        raise ConfigError(
            f"task.scene: sim={name_spec(sim)} cannot build objects; choose sim=native or sim=warp, "
            "or task.scene={}"
        )
    return found
