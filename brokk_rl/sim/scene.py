"""The concrete block with the borehole: scene vectors and the MuJoCo geoms that follow from them.

A scene is a vector of `COLUMNS`. The block is a mocap body. Its origin is the centre of the
borehole's rim; its z axis is the hole's axis, out of the block. The borehole is a regular octagon
around the drilled circle: four slabs whose inner faces make a square, and four posts that cut its
corners. The slabs serve as block and as wall of the hole, which halves the geom pairs of a closed
ring of eight walls.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

from brokk_rl.errors import ConfigError

COLUMNS = ("hole_x_m", "hole_y_m", "rim_z_m", "yaw_rad", "block_scale", "hole_radius_m", "lean_rad")
"""Columns of a scene, `S` of them: centre of the rim in the base frame, turn of the block about the
hole's axis, factor on its footprint, radius of the circle that the borehole's walls inscribe, tilt
of that axis away from the machine, in the plane through the slew axis. A block that leans stands on
nothing: `GROUND` would lean with it."""
SIZE = len(COLUMNS)

HALF_LENGTH_M, HALF_WIDTH_M, HEIGHT_M = 0.5, 0.4, 0.75
"""Nominal block: 1.0 x 0.8 m and 0.75 m high; it goes into the ground where the rim is lower."""
OUTER_RADIUS_M = math.hypot(HALF_LENGTH_M, HALF_WIDTH_M)
"""Radius of the circle around the nominal block."""
NOMINAL_DISTANCE_M = 2.6
"""Distance of the nominal hole from the slew axis, within the task's range of 2.3 to 3.5 m."""
HOLE_RADIUS_M = 0.05
"""Paper: a borehole of 10 cm."""
HOLE_DEPTH_M = 0.40
"""Chosen by hand: deeper than the 0.14 m at which the task aims, so that the chisel does not touch
the bottom."""
SCALE_BOUNDS, HOLE_RADIUS_BOUNDS_M = (0.5, 1.25), (0.01, 0.08)
"""Bounds of a scene. MuJoCo's bounding volumes are compiled for the largest geoms within them, and
so hold every smaller one."""
FAR_M = 10.0
"""Horizontal distance beyond which a block is not part of the task (goal_pose puts it 20 m
away)."""
GROUND = "ground"
"""The plane on which the chisel stops: the ground, or the bottom of a hole that is deeper than the
ground."""
POST_HALF_THICKNESS_M = 0.02
"""More than the largest radius times (sqrt(2) - 1) / 2, so that the posts reach the corners of the
square."""
NUM_WALL_PARTS = 24
"""Boxes of the visual wall; chosen by hand for the eye."""
WALL_OVERLAP_M = 0.002
"""Overlap of the visual wall with the slabs, so that no gap shows."""
WALL_RECESS_M = 0.0003
"""Distance of the visual wall below the rim, so that their faces do not coincide."""

SOLID_GROUP = 1
"""Group of geoms that are seen and touched."""

# contact bits: the chisel meets the real hole, all other links the block as if it had no hole
_TOOL, _ARM = 1, 2
_FRICTION = (0.4, 0.005, 0.0001)
"""Sliding, torsional and rolling friction; 0.4 for steel on concrete, the others MuJoCo's
defaults."""


@dataclass(frozen=True)
class BlockGeoms:
    """Geoms of the block in its own frame.

    Attributes:
        names: Geom names.
        size: Half sizes (or radius, half height), `(G, 3)`, m.
        pos: Centres, `(G, 3)`, m.
        yaw_rad: Turn of each geom about the hole's axis, `(G,)`.
    """

    names: tuple[str, ...]
    size: np.ndarray
    pos: np.ndarray
    yaw_rad: np.ndarray


def make_nominal_scenes(num_worlds: int, device: torch.device | str = "cpu") -> torch.Tensor:
    """Return scenes with the nominal block in front of the machine, `(N, S)`."""
    scene = [NOMINAL_DISTANCE_M, 0.0, HEIGHT_M, 0.0, 1.0, HOLE_RADIUS_M, 0.0]
    return torch.tensor(scene, device=device).repeat(num_worlds, 1)


def make_empty_scenes(num_worlds: int, device: torch.device | str = "cpu") -> torch.Tensor:
    """Return scenes without anything to touch, `(N, S)`: block and ground are far away and below."""
    scene = make_nominal_scenes(num_worlds, device)
    scene[:, COLUMNS.index("hole_x_m")] = 2.0 * FAR_M
    scene[:, COLUMNS.index("rim_z_m")] = -2.0 * FAR_M
    return scene


def build_collision_geoms(scale: float, radius_m: float) -> BlockGeoms:
    """Return the colliding boxes of a block; sizes and positions are affine in both arguments."""
    length, width, middle = HALF_LENGTH_M * scale, HALF_WIDTH_M * scale, -HEIGHT_M / 2
    post = POST_HALF_THICKNESS_M
    plug = (HEIGHT_M - HOLE_DEPTH_M) / 2
    parts = []
    for sign, name in ((1, "front"), (-1, "back")):
        half = ((length - radius_m) / 2, width, -middle)
        parts.append((f"slab_{name}", half, (sign * (length + radius_m) / 2, 0, middle), 0.0))
    for sign, name in ((1, "left"), (-1, "right")):
        half = (radius_m, (width - radius_m) / 2, -middle)
        parts.append((f"slab_{name}", half, (0, sign * (width + radius_m) / 2, middle), 0.0))
    for i in range(4):
        angle = np.pi / 4 + i * np.pi / 2
        x, y = (radius_m + post) * np.cos(angle), (radius_m + post) * np.sin(angle)
        half = (post, radius_m * np.tan(np.pi / 8) + post, -middle)
        parts.append((f"post_{i}", half, (x, y, middle), angle))
    parts.append(("plug", (radius_m, radius_m, plug), (0, 0, -HOLE_DEPTH_M - plug), 0.0))
    parts.append(("block_envelope", (length, width, -middle), (0, 0, middle), 0.0))
    names, size, pos, yaw_rad = zip(*parts, strict=True)
    return BlockGeoms(names, *(np.array(one, float) for one in (size, pos, yaw_rad)))


def build_visual_wall(radius_m: float) -> BlockGeoms:
    """Return thin boxes that make the octagon look like a drilled hole, ending below its rim."""
    # Half the thickness that reaches the corners of the square between the slabs.
    half = radius_m * (np.sqrt(2.0) - 1.0) / 2 + WALL_OVERLAP_M
    angles = 2 * np.pi * np.arange(NUM_WALL_PARTS) / NUM_WALL_PARTS
    width = (radius_m + 2 * half) * np.tan(np.pi / NUM_WALL_PARTS)
    depth = HOLE_DEPTH_M / 2
    size = np.tile([half, width, depth], (NUM_WALL_PARTS, 1))
    x, y = (radius_m + half) * np.cos(angles), (radius_m + half) * np.sin(angles)
    pos = np.stack([x, y, np.full(NUM_WALL_PARTS, -WALL_RECESS_M - depth)], 1)
    return BlockGeoms(tuple(f"wall_{i}" for i in range(NUM_WALL_PARTS)), size, pos, angles)


def add_block(spec: mujoco.MjSpec, visual: bool) -> None:
    """Add the mocap body `block` with its geoms, as large as a scene may make it.

    Args:
        spec: Written.
        visual: Add also the geoms that only pictures need.
    """
    body = spec.worldbody.add_body(
        name="block", mocap=True, pos=make_nominal_scenes(1)[0, :3].numpy()
    )
    block = build_collision_geoms(1.0, HOLE_RADIUS_M)
    corners = itertools.product(SCALE_BOUNDS, HOLE_RADIUS_BOUNDS_M)
    largest = np.max([build_collision_geoms(*corner).size for corner in corners], axis=0)
    for name, box in _list_boxes(replace(block, size=largest)):
        is_shown = name.startswith("slab") or name == "plug"
        body.add_geom(
            **box,
            conaffinity=_ARM if name == "block_envelope" else _TOOL,
            friction=_FRICTION,
            group=1 if is_shown else 3,
            material="hole_bottom" if name == "plug" else "concrete",
        )
    body.add_geom(
        name=GROUND,
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=(1, 1, 1),
        pos=(0, 0, -HEIGHT_M),
        contype=0,
        conaffinity=_TOOL,
        friction=_FRICTION,
        group=3,
    )
    if visual:  # the round wall of the hole
        for _, box in _list_boxes(build_visual_wall(HOLE_RADIUS_M)):
            body.add_geom(**box, conaffinity=0, group=2, material="concrete")


def add_site(spec: mujoco.MjSpec, path: Path | None) -> None:
    """Add what stands beside the block; tool and arm meet its geoms.

    A geom with the name of one of the machine's gives that one its shape: another tool.

    Raises:
        ConfigError: MuJoCo cannot read the file, or something in it moves.
    """
    if path is None:
        return
    try:
        site = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise ConfigError(f"task.scene: {path} is no MJCF ({error})") from error
    if site.joints or site.actuators:
        raise ConfigError(
            f"task.scene: what {path} holds must stand still; take its joints and actuators out"
        )
    for geom in list(site.geoms):
        if own := spec.geom(geom.name) if geom.name else None:
            own.type, own.size = geom.type, geom.size
            own.fromto, own.pos, own.quat = geom.fromto, geom.pos, geom.quat
            site.delete(geom)
        elif geom.contype or geom.conaffinity:
            geom.contype, geom.conaffinity = 0, _TOOL | _ARM
            geom.group = SOLID_GROUP
    spec.attach(site, prefix="site/", frame=spec.worldbody.add_frame())


def _list_boxes(geoms: BlockGeoms) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield name and attributes of each box."""
    for name, size, pos, yaw in zip(geoms.names, geoms.size, geoms.pos, geoms.yaw_rad, strict=True):
        turn = (np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2))
        box = {"name": name, "type": mujoco.mjtGeom.mjGEOM_BOX, "contype": 0}
        yield name, box | {"size": size, "pos": pos, "quat": turn}


class ScenePlacement:
    """Map from scenes to MuJoCo's numbers, batched in torch.

    Args:
        model: Compiled model; gives the ids of the geoms.
        device: Where the scenes lie.
        dtype: Type of the results.
    """

    def __init__(
        self, model: mujoco.MjModel, device: torch.device | str, dtype: torch.dtype
    ) -> None:
        # sizes and positions are affine in scale and radius: three evaluations give the whole map
        origin = build_collision_geoms(0.0, 0.0)
        base, by_scale, by_radius = (
            np.concatenate([block.size, block.pos], axis=1)
            for block in (origin, build_collision_geoms(1.0, 0.0), build_collision_geoms(0.0, 1.0))
        )
        table = np.stack([base, by_scale - base, by_radius - base])
        # a row of zeros for the ground, which the height of the rim sets
        table = np.concatenate([table, np.zeros((3, 1, 6))], axis=1)
        self._table = torch.tensor(table.reshape(3, -1), dtype=dtype, device=device)
        ids = [model.geom(name).id for name in (*origin.names, GROUND)]
        self.geom_ids = torch.tensor(ids, device=device)
        lower, upper = zip(SCALE_BOUNDS, HOLE_RADIUS_BOUNDS_M, strict=True)
        self._lower = torch.tensor(lower, dtype=dtype, device=device)
        self._upper = torch.tensor(upper, dtype=dtype, device=device)

    def geoms(self, scene: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return sizes and positions of the block's geoms, `(N, G, 3)` each.

        Args:
            scene: Scenes, `(N, S)`; clamped to the bounds.
        """
        scene = scene.to(self._table.dtype)
        shape = torch.minimum(torch.maximum(scene[:, 4:6], self._lower), self._upper)
        both = torch.addmm(self._table[:1], shape, self._table[1:]).unflatten(1, (-1, 6))
        ground_m = scene[:, 2].clamp(min=HOLE_DEPTH_M)
        both[:, -1, 5] = -ground_m.where(scene[:, 6] == 0.0, FAR_M)
        return both[..., :3], both[..., 3:]

    def pose(self, scene: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return position `(N, 3)` and quaternion `(N, 4)` of the block for scenes `(N, S)`."""
        scene = scene.to(self._table.dtype)
        turn, lean = scene[:, 3:4] / 2, scene[:, 6:7] / 2
        across = torch.stack((-scene[:, 1], scene[:, 0]), 1)
        across = across / across.norm(dim=1, keepdim=True).clamp(min=1e-6) * lean.sin()
        # the block turns about its own axis, then leans about the horizontal across the arm's plane
        x = across[:, :1] * turn.cos() + across[:, 1:] * turn.sin()
        y = across[:, 1:] * turn.cos() - across[:, :1] * turn.sin()
        quaternion = torch.cat((lean.cos() * turn.cos(), x, y, lean.cos() * turn.sin()), 1)
        return scene[:, :3], quaternion
