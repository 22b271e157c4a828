"""The concrete block with the borehole: what may differ from world to world, and what that means for MuJoCo's geoms.

A scene is a vector of `COLUMNS`. The block is a mocap body whose origin is the centre of the
borehole's rim, z along the hole's
axis out of the block. The borehole is a regular octagon around the drilled circle: four slabs whose
inner faces make a square, four posts that cut its corners. A slab that serves as block and wall of
the hole saves half of the geom pairs that a closed ring would need.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
import torch

COLUMNS = ("hole_x_m", "hole_y_m", "rim_z_m", "yaw_rad", "block_scale", "hole_radius_m")
"""Columns of a scene, `S` of them: centre of the rim in the base frame, turn of the block about the
vertical, factor on its footprint, radius of the circle that the borehole's walls inscribe."""
SIZE = len(COLUMNS)

HALF_LENGTH_M, HALF_WIDTH_M, HEIGHT_M = 0.5, 0.4, 0.75
"""Nominal block: 1.0 x 0.8 m and 0.75 m high; it goes into the ground where the rim is lower."""
HOLE_RADIUS_M = 0.05
"""Paper: a borehole of 10 cm."""
HOLE_DEPTH_M = 0.40
SCALE_BOUNDS, HOLE_RADIUS_BOUNDS_M = (0.5, 1.25), (0.01, 0.08)
"""Bounds of a scene; MuJoCo's bounding volumes are compiled for the largest geoms within them and
so hold every smaller one."""
GROUND = "ground"
"""The plane on which the chisel stops: the ground, or the bottom of a hole that goes deeper than
the ground."""
POST_HALF_THICKNESS_M = 0.02
"""Half the thickness of the posts; more than the largest radius times (sqrt(2) - 1) / 2, so that
they reach the corners of the square."""

_TOOL, _ARM = (
    1,
    2,
)  # contact bits: the chisel meets the real hole, everything else the block as if it had none
_FRICTION = (0.4, 0.005, 0.0001)  # steel on concrete
_DIAGONAL = float(np.sqrt(0.5))


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
    """Returns scenes with the nominal block in front of the machine, `(N, S)`."""
    return torch.tensor([2.6, 0.0, HEIGHT_M, 0.0, 1.0, HOLE_RADIUS_M], device=device).repeat(
        num_worlds, 1
    )


def build_collision_geoms(scale: float, radius_m: float) -> BlockGeoms:
    """Returns the colliding boxes of a block; sizes and positions are affine in both arguments."""
    length, width, middle = HALF_LENGTH_M * scale, HALF_WIDTH_M * scale, -HEIGHT_M / 2
    parts: list[tuple[str, tuple[float, float, float], tuple[float, float, float], float]] = []
    for sign, name in ((1, "front"), (-1, "back")):
        parts.append(
            (
                f"slab_{name}",
                ((length - radius_m) / 2, width, -middle),
                (sign * (length + radius_m) / 2, 0, middle),
                0.0,
            )
        )
    for sign, name in ((1, "left"), (-1, "right")):
        parts.append(
            (
                f"slab_{name}",
                (radius_m, (width - radius_m) / 2, -middle),
                (0, sign * (width + radius_m) / 2, middle),
                0.0,
            )
        )
    for i in range(4):
        angle = np.pi / 4 + i * np.pi / 2
        x, y = (
            (radius_m + POST_HALF_THICKNESS_M) * np.cos(angle),
            (radius_m + POST_HALF_THICKNESS_M) * np.sin(angle),
        )
        parts.append(
            (
                f"post_{i}",
                (
                    POST_HALF_THICKNESS_M,
                    radius_m * np.tan(np.pi / 8) + POST_HALF_THICKNESS_M,
                    -middle,
                ),
                (x, y, middle),
                angle,
            )
        )
    plug = (HEIGHT_M - HOLE_DEPTH_M) / 2
    parts.append(("plug", (radius_m, radius_m, plug), (0, 0, -HOLE_DEPTH_M - plug), 0.0))
    parts.append(("block_envelope", (length, width, -middle), (0, 0, middle), 0.0))
    names, size, pos, yaw = zip(*parts, strict=True)
    return BlockGeoms(names, np.array(size, float), np.array(pos, float), np.array(yaw, float))


def build_visual_wall(radius_m: float, num_parts: int = 24) -> BlockGeoms:
    """Returns thin boxes that make the octagon look like a drilled hole, ending just below its rim."""
    half = (
        radius_m * (np.sqrt(2.0) - 1.0) / 2 + 0.002
    )  # out to the corners of the square between the slabs
    angles = 2 * np.pi * np.arange(num_parts) / num_parts
    width = (radius_m + 2 * half) * np.tan(np.pi / num_parts)
    depth = HOLE_DEPTH_M / 2
    size = np.tile([half, width, depth], (num_parts, 1))
    pos = np.stack(
        [
            (radius_m + half) * np.cos(angles),
            (radius_m + half) * np.sin(angles),
            np.full(num_parts, -0.0003 - depth),
        ],
        1,
    )
    return BlockGeoms(tuple(f"wall_{i}" for i in range(num_parts)), size, pos, angles)


def add_block(spec: mujoco.MjSpec, visual: bool) -> None:
    """Adds the mocap body `block` with its geoms, as large as a scene may make it; `visual` adds what only the eye needs."""
    body = spec.worldbody.add_body(
        name="block", mocap=True, pos=make_nominal_scenes(1)[0, :3].numpy()
    )
    block = build_collision_geoms(1.0, HOLE_RADIUS_M)
    largest = np.max(
        [
            build_collision_geoms(scale, radius).size
            for scale in SCALE_BOUNDS
            for radius in HOLE_RADIUS_BOUNDS_M
        ],
        axis=0,
    )
    for name, size, pos, yaw in zip(block.names, largest, block.pos, block.yaw_rad, strict=True):
        is_envelope = name == "block_envelope"
        is_shown = name.startswith("slab") or name == "plug"
        body.add_geom(
            name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=pos, quat=_turn_about_z(yaw), contype=0,
            conaffinity=_ARM if is_envelope else _TOOL, friction=_FRICTION, group=1 if is_shown else 3,
            material="hole_bottom" if name == "plug" else "concrete",
        )  # fmt: skip
    body.add_geom(
        name=GROUND, type=mujoco.mjtGeom.mjGEOM_PLANE, size=(1, 1, 1), pos=(0, 0, -HEIGHT_M), contype=0, conaffinity=_TOOL,
        friction=_FRICTION, group=3,
    )  # fmt: skip
    if visual:
        wall = build_visual_wall(HOLE_RADIUS_M)
        for name, size, pos, yaw in zip(wall.names, wall.size, wall.pos, wall.yaw_rad, strict=True):
            body.add_geom(
                name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=pos, quat=_turn_about_z(yaw), contype=0, conaffinity=0, group=2,
                material="concrete",
            )  # fmt: skip
        body.add_camera(
            name="close",
            pos=(-0.65, -1.05, 0.70),
            fovy=52,
            mode=mujoco.mjtCamLight.mjCAMLIGHT_TARGETBODY,
            targetbody="block",
        )


def _turn_about_z(yaw_rad: float) -> tuple[float, float, float, float]:
    return (float(np.cos(yaw_rad / 2)), 0.0, 0.0, float(np.sin(yaw_rad / 2)))


class ScenePlacement:
    """Turns scenes into MuJoCo's numbers, batched in torch.

    Args:
        model: Compiled model; gives the ids of the geoms.
        device: Where the scenes lie.
        dtype: Type of the results.
    """

    def __init__(
        self, model: mujoco.MjModel, device: torch.device | str, dtype: torch.dtype
    ) -> None:
        nominal, wider, larger = (
            build_collision_geoms(0.0, 0.0),
            build_collision_geoms(0.0, 1.0),
            build_collision_geoms(1.0, 0.0),
        )
        # affine in scale and radius, hence three evaluations give the whole map
        stack = [np.concatenate([b.size, b.pos], axis=1) for b in (nominal, larger, wider)]
        table = np.stack([stack[0], stack[1] - stack[0], stack[2] - stack[0]])
        table = np.concatenate(
            [table, np.zeros((3, 1, 6))], axis=1
        )  # the ground, set by the height of the rim
        self._table = torch.tensor(table.reshape(3, -1), dtype=dtype, device=device)
        self.geom_ids = torch.tensor(
            [model.geom(name).id for name in (*nominal.names, GROUND)], device=device
        )
        self._lower = torch.tensor(
            [SCALE_BOUNDS[0], HOLE_RADIUS_BOUNDS_M[0]], dtype=dtype, device=device
        )
        self._upper = torch.tensor(
            [SCALE_BOUNDS[1], HOLE_RADIUS_BOUNDS_M[1]], dtype=dtype, device=device
        )

    def geoms(self, scene: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns sizes and positions of the block's geoms, `(N, G, 3)` each, for scenes `(N, S)`, clamped to the bounds."""
        scene = scene.to(self._table.dtype)
        shape = torch.minimum(torch.maximum(scene[:, 4:6], self._lower), self._upper)
        both = torch.addmm(self._table[:1], shape, self._table[1:]).unflatten(1, (-1, 6))
        both[:, -1, 5] = -scene[:, 2].clamp(min=HOLE_DEPTH_M)
        return both[..., :3], both[..., 3:]

    def pose(self, scene: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns position `(N, 3)` and quaternion `(N, 4)` of the block for scenes `(N, S)`."""
        half = scene[:, 3:4].to(self._table.dtype) / 2
        zero = torch.zeros_like(half)
        return scene[:, :3].to(self._table.dtype), torch.cat(
            (half.cos(), zero, zero, half.sin()), 1
        )
