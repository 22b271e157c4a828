"""Mass behind a motor that is commanded by force or torque, joint by joint.

    mass q'' = max_force u(t - dead_time) - viscous q' - coulomb sign(q') - offset

A command acts for a whole control period. The speed is solved implicitly over the period, so that viscous
friction of any size is stable and Coulomb friction brings a joint exactly to rest.
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import torch

from actuators.models.parameters import PerJoint, SpreadParameters, check_interface, read_parameters
from actuators.models.transport import select_commands_in_force
from brokk_rl.errors import ConfigError
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.spec import spec

NUMBERS = ("dead_time_s", "mass_kg", "viscous_n_s_m", "coulomb_n", "offset_n")
SPEED_SAMPLES = 5
"""Positions from which a free run takes the speed that it begins with, by a parabola. Fewer take up the
noise of the encoder, more its acceleration; on the linear drive EMPS 4 to 7 differ by 2 % of the mass."""


@spec
class ForceDrive:
    """Mass with viscous and Coulomb friction and a constant force, driven by the command.

    Attributes:
        dead_time_s: Time until a command acts; `null` takes the machine's.
        mass_kg: Mass, or inertia in kg m² of a hinge, motor and gear included.
        viscous_n_s_m: Viscous friction (Nm s/rad of a hinge).
        coulomb_n: Coulomb friction (Nm of a hinge).
        offset_n: Constant force against the positive direction: weight, or an offset of the motor.
        spread: Relative half width, by field name, of draws per environment and joint at reset.
    """

    label: ClassVar = "force"
    interfaces: ClassVar = frozenset({"torque"})

    dead_time_s: PerJoint | None
    mass_kg: PerJoint
    viscous_n_s_m: PerJoint
    coulomb_n: PerJoint
    offset_n: PerJoint
    spread: dict[str, float]

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> "ForceDriveModel":
        """Return a model for `num_envs` environments on `device`.

        Raises:
            ConfigError: the machine is not commanded by torque, or a number makes no sense.
        """
        return ForceDriveModel(self, machine, num_envs, device)


class ForceDriveModel:
    """Implicit solution over a control period.

    Attributes:
        parameters: Numbers by name, `(N, J)`. Write in place or replace an entry to simulate `N`
            candidates side by side.
        drive_changes: Changes of them by effects, `(N, J)` by name: a factor on the mass, force added to
            the others.
    """

    def __init__(
        self, config: ForceDrive, machine: Machine, num_envs: int, device: torch.device
    ) -> None:
        check_interface(machine, "torque", "a force drive takes torques")
        nominal = read_parameters(
            config,
            NUMBERS,
            machine,
            positive=("mass_kg",),
            not_negative=("viscous_n_s_m", "coulomb_n"),
        )
        self._parameters = SpreadParameters(
            nominal, config.spread, num_envs, device, "actuator.spread"
        )
        self.parameters = self._parameters.value
        self.drive_changes: dict[str, torch.Tensor] = {}
        self._period_s = machine.period_s

        def tensor(values: object) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=device)

        self._lower, self._upper = tensor(machine.lower), tensor(machine.upper)
        self._max_force = tensor(machine.max_force)
        count = min(SPEED_SAMPLES, machine.num_history)
        times_s = self._period_s * torch.arange(1 - count, 1, dtype=torch.float64)
        powers = torch.stack([times_s**power for power in range(3)], 1)
        # Slope at the newest sample of the parabola through the last positions.
        self._slope = tensor(torch.linalg.pinv(powers)[1].numpy())
        self._speed = torch.zeros(num_envs, machine.num_joints, device=device)
        self._fresh = torch.ones(num_envs, dtype=torch.bool, device=device)
        self.reset(self._fresh.clone())

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """`speed` `(N, J)` in rad/s or m/s, `fresh`, and the drawn parameters."""
        return {"speed": self._speed, "fresh": self._fresh, **self._parameters.state}

    def reset(self, mask: torch.Tensor) -> None:
        """Let the environments of `mask`, `(N,)` bool, start from their history; redraw."""
        self._speed.masked_fill_(mask[:, None], 0.0)
        self._fresh.logical_or_(mask)
        self._parameters.redraw(mask)

    def step(self, history: History) -> torch.Tensor:
        """Return the joint positions one control period later, shape `(N, J)`."""
        value, period_s = self._change_numbers(), self._period_s
        earlier, later, part = select_commands_in_force(history.u, value["dead_time_s"] / period_s)
        force = torch.lerp(later, earlier, part) * self._max_force - value["offset_n"]
        q = history.q[:, -1]
        recent = history.q[:, -len(self._slope) :]
        begun = torch.einsum("h,nhj->nj", self._slope, recent)
        before = torch.where(self._fresh[:, None], begun, self._speed)
        mass = value["mass_kg"]
        speed = (before + period_s * force / mass) / (
            1.0 + period_s * value["viscous_n_s_m"] / mass
        )
        friction = period_s * value["coulomb_n"] / mass
        speed = speed.sign() * (speed.abs() - friction).clamp(min=0.0)
        moved = q + 0.5 * period_s * (before + speed)
        low, high = torch.minimum(self._lower, q), torch.maximum(self._upper, q)
        held = torch.minimum(torch.maximum(moved, low), high)
        self._speed.copy_(speed.masked_fill(held != moved, 0.0))
        self._fresh.fill_(False)
        return held

    def _change_numbers(self) -> dict[str, torch.Tensor]:
        """Return the numbers with the changes by effects, `(N, J)`."""
        value = dict(self.parameters)
        for name, change in self.drive_changes.items():
            own = value[name]
            value[name] = own * change if name == "mass_kg" else own + change
        return value

    @property
    def delay_s(self) -> torch.Tensor:
        """Dead time, `(N, J)`."""
        return self.parameters["dead_time_s"]


def change_drive(
    model: Any, drives: Mapping[str, str], value: Mapping[str, torch.Tensor], where: str
) -> None:
    """Write numbers of an effect into the `drive_changes` of the drive within `model`.

    Args:
        model: The drive, or effects around it.
        drives: Number of the drive that each number of the effect changes.
        value: Numbers of the effect, `(N, J)` by name.
        where: Config node named in messages.

    Raises:
        ConfigError: the model inside is no drive, so that it has no such number.
    """
    while hasattr(model, "inner"):
        model = model.inner
    if not hasattr(model, "drive_changes"):
        raise ConfigError(
            f"{where}: it changes mass or friction of a drive, and {type(model).__name__} has none; choose actuator=force"
        )
    for name, changed in drives.items():
        model.drive_changes[changed] = value[name]
