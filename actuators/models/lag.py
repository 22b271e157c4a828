"""Simple actuator models: ideal, and dead time with dead band and first-order lag."""

from __future__ import annotations

from typing import Annotated, ClassVar, NamedTuple

import torch

from actuators.models.joint_model import CommandParts, JointMemory, MemorylessModel, PlannableModel
from actuators.models.machine_tensors import MachineTensors
from actuators.models.parameters import (
    NonNegativePerJoint,
    NumberBounds,
    PerJoint,
    check_interface,
    open_valve,
)
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.spec import spec


@spec
class Ideal:
    """Moves at once at the machine's full speed times the command.

    Attributes:
        speed_scale: Speed at full command over the machine's `max_speed`.
    """

    speed_scale: float

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> IdealModel:
        """Return a model for `num_envs` environments on `device`.

        Raises:
            ConfigError: the machine is not commanded by speed.
        """
        check_interface(machine, "speed", "an ideal drive follows speeds")
        return IdealModel(self, machine, device)


class IdealModel(MemorylessModel):
    """`q' = q + period * speed_scale * max_speed * u`, clamped to the travel. No memory."""

    def __init__(self, config: Ideal, machine: Machine, device: torch.device) -> None:
        self._plant = MachineTensors(machine, device)
        step = machine.max_speed * machine.period_s * config.speed_scale
        self._step_at_full = torch.as_tensor(step, dtype=torch.float32, device=device)

    def step(self, history: History) -> torch.Tensor:
        """Return the joint positions one control period later, shape `(N, J)`."""
        return self._plant.hold(history.q[:, -1] + history.u[:, -1] * self._step_at_full)


@spec
class FirstOrderLag:
    """Dead time, dead band on each side, gain and first-order lag, joint by joint.

    Attributes:
        dead_time_s: Pure transport delay of the command; `null` takes the machine's. Need not be a
            multiple of the period.
        dead_band_extend: Command up to which nothing moves in the positive direction, in [0, 1).
        dead_band_retract: The same for the negative direction.
        gain: Speed at full command over the machine's `max_speed`.
        time_constant_s: Time constant with which the speed follows the command; 0 for none.
    """

    label: ClassVar = "lag"

    dead_time_s: PerJoint | None
    dead_band_extend: Annotated[PerJoint, NumberBounds("0 or more, below 1", 0.0, 0.999)]
    dead_band_retract: Annotated[PerJoint, NumberBounds("0 or more, below 1", 0.0, 0.999)]
    gain: PerJoint
    time_constant_s: NonNegativePerJoint

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> FirstOrderLagModel:
        """Return a model for `num_envs` environments on `device`.

        Raises:
            ConfigError: the dead time does not fit the machine's history, or a joint is unknown.
        """
        return FirstOrderLagModel(self, machine, num_envs, device)


class LagSolution(NamedTuple):
    """Exact solution of each step of a run, linear in the speed at its beginning.

    Attributes:
        moves: Motion without that speed, `(K, N, J)`, rad or m.
        speeds: Speed after it, `(K, N, J)`.
        reach_s: Motion for one of speed, `(N, J)`.
        kept: Speed after it for one of speed.
    """

    moves: torch.Tensor
    speeds: torch.Tensor
    reach_s: torch.Tensor
    kept: torch.Tensor


class FirstOrderLagModel(PlannableModel):
    """Exact solution of `time_constant * v' + v = v_full * open_valve(u(t - dead_time))`."""

    STATES = ("speed",)
    INTERFACE = ("speed", "a lagging drive follows speeds")

    def ask(self, commands: torch.Tensor) -> torch.Tensor:
        """Return the speeds that commands ask for."""
        value = self.parameters
        opening = open_valve(commands, value["dead_band_extend"], value["dead_band_retract"])
        return opening * value["gain"] * self.plant.max_speed

    def solve(self, drive: CommandParts) -> LagSolution:
        """Return motion and speed after each step."""
        # A time constant of 0 would divide by zero; a microsecond is as good.
        time_constant_s = self.parameters["time_constant_s"].clamp(min=1e-6)
        first_s, second_s = (
            drive.part * self.plant.period_s,
            (1.0 - drive.part) * self.plant.period_s,
        )
        decays = [torch.exp(-one / time_constant_s) for one in (first_s, second_s)]
        reach_s = [time_constant_s * (1.0 - decay) for decay in decays]
        between = drive.earlier * (1.0 - decays[0])
        moves = drive.earlier * (first_s - reach_s[0]) + drive.later * (second_s - reach_s[1])
        return LagSolution(
            moves=moves + between * reach_s[1],
            speeds=between * decays[1] + drive.later * (1.0 - decays[1]),
            reach_s=reach_s[0] + decays[0] * reach_s[1],
            kept=decays[0] * decays[1],
        )

    def begin(self, drive: CommandParts, q: torch.Tensor, before: torch.Tensor) -> JointMemory:
        """Return the speed that the history shows: a free run may begin in the middle of a motion."""
        return {"speed": (q - before) / self.plant.period_s}

    def advance(
        self,
        k: int,
        q: torch.Tensor,
        drive: CommandParts,
        solution: LagSolution,
        memory: JointMemory,
    ) -> tuple[torch.Tensor, JointMemory]:
        """Return positions and speed after step `k`; a joint at its stop has no speed left."""
        speed = memory["speed"]
        moved = q + torch.addcmul(solution.moves[k], speed, solution.reach_s)
        held = self.plant.hold(moved)
        after = torch.addcmul(solution.speeds[k], speed, solution.kept)
        return held, {"speed": after.masked_fill(held != moved, 0.0)}
