"""A URDF or MJCF as people have them: what MuJoCo would misread is mended with a remark, or refused.

MuJoCo reads both kinds of file into the same spec. Inertias, ranges and meshes are mended there. Of a
URDF the numbers are cleaned before, and the speed limits read, which MuJoCo does not know.
"""

from __future__ import annotations

import io
import math
import os
import re
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal
from urllib.parse import unquote

import mujoco
import numpy as np
import trimesh

from brokk_rl.errors import ConfigError
from brokk_rl.plain_files import parse_model

KINDS: dict[int, Literal["hinge", "slide"]] = {
    int(mujoco.mjtJoint.mjJNT_HINGE): "hinge",
    int(mujoco.mjtJoint.mjJNT_SLIDE): "slide",
}
"""Joints of which a machine is made."""
NUM_SIZES = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): 1,
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): 2,
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): 3,
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): 2,
    int(mujoco.mjtGeom.mjGEOM_BOX): 3,
}
"""Number of sizes of each primitive."""
UNITS = {"hinge": "rad", "slide": "m"}
DOUBTED = {"hinge": (4.0 * math.pi + 0.1, "degrees", math.pi / 180.0), "slide": (30.0, "mm", 1e-3)}
"""Limit beyond which the unit is doubted, the one that is likely, and its factor: joints of arms end
at two turns, and axes of portals at some 20 m."""
FASTEST = {"hinge": 30.0, "slide": 10.0}
"""Speed beyond which a limit is a placeholder, rad/s and m/s: no joint of an arm is as fast."""
SMALLEST_KG, SMALLEST_KG_M2 = 1e-6, 1e-9
"""Mass and inertia of frames, which MuJoCo wants to be positive."""
NEGATIVE_SHARE, NEGATIVE_KG_M2 = 0.01, 1e-6
"""Size of a negative principal inertia that counts as rounding: share of the largest, and what the
smallest parts have."""
ROD_SHARE = 1e-3
"""Inertia of a thin rod about its axis, as a share of the one across it: twenty times as long as thick."""
DENSITY_KG_M3 = 2700.0
"""Density of aluminium, for the inertia of a link that has none."""
MOST_FACES = 200_000
"""Faces that MuJoCo reads of an STL."""
INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
LARGEST_EFFORT = 1e7
"""Torque or force beyond which a limit is a placeholder, Nm and N."""
MESH_PREFIX = re.compile(r"^(package|model|file)://")


@dataclass
class ModelSource:
    """A model file as MuJoCo compiles it, with what MuJoCo does not read.

    Attributes:
        path: The file.
        spec: The mended model, from which `model` was compiled.
        model: The compiled model; fixed frames keep their names, and ends of travel are mended.
        speeds: Speed limits of joints by name, rad/s or m/s.
        doubted: Joints whose numbers were converted from a unit that was guessed.
        followers: Name of the joint that a joint follows (`<mimic>`, or `<equality>` of joints).
        notes: Names of joints and links by what was mended or guessed of them.
    """

    path: Path
    spec: Any = None
    model: Any = None
    speeds: dict[str, float] = field(default_factory=dict)
    doubted: set[int] = field(default_factory=set)
    followers: dict[int, str] = field(default_factory=dict)
    notes: dict[str, list[str]] = field(default_factory=dict)

    @property
    def remarks(self) -> list[str]:
        """One sentence for each kind of finding, with the names of what it is about."""
        said = []
        for text, names in self.notes.items():
            said.append(f"{', '.join(names)}: {text}" if names else text)
        return said

    def remark(self, text: str) -> None:
        """Say something about the whole file, once."""
        self.notes.setdefault(text, [])

    def note(self, name: str, text: str) -> None:
        """Note that something was mended or guessed of a joint or link."""
        self.notes.setdefault(text, []).append(name)

    def refuse(self, text: str) -> ConfigError:
        """Return an error about the file."""
        return ConfigError(f"subject.model={self.path}: {text}")


def read_source(path: Path, packages: Sequence[str] = ()) -> ModelSource:
    """Return a URDF or MJCF.

    Args:
        path: The file.
        packages: Folders in which `package://` and missing meshes are searched first.

    Raises:
        ConfigError: The file is missing, is neither, or holds something that cannot be mended.
    """
    source = ModelSource(path)
    root = parse_model(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what MuJoCo will no longer read in a later version
            if root.tag == "robot":
                _clean_urdf(root, source)
                text = ElementTree.tostring(root, encoding="unicode")
                source.spec = mujoco.MjSpec.from_string(text)
                _mend_links(source.spec)
            else:
                source.spec = mujoco.MjSpec.from_file(str(path))
            _embed_meshes(source, packages)
            _mend_inertias(source)
            _swap_limits(source)
            source.model = source.spec.compile()
    except ValueError as error:
        raise source.refuse(f"MuJoCo cannot read it as URDF or MJCF: {error}") from error
    if not np.isfinite(source.model.body_pos).all():
        raise source.refuse("a place in it is not finite; change nan and inf to numbers")
    _mend_travels(source)
    _list_followers(source)
    return source


# the text of a URDF


def _clean_urdf(root: ElementTree.Element, source: ModelSource) -> None:
    """Make a URDF readable for MuJoCo, and read the speed limits."""
    text = ElementTree.tostring(root, encoding="unicode")
    if "${" in text or "$(" in text or "wiki/xacro" in text:
        raise source.refuse(
            "this is xacro, not yet a URDF; run "
            f"`xacro {source.path.name} > robot.urdf` and give robot.urdf"
        )
    for link in root.findall("link"):
        _complete_inertial(link)
    for joint in root.findall("joint"):
        _clean_joint(joint, source)
    own = root.find("mujoco")
    if own is None:
        own = ElementTree.SubElement(root, "mujoco")
    for compiler in own.findall("compiler"):
        own.remove(compiler)
    ElementTree.SubElement(own, "compiler", discardvisual="false", strippath="false")


def _complete_inertial(link: ElementTree.Element) -> None:
    """Give the inertia of a link all of its entries; one without a mass goes."""
    inertial = link.find("inertial")
    if inertial is None:
        return
    if inertial.find("mass") is None:
        link.remove(inertial)
        return
    inertia = inertial.find("inertia")
    if inertia is None:
        inertia = ElementTree.SubElement(inertial, "inertia")
    for key in INERTIA:
        inertia.attrib.setdefault(key, "0")


def _clean_joint(joint: ElementTree.Element, source: ModelSource) -> None:
    """Leave the limits of a joint that are some; keep its speed limit."""
    name, limit = joint.get("name", ""), joint.find("limit")
    if (kind := joint.get("type")) in ("floating", "planar"):
        joint.set("type", "fixed")
        source.note(name, f"{kind}, and counts as fixed: the base of a machine stands still.")
    if limit is None:
        return
    values = {}
    for key in ("velocity", "effort", "lower", "upper"):
        text = limit.attrib.pop(key, "").strip().replace(",", ".")
        try:
            values[key] = float(text or 0.0)
        except ValueError as error:
            said = f"joint '{name}': {key}=\"{text}\" of <limit> is no number"
            raise source.refuse(said) from error
    lower, upper = values["lower"], values["upper"]
    if lower != upper and math.isfinite(upper - lower):
        limit.attrib |= {"lower": str(lower), "upper": str(upper)}
    if 0.0 < values["effort"] < LARGEST_EFFORT:
        limit.set("effort", str(values["effort"]))
    if 0.0 < values["velocity"] < math.inf:
        source.speeds[name] = values["velocity"]


# the spec of both kinds


def _mend_links(spec: mujoco.MjSpec) -> None:
    """Take away what MuJoCo guesses of the shapes of a URDF: masses, and shapes without a size."""
    for body in spec.bodies[1:]:
        body.explicitinertial = True
    for mesh in spec.meshes:  # open surfaces have no volume
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    for geom in list(spec.geoms):
        sizes = geom.size[: NUM_SIZES.get(int(geom.type), 0)]
        if min(sizes, default=1.0) <= 0.0:
            spec.delete(geom)


def _embed_meshes(source: ModelSource, packages: Sequence[str]) -> None:
    """Give each mesh its file as an asset; delete those that cannot be read, and all textures."""
    spec, here = source.spec, source.path.resolve().parent
    folders = [Path(), *(Path(folder).expanduser() for folder in packages)]
    folders += [here / spec.meshdir, here, *here.parents[:3]]
    searched = os.environ.get("ROS_PACKAGE_PATH", "")
    folders += [Path(folder) for folder in searched.split(os.pathsep) if folder]
    assets, missing = {}, []
    for number, mesh in enumerate(list(spec.meshes)):
        if not mesh.file:
            continue
        file = _find_mesh(mesh.file, folders)
        if file and file.suffix == ".msh":  # MuJoCo's own format
            mesh.file = str(file.resolve())
            continue
        data = _load_mesh(file) if file else None
        if file is None or data is None:
            missing.append(mesh.file)
            for geom in [one for one in spec.geoms if one.meshname == mesh.name]:
                spec.delete(geom)
            spec.delete(mesh)
            continue
        mesh.file = f"{number}_{file.stem}.stl"
        assets[mesh.file] = data
    spec.meshdir, spec.assets = "", assets
    if missing:
        source.note(
            f"{len(missing)} meshes (first: {missing[0]})",
            "not found or not read, and left out. subject.packages=[<folder>] says where to look.",
        )
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    for picture in (*spec.textures, *spec.skins):
        spec.delete(picture)


def _find_mesh(name: str, folders: Sequence[Path]) -> Path | None:
    """Return a mesh of a name such as `package://arm/meshes/base.stl`."""
    bare = Path(unquote(MESH_PREFIX.sub("", name)).replace("\\", "/"))
    names = [bare]
    if MESH_PREFIX.match(name) and len(bare.parts) > 1:
        # beside a file that stands in the package itself, without its name
        names.append(Path(*bare.parts[1:]))
    for folder in folders:
        for choice in names:
            if (folder / choice).is_file():
                return folder / choice
    return None


def _load_mesh(file: Path) -> bytes | None:
    """Return a mesh file as a binary STL; `None` where it cannot be read or is too large."""
    try:
        mesh = trimesh.load(file, force="mesh", process=False)
    except Exception:  # each format of trimesh has errors of its own
        return None
    if not isinstance(mesh, trimesh.Trimesh) or not 4 <= len(mesh.faces) <= MOST_FACES:
        return None
    if np.ptp(mesh.vertices, axis=0).min() <= 0.0:  # flat: MuJoCo wants a volume
        return None
    stream = io.BytesIO()
    mesh.export(stream, file_type="stl")
    return stream.getvalue()


def _mend_inertias(source: ModelSource) -> None:
    """Give each body an inertia that a body can have, or raise an error that names it."""
    spec = source.spec
    spec.compiler.fusestatic = False
    spec.compiler.discardvisual = False
    spec.compiler.boundmass = SMALLEST_KG
    spec.compiler.boundinertia = SMALLEST_KG_M2
    for body in spec.bodies[1:]:
        if not body.explicitinertial:
            continue
        where, mass_kg = f"link '{body.name}'", float(body.mass)
        if mass_kg < 0.0:
            raise source.refuse(f"{where} has a mass of {mass_kg:g} kg; write one above 0")
        if mass_kg < SMALLEST_KG:  # a frame
            _set_inertia(body, np.zeros(3), np.eye(3))
            continue
        principal, axes = np.linalg.eigh(_read_tensor(body))
        if principal[0] < -NEGATIVE_SHARE * principal[2] - NEGATIVE_KG_M2:
            raise source.refuse(
                f"{where} has a principal inertia of {principal[0]:.3g} kg m²; expected values above 0, "
                "check ixx to izz and their signs"
            )
        mended = np.where(principal > 0.0, principal, ROD_SHARE * principal[2])
        if not principal.any():  # that of an aluminium ball of its mass
            radius_m = (3.0 * mass_kg / (4.0 * math.pi * DENSITY_KG_M3)) ** (1 / 3)
            mended = np.full(3, 0.4 * mass_kg * radius_m**2)
        largest = mended[0] + mended[1]
        if mended[2] > (1.0 + 1e-6) * largest:
            mended[2] = 0.999 * largest
        if (mended != principal).any():
            text = "no inertia that a body has; one nearby is taken. Check its <inertia>."
            source.note(where, text)
        _set_inertia(body, mended, axes)


def _read_tensor(body: mujoco.MjsBody) -> np.ndarray:
    """Return the inertia of a body in its inertial frame, `(3, 3)`."""
    if math.isnan(body.fullinertia[0]):
        return np.diag(body.inertia)
    xx, yy, zz, xy, xz, yz = body.fullinertia
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _set_inertia(body: mujoco.MjsBody, principal: np.ndarray, axes: np.ndarray) -> None:
    """Give a body principal inertias about axes, the columns, in its inertial frame."""
    axes = axes * np.array([1.0, 1.0, np.linalg.det(axes)])  # right-handed
    turn, whole = np.zeros(4), np.zeros(4)
    mujoco.mju_mat2Quat(turn, axes.ravel())
    mujoco.mju_mulQuat(whole, body.iquat, turn)
    body.iquat, body.inertia = whole, principal
    body.fullinertia[0] = math.nan


def _swap_limits(source: ModelSource) -> None:
    for joint in source.spec.joints:
        lower, upper = joint.range
        if lower > upper:
            source.note(
                joint.name, f"the lower limit {lower:g} lies above the upper {upper:g}; swapped."
            )
            joint.range = joint.range[::-1]
            joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE


# what the compiled model says


def _mend_travels(source: ModelSource) -> None:
    """Write ends of travel in rad or m, whatever unit they seem to have; drop speeds of no joint."""
    model = source.model
    for joint in range(model.njnt):
        name, kind = model.joint(joint).name, KINDS.get(int(model.jnt_type[joint]))
        if kind is None:
            continue
        (lower, upper), unit = model.jnt_range[joint].tolist(), UNITS[kind]
        bound, wrong, factor = DOUBTED[kind]
        if model.jnt_limited[joint] and max(-lower, upper) > bound:
            source.doubted.add(joint)
            model.jnt_range[joint] *= factor
            source.note(
                name,
                f"limits of {lower:g} to {upper:g} {unit} are doubted and read as {wrong}: "
                f"{factor * lower:.4g} to {factor * upper:.4g} {unit}. Write them in {unit}.",
            )
            if name in source.speeds:
                source.speeds[name] *= factor
        if (speed := source.speeds.get(name, 0.0)) > FASTEST[kind]:
            source.note(
                name, f"the speed limit of {speed:g} {unit}/s is doubted and counts as not given."
            )
            del source.speeds[name]


def _list_followers(source: ModelSource) -> None:
    """List the joints that follow another one."""
    model = source.model
    for number in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT):
        leader = int(model.eq_obj2id[number])
        name = model.joint(leader).name if leader >= 0 else "a constant"
        source.followers[int(model.eq_obj1id[number])] = name
