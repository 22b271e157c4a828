"""DC motor behind a gear, commanded by its duty: a drive of `actuators.models.force_drive` with a motor circuit.

    force = max_force (duty share - speed / no_load), at most force_limit either way
    share = supply voltage under load over that without load

`max_force` of the machine is the force at full duty and standstill. From a data sheet (supply voltage V,
winding R, torque constant k, gear ratio n): `max_force = k n V / R`, `no_load = V / (k n)`, `force_limit =
k n` times the largest current; `mass_kg` of the load includes the rotor's inertia times n^2.
The inductance is left out: its time constant is below a millisecond. Losses of the gear are friction of the
load. Source: "MuJoCo DC Motor Model", Google DeepMind, equations 1 and 2.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch

from actuators.models.force_drive import ForceDrive, ForceDriveModel
from actuators.models.parameters import PerJoint, expand_per_joint
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.spec import spec


@spec
class DcMotor:
    """DC motors on one supply; a command is a duty.

    Attributes:
        load: Mass, friction and weight behind the gear; its dead time is that of the motor.
        no_load_m_s: Speed at full duty without a load (rad/s of a hinge); `null` takes the machine's
            `max_speed`.
        force_limit_n: Force at the largest current (Nm of a hinge); `null` for no limit.
        supply_share: Resistance of the supply and its cable, which all motors share, over that of a
            winding: the voltage drops to 1 / (1 + share) while one motor stalls.
    """

    label: ClassVar = "dc_motor"
    interfaces: ClassVar = frozenset({"torque"})

    load: ForceDrive
    no_load_m_s: PerJoint | None
    force_limit_n: PerJoint | None
    supply_share: PerJoint

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> ForceDriveModel:
        """Return a model for `num_envs` environments on `device`.

        Raises:
            ConfigError: the machine is not commanded by torque, or a number makes no sense.
        """
        model = self.load.build(machine, num_envs, device)

        def read(name: str, absent: np.ndarray, least: float) -> torch.Tensor:
            value = getattr(self, name)
            found = (
                absent if value is None else expand_per_joint(value, machine, f"actuator.{name}")
            )
            if (found < least).any():
                raise ConfigError(f"actuator.{name}: expected > 0, got {found.tolist()}")
            return torch.as_tensor(found, dtype=torch.float32, device=device)

        least = np.finfo(float).tiny  # above 0
        no_load = read("no_load_m_s", machine.max_speed, least)
        limit = read("force_limit_n", np.full(machine.num_joints, np.inf), least)
        share = read("supply_share", np.zeros(machine.num_joints), 0.0)
        stall = torch.as_tensor(machine.max_force, dtype=torch.float32, device=device)
        model.motor = MotorCircuit(stall, no_load, limit, share)
        return model


@dataclass(frozen=True, eq=False)
class MotorCircuit:
    """Force of motors as a function of duty and speed; all `(J,)`.

    Attributes:
        stall: Force at full duty and standstill, N or Nm.
        no_load: Speed at full duty without a load.
        limit: Largest force.
        supply_share: Resistance of the supply over that of a winding.
    """

    stall: torch.Tensor
    no_load: torch.Tensor
    limit: torch.Tensor
    supply_share: torch.Tensor

    @property
    def back_emf(self) -> torch.Tensor:
        """Loss of force over speed, N s/m or Nm s/rad: viscous friction, while no limit is reached."""
        return self.stall / self.no_load

    def compute_stall(self, duty: torch.Tensor, speed: torch.Tensor) -> torch.Tensor:
        """Return the force at standstill under the voltage that the supply has left, `(N, J)`.

        A motor draws `duty current` from the supply, and its current follows the voltage:
        `share = 1 - sum supply_share duty (duty share - speed / no_load)`, solved for `share`. What
        braking motors feed back does not raise the voltage.
        """
        fed_back = (self.supply_share * duty * speed / self.no_load).sum(1, keepdim=True)
        drawn = (self.supply_share * duty.square()).sum(1, keepdim=True)
        return self.stall * duty * ((1.0 + fed_back) / (1.0 + drawn)).clamp(max=1.0)
