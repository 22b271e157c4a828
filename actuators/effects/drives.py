"""Effects on drives: joints that are commanded by force or torque.

They change the mass or the friction of the simulated drive itself, which solves both together: friction
that stops a joint within a period cannot be put around a model that does not know of it.
"""

from types import MappingProxyType
from typing import ClassVar

from actuators.effects.effect import EffectSpec
from actuators.effects.ranges import EffectNumber, Joints, Value
from brokk_rl.spec import spec


@spec
class CoulombFriction(EffectSpec):
    """Dry friction of a drive: a force against the motion, the same at all speeds.

    Attributes:
        joints: Joints it acts on, or `all`.
        coulomb_n: Friction beyond that of the simulator (Nm of a hinge).
    """

    joints: Joints
    coulomb_n: Value
    side = "drive"
    interfaces = frozenset({"torque"})
    drives = MappingProxyType({"coulomb_n": "coulomb_n"})
    numbers: ClassVar = {
        # Gears and screws lose some percent of the largest force.
        "coulomb_n": EffectNumber("N", none=0.0, typical=0.05, bounds=(0.0, 0.5), scale="force")
    }


@spec
class ViscousFriction(EffectSpec):
    """Friction of a drive in proportion to its speed; the back EMF of a voltage-fed motor is one too.

    Attributes:
        joints: Joints it acts on, or `all`.
        viscous_n_s_m: Friction beyond that of the simulator (Nm s/rad of a hinge).
    """

    joints: Joints
    viscous_n_s_m: Value
    side = "drive"
    interfaces = frozenset({"torque"})
    drives = MappingProxyType({"viscous_n_s_m": "viscous_n_s_m"})
    numbers: ClassVar = {
        # The same loss as dry friction, at full speed.
        "viscous_n_s_m": EffectNumber(
            "N s/m", none=0.0, typical=0.05, bounds=(0.0, 1.0), scale="viscosity"
        )
    }


@spec
class Inertia(EffectSpec):
    """Another mass than that of the simulator: a load, or a rotor behind a gear (armature).

    Attributes:
        joints: Joints it acts on, or `all`.
        factor: Mass over that of the simulator.
    """

    joints: Joints
    factor: Value
    side = "drive"
    interfaces = frozenset({"torque"})
    drives = MappingProxyType({"factor": "mass_kg"})
    numbers: ClassVar = {"factor": EffectNumber("1", none=1.0, typical=1.3, bounds=(0.2, 5.0))}


@spec
class ForceOffset(EffectSpec):
    """A constant force against the positive direction: weight, or an amplifier that is off its zero.

    Attributes:
        joints: Joints it acts on, or `all`.
        offset_n: Force beyond that of the simulator (Nm of a hinge).
    """

    joints: Joints
    offset_n: Value
    side = "drive"
    interfaces = frozenset({"torque"})
    drives = MappingProxyType({"offset_n": "offset_n"})
    numbers: ClassVar = {
        "offset_n": EffectNumber("N", none=0.0, typical=0.02, bounds=(-0.5, 0.5), scale="force")
    }
