"""Triangles of the machine and its block, for viewers that draw outside of MuJoCo."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import trimesh

from brokk_rl.machine import Machine
from brokk_rl.sim.posed_scene import SHOWN_GROUPS, PosedScene
from brokk_rl.sim.scene import HALF_LENGTH_M, HALF_WIDTH_M, HEIGHT_M, HOLE_DEPTH_M

NUM_SIDES = 48
"""Sides of round parts; chosen by hand for the eye."""
SMOOTH_RAD = 0.6
"""Angle between faces up to which their edge is drawn smooth. Chosen by hand."""
BLOCK = "block"
"""Body of the block; see `brokk_rl.sim.scene`."""


@dataclass(frozen=True)
class BodyShape:
    """Triangles of one colour on one body.

    Attributes:
        body: Index of the body in the rows of its machine's poses.
        color: Red, green and blue, 0 to 1.
        vertices: Corners in the frame of the body, `(V, 3)`, m.
        faces: Rows of `vertices`, `(F, 3)`.
    """

    body: int
    color: tuple[float, float, float]
    vertices: np.ndarray
    faces: np.ndarray


class MachineMesh:
    """Triangles of a machine, and the poses of its bodies at joint positions.

    Args:
        machine: The machine.

    Attributes:
        shapes: One entry a body and colour; geoms of the ground and the block are left out.
    """

    def __init__(self, machine: Machine) -> None:
        self._posed = PosedScene(machine)
        model = self._posed.model
        self._data = mujoco.MjData(model)
        block = model.body(BLOCK).id
        parts: dict[tuple[int, tuple[float, float, float]], list[trimesh.Trimesh]] = {}
        for geom in range(model.ngeom):
            body = int(model.geom_bodyid[geom])
            plane = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE
            if body == block or plane or model.geom_group[geom] not in SHOWN_GROUPS:
                continue
            parts.setdefault((body, _read_color(model, geom)), []).append(_shape_geom(model, geom))
        self.shapes = []
        for (body, color), meshes in parts.items():
            mesh = trimesh.util.concatenate(meshes)
            assert isinstance(mesh, trimesh.Trimesh)
            self.shapes.append(
                BodyShape(body, color, np.array(mesh.vertices), np.array(mesh.faces))
            )

    def is_moving(self, body: int) -> bool:
        """Return whether a body moves when joints do."""
        return bool(self._posed.model.body_weldid[body] != 0)

    def compute_poses(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return positions, `(N, bodies, 3)`, and quaternions w first, `(N, bodies, 4)`, at `q`."""
        positions, turns = [], []
        for row in q:
            self._data.qpos[:] = row
            mujoco.mj_kinematics(self._posed.model, self._data)
            positions.append(self._data.xpos.copy())
            turns.append(self._data.xquat.copy())
        return np.array(positions), np.array(turns)


def build_drilled_block(scale: float, radius_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of the block, its hole round; origin at the rim, z out of it.

    Args:
        scale: Factor on the footprint.
        radius_m: Radius of the hole.
    """
    angles = 2 * np.pi * np.arange(NUM_SIDES) / NUM_SIDES
    circle = np.stack((np.cos(angles), np.sin(angles)), 1)
    half = np.array([HALF_LENGTH_M, HALF_WIDTH_M]) * scale
    # rays through the circle's corners end on the rectangle, whose own corners are put on the
    # nearest rays
    edge = circle / np.abs(circle / half).max(1, keepdims=True)
    for corner in half * [[1, 1], [-1, 1], [-1, -1], [1, -1]]:
        edge[np.argmin(np.linalg.norm(edge - corner, axis=1))] = corner
    hole = radius_m * circle
    rings = [
        (edge, -HEIGHT_M), (edge, 0.0),  # sides
        (edge, 0.0), (hole, 0.0),  # top
        (hole, 0.0), (hole, -HOLE_DEPTH_M),  # wall of the hole
    ]  # fmt: skip
    vertices = [np.column_stack((ring, np.full(NUM_SIDES, z))) for ring, z in rings]
    faces = []
    index, following = np.arange(NUM_SIDES), np.roll(np.arange(NUM_SIDES), -1)
    for pair in range(0, len(rings), 2):
        low, high = pair * NUM_SIDES, (pair + 1) * NUM_SIDES
        faces.append(np.stack((low + index, low + following, high + following), 1))
        faces.append(np.stack((low + index, high + following, high + index), 1))
    mesh = trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), process=False)
    bottom = trimesh.creation.cylinder(radius_m, 0.002, sections=NUM_SIDES)
    bottom.apply_translation((0.0, 0.0, -HOLE_DEPTH_M))
    whole = trimesh.util.concatenate([_shade(mesh), _shade(bottom)])
    assert isinstance(whole, trimesh.Trimesh)
    return np.array(whole.vertices), np.array(whole.faces)


def _read_color(model: mujoco.MjModel, geom: int) -> tuple[float, float, float]:
    material = model.geom_matid[geom]
    rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
    return float(rgba[0]), float(rgba[1]), float(rgba[2])


def _shape_geom(model: mujoco.MjModel, geom: int) -> trimesh.Trimesh:
    """Return the triangles of a geom in the frame of its body."""
    size, kind = model.geom_size[geom], model.geom_type[geom]
    shape = mujoco.mjtGeom
    if kind == shape.mjGEOM_BOX:
        mesh = trimesh.creation.box(2.0 * size)
    elif kind == shape.mjGEOM_SPHERE:
        mesh = trimesh.creation.icosphere(3, size[0])
    elif kind == shape.mjGEOM_ELLIPSOID:
        mesh = trimesh.creation.icosphere(3, 1.0).apply_scale(size)
    elif kind == shape.mjGEOM_CAPSULE:
        mesh = trimesh.creation.capsule(2.0 * size[1], size[0], (NUM_SIDES // 2, NUM_SIDES // 2))
    elif kind == shape.mjGEOM_CYLINDER:
        mesh = trimesh.creation.cylinder(size[0], 2.0 * size[1], sections=NUM_SIDES)
    else:
        mesh = _read_mesh(model, geom)
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
    place = np.eye(4)
    place[:3, :3], place[:3, 3] = turn.reshape(3, 3), model.geom_pos[geom]
    return _shade(mesh).apply_transform(place)


def _read_mesh(model: mujoco.MjModel, geom: int) -> trimesh.Trimesh:
    """Return the triangles of a mesh geom; none for kinds that a machine does not have."""
    mesh = model.geom_dataid[geom]
    if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_MESH or mesh < 0:
        return trimesh.Trimesh()
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    vertices = model.mesh_vert[first : first + count]
    first, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    return trimesh.Trimesh(vertices, model.mesh_face[first : first + count], process=False)


def _shade(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the mesh with corners of its own on both sides of each sharp edge."""
    return trimesh.graph.smooth_shade(mesh, angle=SMOOTH_RAD) if len(mesh.faces) else mesh
