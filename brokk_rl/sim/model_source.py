"""A model file with what MuJoCo does not read of it; reading of an MJCF."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np

KINDS: dict[int, Literal["hinge", "slide"]] = {
    int(mujoco.mjtJoint.mjJNT_HINGE): "hinge",
    int(mujoco.mjtJoint.mjJNT_SLIDE): "slide",
}
"""Joints of which a machine is made."""
DOUBTED = {
    "hinge": (4.0 * math.pi + 0.1, "rad", "degrees", math.pi / 180.0),
    "slide": (30.0, "m", "mm", 1e-3),
}
"""Limit beyond which the unit is doubted, the unit, the one that is likely, and its factor: joints of
arms end at two turns, and axes of portals at some 20 m."""
NARROW_RAD = 0.12
"""Travel of a hinge below which radians may have been read as degrees: π becomes 0.055."""
SMALLEST_KG, SMALLEST_KG_M2 = 1e-6, 1e-9
"""Mass and inertia of frames, which MuJoCo wants to be positive."""


@dataclass
class JointLimits:
    """Limits of a joint as a file has them; `None` where it has none.

    Attributes:
        travel: Lower and upper end, rad or m.
        speed: Speed limit, rad/s or m/s.
        effort: Torque or force limit, Nm or N.
        is_doubted: Whether the numbers were converted from a unit that was guessed.
    """

    travel: tuple[float, float] | None = None
    speed: float | None = None
    effort: float | None = None
    is_doubted: bool = False


@dataclass
class ModelSource:
    """A model file as MuJoCo compiles it, with what MuJoCo does not read.

    Attributes:
        path: The file.
        model: The compiled model; fixed frames keep their names.
        limits: Of each hinge and slide, by name.
        followers: Joint that a joint follows (`<mimic>`, or `<equality>` of joints), by name.
        notes: Names of joints and links by what was mended at them.
    """

    path: Path
    model: mujoco.MjModel
    limits: dict[str, JointLimits] = field(default_factory=dict)
    followers: dict[str, str] = field(default_factory=dict)
    notes: dict[str, list[str]] = field(default_factory=dict)

    @property
    def remarks(self) -> list[str]:
        """One sentence for each kind of finding, with the names of what it is about."""
        return [f"{', '.join(names)}: {text}" for text, names in self.notes.items()]

    def note(self, name: str, text: str) -> None:
        """Note that something was mended at a joint, link or file."""
        self.notes.setdefault(text, []).append(name)


def set_travel(
    found: JointLimits, travel: tuple[float, float], kind: str, name: str, source: ModelSource
) -> None:
    """Write the ends of a joint's travel: in order, in rad, and only where there are some."""
    lower, upper = travel
    if lower > upper:
        source.note(name, f"the lower limit {lower:g} lies above the upper {upper:g}; swapped.")
        lower, upper = upper, lower
    if lower == upper or not np.isfinite(travel).all():
        source.note(name, f"limits of {travel[0]:g} and {travel[1]:g} are none.")
        return
    bound, unit, wrong, factor = DOUBTED[kind]
    if max(-lower, upper) > bound:
        found.is_doubted = True
        source.note(
            name,
            f"limits of {lower:g} to {upper:g} {unit} are doubted and read as {wrong}: "
            f"{factor * lower:.4g} to {factor * upper:.4g} {unit}. Write them in {unit}.",
        )
        lower, upper = factor * lower, factor * upper
    elif kind == "hinge" and upper - lower < NARROW_RAD:
        source.note(name, f"limits of {lower:.3g} to {upper:.3g} rad are narrow: degrees or rad?")
    found.travel = (lower, upper)


def balance_inertia(principal: np.ndarray) -> np.ndarray:
    """Return principal inertias, smallest first, that a body can have: the largest is cut."""
    return np.array([*principal[:2], 0.999 * principal[:2].sum()])


def describe_balance(principal: np.ndarray, keys: str) -> str:
    """Return a remark about principal inertias that no body has; `keys` are those to check."""
    return (
        f"an inertia that no body has ({principal[2]:.3g} exceeds {principal[0]:.3g} + "
        f"{principal[1]:.3g} kg m²); the largest is cut to their sum. Check {keys}."
    )


def read_mjcf(path: Path) -> ModelSource:
    """Return an MJCF: a machine, or a scene with machines and objects."""
    source = ModelSource(path, model=Any)  # pyright: ignore[reportArgumentType]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what MuJoCo will no longer read in a later version
        spec = mujoco.MjSpec.from_file(str(path))
        source.model = model = _compile_mended(spec, source)
    _read_mjcf_limits(source)
    for number in range(model.neq):
        pair = model.eq_obj1id[number], model.eq_obj2id[number]
        if model.eq_type[number] == mujoco.mjtEq.mjEQ_JOINT:
            leader = model.joint(int(pair[1])).name if pair[1] >= 0 else "a constant"
            source.followers[model.joint(int(pair[0])).name] = leader
    return source


def _compile_mended(spec: mujoco.MjSpec, source: ModelSource) -> mujoco.MjModel:
    """Return the compiled model, with what MuJoCo would end at mended."""
    spec.compiler.fusestatic = False
    spec.compiler.discardvisual = False
    spec.compiler.boundmass = SMALLEST_KG
    spec.compiler.boundinertia = SMALLEST_KG_M2
    _remove_missing_files(spec, source)
    _balance_inertias(spec, source)
    for joint in spec.joints:
        if joint.range[0] > joint.range[1]:
            lower, upper = joint.range
            source.note(
                joint.name, f"the lower limit {lower:g} lies above the upper {upper:g}; swapped."
            )
            joint.range = joint.range[::-1]
    return spec.compile()


def _read_mjcf_limits(source: ModelSource) -> None:
    """Read limits and efforts of the joints of an MJCF."""
    model = source.model
    for joint in range(model.njnt):
        name, kind = model.joint(joint).name, int(model.jnt_type[joint])
        found = source.limits[name] = JointLimits()
        shape = KINDS.get(kind)
        if model.jnt_limited[joint] and shape:
            lower, upper = model.jnt_range[joint]
            set_travel(found, (float(lower), float(upper)), shape, name, source)
        if model.jnt_actfrclimited[joint]:
            found.effort = float(model.jnt_actfrcrange[joint, 1])
    for actuator in range(model.nu):
        if model.actuator_trntype[actuator] != mujoco.mjtTrn.mjTRN_JOINT:
            continue
        found = source.limits[model.joint(int(model.actuator_trnid[actuator, 0])).name]
        if model.actuator_forcelimited[actuator] and not found.effort:
            found.effort = float(model.actuator_forcerange[actuator, 1])


def _remove_missing_files(spec: mujoco.MjSpec, source: ModelSource) -> None:
    """Delete meshes and textures whose files are missing, and the geoms that are drawn of them."""
    path, missing = source.path, []
    for mesh in list(spec.meshes):
        if mesh.file and not (path.parent / spec.meshdir / mesh.file).is_file():
            missing.append(mesh.file)
            for geom in [one for one in spec.geoms if one.meshname == mesh.name]:
                spec.delete(geom)
            spec.delete(mesh)
    if missing:
        source.note(
            f"{len(missing)} meshes (first: {missing[0]})",
            "not found and left out. Put them beside the file.",
        )
    for skin in list(spec.skins):
        spec.delete(skin)
    gone = set()
    for texture in list(spec.textures):
        if texture.file and not (path.parent / spec.texturedir / texture.file).is_file():
            gone.add(texture.name)
            spec.delete(texture)
    for material in spec.materials:
        material.textures = ["" if name in gone else name for name in material.textures]


def _balance_inertias(spec: mujoco.MjSpec, source: ModelSource) -> None:
    """Balance inertias that no body has."""
    for body in spec.bodies:
        order = np.argsort(body.inertia)
        principal = np.array(body.inertia)[order]
        if body.explicitinertial and principal[2] > (1.0 + 1e-6) * (principal[0] + principal[1]):
            source.note(f"body '{body.name}'", describe_balance(principal, "diaginertia"))
            balanced = np.zeros(3)
            balanced[order] = balance_inertia(principal)
            body.inertia = balanced
