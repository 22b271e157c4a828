"""A machine and its MJCF from the URDF or MJCF of an arm.

Link frames of a machine are parallel to the base at zero, so origins and axes are read off the world
positions of that pose. Bodies behind joints that are not part of the chain, such as a gripper's
fingers, stay where they are drawn and add to the mass of the link that carries them.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.spec import restore_spec

PERIOD_S, DEAD_TIME_S, NUM_HISTORY = 0.05, 0.1, 5
"""Control of a machine of which nothing is measured: the paper's 20 Hz, two periods of dead time, and
twice that as history."""
GUESSED_SPEED = {"hinge": 0.3, "slide": 0.1}
"""Speed at full command where the file has none, rad/s and m/s: between the joints of `brokk170`."""
YIELD_FACTOR = 3.0
"""Guessed yield force over the largest weight that the joint carries, as in `brokk170`."""
FIRST_MODE_HZ = 6.0
"""First mode of the closed cylinders, from which a stiffness is guessed, as in `brokk170`."""
NUM_POSES = 512
"""Random poses in which the largest weight on a joint is looked for."""
TIP = "tip"
_KINDS = {int(mujoco.mjtJoint.mjJNT_HINGE): "hinge", int(mujoco.mjtJoint.mjJNT_SLIDE): "slide"}
_SHAPES = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): ("sphere", 1),
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): ("capsule", 2),
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): ("ellipsoid", 3),
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): ("cylinder", 2),
    int(mujoco.mjtGeom.mjGEOM_BOX): ("box", 3),
}
"""Name in an MJCF and number of sizes of each primitive."""


@dataclass(frozen=True)
class ImportedMachine:
    """A machine from a model file.

    Attributes:
        values: The machine as plain data: its fields, without classes.
        mjcf: Text of its MJCF.
        remarks: Guesses and simplifications, one sentence each.
    """

    values: dict[str, Any]
    mjcf: str
    remarks: list[str] = field(default_factory=list)

    def build(self) -> Machine:
        """Return the machine."""
        return restore_spec(Machine, self.values)


def import_model(path: Path, name: str) -> ImportedMachine:
    """Return the machine `name` of a URDF or MJCF.

    Raises:
        ConfigError: The file is missing or invalid, or has no serial chain of hinges and slides.
    """
    if not path.is_file():
        raise ConfigError(f"subject.model={path}: there is no such file (seen from {Path.cwd()})")
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        spec.compiler.fusestatic = False  # fixed frames, such as a URDF's tool0, keep their names
        spec.compiler.discardvisual = False
        model = spec.compile()
    except ValueError as error:
        raise ConfigError(
            f"subject.model={path}: MuJoCo cannot read it as URDF or MJCF: {error}"
        ) from error
    return _ModelReader(model, path, name).read()


class _ModelReader:
    """One model at its zero pose: chain, links, numbers and shapes."""

    def __init__(self, model: mujoco.MjModel, path: Path, name: str) -> None:
        self._model, self._path, self._name = model, path, name
        self._data = mujoco.MjData(model)
        mujoco.mj_resetData(model, self._data)
        mujoco.mj_forward(model, self._data)
        self._remarks: list[str] = []
        self._limits = _read_urdf_limits(path)
        self._chain = self._find_chain()
        self._links = self._group_bodies()
        self._anchors = self._data.xanchor[self._chain].copy()
        self._loads = self._measure_loads()
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, self._data, full)
        self._inertia = np.diag(full)[model.jnt_dofadr[self._chain]]

    def read(self) -> ImportedMachine:
        """Return the machine."""
        tool_m = self._find_tool()
        joints = [self._describe_joint(row) for row in range(len(self._chain))]
        self._describe_commands(joints)
        source = self._path.name
        values = {
            "name": self._name,
            "title": f"{self._name}, from {source}",
            "mjcf": f"{self._name}.xml",
            "period_s": PERIOD_S,
            "dead_time_s": DEAD_TIME_S,
            "num_history": NUM_HISTORY,
            "joints": joints,
            "tool_m": [_make_dimension(value, source, "high") for value in tool_m],
            "exclusive": [],
            "levers": [],
        }
        self._remarks.append(
            f"The control period ({PERIOD_S} s), the dead time ({DEAD_TIME_S} s) and num_history are guesses; "
            "mode=identify measures the dead time."
        )
        self._remarks.append(
            "Only the last link touches anything; give other links contype, a site and a <touch> sensor in the MJCF."
        )
        return ImportedMachine(values, self._write_mjcf(tool_m), self._remarks)

    def _find_chain(self) -> list[int]:
        """Return the joints of the longest chain from the base."""
        model, path = self._model, self._path
        for joint in range(model.njnt):
            if int(model.jnt_type[joint]) not in _KINDS:
                raise ConfigError(
                    f"subject.model={path}: joint '{model.joint(joint).name}' is neither a hinge nor a slide; "
                    "a machine is a chain of such joints on a fixed base"
                )
        chains = [self._list_ancestors(joint) for joint in range(model.njnt)]
        chain = max(chains, key=len, default=[])
        if not chain:
            raise ConfigError(f"subject.model={path}: it has no joint that moves")
        names = [model.joint(joint).name for joint in range(model.njnt) if joint not in chain]
        if names:
            self._remarks.append(
                f"{', '.join(names)} are not part of the longest chain and stay where they are drawn."
            )
        return chain

    def _list_ancestors(self, joint: int) -> list[int]:
        """Return the joints from the base up to and including `joint`."""
        model, chain = self._model, [joint]
        body = int(model.jnt_bodyid[joint])
        if model.body_jntnum[body] != 1:
            raise ConfigError(
                f"subject.model={self._path}: body '{model.body(body).name}' has {model.body_jntnum[body]} joints; "
                "give each joint a body of its own"
            )
        while (body := int(model.body_parentid[body])) != 0:
            if model.body_jntnum[body]:
                chain.insert(0, int(model.body_jntadr[body]))
        return chain

    def _group_bodies(self) -> list[list[int]]:
        """Return the bodies that move with each joint of the chain; the base comes first."""
        model = self._model
        moved_by = {int(model.jnt_bodyid[joint]): row for row, joint in enumerate(self._chain)}
        groups: list[list[int]] = [[] for _ in range(len(self._chain) + 1)]
        owner = {0: -1}
        for body in range(1, model.nbody):
            owner[body] = moved_by.get(body, owner[int(model.body_parentid[body])])
            groups[owner[body] + 1].append(body)
        groups[0].insert(0, 0)
        return groups

    def _measure_loads(self) -> np.ndarray:
        """Return the largest weight on each joint of the chain over random poses, Nm or N."""
        model, data = self._model, mujoco.MjData(self._model)
        generator, largest = np.random.default_rng(0), np.zeros(len(self._chain))
        dofs = model.jnt_dofadr[self._chain]
        for _ in range(NUM_POSES):
            for joint in self._chain:
                low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (-np.pi, np.pi)
                data.qpos[model.jnt_qposadr[joint]] = generator.uniform(low, high)
            mujoco.mj_forward(model, data)
            largest = np.maximum(largest, np.abs(data.qfrc_bias[dofs]))
        return largest

    def _describe_joint(self, row: int) -> dict[str, Any]:
        """Return a joint and its link as plain data."""
        model, joint, source = self._model, self._chain[row], self._path.name
        name = model.joint(joint).name
        kind = _KINDS[int(model.jnt_type[joint])]
        zero = model.qpos0[model.jnt_qposadr[joint]]
        limits = self._limits.get(name, {})
        if model.jnt_limited[joint]:
            lower, upper = (float(value - zero) for value in model.jnt_range[joint])
            travel = (source, "high")
        else:
            lower, upper = (-math.pi, math.pi) if kind == "hinge" else (-1.0, 1.0)
            travel = (f"guess: {source} has no limits", "low")
            self._remarks.append(f"{name} has no limits in {source}; measure them.")
        speed, effort = limits.get("velocity"), limits.get("effort")
        if not speed:
            self._remarks.append(f"{name} has no speed at full command in {source}; measure it.")
        if not effort:
            self._remarks.append(f"{name} has no force limit in {source}; yield_force is a guess.")
        inertia = float(self._inertia[row])
        mass_kg, com_m, _ = self._sum_masses(row)
        origin_m = self._anchors[row] - (self._anchors[row - 1] if row else 0.0)
        return {
            "name": name,
            "part": None,
            "kind": kind,
            "lower": _make_dimension(lower, *travel),
            "upper": _make_dimension(upper, *travel),
            "home": round(min(max(0.0, lower), upper), 6),
            "max_speed": _make_dimension(speed, f"velocity limit in {source}", "medium")
            if speed
            else _make_dimension(GUESSED_SPEED[kind], "guess", "low"),
            "body": {
                "axis": _normalise(self._data.xaxis[joint]),
                "origin_m": [_make_dimension(value, source, "high") for value in origin_m],
                "mass_kg": _make_dimension(mass_kg, source, "medium"),
                "com_m": _round(com_m),
                "yield_force": _make_dimension(effort, f"effort limit in {source}", "medium")
                if effort
                else _make_dimension(
                    YIELD_FACTOR * max(self._loads[row], 1.0),
                    "guess: three times the largest weight on the joint",
                    "low",
                ),
                "stiffness": _make_dimension(
                    (2 * math.pi * FIRST_MODE_HZ) ** 2 * inertia,
                    f"guess: first mode of the closed cylinder at {FIRST_MODE_HZ:g} Hz",
                    "low",
                ),
            },
        }

    def _describe_commands(self, joints: list[dict[str, Any]]) -> None:
        """Add `command` to each joint: that of its actuator, a guess where the model has none."""
        found = [one for one in map(self._read_command, self._chain) if one is not None]
        if len(found) < len(joints) or len({command for command, _ in found}) > 1:
            found = [("valve", 0.0)] * len(joints)
            self._remarks.append(
                "command: valve is a guess; write velocity, position or torque (with max_force) at the joints of "
                "other drives."
            )
        for values, (command, force) in zip(joints, found, strict=True):
            values["command"] = command
            if command == "torque":
                values["max_force"] = _make_dimension(force, self._path.name, "medium")

    def _read_command(self, joint: int) -> tuple[str, float] | None:
        """Return what the actuator of a joint is commanded by and its largest force; `None` without one."""
        model = self._model
        for actuator in range(model.nu):
            is_own = model.actuator_trnid[actuator, 0] == joint
            if not is_own or model.actuator_trntype[actuator] != mujoco.mjtTrn.mjTRN_JOINT:
                continue
            stiffness, damping = -model.actuator_biasprm[actuator, 1:3]
            if stiffness > 0:
                return "position", 0.0
            if damping > 0:
                return "velocity", 0.0
            gain = model.actuator_gainprm[actuator, 0] * model.actuator_gear[actuator, 0]
            force = abs(gain) * float(model.actuator_ctrlrange[actuator, 1])
            return ("torque", force) if force > 0 else None
        return None

    def _sum_masses(self, row: int) -> tuple[float, np.ndarray, np.ndarray]:
        """Return mass (kg), centre (m, from the joint) and inertia about it of a link."""
        model, data, bodies = self._model, self._data, self._links[row + 1]
        masses = model.body_mass[bodies]
        mass_kg = float(masses.sum())
        if mass_kg <= 0.0:
            raise ConfigError(
                f"subject.model={self._path}: the link behind joint '{model.joint(self._chain[row]).name}' has no "
                "mass; give it an <inertial>"
            )
        centre = (masses[:, None] * data.xipos[bodies]).sum(0) / mass_kg
        inertia = np.zeros((3, 3))
        for body, mass in zip(bodies, masses, strict=True):
            turn, away = data.ximat[body].reshape(3, 3), data.xipos[body] - centre
            inertia += turn @ np.diag(model.body_inertia[body]) @ turn.T
            inertia += mass * (away @ away * np.eye(3) - np.outer(away, away))
        return mass_kg, centre - self._anchors[row], inertia

    def _find_tool(self) -> np.ndarray:
        """Return the tool point from the last joint: a site, else the last fixed frame, else the far end."""
        model, data, bodies = self._model, self._data, self._links[-1]
        last = self._anchors[-1]
        sites = [site for site in range(model.nsite) if model.site_bodyid[site] in bodies]
        named = [site for site in sites if model.site(site).name == TIP]
        if sites:
            return data.site_xpos[(named or sites)[-1]] - last
        frames = [body for body in bodies if not np.allclose(data.xpos[body], last)]
        if frames:
            frame = max(frames, key=lambda body: float(np.linalg.norm(data.xpos[body] - last)))
            self._remarks.append(f"The tool point is the frame '{model.body(frame).name}'.")
            return data.xpos[frame] - last
        self._remarks.append(
            "There is no site nor fixed frame for the tool point; twice the distance to the last link's centre "
            "of mass is a guess."
        )
        return 2.0 * self._sum_masses(len(self._chain) - 1)[1]

    def _write_mjcf(self, tool_m: np.ndarray) -> str:
        """Return an MJCF whose link frames lie in the joints, parallel to the base at zero."""
        root = ElementTree.Element("mujoco", model=self._name)
        ElementTree.SubElement(root, "compiler", angle="radian")
        world = ElementTree.SubElement(root, "worldbody")
        self._add_shapes(world, self._links[0], np.zeros(3), touches=False)
        parent = world
        for row, joint in enumerate(self._chain):
            name, at_m = self._model.joint(joint).name, self._anchors[row]
            origin_m = at_m - (self._anchors[row - 1] if row else 0.0)
            parent = ElementTree.SubElement(
                parent, "body", name=f"{name}_link", pos=_format(origin_m)
            )
            mass_kg, com_m, inertia = self._sum_masses(row)
            principal, turn = np.linalg.eigh(inertia)
            turn[:, 2] *= np.linalg.det(turn)  # right-handed
            ElementTree.SubElement(
                parent,
                "inertial",
                pos=_format(com_m),
                quat=_format(_to_quaternion(turn)),
                mass=f"{mass_kg:.6g}",
                diaginertia=_format(principal),
            )
            kind = _KINDS[int(self._model.jnt_type[joint])]
            axis = _format(_normalise(self._data.xaxis[joint]))
            ElementTree.SubElement(parent, "joint", name=name, type=kind, axis=axis)
            is_last = row == len(self._chain) - 1
            self._add_shapes(parent, self._links[row + 1], at_m, touches=is_last)
        ElementTree.SubElement(parent, "site", name=TIP, pos=_format(tool_m), size="0.01")
        bound = 2.0 * float(np.linalg.norm(tool_m)) + 1.0
        ElementTree.SubElement(
            parent, "site", name="touch", type="sphere", size=f"{bound:.4g}", group="5"
        )
        sensor = ElementTree.SubElement(root, "sensor")
        ElementTree.SubElement(sensor, "touch", name="contact", site="touch")
        ElementTree.indent(root)
        return ElementTree.tostring(root, encoding="unicode") + "\n"

    def _add_shapes(
        self, parent: ElementTree.Element, bodies: Sequence[int], at_m: np.ndarray, touches: bool
    ) -> None:
        """Add the geoms of `bodies` to a link at `at_m`: for the eye, and once more to touch with."""
        model = self._model
        geoms = [geom for geom in range(model.ngeom) if model.geom_bodyid[geom] in bodies]
        pictures = [geom for geom in geoms if not model.geom_contype[geom]]
        for geom in geoms:
            place = self._place_shape(geom, at_m)
            if place is None:
                continue
            if geom in (pictures or geoms):
                color = _format(model.geom_rgba[geom])
                silent = {"group": "2", "contype": "0", "conaffinity": "0", "rgba": color}
                ElementTree.SubElement(parent, "geom", place, **silent)
            if touches and (model.geom_contype[geom] or len(pictures) == len(geoms)):
                felt = {"group": "3", "contype": "1", "conaffinity": "0"}
                ElementTree.SubElement(parent, "geom", place, **felt)

    def _place_shape(self, geom: int, at_m: np.ndarray) -> dict[str, str] | None:
        """Return type, size and place of a geom in a link at `at_m`; `None` for ground."""
        model, data = self._model, self._data
        kind, centre = int(model.geom_type[geom]), data.geom_xpos[geom]
        turn = data.geom_xmat[geom].reshape(3, 3)
        if kind in _SHAPES:
            shape, count = _SHAPES[kind]
            size = model.geom_size[geom, :count]
        elif kind == mujoco.mjtGeom.mjGEOM_MESH:
            shape, size = "box", model.geom_aabb[geom, 3:]
            centre = centre + turn @ model.geom_aabb[geom, :3]
            remark = "Meshes are drawn as boxes around them."
            if remark not in self._remarks:
                self._remarks.append(remark)
        else:
            return None
        return {
            "type": shape,
            "size": _format(size),
            "pos": _format(centre - at_m),
            "quat": _format(_to_quaternion(turn)),
        }


def _to_quaternion(turn: np.ndarray) -> np.ndarray:
    """Return the quaternion, w first, of a rotation matrix."""
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, turn.ravel())
    return quaternion


def _read_urdf_limits(path: Path) -> dict[str, dict[str, float]]:
    """Return velocity and effort of each joint of a URDF, which MuJoCo does not read."""
    root = ElementTree.parse(path).getroot()
    found = {}
    for joint in root.iter("joint") if root.tag == "robot" else ():
        limit = joint.find("limit")
        if limit is not None:
            found[joint.get("name", "")] = {
                key: float(limit.get(key, 0.0)) for key in ("velocity", "effort")
            }
    return found


def _make_dimension(value: float, source: str, confidence: str) -> dict[str, Any]:
    return {"value": float(f"{float(value):.6g}"), "source": source, "confidence": confidence}


def _normalise(axis: np.ndarray) -> list[float]:
    rounded = np.round(axis, 9)
    return [float(value) for value in rounded / np.linalg.norm(rounded)]


def _round(values: np.ndarray) -> list[float]:
    return [round(float(value), 6) for value in values]


def _format(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(f"{0.0 if abs(value) < 1e-12 else value:.8g}" for value in values)
