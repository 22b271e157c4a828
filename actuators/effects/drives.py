"""Effects on drives: joints that are commanded by force or torque, and servos.

They change mass, friction or torque of the simulated drive itself, which solves all together: friction
that stops a joint within a period cannot be put around a model that does not know of it.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar

from actuators.effects.effect import EffectSpec
from actuators.effects.ranges import EffectNumber
from brokk_rl.spec import spec


class DriveEffect(EffectSpec):
    """An effect that changes numbers of a drive.

    Attributes:
        drives: Number of the drive that each of its numbers changes, where the names differ.
    """

    side = "drive"
    interfaces = frozenset({"torque"})
    drives: ClassVar[Mapping[str, str]] = MappingProxyType({})


@spec
class CoulombFriction(DriveEffect):
    """Dry friction of a drive: a force against the motion, the same at all speeds.

    Attributes:
        joints: Joints it acts on, or `all`.
        coulomb_n: Friction beyond that of the simulator (Nm of a hinge).
    """

    numbers: ClassVar = {
        # Gears and screws lose some percent of the largest force.
        "coulomb_n": EffectNumber("N", none=0.0, typical=0.05, bounds=(0.0, 0.5), scale="force")
    }


@spec
class ViscousFriction(DriveEffect):
    """Friction of a drive in proportion to its speed; the back EMF of a voltage-fed motor is one too.

    Attributes:
        joints: Joints it acts on, or `all`.
        viscous_n_s_m: Friction beyond that of the simulator (Nm s/rad of a hinge).
    """

    numbers: ClassVar = {
        # The same loss as dry friction, at full speed.
        "viscous_n_s_m": EffectNumber(
            "N s/m", none=0.0, typical=0.05, bounds=(0.0, 1.0), scale="viscosity"
        )
    }


@spec
class Inertia(DriveEffect):
    """Another mass than that of the simulator: a load, or a rotor behind a gear (armature).

    Attributes:
        joints: Joints it acts on, or `all`.
        factor: Mass over that of the simulator.
    """

    drives = MappingProxyType({"factor": "mass_kg"})
    numbers: ClassVar = {"factor": EffectNumber("1", none=1.0, typical=1.3, bounds=(0.2, 5.0))}


@spec
class Damping(DriveEffect):
    """Another damping of a position servo: the derivative gain of its firmware, back EMF, viscous friction.

    With less of it a joint overshoots its target; with more it comes later.

    Attributes:
        joints: Joints it acts on, or `all`.
        factor: Damping over that of the simulator.
    """

    interfaces = frozenset({"position"})
    drives = MappingProxyType({"factor": "damping"})
    numbers: ClassVar = {"factor": EffectNumber("1", none=1.0, typical=0.6, bounds=(0.1, 5.0))}


@spec
class ForceOffset(DriveEffect):
    """A constant force against the positive direction: weight, or an amplifier that is off its zero.

    Attributes:
        joints: Joints it acts on, or `all`.
        offset_n: Force beyond that of the simulator (Nm of a hinge).
    """

    numbers: ClassVar = {
        "offset_n": EffectNumber("N", none=0.0, typical=0.02, bounds=(-0.5, 0.5), scale="force")
    }


@spec
class StribeckFriction(DriveEffect):
    """Dry friction of a drive that is larger at rest than in motion: it starts with a jerk and creeps in steps.

    It falls with the speed as `stribeck_m_s` of the simulated drive says.

    Attributes:
        joints: Joints it acts on, or `all`.
        stribeck_n: Friction at rest beyond that of the simulator (Nm of a hinge).
    """

    numbers: ClassVar = {
        # At rest 1.2 to 2 times the friction in motion, which is 5 % of the largest force.
        "stribeck_n": EffectNumber("N", none=0.0, typical=0.03, bounds=(0.0, 0.5), scale="force")
    }


@spec
class LoadFriction(DriveEffect):
    """Dry friction of a gear that grows with the force through it.

    Duclusaud, Passault, Padois and Ly, ICRA 2025, models M3 and M5; see `actuators.models.friction`.

    Attributes:
        joints: Joints it acts on, or `all`.
        motor_load: Friction over the force of the motor, beyond that of the simulator.
        outside_load: The same over the weight on the joint.
    """

    numbers: ClassVar = {
        # Gears of servos lose 2 to 20 % of the torque; from 1 on the motor moves nothing.
        "motor_load": EffectNumber("1", none=0.0, typical=0.1, bounds=(0.0, 0.9)),
        "outside_load": EffectNumber("1", none=0.0, typical=0.1, bounds=(0.0, 0.9)),
    }


@spec
class PoseForce(DriveEffect):
    """Weight on a drive that changes with the position of its joint.

    Attributes:
        joints: Joints it acts on, or `all`.
        pose_sin_n: Force against the positive direction that follows the sine of the angle from
            mid-travel (Nm), or the place in the travel of a sliding joint.
        pose_cos_n: The same with the cosine of the angle less 1; nothing on a sliding joint.
    """

    numbers: ClassVar = {
        # A servo that bears a tenth of its largest torque in the outermost pose.
        "pose_sin_n": EffectNumber("N", none=0.0, typical=0.1, bounds=(-1.0, 1.0), scale="force"),
        "pose_cos_n": EffectNumber("N", none=0.0, typical=0.1, bounds=(-1.0, 1.0), scale="force"),
    }


@spec
class TorqueLimit(DriveEffect):
    """A servo that pulls no harder from some error on: a limit in its firmware, a weak motor or supply.

    Weight acts beside the pull: a joint comes up slower than down, and falls where the limit is below
    its sag. `sag` as another effect shifts the target and does not load the motor here.

    Attributes:
        joints: Joints it acts on, or `all`.
        shortage: Error of 5 % of the travel over the error at which the torque is at its limit; 0 for no
            limit, 1 for a limit at that error.
        firmware_damping: Part of the servo's damping within the limit; see `actuators.models.servo`.
    """

    interfaces = frozenset({"position"})
    numbers: ClassVar = {
        # STS3215: 20 % of its 2.9 Nm over 24 to 40 Nm/rad are reached at 0.02 rad, 2.5 % of a travel
        # of 0.8 rad. The largest is 0.25 % of the travel, where an arm falls.
        "shortage": EffectNumber("1", none=0.0, typical=2.0, bounds=(0.0, 20.0)),
        # The derivative gain is within a limit of the duty, back EMF is not: about as large on STS3215.
        "firmware_damping": EffectNumber(
            "1", none=None, typical=0.5, bounds=(0.0, 1.0), trials=(0.5,)
        ),
    }
