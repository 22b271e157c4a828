"""Reading of a URDF or MJCF as people have them: what MuJoCo would misread is mended or named.

MuJoCo does not follow `package://`, ignores `<mimic>`, and ends at one bad number. Here each such
finding is either mended, with a remark, or refused by the name of its joint or link.
"""

from __future__ import annotations

import io
import math
import os
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import trimesh

from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.sim.model_source import (
    SMALLEST_KG,
    SMALLEST_KG_M2,
    JointLimits,
    ModelSource,
    balance_inertia,
    describe_balance,
    read_mjcf,
    set_travel,
)

FASTEST = {"hinge": 30.0, "slide": 10.0}
"""Speed beyond which a limit is a placeholder, rad/s and m/s: no joint of an arm is as fast."""
DENSITY_KG_M3 = 2700.0
"""Density of aluminium, for the inertia of a link that has none."""
LARGEST_M = 5.0
"""Radius of gyration of a link beyond which its inertia has another unit; a crane's boom has 3 m."""
MOST_FACES = 200_000
"""Faces that MuJoCo reads of an STL."""
NUMBERS = {
    *("xyz", "rpy", "value", "ixx", "ixy", "ixz", "iyy", "iyz", "izz", "radius", "length", "size"),
    *("scale", "lower", "upper", "velocity", "effort", "multiplier", "offset"),
}
"""Attributes of a URDF that hold numbers."""
OPTIONAL = frozenset({"lower", "upper", "velocity", "effort"})
"""Those that may be empty."""
MESH_PREFIX = re.compile(r"^(package|model|file)://")


def read_source(path: Path, packages: Sequence[str] = ()) -> ModelSource:
    """Return a URDF or MJCF.

    Args:
        path: The file.
        packages: Folders in which `package://` and missing meshes are searched first.

    Raises:
        ConfigError: The file is missing, is neither, or holds something that cannot be mended.
    """
    if not path.is_file():
        raise ConfigError(f"subject.model={path}: there is no such file (seen from {Path.cwd()})")
    root = _parse_xml(path)
    try:
        if root.tag == "robot":
            return _UrdfReader(path, root, packages).read()
        return read_mjcf(path)
    except ValueError as error:
        raise _refuse(path, f"MuJoCo cannot read it as URDF or MJCF: {error}") from error


def _parse_xml(path: Path) -> ElementTree.Element:
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, UnicodeDecodeError) as error:
        hint = "; run xacro first" if "xacro" in path.name or "prefix" in str(error) else ""
        raise _refuse(
            path, f"it is no XML, cannot read it as URDF or MJCF ({error}){hint}"
        ) from error
    if root.tag not in ("robot", "mujoco"):
        raise _refuse(
            path,
            f"expected a URDF (<robot>) or an MJCF (<mujoco>), got <{root.tag}>; export it as one of these",
        )
    return root


def _refuse(path: Path, text: str) -> ConfigError:
    return ConfigError(f"subject.model={path}: {text}")


class _UrdfReader:
    """One URDF: numbers, inertias, limits and meshes are mended in its XML."""

    def __init__(self, path: Path, root: ElementTree.Element, packages: Sequence[str]) -> None:
        self._path, self._root = path, root
        self._folders = [Path(folder).expanduser() for folder in packages]
        self._folders += [path.resolve().parent, *path.resolve().parents[1:4]]
        searched = os.environ.get("ROS_PACKAGE_PATH", "")
        self._folders += [Path(folder) for folder in searched.split(os.pathsep) if folder]
        self._source = ModelSource(path, model=Any)  # pyright: ignore[reportArgumentType]
        self._assets: dict[str, bytes] = {}
        self._missing: list[str] = []

    def read(self) -> ModelSource:
        """Return the source."""
        for part in (*self._root.findall("link"), *self._root.findall("joint")):
            self._check_numbers(part)
        self._check_names()
        for link in self._root.findall("link"):
            self._correct_inertia(link)
            for shape in (*link.findall("visual"), *link.findall("collision")):
                if _is_flat(shape):
                    link.remove(shape)
                else:
                    self._read_mesh(link, shape)
        for joint in self._root.findall("joint"):
            self._read_joint(joint)
        if self._missing:
            self._source.note(
                f"{len(self._missing)} meshes (first: {self._missing[0]})",
                "not found or not read, and left out. subject.packages=[<folder>] says where to look.",
            )
        self._source.model = self._compile()
        return self._source

    def _check_numbers(self, part: ElementTree.Element) -> None:
        """Make every number of a link or joint readable, or raise an error that names it."""
        where = f"{part.tag} '{part.get('name')}'"
        for element in part.iter():
            if "xacro" in element.tag:
                raise _refuse(self._path, self._describe_xacro(f"{where} holds <{element.tag}>"))
            for key, text in list(element.attrib.items()):
                if "${" in text or "$(" in text:
                    raise _refuse(self._path, self._describe_xacro(f'{where} has {key}="{text}"'))
                is_mass = key == "value" and element.tag != "mass"
                if key in NUMBERS and not is_mass:
                    self._check_number(element, key, text, where)

    def _describe_xacro(self, text: str) -> str:
        return (
            f"{text}: this is xacro, not yet a URDF; run "
            f"`xacro {self._path.name} > robot.urdf` and give robot.urdf"
        )

    def _check_names(self) -> None:
        """Raise an error where a name repeats, or a joint hangs on a link that there is not."""
        links = [link.get("name", "") for link in self._root.findall("link")]
        joints = self._root.findall("joint")
        for names in (links, [joint.get("name", "") for joint in joints]):
            repeated = {name for name in names if names.count(name) > 1}
            if repeated:
                raise _refuse(self._path, f"the name '{min(repeated)}' repeats; rename one")
        for joint in joints:
            for end in ("parent", "child"):
                element = joint.find(end)
                name = "" if element is None else element.get("link", "")
                if name not in links:
                    raise _refuse(
                        self._path,
                        f"joint '{joint.get('name')}': there is no {end} link '{name}'; "
                        f"{list_choices(name, links)}",
                    )

    def _check_number(self, element: ElementTree.Element, key: str, text: str, where: str) -> None:
        if not text.strip():
            if key not in OPTIONAL:
                raise _refuse(
                    self._path, f'{where}: {key}="" of <{element.tag}> is empty; write the number'
                )
            self._source.note(where, f'{key}="" is empty and counts as not given.')
            del element.attrib[key]
            return
        words = text.split()
        if len(words) == 1 and re.fullmatch(r"[-+]?\d+,\d+", text.strip()):
            words = [text.strip().replace(",", ".")]
            self._source.note(
                where, f'{key}="{text}" has a decimal comma and is read as {words[0]}.'
            )
        try:
            values = [float(word) for word in words]
        except ValueError:
            raise _refuse(
                self._path,
                f'{where}: {key}="{text}" of <{element.tag}> is no number; expected numbers with a point, '
                "separated by spaces",
            ) from None
        if not np.isfinite(values).all() and key not in OPTIONAL:
            raise _refuse(
                self._path, f'{where}: {key}="{text}" of <{element.tag}> is not finite; change it'
            )
        element.set(key, " ".join(words))
        if key == "rpy" and max(map(abs, values)) > 2.0 * math.pi:
            self._source.note(where, f'rpy="{text}" is doubted: expected rad; degrees?')

    def _correct_inertia(self, link: ElementTree.Element) -> None:
        """Give a link an inertia that a body can have, or raise an error that names it."""
        name = link.get("name", "")
        inertial = link.find("inertial")
        if inertial is None:
            inertial = ElementTree.SubElement(link, "inertial")
        mass = inertial.find("mass")
        mass_kg = float(mass.get("value", 0.0)) if mass is not None else 0.0
        if mass_kg < 0.0:
            raise _refuse(
                self._path, f"link '{name}' has a mass of {mass_kg:g} kg; write one above 0"
            )
        inertia = inertial.find("inertia")
        tensor = _read_tensor(inertia)
        if mass_kg < SMALLEST_KG:  # a frame
            mass_kg, tensor = SMALLEST_KG, SMALLEST_KG_M2 * np.eye(3)
        elif not tensor.any():
            radius_m = (3.0 * mass_kg / (4.0 * math.pi * DENSITY_KG_M3)) ** (1 / 3)
            tensor = 0.4 * mass_kg * radius_m**2 * np.eye(3)
            self._source.note(
                f"link '{name}'",
                "no inertia; that of an aluminium ball of its mass is taken. Write <inertia>.",
            )
        principal = np.linalg.eigvalsh(tensor)
        if principal[0] <= 0.0:
            raise _refuse(
                self._path,
                f"link '{name}' has a principal inertia of {principal[0]:.3g} kg m²; expected values above 0, "
                "check ixx to izz and their signs",
            )
        if principal[2] > (1.0 + 1e-6) * (principal[0] + principal[1]):
            self._source.note(f"link '{name}'", describe_balance(principal, "ixx to izz"))
            axes = np.linalg.eigh(tensor)[1]
            tensor = axes @ np.diag(balance_inertia(principal)) @ axes.T
        if math.sqrt(principal[2] / mass_kg) > LARGEST_M:
            self._source.note(
                f"link '{name}'", f"{principal[2]:.3g} kg m² at {mass_kg:g} kg are doubted: units?"
            )
        for old in (mass, inertia):
            if old is not None:
                inertial.remove(old)
        ElementTree.SubElement(inertial, "mass", value=repr(float(mass_kg)))
        rows, columns = np.triu_indices(3)
        values = {
            f"i{'xyz'[i]}{'xyz'[j]}": repr(float(tensor[i, j]))
            for i, j in zip(rows, columns, strict=True)
        }
        ElementTree.SubElement(inertial, "inertia", values)

    def _read_mesh(self, link: ElementTree.Element, shape: ElementTree.Element) -> None:
        """Put the mesh of a shape into the assets; remove the shape where it cannot be read."""
        mesh = shape.find("geometry/mesh")
        if mesh is None:
            return
        name = mesh.get("filename", "")
        file = self._find_mesh(name)
        scale = [float(value) for value in mesh.attrib.pop("scale", "1 1 1").split()[:3]]
        data = _load_mesh(file, np.resize(scale, 3)) if file else None
        if data is None:
            link.remove(shape)
            self._missing.append(name)
            return
        asset = f"{len(self._assets)}_{Path(name).stem}.stl"
        self._assets[asset] = data
        mesh.set("filename", asset)

    def _find_mesh(self, name: str) -> Path | None:
        """Return a mesh of a name such as `package://arm/meshes/base.stl`."""
        bare = MESH_PREFIX.sub("", name)
        parts = Path(bare).parts
        if not parts:
            return None
        # beside a file that stands in the package itself, without its name
        inside = Path(*parts[1:]) if len(parts) > 1 else Path(bare)
        for folder in (Path(), *self._folders):
            choices = [folder / bare]
            if MESH_PREFIX.match(name):
                choices.append(folder / inside)
            for choice in choices:
                if choice.is_file():
                    return choice
        return None

    def _read_joint(self, joint: ElementTree.Element) -> None:
        """Take limits and `<mimic>` out of a joint, and leave MuJoCo what it reads rightly."""
        name, kind = joint.get("name", ""), joint.get("type", "")
        limit = joint.find("limit")
        if limit is not None:
            joint.remove(limit)
        mimic = joint.find("mimic")
        if mimic is not None:
            joint.remove(mimic)
            self._source.followers[name] = mimic.get("joint", "an unnamed joint")
        if kind in ("floating", "planar"):
            joint.set("type", "fixed")
            self._source.note(
                name, f"{kind}, and counts as fixed: the base of a machine stands still."
            )
        if kind not in ("revolute", "prismatic", "continuous"):
            return
        shape = "slide" if kind == "prismatic" else "hinge"
        given = {} if limit is None else {key: float(limit.get(key, "nan")) for key in OPTIONAL}
        found = JointLimits()
        self._source.limits[name] = found
        if kind != "continuous" and limit is not None and {"lower", "upper"} & limit.attrib.keys():
            travel = (float(limit.get("lower", 0.0)), float(limit.get("upper", 0.0)))
            set_travel(found, travel, shape, name, self._source)
        found.speed = self._choose_limit(given, "velocity", name)
        found.effort = self._choose_limit(given, "effort", name)
        if found.speed and found.speed > FASTEST[shape]:
            if found.is_doubted:
                found.speed = math.radians(found.speed)
            else:
                unit = "m/s" if shape == "slide" else "rad/s"
                self._source.note(
                    name,
                    f"the speed limit of {found.speed:g} {unit} is doubted and counts as not given.",
                )
                found.speed = None

    def _choose_limit(self, given: dict[str, float], key: str, joint: str) -> float | None:
        """Return a limit above 0 and finite; remark on one that is neither that nor missing."""
        value = given.get(key, math.nan)
        if value > 0.0 and math.isfinite(value):
            return value
        if value != 0.0 and not math.isnan(value):
            self._source.note(joint, f'{key}="{value:g}" is no limit and counts as not given.')
        return None

    def _compile(self) -> mujoco.MjModel:
        own = self._root.find("mujoco")
        if own is None:
            own = ElementTree.SubElement(self._root, "mujoco")
        for compiler in own.findall("compiler"):
            own.remove(compiler)
        ElementTree.SubElement(
            own, "compiler", fusestatic="false", discardvisual="false", strippath="true"
        )
        text = ElementTree.tostring(self._root, encoding="unicode")
        spec = mujoco.MjSpec.from_string(text, assets=self._assets)
        for mesh in spec.meshes:  # open surfaces have no volume
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        return spec.compile()


def _is_flat(shape: ElementTree.Element) -> bool:
    """Return whether a shape of a URDF has a size of 0."""
    sizes = [
        float(word)
        for part in shape.iter()
        for key in ("radius", "length", "size")
        for word in part.get(key, "").split()
    ]
    return bool(sizes) and min(sizes) <= 0.0


def _read_tensor(inertia: ElementTree.Element | None) -> np.ndarray:
    """Return the inertia tensor of a URDF, `(3, 3)`; zeros where it has none."""
    tensor = np.zeros((3, 3))
    if inertia is not None:
        for i, j in zip(*np.triu_indices(3), strict=True):
            tensor[i, j] = tensor[j, i] = float(inertia.get(f"i{'xyz'[i]}{'xyz'[j]}", 0.0))
    return tensor


def _load_mesh(file: Path, scale: np.ndarray) -> bytes | None:
    """Return a mesh file as a binary STL; `None` where it cannot be read or is too large."""
    try:
        mesh = trimesh.load(file, force="mesh", process=False)
    except Exception:  # each format of trimesh has errors of its own
        return None
    if not isinstance(mesh, trimesh.Trimesh) or not 4 <= len(mesh.faces) <= MOST_FACES:
        return None
    if np.ptp(mesh.vertices, axis=0).min() <= 0.0:  # flat: MuJoCo wants a volume
        return None
    mesh.apply_scale(scale)
    stream = io.BytesIO()
    mesh.export(stream, file_type="stl")
    return stream.getvalue()
