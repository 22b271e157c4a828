"""A machine as a MuJoCo model: its MJCF with the machine's numbers, its drive, and who simulates it.

The MJCF holds the shapes of the links and the distribution of their mass. Every other number is
written into it from the machine's YAML, so that simulation, policy and the machine's own computer
cannot disagree.

Each joint has a servo of its own inside MuJoCo, force = stiffness (act - q) - damping q', cut off
at the yield force (the relief valve). Its reference accumulates the predicted increments. "Present
position + increment" would be wrong: any sag under load becomes the next starting point, and the
arm sinks. Within a control period the reference moves on at constant speed v (MuJoCo integrates
ctrl = v into act). It leads by v damping / stiffness, so that damping does not cost a lag.

The simulation has no gravity. The actuator model was learned on a machine that has its weight, so
its increments already contain the effect of gravity, which must not be counted twice.

MuJoCo C (`sim=native`) simulates all of MuJoCo. `sim=warp` leaves stages out, and our kernels
write the dynamics of a chain of links on servos anew. Whether that is the motion of the
machine at hand is measured when its worlds are built (`brokk_rl.sim.parity`). `FEATURES` names only
parts that act late, seldom, or in MuJoCo C as wrongly.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

from brokk_rl.errors import ConfigError
from brokk_rl.kinematics import LinkChain, compute_tool_kinematics
from brokk_rl.machine import ASSETS, Machine, find_mjcf
from brokk_rl.sim.scene import add_block, add_site

VISUAL_GROUP = 2
"""Geoms of this group are for the eye only."""
DAMPING_RATIO = 0.7
"""Of the servo against the inertia seen at the joint at home; a heavier pose is damped less."""


CONTACTS = "contact_force"
"""Name of the sensor of all contacts."""
NUM_CONTACTS, LARGEST_FIRST = 16, 2
"""Contacts of a world that are felt, and MuJoCo's number for the largest forces first. Chosen by hand:
the chisel of `brokk170` has four at most."""
MAX_SPEED, SPEED_MARGIN = 20.0, 4.0
"""Joint speed (rad/s or m/s) beyond which a world counts as diverged: forty times what `brokk170`
can do, and a multiple of what a faster machine can."""
FASTEST_MODE = 0.7
"""Largest change of phase of the drives' fastest mode in a substep, rad, that a new machine gets: the
integrator becomes unstable at 2, and `brokk170` reaches 0.9 in its worst pose."""
NUM_POSES, FRAME_TOLERANCE_M = 16, 1e-6
"""Random poses in which YAML and MJCF are compared, and the difference allowed: both are computed in
double precision."""
MAX_DOFS = 16
"""Up to here Warp unrolls the loops over degrees of freedom."""

_DISABLE = mujoco.mjtDisableBit
_NEEDED = _DISABLE.mjDSBL_ACTUATION | _DISABLE.mjDSBL_SENSOR | _DISABLE.mjDSBL_AUTORESET
"""Parts of MuJoCo that a world cannot do without: drives, contact forces from sensors, and the word
about a world that diverges."""


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
    _add_contact_sensor(spec)
    model = spec.compile()
    _check_frames(model, machine)
    add_drive(spec, machine, compute_inertia(model, machine.home).diagonal())
    return spec.compile()


def compile_machine(machine: Machine) -> mujoco.MjModel:
    """Return the model of `machine` alone, without block and drives.

    Raises:
        ConfigError: See `compile_model`.
    """
    spec = _read_mjcf(machine)
    _write_machine(spec, machine)
    return spec.compile()


def mask_normal_forces(model: mujoco.MjModel) -> np.ndarray:
    """Return 1 for the normal forces of contacts among `sensordata`, else 0; sum them up."""
    chosen = np.zeros(model.nsensordata)
    sensor = model.sensor(CONTACTS)
    chosen[int(sensor.adr[0]) : int(sensor.adr[0] + sensor.dim[0]) : 3] = 1.0
    return chosen


def list_touching(model: mujoco.MjModel) -> list[str]:
    """Return the names of the bodies that move and may touch something."""
    can_touch = (model.geom_contype | model.geom_conaffinity) != 0
    bodies = np.unique(model.geom_bodyid[can_touch])
    moves = model.body_dofnum[model.body_weldid[bodies]] > 0
    return [model.body(body).name for body in bodies[moves]]


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


def _check_frames(model: mujoco.MjModel, machine: Machine) -> None:
    """Refuse a model whose joints or tool point do not stand where the machine's YAML has them.

    A policy is judged by the kinematics of the YAML; the simulated tool must be there.

    Raises:
        ConfigError: They differ in random poses; the message names the first joint.
    """
    chain, data = LinkChain(machine.joints), mujoco.MjData(model)
    poses = np.random.default_rng(0).uniform(machine.lower, machine.upper, (NUM_POSES, model.nq))
    tips_m = compute_tool_kinematics(machine, poses).tip_in_base_m
    names = [*machine.joint_names, "tip"]
    found_m = np.zeros((NUM_POSES, len(names), 3))
    for row, q in enumerate(poses):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        for column, name in enumerate(machine.joint_names):
            found_m[row, column] = data.xpos[model.joint(name).bodyid[0]]
        found_m[row, -1] = data.site("tip").xpos
    expected_m = np.concatenate((chain.place(poses).place_m, tips_m[:, None]), 1)
    away_m = np.linalg.norm(found_m - expected_m, axis=-1).max(0)
    if (away_m <= FRAME_TOLERANCE_M).all():
        return
    first = int((away_m > FRAME_TOLERANCE_M).argmax())
    # a link that is turned moves what hangs on it, not its own origin
    joint = names[max(0, first - 1)]
    raise ConfigError(
        f"machine {machine.name}: expected {names[first]} of {machine.mjcf} where the machine's YAML has "
        f"it, got it {away_m[first]:.3g} m away in random poses: joint {joint} stands or turns otherwise; "
        "change euler, quat or ref of its link, or pos of what carries it"
    )


def _add_contact_sensor(spec: mujoco.MjSpec) -> None:
    """Feel every contact, in the place of the sensors that the MJCF has."""
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    force = 1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE)
    sensor = spec.add_sensor(name=CONTACTS, type=mujoco.mjtSensor.mjSENS_CONTACT)
    sensor.intprm = [force, LARGEST_FIRST, NUM_CONTACTS]


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
    # what gravity does to the motion is in the actuator model, see the head of this module
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


# the drive


def compute_inertia(model: mujoco.MjModel, q: np.ndarray) -> np.ndarray:
    """Return the mass matrix of an arm at `q`, `(J, J)`, kg m² or kg."""
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    return full


def find_fastest_mode(
    model: mujoco.MjModel, stiffness: np.ndarray, poses: np.ndarray
) -> tuple[float, int]:
    """Return the fastest mode of an arm on its drives, rad/s, and the joint that moves most in it.

    Coupled joints swing faster than each alone: what counts is the largest eigenvalue of M⁻¹ K.

    Args:
        model: Model of the arm alone.
        stiffness: Of each drive, `(J,)`, Nm/rad or N/m.
        poses: Poses to look at, `(P, J)`.
    """
    fastest, joint = 0.0, 0
    for q in poses:
        # symmetric: K^½ M⁻¹ K^½
        root = np.sqrt(stiffness)
        inverse = np.linalg.inv(compute_inertia(model, q))
        values, vectors = np.linalg.eigh(root[:, None] * inverse * root)
        if values[-1] > fastest:
            fastest, joint = float(values[-1]), int(np.abs(vectors[:, -1]).argmax())
    return float(np.sqrt(fastest)), joint


def add_drive(spec: mujoco.MjSpec, machine: Machine, inertia: np.ndarray) -> None:
    """Add one servo per joint, in machine order.

    Args:
        spec: Model with the joints.
        machine: Gives stiffness and yield force.
        inertia: Inertia seen at each joint, `(J,)`, kg m² or kg.
    """
    for joint, body, seen in zip(machine.joints, machine.bodies, inertia, strict=True):
        stiffness = body.stiffness.value
        damping = 2.0 * DAMPING_RATIO * float(np.sqrt(stiffness * seen))
        actuator = spec.add_actuator(
            name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        actuator.set_to_intvelocity(kp=stiffness, kv=damping)
        actuator.actlimited = mujoco.mjtLimited.mjLIMITED_FALSE
        actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
        actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        actuator.forcerange = (-body.yield_force.value, body.yield_force.value)


class DriveReferences:
    """References of all drives of all worlds; every update is in place.

    Args:
        model: Compiled model with the servos.
        machine: Gives the control period and yield forces.
        num_worlds: `N`.
        device: Where the worlds live.
        dtype: Type in which the reference accumulates.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        machine: Machine,
        num_worlds: int,
        device: torch.device | str,
        dtype: torch.dtype,
    ) -> None:
        stiffness, damping = model.actuator_gainprm[:, 0], -model.actuator_biasprm[:, 2]

        def constant(values: np.ndarray) -> torch.Tensor:
            return torch.tensor(values, dtype=dtype, device=device)

        self.reference = torch.zeros(num_worlds, machine.num_joints, dtype=dtype, device=device)
        self._rate = 1.0 / machine.period_s
        self._max_speed = max(MAX_SPEED, SPEED_MARGIN * float(machine.max_speed.max()))
        self._lead = constant(damping / stiffness)
        self._leash = constant(
            np.array([body.yield_force.value for body in machine.bodies]) / stiffness
        )

    def set_servos(
        self, stiffness: torch.Tensor, damping: torch.Tensor, yield_force: torch.Tensor
    ) -> None:
        """Give each world servos of its own, each argument `(N, J)` or `(J,)`.

        The first call makes room for them, later ones write in place.
        """
        if self._lead.dim() == 1:
            self._lead = self._lead.expand_as(self.reference).clone()
            self._leash = self._leash.expand_as(self.reference).clone()
        self._lead.copy_(damping / stiffness)
        self._leash.copy_(yield_force / stiffness)

    def step(
        self, q: torch.Tensor, increment: torch.Tensor, act: torch.Tensor, ctrl: torch.Tensor
    ) -> None:
        """Move the references on by one control period.

        The reference never leads the joint by more than the lead that opens the relief valve. So a
        blocked joint does not wind up.

        Args:
            q: Present positions, `(N, J)`.
            increment: Predicted motion over the coming period, `(N, J)`.
            act: Written: activations at the start of the period, `(N, J)`.
            ctrl: Written: reference speeds, `(N, J)`.
        """
        reference = self.reference
        torch.clamp(reference, q - self._leash, q + self._leash, out=reference)
        ctrl.copy_(increment).mul_(self._rate)
        torch.addcmul(reference, self._lead, ctrl, out=act)
        reference.add_(increment)

    def diverged(self, speeds: torch.Tensor) -> torch.Tensor:
        """Return diverged worlds, `(N,)` bool, whose `measure_speeds`, `(N, J)`, are absurd or NaN."""
        return (speeds.amax(1) <= self._max_speed).logical_not_()

    def measure_speeds(self, qvel: torch.Tensor) -> torch.Tensor:
        """Return sizes of joint speeds `(N, J)`, NaN also where a reference is not finite.

        The references count because the cut-off at the yield force turns NaN into a force that
        looks sound.
        """
        return self.reference.mul(0.0).add_(qvel).abs_()

    def reset(self, mask: torch.Tensor, q: torch.Tensor) -> None:
        """Put the references of the worlds of `mask`, `(N,)` bool, to `q`, `(N, J)`."""
        torch.where(mask[:, None], q.to(self.reference.dtype), self.reference, out=self.reference)


# what backends leave out


FEATURES: dict[str, tuple[Callable[[mujoco.MjModel], Any], bool]] = {
    "a flag actuation=disable, sensor=disable or autoreset=disable": (
        lambda model: model.opt.disableflags & _NEEDED,
        False,
    ),
    "mocap bodies of its own": (lambda model: model.nmocap > 1, False),
    "flags that switch a part of MuJoCo on": (lambda model: model.opt.enableflags, True),
    "friction in joints": (lambda model: model.dof_frictionloss.any(), True),
    "springs that yield": (lambda model: model.nplastic or model.jnt_springyield.any(), True),
    "tendons": (lambda model: model.ntendon, True),
    "equalities": (lambda model: model.neq, True),
    "deformable bodies": (lambda model: model.nflex, True),
    "plugins": (lambda model: model.nplugin, True),
    "branches": (lambda model: (np.diff(model.dof_parentid) != 1).any(), True),
    f"more than {MAX_DOFS} joints": (lambda model: model.nv > MAX_DOFS, True),
}
"""By name: whether a model has the part, and whether `sim=native` simulates it; `sim=warp` does not.
Found by comparing the sources of MuJoCo 4.0.0 and mujoco_warp 4.0.0."""


def check_simulated(model: mujoco.MjModel, machine: str, is_warp: bool) -> None:
    """Raise a `ConfigError` for a model with parts that a simulator leaves out.

    Args:
        model: The compiled model.
        machine: Name of the machine, for the message.
        is_warp: Whether `sim=warp` is about to simulate it; else `sim=native`.
    """
    found = {}
    for name, (is_used, is_native) in FEATURES.items():
        if is_used(model) and (is_warp or not is_native):
            found[name] = is_native
    if found:
        name, instead = "sim=warp" if is_warp else "sim=native", ""
        if all(found.values()):
            instead = ", or choose sim=native"
        raise ConfigError(
            f"machine {machine}: {name} simulates a chain of links driven by servos, but the MJCF "
            f"has {', '.join(found)}; remove that from the MJCF{instead}"
        )
