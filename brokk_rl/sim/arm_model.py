"""An arm of a model at its zero pose: its links, tool point and shapes, and an MJCF of it alone.

Link frames of a machine are parallel to the base at zero, so origins and axes are read off the world
positions of that pose. Bodies behind joints that are not part of the chain, such as a gripper's
fingers, stay where they are drawn and add to the mass of the link that carries them.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np
import trimesh

from brokk_rl.errors import ConfigError
from brokk_rl.sim.kinematic_tree import KinematicTree
from brokk_rl.sim.model_source import NUM_SIZES, read_source

TIP = "tip"
TIP_NAMES = re.compile("tip|tcp|tool|grasp|grip_site|^grip|:grip|ee_|eef|end_?eff|attach", re.I)
"""Names of frames at the end of an arm."""
NEAREST_TIP_M, GUESSED_TIP_M = 1e-3, np.array([0.0, 0.0, 0.1])
"""Distance of a tool point from the last joint at least, so that the tool has a direction, and a
tool point where the model has none."""


@dataclass(frozen=True)
class ModelChoices:
    """Choices of what is taken of a model file.

    Attributes:
        chain: Last joint or link of the arm, its first and last link, or all its joints; empty for the
            longest chain.
        tip: Site or link of the tool point; `None`: a frame named so, else the far end.
        gripper: Whether the first joint of the gripper is the last one of the machine.
        drive: What moves the joints; `auto` reads it off the model.
        command: Quantity that commands set; `auto` as the model's actuators have it.
        packages: Folders in which meshes of `package://…` are searched.
    """

    chain: tuple[str, ...] = ()
    tip: str | None = None
    gripper: bool = False
    drive: Literal["auto", "electric", "hydraulic"] = "auto"
    command: Literal["auto", "valve", "velocity", "position", "torque"] = "auto"
    packages: tuple[str, ...] = ()


class ArmModel:
    """An arm of a model file.

    Args:
        path: The file.
        choices: What is taken of it.

    Attributes:
        source: The file as it was read.
        tree: Its joints.
        model: MuJoCo's model.
        data: Its state at the zero pose, seen from the foot of the arm.
        chain: Joints of the arm in the model.
        names: Their names.
        anchors: Their places, `(J, 3)`, m.
        remarks: Simplifications, one sentence each.

    Raises:
        ConfigError: The file is missing or invalid, or has no serial chain of hinges and slides.
    """

    def __init__(self, path: Path, choices: ModelChoices) -> None:
        self._choices = choices
        self.source = read_source(path, choices.packages)
        self.model = model = self.source.model
        self.data = mujoco.MjData(model)
        mujoco.mj_resetData(model, self.data)
        mujoco.mj_forward(model, self.data)
        self.tree = KinematicTree(self.source)
        self._arm = self.tree.choose(choices.chain, choices.tip, choices.gripper)
        self.remarks = self.source.remarks + self.tree.describe_held(self._arm)
        self.chain = self._arm.joints
        self.names = self._choose_names()
        self._links = self._group_bodies()
        self._move_to_base()
        self.anchors = self.data.xanchor[self.chain].copy()

    def _choose_names(self) -> list[str]:
        """Return a name for each joint, of letters, digits and `_`, as columns of recordings need it."""
        names = [self.model.joint(joint).name for joint in self.chain]
        clean = [re.sub(r"\W+", "_", name) or f"q{row + 1}" for row, name in enumerate(names)]
        changed = [name for name, old in zip(clean, names, strict=True) if name != old]
        if changed:
            self.remarks.append(f"Joints are renamed: {', '.join(changed)}.")
        return clean

    def _group_bodies(self) -> list[list[int]]:
        """Return the bodies that move with each joint of the chain; those of the base come first.

        Bodies of other robots and of the scene are left out. A body with several joints belongs to
        the last of them.
        """
        model, root = self.model, self._arm.root
        moved_by = {int(model.jnt_bodyid[joint]): row for row, joint in enumerate(self.chain)}
        groups: list[list[int]] = [[] for _ in range(len(self.chain) + 1)]
        owner: dict[int, int] = {0: -1}
        left_out = []
        for body in range(1, model.nbody):
            owner[body] = moved_by.get(body, owner[int(model.body_parentid[body])])
            if int(model.body_rootid[body]) == root:
                groups[owner[body] + 1].append(body)
            elif model.body_parentid[body] == 0:
                left_out.append(model.body(body).name or "a body without name")
        if left_out:
            self.remarks.append(
                f"{', '.join(left_out)} are other bodies of the scene and are left out."
            )
        return groups

    def _move_to_base(self) -> None:
        """Put the foot of the robot above the origin, its x axis forward; heights stay."""
        model, data, root = self.model, self.data, self._arm.root
        x_m, y_m, _ = data.xpos[root]
        forward = data.xmat[root].reshape(3, 3)[:, 0]
        yaw = math.atan2(forward[1], forward[0]) if np.hypot(*forward[:2]) > 0.5 else 0.0
        if np.allclose((x_m, y_m, yaw), 0.0, atol=1e-6):
            return
        self.remarks.append(
            f"The robot stands at x {x_m:.3g}, y {y_m:.3g} m, turned by {yaw:.3g} rad; its foot is the "
            "origin here, and it looks along x."
        )
        turn, moved_m, turned = np.zeros(4), np.zeros(3), np.zeros(4)
        mujoco.mju_axisAngle2Quat(turn, np.array([0.0, 0.0, 1.0]), -yaw)
        free = int(model.body_jntadr[root])
        if free >= 0 and model.jnt_type[free] == mujoco.mjtJoint.mjJNT_FREE:
            place = data.qpos[model.jnt_qposadr[free] :][:7]
            pos_m, quat = place[:3], place[3:]
        else:
            pos_m, quat = model.body_pos[root], model.body_quat[root]
        mujoco.mju_rotVecQuat(moved_m, pos_m - (x_m, y_m, 0.0), turn)
        mujoco.mju_mulQuat(turned, turn, quat)
        pos_m[:], quat[:] = moved_m, turned
        mujoco.mj_forward(model, data)

    def sum_masses(self, row: int) -> tuple[float, np.ndarray, np.ndarray]:
        """Return mass (kg), centre (m, from the joint) and inertia about it of a link.

        A body with several joints is divided among them: each but the last carries a tenth.
        """
        model, data = self.model, self.data
        joint = self.chain[row]
        owners = model.jnt_bodyid[self.chain]
        (alike,) = np.nonzero(owners == owners[row])
        bodies = self._links[alike[-1] + 1]
        masses = model.body_mass[bodies]
        mass_kg = float(masses.sum())
        if mass_kg < 1e-4:
            raise ConfigError(
                f"subject.model={self.source.path}: the link '{model.body(int(model.jnt_bodyid[joint])).name}' behind joint "
                f"'{model.joint(joint).name}' has no mass; give it an <inertial>"
            )
        centre = (masses[:, None] * data.xipos[bodies]).sum(0) / mass_kg
        inertia = np.zeros((3, 3))
        for body, mass in zip(bodies, masses, strict=True):
            turn, away = data.ximat[body].reshape(3, 3), data.xipos[body] - centre
            inertia += turn @ np.diag(model.body_inertia[body]) @ turn.T
            inertia += mass * (away @ away * np.eye(3) - np.outer(away, away))
        share = 1.0 - 0.1 * (len(alike) - 1) if row == alike[-1] else 0.1
        return share * mass_kg, centre - self.anchors[row], share * inertia

    def find_tool(self) -> np.ndarray:
        """Return the tool point from the last joint: as asked, a named frame, else the far end."""
        model, data, bodies, last = self.model, self.data, self._links[-1], self.anchors[-1]
        fingers = {int(model.jnt_bodyid[joint]) for joint in self._arm.gripper}
        frames, tip = self._list_frames(bodies), self._choices.tip
        if tip is not None and tip not in frames:
            raise ConfigError(
                f"subject.tip={tip}: it does not move with {self.names[-1]}, the last joint; choose one of "
                f"{', '.join(frames)}, or another subject.chain"
            )
        if (wanted := tip or TIP) in frames:
            return frames[wanted] - last
        gripper = set(self._arm.gripper)
        palm = [body for body in bodies if gripper.isdisjoint(self.tree.list_above(body, False))]
        choices = {}
        for name, at_m in self._list_frames(palm).items():
            if np.linalg.norm(at_m - last) > NEAREST_TIP_M:
                choices[name] = at_m
        if named := [name for name in choices if TIP_NAMES.search(name)]:
            chosen = named[-1]
        elif fingers:
            self.remarks.append(
                "The tool point is the middle of the gripper's fingers; subject.tip=… chooses another."
            )
            return data.xipos[sorted(fingers)].mean(0) - last
        elif choices:
            chosen = max(choices, key=lambda name: float(np.linalg.norm(choices[name] - last)))
        else:
            self.remarks.append(
                "There is no site nor fixed frame for the tool point; twice the distance to the last link's centre "
                "of mass is a guess."
            )
            centre_m = self.sum_masses(len(self.chain) - 1)[1]
            return 2.0 * centre_m if np.linalg.norm(centre_m) > NEAREST_TIP_M else GUESSED_TIP_M
        self.remarks.append(
            f"The tool point is the frame '{chosen}'; subject.tip=… chooses another."
        )
        return choices[chosen] - last

    def _list_frames(self, bodies: Sequence[int]) -> dict[str, np.ndarray]:
        """Return the places of bodies and of the sites on them, by name."""
        model, data = self.model, self.data
        frames = {model.body(body).name: data.xpos[body] for body in bodies}
        for site in range(model.nsite):
            if model.site_bodyid[site] in bodies:
                frames[model.site(site).name] = data.site_xpos[site]
        return frames

    def write(self, name: str, tool_m: np.ndarray) -> tuple[mujoco.MjModel, str, dict[str, bytes]]:
        """Return model, text and meshes of an MJCF whose link frames lie in the joints, parallel to the base at zero."""
        made = mujoco.MjSpec()
        made.modelname, made.compiler.degree = name, False
        meshes: dict[str, bytes] = {}
        self._add_shapes(made, made.worldbody, 0, np.zeros(3), meshes)
        parent = made.worldbody
        for row, joint in enumerate(self.chain):
            at_m = self.anchors[row]
            origin_m = at_m - (self.anchors[row - 1] if row else 0.0)
            parent = parent.add_body(name=f"{self.names[row]}_link", pos=origin_m)
            mass_kg, com_m, inertia = self.sum_masses(row)
            principal, turn = np.linalg.eigh(inertia)
            turn[:, 2] *= np.linalg.det(turn)  # right-handed
            parent.explicitinertial = True
            parent.mass, parent.ipos = mass_kg, com_m
            parent.iquat, parent.inertia = _to_quaternion(turn), principal
            parent.add_joint(
                name=self.names[row],
                type=self.model.jnt_type[joint],
                axis=normalise_axis(self.data.xaxis[joint]),
                armature=float(self.model.dof_armature[self.model.jnt_dofadr[joint]]),
            )
            self._add_shapes(made, parent, row + 1, at_m, meshes)
        parent.add_site(name=TIP, pos=tool_m, size=[0.01, 0.01, 0.01])
        made.assets = meshes
        compiled = made.compile()
        return compiled, made.to_xml(), meshes

    def _add_shapes(
        self,
        made: mujoco.MjSpec,
        link: mujoco.MjsBody,
        group: int,
        at_m: np.ndarray,
        meshes: dict[str, bytes],
    ) -> None:
        """Add the geoms of a group of bodies to a link at `at_m`: for the eye, and to touch with."""
        model, bodies = self.model, self._links[group]
        geoms = [geom for geom in range(model.ngeom) if model.geom_bodyid[geom] in bodies]
        pictures = [geom for geom in geoms if not model.geom_contype[geom]]
        for geom in geoms:
            kind = int(model.geom_type[geom])
            turn = self.data.geom_xmat[geom].reshape(3, 3)
            centre = self.data.geom_xpos[geom]
            place = {"pos": centre - at_m, "quat": _to_quaternion(turn)}
            if kind in NUM_SIZES:
                place |= {"type": model.geom_type[geom], "size": model.geom_size[geom]}
            elif kind != mujoco.mjtGeom.mjGEOM_MESH:
                continue
            if geom in (pictures or geoms):
                shown = place
                if kind == mujoco.mjtGeom.mjGEOM_MESH:
                    mesh = self._add_mesh(made, int(model.geom_dataid[geom]), meshes)
                    shown = place | {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": mesh}
                link.add_geom(
                    group=2, contype=0, conaffinity=0, rgba=self._read_color(geom), **shown
                )
            is_last = group == len(self.chain)
            if is_last and (model.geom_contype[geom] or len(pictures) == len(geoms)):
                if kind == mujoco.mjtGeom.mjGEOM_MESH:
                    box = model.geom_aabb[geom]
                    place["pos"] = centre + turn @ box[:3] - at_m
                    place |= {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": box[3:]}
                    self._remark("Meshes touch as boxes around them.")
                link.add_geom(group=3, contype=1, conaffinity=0, **place)

    def _add_mesh(self, made: mujoco.MjSpec, mesh: int, meshes: dict[str, bytes]) -> str:
        """Add a mesh with a file of its own, once; return its name."""
        model, name = self.model, f"mesh_{mesh}"
        file = f"{made.modelname}_meshes/{mesh}.stl"
        if file not in meshes:
            first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
            vertices = model.mesh_vert[first : first + count]
            first, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
            faces = model.mesh_face[first : first + count]
            stream = io.BytesIO()
            trimesh.Trimesh(vertices, faces, process=False).export(stream, file_type="stl")
            meshes[file] = stream.getvalue()
            made.add_mesh(name=name, file=file, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        return name

    def _read_color(self, geom: int) -> np.ndarray:
        material = self.model.geom_matid[geom]
        return self.model.mat_rgba[material] if material >= 0 else self.model.geom_rgba[geom]

    def _remark(self, text: str) -> None:
        """Add a remark once."""
        if text not in self.remarks:
            self.remarks.append(text)


def _to_quaternion(turn: np.ndarray) -> np.ndarray:
    """Return the quaternion, w first, of a rotation matrix."""
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, turn.ravel())
    return quaternion


def normalise_axis(axis: np.ndarray | Sequence[float]) -> list[float]:
    """Return a unit axis without rounding errors of the pose."""
    rounded = np.round(axis, 9)
    return [float(value) for value in rounded / np.linalg.norm(rounded)]
