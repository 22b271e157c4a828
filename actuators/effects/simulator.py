"""Effects on numbers inside of an MJCF file: friction, damping, armature, gain and limit of its drives.

They exist around `diagnosis.own_simulator` only. The way back is a change of the file.
"""

from __future__ import annotations

from types import MappingProxyType
from typing import ClassVar

from actuators.effects.drives import DriveEffect
from actuators.effects.effect import ANY_INTERFACE
from actuators.effects.ranges import EffectNumber
from brokk_rl.spec import spec


class _InsideEffect(DriveEffect):
    """An effect that writes one number of the plant."""

    interfaces = ANY_INTERFACE


@spec
class JointFriction(_InsideEffect):
    """Coulomb friction in the joint: `frictionloss`.

    Attributes:
        joints: Joints it acts on, or `all`.
        part: Torque of the friction, over the torque of the drive at an error of 5 % of the travel
            (position), at full speed (velocity) or at full command (torque).
    """

    drives = MappingProxyType({"part": "friction"})
    # Chosen by hand: the drive stops 0.75 % of the travel from its target.
    numbers: ClassVar = {"part": EffectNumber("1", none=0.0, typical=0.15, bounds=(0.0, 2.0))}


@spec
class JointDamping(_InsideEffect):
    """Viscous friction in the joint: `damping`.

    Attributes:
        joints: Joints it acts on, or `all`.
        part: Torque at full speed, over the same torque of the drive; negative where the file damps more
            than the robot.
    """

    drives = MappingProxyType({"part": "damping"})
    # Chosen by hand: at full speed the drive lags by 1 % of the travel more.
    numbers: ClassVar = {"part": EffectNumber("1", none=0.0, typical=0.2, bounds=(-5.0, 5.0))}


@spec
class JointArmature(_InsideEffect):
    """Inertia of rotor and gear: `armature`.

    Attributes:
        joints: Joints it acts on, or `all`.
        part: Added inertia over that of the joint in the file's own pose.
    """

    drives = MappingProxyType({"part": "armature"})
    # Chosen by hand: a rotor behind a gear of some hundreds doubles the inertia of a small arm.
    numbers: ClassVar = {"part": EffectNumber("1", none=0.0, typical=0.5, bounds=(0.0, 20.0))}


@spec
class DriveGain(_InsideEffect):
    """Stiffness of the drive: `kp`, `kv` or the gain of a motor.

    Attributes:
        joints: Joints it acts on, or `all`.
        gain: Factor.
    """

    drives = MappingProxyType({"gain": "gain"})
    # Chosen by hand: a battery that sags takes a fifth of the voltage.
    numbers: ClassVar = {"gain": EffectNumber("1", none=1.0, typical=0.8, bounds=(0.1, 5.0))}


@spec
class DriveLimit(_InsideEffect):
    """Largest force of the drive: `forcerange`, as narrow or narrower than that of the file.

    Attributes:
        joints: Joints it acts on, or `all`.
        shortage: Torque of the drive at an error of 5 % of the travel (position), at full speed
            (velocity) or at full command (torque), over its largest torque; 0 for no limit.
    """

    drives = MappingProxyType({"shortage": "limit"})
    # As `torque_limit` around a servo; a drive at its full command is limited from 1 on.
    numbers: ClassVar = {"shortage": EffectNumber("1", none=0.0, typical=2.0, bounds=(0.0, 20.0))}


EFFECTS = MappingProxyType(
    {
        kind.name(): kind
        for kind in (JointFriction, JointDamping, JointArmature, DriveGain, DriveLimit)
    }
)
"""The effects by name."""
