"""Mass behind a motor that is commanded by force or torque, joint by joint.

    mass q'' = max_force u(t - dead_time) - viscous q' - dry sign(q') - weight(q)
    weight   = offset + pose_sin sin(angle) + pose_cos (cos(angle) - 1)

`angle` counts from the middle of the travel; a sliding joint has its place in the travel, from -1 to 1,
for the sine and 0 for the last term. `dry` is Coulomb friction, and what `actuators.models.friction` adds.
A command acts for a whole control period. The speed is solved implicitly over the period, so that viscous
friction of any size is stable and dry friction brings a joint exactly to rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch

from actuators.models.friction import STRIBECK_SPEED, compute_dry_friction
from actuators.models.joint_model import ParametricModel
from actuators.models.parameters import (
    NonNegativePerJoint,
    PerJoint,
    PositivePerJoint,
    select_commands_in_force,
)
from brokk_rl.errors import ConfigError
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.spec import spec

SPEED_SAMPLES = 5
"""Positions from which a free run takes the speed that it begins with, by a parabola. Fewer take up the
noise of the encoder, more its acceleration; on the linear drive EMPS 4 to 7 differ by 2 % of the mass."""


@spec
class ForceDrive:
    """Mass with friction and weight, driven by the command.

    Attributes:
        dead_time_s: Time until a command acts; `null` takes the machine's.
        mass_kg: Mass, or inertia in kg m² of a hinge, motor and gear included.
        viscous_n_s_m: Viscous friction (Nm s/rad of a hinge).
        coulomb_n: Coulomb friction (Nm of a hinge).
        offset_n: Constant force against the positive direction: weight in the middle of the travel, or an
            offset of the motor.
        pose_sin_n: Weight that follows the sine of the angle from there (the place in the travel of a
            sliding joint).
        pose_cos_n: Weight that follows its cosine, less 1.
        stribeck_n: Dry friction at rest beyond Coulomb friction.
        stribeck_m_s: Speed at which a third of it is left (rad/s of a hinge); `null` takes a twentieth of
            the machine's `max_speed`.
        stribeck_power: Power of the speed in the exponential by which it falls.
        motor_load: Dry friction over the force of the motor, see `actuators.models.friction`.
        outside_load: Dry friction over the weight.
        motor_load_at_rest: The same at rest, beyond that in motion.
        outside_load_at_rest: The same of the weight.
        motor_load_square: Friction at rest over the square of the motor's force over `max_force`.
        outside_load_square: The same of the weight.
    """

    label: ClassVar = "force"
    interfaces: ClassVar = frozenset({"torque"})

    dead_time_s: PerJoint | None
    mass_kg: PositivePerJoint
    viscous_n_s_m: NonNegativePerJoint
    coulomb_n: NonNegativePerJoint
    offset_n: PerJoint
    # Files from before these numbers lack them; neutral.
    pose_sin_n: PerJoint = 0.0
    pose_cos_n: PerJoint = 0.0
    stribeck_n: NonNegativePerJoint = 0.0
    stribeck_m_s: PositivePerJoint | None = None
    stribeck_power: PositivePerJoint = 1.0
    motor_load: NonNegativePerJoint = 0.0
    outside_load: NonNegativePerJoint = 0.0
    motor_load_at_rest: NonNegativePerJoint = 0.0
    outside_load_at_rest: NonNegativePerJoint = 0.0
    motor_load_square: NonNegativePerJoint = 0.0
    outside_load_square: NonNegativePerJoint = 0.0

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> ForceDriveModel:
        """Return a model for `num_envs` environments on `device`.

        Raises:
            ConfigError: the machine is not commanded by torque, or a number makes no sense.
        """
        return ForceDriveModel(self, machine, num_envs, device)


class ForceDriveModel(ParametricModel):
    """Implicit solution over a control period.

    Attributes:
        drive_changes: Changes of the numbers by effects, `(N, J)` by name: a factor on the mass, force
            added to the others.
    """

    STATES = ("speed",)
    INTERFACE = ("torque", "a force drive takes torques")

    def __init__(
        self, config: ForceDrive, machine: Machine, num_envs: int, device: torch.device
    ) -> None:
        absent = {"stribeck_m_s": STRIBECK_SPEED * machine.max_speed}
        super().__init__(config, machine, num_envs, device, absent)
        self.drive_changes: dict[str, torch.Tensor] = {}
        self._max_force = torch.as_tensor(machine.max_force, dtype=torch.float32, device=device)
        count = min(SPEED_SAMPLES, machine.num_history)
        times_s = machine.period_s * torch.arange(1 - count, 1, dtype=torch.float64)
        powers = torch.stack([times_s**power for power in range(3)], 1)
        # Slope at the newest sample of the parabola through the last positions.
        self._slope = torch.linalg.pinv(powers)[1].to(device, torch.float32)

    def step(self, history: History) -> torch.Tensor:
        """Return the joint positions one control period later, shape `(N, J)`."""
        value, period_s = self._change_numbers(), self.plant.period_s
        earlier, later, part = select_commands_in_force(history.u, value["dead_time_s"] / period_s)
        command = torch.lerp(later, earlier, part)
        q = history.q[:, -1]
        weight = self._weigh(value, q)
        recent = history.q[:, -len(self._slope) :]
        begun = torch.einsum("h,nhj->nj", self._slope, recent)
        before = self.recall({"speed": begun})["speed"]
        mass = value["mass_kg"]
        step, motor = period_s / mass, command * self._max_force
        speed = (before + step * (motor - weight)) / (1.0 + step * value["viscous_n_s_m"])
        states = (before, motor, weight, self._max_force)
        friction = period_s * compute_dry_friction(value, *states) / mass
        speed = speed.sign() * (speed.abs() - friction).clamp(min=0.0)
        moved = q + 0.5 * period_s * (before + speed)
        held = self.plant.hold_from(q, moved)
        self.keep({"speed": speed.masked_fill(held != moved, 0.0)})
        return held

    def _weigh(self, value: dict[str, torch.Tensor], q: torch.Tensor) -> torch.Tensor:
        """Return the force from outside against the positive direction, `(N, J)`."""
        sin, cos = self.plant.read_pose(q)
        return value["offset_n"] + value["pose_sin_n"] * sin + value["pose_cos_n"] * (cos - 1.0)

    def _change_numbers(self) -> dict[str, torch.Tensor]:
        """Return the numbers with the changes by effects, `(N, J)`."""
        value = dict(self.parameters)
        for name, change in self.drive_changes.items():
            own = value[name]
            value[name] = own * change if name == "mass_kg" else own + change
        return value


def change_drive(model: Any, changes: Mapping[str, torch.Tensor], where: str) -> None:
    """Write numbers of an effect into the `drive_changes` of the drive within `model`.

    Args:
        model: The drive, or effects around it.
        changes: By number of the drive, `(N, J)`.
        where: Config node named in messages.

    Raises:
        ConfigError: the model inside is no drive, so that it has no such number.
    """
    while hasattr(model, "inner"):
        model = model.inner
    if not hasattr(model, "drive_changes"):
        raise ConfigError(
            f"{where}: it changes numbers of a drive, and {type(model).__name__} has none; choose actuator=force (joints "
            "commanded by torque) or actuator=servo (by position)"
        )
    model.drive_changes.update(changes)
