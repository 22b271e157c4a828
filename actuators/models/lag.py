"""Simple actuator models: ideal, and dead time with dead band and first-order lag."""

from dataclasses import dataclass
from typing import ClassVar

import torch

from actuators.models.parameters import (
    PerJoint,
    SpreadParameters,
    check_interface,
    open_valve,
    read_parameters,
    select_commands_in_force,
    split_run_commands,
)
from brokk_rl.errors import ConfigError
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

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> "IdealModel":
        """Return a model for `num_envs` environments on `device`.

        Raises:
            ConfigError: the machine is not commanded by speed.
        """
        check_interface(machine, "speed", "an ideal drive follows speeds")
        return IdealModel(self, machine, device)


class IdealModel:
    """`q' = q + period * speed_scale * max_speed * u`, clamped to the travel. No memory."""

    def __init__(self, config: Ideal, machine: Machine, device: torch.device) -> None:
        self._step_at_full = torch.as_tensor(
            machine.max_speed * machine.period_s * config.speed_scale,
            dtype=torch.float32,
            device=device,
        )
        self._lower = torch.as_tensor(machine.lower, dtype=torch.float32, device=device)
        self._upper = torch.as_tensor(machine.upper, dtype=torch.float32, device=device)

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """Nothing."""
        return {}

    def reset(self, mask: torch.Tensor) -> None:
        """Do nothing."""

    def step(self, history: History) -> torch.Tensor:
        """Return the joint positions one control period later, shape `(N, J)`."""
        return (history.q[:, -1] + history.u[:, -1] * self._step_at_full).clamp(
            self._lower, self._upper
        )


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
        spread: Relative half width, by field name, of draws per environment and joint at
            reset.
    """

    label: ClassVar = "lag"

    dead_time_s: PerJoint | None
    dead_band_extend: PerJoint
    dead_band_retract: PerJoint
    gain: PerJoint
    time_constant_s: PerJoint
    spread: dict[str, float]

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> "FirstOrderLagModel":
        """Return a model for `num_envs` environments on `device`.

        Raises:
            ConfigError: the dead time does not fit the machine's history, or a number makes no
                sense.
        """
        return FirstOrderLagModel(self, machine, num_envs, device)


class FirstOrderLagModel:
    """Exact solution of `time_constant * v' + v = v_full * open_valve(u(t - dead_time))`.

    Attributes:
        parameters: Numbers by name, `(N, J)`. Write in place or replace an entry to simulate `N`
            candidates side by side; gradients flow to an entry that wants them until the next
            `reset`.
    """

    def __init__(
        self, config: FirstOrderLag, machine: Machine, num_envs: int, device: torch.device
    ) -> None:
        check_interface(machine, "speed", "a lagging drive follows speeds")
        bands = ("dead_band_extend", "dead_band_retract")
        nominal = read_parameters(
            config,
            (*bands, "gain", "time_constant_s", "dead_time_s"),
            machine,
            not_negative=("time_constant_s",),
        )
        for name in bands:
            if ((nominal[name] < 0) | (nominal[name] >= 1)).any():
                raise ConfigError(
                    f"actuator.{name}: expected dead bands in [0, 1), got {nominal[name].tolist()}"
                )
        self._parameters = SpreadParameters(
            nominal, config.spread, num_envs, device, "actuator.spread"
        )
        self.parameters = self._parameters.value
        self._period_s = machine.period_s
        self._max_speed = torch.as_tensor(machine.max_speed, dtype=torch.float32, device=device)
        self._lower = torch.as_tensor(machine.lower, dtype=torch.float32, device=device)
        self._upper = torch.as_tensor(machine.upper, dtype=torch.float32, device=device)
        self._speed = torch.zeros(num_envs, machine.num_joints, device=device)
        self._fresh = torch.ones(num_envs, dtype=torch.bool, device=device)
        self.reset(torch.ones(num_envs, dtype=torch.bool, device=device))

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """`speed` `(N, J)` in rad/s or m/s, `fresh`, and the drawn parameters."""
        return {"speed": self._speed, "fresh": self._fresh, **self._parameters.state}

    def reset(self, mask: torch.Tensor) -> None:
        """Let the environments of `mask`, `(N,)` bool, start from their history; redraw.

        Cuts gradients.
        """
        if self._speed.requires_grad:
            self._speed.detach_()
        self._speed.masked_fill_(mask[:, None], 0.0)
        self._fresh.logical_or_(mask)
        self._parameters.redraw(mask)

    def step(self, history: History) -> torch.Tensor:
        """Return the joint positions one control period later, shape `(N, J)`."""
        value = self.parameters
        earlier, later, part = select_commands_in_force(
            history.u, value["dead_time_s"] / self._period_s
        )
        q = history.q[:, -1]
        # a free run may begin in the middle of a motion; at rest the history is level
        speed = torch.where(
            self._fresh.clone()[:, None], (q - history.q[:, -2]) / self._period_s, self._speed
        )
        for u, duration_s in (
            (earlier, part * self._period_s),
            (later, (1.0 - part) * self._period_s),
        ):
            target = (
                open_valve(u, value["dead_band_extend"], value["dead_band_retract"])
                * value["gain"]
                * self._max_speed
            )
            # A time constant of 0 would divide by zero; a microsecond is as good.
            time_constant_s = value["time_constant_s"].clamp(min=1e-6)
            decay = torch.exp(-duration_s / time_constant_s)
            q = q + target * duration_s + (speed - target) * time_constant_s * (1.0 - decay)
            speed = target + (speed - target) * decay
        held = q.clamp(self._lower, self._upper)
        # A joint at its stop has no speed left.
        self._speed.copy_(speed.masked_fill(held != q, 0.0))
        self._fresh.fill_(False)
        return held

    @property
    def delay_s(self) -> torch.Tensor:
        """Dead time, `(N, J)`."""
        return self.parameters["dead_time_s"]

    def plan_run(
        self,
        u: torch.Tensor,
        first: int,
        q: torch.Tensor | None = None,
        drive: "LagDrive | None" = None,
    ) -> "LagRun":
        """See `actuators.contracts.PlannedModel`; `drive`: that of the commands, if known."""
        return LagRun(self, self.drive(u, first) if drive is None else drive, first)

    def drive(self, u: torch.Tensor, first: int) -> "LagDrive":
        """Return the speeds that the commands of a run `(T, N, J)` ask for, whatever the positions are."""
        value, speeds = self.parameters, []
        earlier, later, part = split_run_commands(u, value["dead_time_s"] / self._period_s, first)
        for commands in (earlier, later):
            opening = open_valve(commands, value["dead_band_extend"], value["dead_band_retract"])
            speeds.append(opening * value["gain"] * self._max_speed)
        return LagDrive(speeds[0], speeds[1], part)

    @property
    def period_s(self) -> float:
        """Control period, s."""
        return self._period_s

    def hold(self, q: torch.Tensor) -> torch.Tensor:
        """Return positions within the travel."""
        return q.clamp(self._lower, self._upper)


@dataclass(frozen=True, eq=False)
class LagDrive:
    """Speeds that commands ask for in each step of a run.

    Attributes:
        earlier: In the first part of the period, `(K, N, J)`.
        later: In the rest, `(K, N, J)`.
        part: Length of the first part, in periods, `(N, J)`.
    """

    earlier: torch.Tensor
    later: torch.Tensor
    part: torch.Tensor

    def repeat(self, count: int) -> "LagDrive":
        """Return that of all environments, `count` times one after the other."""
        earlier, later = self.earlier.repeat(1, count, 1), self.later.repeat(1, count, 1)
        return LagDrive(earlier, later, self.part.repeat(count, 1))


class LagRun:
    """A run of a `FirstOrderLagModel`; see `actuators.contracts.PlannedRun`.

    The solution of a period is linear in the speed at its beginning: motion and speed after it are
    a constant of the commands plus a factor times that speed.
    """

    def __init__(self, model: FirstOrderLagModel, drive: LagDrive, first: int) -> None:
        self._model, self._first = model, first
        self._speed: torch.Tensor | None = None
        time_constant_s = model.parameters["time_constant_s"].clamp(min=1e-6)  # as in `step`
        first_s, second_s = drive.part * model.period_s, (1.0 - drive.part) * model.period_s
        decays = [torch.exp(-one / time_constant_s) for one in (first_s, second_s)]
        reach_s = [time_constant_s * (1.0 - decay) for decay in decays]
        between = drive.earlier * (1.0 - decays[0])
        self._kept = decays[0] * decays[1]
        self._reach_s = reach_s[0] + decays[0] * reach_s[1]
        self._speeds = between * decays[1] + drive.later * (1.0 - decays[1])
        self._moves = (
            drive.earlier * (first_s - reach_s[0])
            + drive.later * (second_s - reach_s[1])
            + between * reach_s[1]
        )

    def step(self, k: int, q: torch.Tensor) -> torch.Tensor:
        """Return positions `k`, `(N, J)`."""
        place, now = k - self._first, q[k - 1]
        speed = (now - q[k - 2]) / self._model.period_s if self._speed is None else self._speed
        moved = now + torch.addcmul(self._moves[place], speed, self._reach_s)
        held = self._model.hold(moved)
        after = torch.addcmul(self._speeds[place], speed, self._kept)
        self._speed = after.masked_fill(held != moved, 0.0)  # as in `step`
        return held
