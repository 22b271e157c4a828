"""Compilation of a machine and its MJCF to a MuJoCo model.

The MJCF holds the shapes of the links and the distribution of their mass. Every other number is
written into it from the machine's YAML, so that simulation, policy and the machine's own computer
cannot disagree.

"""

from pathlib import Path

import mujoco
import numpy as np

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.registry import find_packages, resolve_package_path
from brokk_rl.sim.drive import add_drive, compute_inertia
from brokk_rl.sim.scene import add_block, add_site

ASSETS = Path(__file__).parent / "assets"
VISUAL_GROUP = 2
"""Geoms of this group are for the eye only."""


def compile_model(
    machine: Machine, timestep_s: float, visual: bool = False, site: Path | None = None
) -> mujoco.MjModel:
    """Return the model of `machine` at a work site with a block.

    Args:
        machine: The machine.
        timestep_s: Length of a substep.
        visual: Keep geoms, cameras and lights that only pictures need. The physics is the same
            without them, and faster.
        site: MJCF of what stands beside the block.

    Raises:
        ConfigError: The MJCF is missing or its joints are not those of the machine.
    """
    spec = _read_mjcf(machine)
    _write_machine(spec, machine)
    add_block(spec, visual)
    add_site(spec, site)
    _write_options(spec, timestep_s)
    if not visual:
        _remove_visuals(spec)
    model = spec.compile()
    _check_touch(model, machine)
    add_drive(spec, machine, compute_inertia(model, machine.home).diagonal())
    return spec.compile()


def find_mjcf(machine: Machine) -> Path:
    """Return the path of the machine's MJCF.

    A file name is looked up in this package, then beside the machines of installed extensions.

    Raises:
        ConfigError: The machine names none, or there is no such file.
    """
    if machine.mjcf is None:
        raise ConfigError(
            f"machine {machine.name} has no MJCF and cannot be simulated; set `mjcf`, or choose "
            "another machine=…"
        )
    beside = [folder / "machine" for folder in find_packages().values()]
    for folder in (ASSETS, *beside):
        path = folder / resolve_package_path(machine.mjcf)
        if path.is_file():
            return path
    raise ConfigError(
        f"machine {machine.name}: there is no MJCF '{machine.mjcf}'; set `mjcf` to the name of a file "
        "beside the machine's YAML in a config package, to package:path, or to an absolute path"
    )


def mask_contact_sensors(model: mujoco.MjModel) -> np.ndarray:
    """Return 1 for the touch sensors among `sensordata`, else 0.

    The sum of the touch sensors is the contact force.
    """
    chosen = np.zeros(model.nsensordata)
    chosen[model.sensor_adr[model.sensor_type == mujoco.mjtSensor.mjSENS_TOUCH]] = 1.0
    return chosen


def list_touching(model: mujoco.MjModel) -> list[int]:
    """Return the bodies that move and may touch something."""
    can_touch = (model.geom_contype | model.geom_conaffinity) != 0
    moving = {
        int(body)
        for body in model.geom_bodyid[can_touch]
        if model.body_dofnum[model.body_weldid[body]]
    }
    return sorted(moving)


def _read_mjcf(machine: Machine) -> mujoco.MjSpec:
    path = find_mjcf(machine)
    try:  # included rather than attached, so that names stay as the MJCF gives them
        includes = "".join(f'<include file="{file}"/>' for file in (ASSETS / "worksite.xml", path))
        spec = mujoco.MjSpec.from_string(f"<mujoco>{includes}</mujoco>")
    except ValueError as error:
        raise ConfigError(f"machine {machine.name}: {path} is not a valid MJCF: {error}") from error
    spec.modelfiledir = str(path.parent)
    found = [joint.name for joint in spec.joints]
    if found != list(machine.joint_names):
        missing = [name for name in machine.joint_names if name not in found]
        extra = [name for name in found if name not in machine.joint_names]
        raise ConfigError(
            f"machine {machine.name}: the joints of {path.name} ({', '.join(found)}) are not "
            "those of the machine "
            f"({', '.join(machine.joint_names)}); missing: {', '.join(missing) or 'none'}, "
            f"unknown: {', '.join(extra) or 'none'}"
        )
    if spec.actuators:
        raise ConfigError(
            f"machine {machine.name}: {path.name} has actuators "
            f"({', '.join(actuator.name or 'without a name' for actuator in spec.actuators)}), but the "
            "drive of each joint follows from the machine's YAML; remove <actuator> from the MJCF"
        )
    if spec.site("tip") is None:
        raise ConfigError(
            f"machine {machine.name}: {path.name} has no site 'tip' for the tool point"
        )
    return spec


def _check_touch(model: mujoco.MjModel, machine: Machine) -> None:
    """Raise a `ConfigError` where a link can touch something and no touch sensor would feel it."""
    is_touch = model.sensor_type == mujoco.mjtSensor.mjSENS_TOUCH
    felt = {int(model.site_bodyid[site]) for site in model.sensor_objid[is_touch]}
    if missing := [body for body in list_touching(model) if body not in felt]:
        raise ConfigError(
            f"machine {machine.name}: geoms of {', '.join(model.body(i).name for i in missing)} can touch "
            "the block, but no touch sensor feels it; add a site around them and a <touch> sensor to "
            'the MJCF, or give these geoms contype="0" conaffinity="0"'
        )


def _write_machine(spec: mujoco.MjSpec, machine: Machine) -> None:
    """Write origins, axes, limits, masses and the tool point into `spec`."""
    drawn = spec.copy().compile()
    links = [spec.joint(name).parent for name in machine.joint_names]
    ends = [_read_values(body.origin_m) for body in machine.bodies[1:]] + [machine.tip_m]
    for joint, body, link, end, drawn_end in zip(
        machine.joints,
        machine.bodies,
        links,
        ends,
        [*(b.pos for b in links[1:]), spec.site("tip").pos],
        strict=True,
    ):
        _scale_geoms(link, np.array(drawn_end), end)
        _write_inertia(link, drawn, body.mass_kg.value, body.com_m)
        link.pos = _read_values(body.origin_m)
        hinge = spec.joint(joint.name)
        hinge.type = (
            mujoco.mjtJoint.mjJNT_HINGE if joint.kind == "hinge" else mujoco.mjtJoint.mjJNT_SLIDE
        )
        hinge.axis, hinge.pos = body.axis, (0.0, 0.0, 0.0)
        hinge.limited, hinge.range = (
            mujoco.mjtLimited.mjLIMITED_TRUE,
            (joint.lower.value, joint.upper.value),
        )
    spec.site("tip").pos = machine.tip_m


def _read_values(dimensions: tuple) -> np.ndarray:
    return np.array([d.value for d in dimensions])


def _scale_geoms(link: mujoco.MjsBody, drawn_end: np.ndarray, end: np.ndarray) -> None:
    """Scale the geoms of a link along it when its length differs from the one drawn in the MJCF."""
    drawn_length, length = np.linalg.norm(drawn_end), np.linalg.norm(end)
    if drawn_length < 1e-9 or abs(length - drawn_length) < 1e-9:
        return
    along, factor = drawn_end / drawn_length, length / drawn_length

    def scaled(point: np.ndarray) -> np.ndarray:
        return point + (factor - 1.0) * along * (along @ point)

    for geom in link.geoms:
        if np.isfinite(geom.fromto[0]):
            geom.fromto = np.concatenate([scaled(geom.fromto[:3]), scaled(geom.fromto[3:])])
            continue
        geom.pos = scaled(geom.pos)
        if geom.type == mujoco.mjtGeom.mjGEOM_BOX:
            axes = np.zeros(9)
            mujoco.mju_quat2Mat(axes, geom.quat)
            geom.size = geom.size * (1.0 + (factor - 1.0) * np.abs(along @ axes.reshape(3, 3)) ** 2)


def _write_inertia(
    link: mujoco.MjsBody, drawn: mujoco.MjModel, mass_kg: float, com_m: tuple[float, float, float]
) -> None:
    """Write mass and centre of mass of a link; its inertia is the MJCF's, scaled with the mass."""
    body = drawn.body(link.name)
    if body.mass[0] <= 0.0:
        raise ConfigError(
            f"link '{link.name}' of the MJCF has no mass: give it an <inertial> or a geom with "
            "density"
        )
    link.explicitinertial = True
    link.mass, link.ipos, link.iquat = mass_kg, com_m, body.iquat
    link.inertia = body.inertia * (mass_kg / body.mass[0])


def _write_options(spec: mujoco.MjSpec, timestep_s: float) -> None:
    option = spec.option
    option.timestep = timestep_s
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # a pyramid's friction depends on how its edges lie, which MuJoCo C and MuJoCo Warp choose
    # differently
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    # what gravity does to the motion is in the actuator model, see `brokk_rl.sim.drive`
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_GRAVITY


def _remove_visuals(spec: mujoco.MjSpec) -> None:
    """Remove geoms, cameras and lights that only pictures need."""
    for geom in [g for g in spec.geoms if g.group == VISUAL_GROUP]:
        spec.delete(geom)
    for thing in [*spec.cameras, *spec.lights]:
        spec.delete(thing)
    used = {geom.meshname for geom in spec.geoms}
    for mesh in [one for one in spec.meshes if one.name not in used]:
        spec.delete(mesh)
