"""An arm cut out of a model at its zero pose: its links, tool point and shapes, and an MJCF of it alone.

MuJoCo itself joins the bodies that no joint of the arm moves: it adds their masses to the link that
carries them. Link frames of a machine are parallel to the base at zero, so origins and axes are read
off the world positions of that pose.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
import trimesh

from brokk_rl.sim.check_subject import CheckSubject
from brokk_rl.sim.kinematic_tree import KinematicTree
from brokk_rl.sim.model_source import NUM_SIZES, SMALLEST_KG, SMALLEST_KG_M2, read_source

TIP = "tip"
TIP_NAMES = re.compile("tip|tcp|tool|grasp|grip_site|^grip|:grip|ee_|eef|end_?eff|attach", re.I)
"""Names of frames at the end of an arm."""
NEAREST_TIP_M, GUESSED_TIP_M = 1e-3, np.array([0.0, 0.0, 0.1])
"""Distance of a tool point from the last joint at least, so that the tool has a direction, and a
tool point where the model has none."""
LEAST_KG = 1e-4
"""Mass below which a link counts as a frame."""
ELEMENTS = ("equalities", "tendons", "actuators", "sensors", "excludes", "pairs", "keys", "flexes")
"""Parts of a model that name bodies and joints; an arm alone has none of them."""


class ArmModel:
    """An arm of a model file, and an MJCF of it alone.

    Link frames of the MJCF lie in the joints and are parallel to the base at zero.

    Args:
        path: The file.
        name: Name of the MJCF.
        choices: What is taken of the file.

    Attributes:
        source: The file as it was read.
        tree: Its joints.
        joints: Joints of the arm in the file's model.
        model: The MJCF as MuJoCo compiles it, a joint a row.
        mjcf: Its text.
        meshes: Files beside it, by their path from it.

    Raises:
        ConfigError: The file is missing or invalid, or has no serial chain of hinges and slides.
    """

    def __init__(self, path: Path, name: str, choices: CheckSubject) -> None:
        self.source = read_source(path, choices.packages)
        self.tree = KinematicTree(self.source)
        wanted = choices.chain_names or ((choices.tip,) if choices.tip else ())
        self._arm = self.tree.choose(wanted)
        self.joints = self._arm.joints
        self.tree.note_held(self._arm)
        self._drawn = mujoco.MjData(self.source.model)
        mujoco.mj_forward(self.source.model, self._drawn)
        tool_m = self._find_tool(choices.tip) - self._drawn.xanchor[self.joints[-1]]
        self._cut = self._cut_out()
        self._data = mujoco.MjData(self._cut)
        mujoco.mj_forward(self._cut, self._data)
        turn = self._move_to_base()
        self.meshes: dict[str, bytes] = {}
        made = self._write(name, turn @ tool_m)
        self.model, self.mjcf = made.compile(), made.to_xml()

    def _choose_names(self) -> list[str]:
        """Return a name for each joint, of letters, digits and `_`, as columns of recordings need it."""
        names: list[str] = []
        for row, joint in enumerate(self.joints):
            old = self.source.model.joint(joint).name
            name = re.sub(r"\W+", "_", old) or f"q{row + 1}"
            while name in names:
                name += "_"
            names.append(name)
            if name != old:
                self.source.note(name, "the joint is renamed.")
        return names

    def _cut_out(self) -> mujoco.MjModel:
        """Return the arm alone: bodies without a joint of the arm are joined to what carries them."""
        model, cut = self.source.model, self.source.spec
        for kind in ELEMENTS:
            for element in list(getattr(cut, kind)):
                cut.delete(element)
        for joint in [one for i, one in enumerate(cut.joints) if i not in self.joints]:
            cut.delete(joint)
        for geom in list(cut.worldbody.geoms):
            cut.delete(geom)
        for number, body in reversed(list(enumerate(cut.bodies))):
            if number and model.body_parentid[number] == 0 and number != self._arm.root:
                self.source.note(body.name or "a body without name", "not of the robot; left out.")
                cut.delete(body)
        cut.compiler.fusestatic = True
        return cut.compile()

    def _move_to_base(self) -> np.ndarray:
        """Put the foot of the robot above the origin, its x axis forward; return the turn, `(3, 3)`."""
        data, drawn, root = self._data, self._drawn, self._arm.root
        x_m, y_m, _ = drawn.xpos[root]
        forward = drawn.xmat[root].reshape(3, 3)[:, 0]
        yaw = math.atan2(forward[1], forward[0]) if np.hypot(*forward[:2]) > 0.5 else 0.0
        if not np.allclose((x_m, y_m, yaw), 0.0, atol=1e-6):
            self.source.remark(
                f"The robot stands at x {x_m:.3g}, y {y_m:.3g} m, turned by {yaw:.3g} rad; its foot is the "
                "origin here, and it looks along x."
            )
        turn = np.array(
            [[math.cos(yaw), math.sin(yaw), 0], [-math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]]
        )
        for points in (data.xanchor, data.xipos, data.geom_xpos):
            points[:] = (points - (x_m, y_m, 0.0)) @ turn.T
        data.xaxis[:] = data.xaxis @ turn.T
        for axes in (data.ximat, data.geom_xmat):
            axes[:] = (turn @ axes.reshape(-1, 3, 3)).reshape(-1, 9)
        return turn

    def _find_tool(self, tip: str | None) -> np.ndarray:
        """Return the place of the tool point in the file's own frame: as asked, a named frame, else the far end."""
        model, drawn, last = self.source.model, self._drawn, self.joints[-1]
        bodies = []
        for body in range(1, model.nbody):
            if last in self.tree.list_above(body, driven=False):
                bodies.append(body)
        frames = self._list_frames(bodies)
        if tip is not None and tip not in frames:
            raise self.source.refuse(
                f"subject.tip={tip} does not move with {self.tree.name(last)}, the last joint; choose one of "
                f"{', '.join(frames)}, or another subject.chain"
            )
        if (wanted := tip or TIP) in frames:
            return frames[wanted]
        away_m = {}
        for name, at_m in frames.items():
            far_m = float(np.linalg.norm(at_m - drawn.xanchor[last]))
            if far_m > NEAREST_TIP_M:
                away_m[name] = far_m
        if named := [name for name in away_m if TIP_NAMES.search(name)]:
            chosen = named[-1]
        elif away_m:
            chosen = max(away_m, key=lambda name: away_m[name])
        else:
            self.source.remark(
                "There is no site nor fixed frame for the tool point; twice the distance to the last link's centre "
                "of mass is a guess."
            )
            com_m = drawn.xipos[model.jnt_bodyid[last]] - drawn.xanchor[last]
            is_apart = np.linalg.norm(com_m) > NEAREST_TIP_M
            return drawn.xanchor[last] + (2.0 * com_m if is_apart else GUESSED_TIP_M)
        self.source.remark(
            f"The tool point is the frame '{chosen}'; subject.tip=… chooses another."
        )
        return frames[chosen]

    def _list_frames(self, bodies: Sequence[int]) -> dict[str, np.ndarray]:
        """Return the places of bodies and of the sites on them, by name."""
        model, drawn = self.source.model, self._drawn
        frames = {model.body(body).name: drawn.xpos[body] for body in bodies}
        for site in range(model.nsite):
            if model.site_bodyid[site] in bodies:
                frames[model.site(site).name] = drawn.site_xpos[site]
        return frames

    def _write(self, name: str, tool_m: np.ndarray) -> mujoco.MjSpec:
        """Return the arm as an MJCF of its own; a body with several joints becomes frames and a link."""
        model, data = self._cut, self._data
        made = mujoco.MjSpec()
        made.modelname, made.compiler.degree = name, False
        link, at_m = made.worldbody, np.zeros(3)
        self._add_shapes(made, link, 0, at_m)
        for row, joint_name in enumerate(self._choose_names()):
            link = link.add_body(name=f"{joint_name}_link", pos=data.xanchor[row] - at_m)
            at_m = data.xanchor[row]
            link.explicitinertial = True
            link.mass, link.inertia = SMALLEST_KG, np.full(3, SMALLEST_KG_M2)
            link.add_joint(
                name=joint_name,
                type=model.jnt_type[row],
                axis=normalise_axis(data.xaxis[row]),
                armature=float(model.dof_armature[row]),
            )
            body = int(model.jnt_bodyid[row])
            if row + 1 == model.njnt or model.jnt_bodyid[row + 1] != body:
                if model.body_mass[body] < LEAST_KG:
                    self.source.note(
                        model.body(body).name, "no mass: it weighs nothing. Write <inertial>."
                    )
                link.mass, link.inertia = model.body_mass[body], model.body_inertia[body]
                link.ipos, link.iquat = data.xipos[body] - at_m, _to_quaternion(data.ximat[body])
                self._add_shapes(made, link, body, at_m)
        link.add_site(name=TIP, pos=tool_m, size=[0.01, 0.01, 0.01])
        made.assets = self.meshes
        return made

    def _add_shapes(
        self, made: mujoco.MjSpec, link: mujoco.MjsBody, body: int, at_m: np.ndarray
    ) -> None:
        """Add the geoms of a body to a link at `at_m`: for the eye, and to touch with."""
        model, data = self._cut, self._data
        geoms = np.flatnonzero(model.geom_bodyid == body).tolist()
        pictures = [geom for geom in geoms if not model.geom_contype[geom]]
        for geom in geoms:
            kind = int(model.geom_type[geom])
            turn = data.geom_xmat[geom].reshape(3, 3)
            centre = data.geom_xpos[geom]
            place = {"pos": centre - at_m, "quat": _to_quaternion(turn)}
            if kind in NUM_SIZES:
                place |= {"type": model.geom_type[geom], "size": model.geom_size[geom]}
            elif kind != mujoco.mjtGeom.mjGEOM_MESH:
                continue
            if geom in (pictures or geoms):
                shown = place
                if kind == mujoco.mjtGeom.mjGEOM_MESH:
                    mesh = self._add_mesh(made, int(model.geom_dataid[geom]))
                    shown = place | {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": mesh}
                material = model.geom_matid[geom]
                rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
                link.add_geom(group=2, contype=0, conaffinity=0, rgba=rgba, **shown)
            is_last = body == model.nbody - 1
            if is_last and (model.geom_contype[geom] or len(pictures) == len(geoms)):
                if kind == mujoco.mjtGeom.mjGEOM_MESH:
                    box = model.geom_aabb[geom]
                    place["pos"] = centre + turn @ box[:3] - at_m
                    place |= {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": box[3:]}
                    self.source.remark("Meshes touch as boxes around them.")
                link.add_geom(group=3, contype=1, conaffinity=0, **place)

    def _add_mesh(self, made: mujoco.MjSpec, mesh: int) -> str:
        """Add a mesh with a file of its own, once; return its name."""
        model, name = self._cut, f"mesh_{mesh}"
        file = f"{made.modelname}_meshes/{mesh}.stl"
        if file not in self.meshes:
            first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
            vertices = model.mesh_vert[first : first + count]
            first, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
            faces = model.mesh_face[first : first + count]
            stream = io.BytesIO()
            trimesh.Trimesh(vertices, faces, process=False).export(stream, file_type="stl")
            self.meshes[file] = stream.getvalue()
            made.add_mesh(name=name, file=file, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        return name


def _to_quaternion(turn: np.ndarray) -> np.ndarray:
    """Return the quaternion, w first, of a rotation matrix."""
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, turn.ravel())
    return quaternion


def normalise_axis(axis: np.ndarray | Sequence[float]) -> list[float]:
    """Return a unit axis without rounding errors of the pose."""
    rounded = np.round(axis, 9)
    return [float(value) for value in rounded / np.linalg.norm(rounded)]
