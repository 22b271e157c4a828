"""Servo of a joint that is commanded by position: a second-order loop behind a dead time.

Once a control period, joint by joint:

    target   command of `dead_time_s` ago, as a position; the two commands of a period act one after the
             other
    held     play operator of width `play_rad` on the target: gear play, or Coulomb friction that the
             stiffness of the loop does not overcome (the width is twice friction over stiffness)
    reached  held target less the sag under gravity, `sag_rad + sag_slope * (held - middle of travel)`
    joint    `response_s^2 q'' + 2 damping response_s q' + q = reached`, solved exactly; viscous friction
             and the derivative gain are in the damping
    limits   speed at most `top_speed` of the machine's `max_speed`

With `response_s`, play and sag of 0 the joint is at its target after one period: the ideal servo.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch

from actuators.models.parameters import PerJoint, SpreadParameters, check_interface, read_parameters
from actuators.models.transport import select_commands_in_force, split_run_commands
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.spec import spec

NUMBERS = (
    "dead_time_s", "response_s", "damping", "top_speed", "play_rad", "sag_rad", "sag_slope",
)  # fmt: skip
SHORTEST_RESPONSE_S = 1e-5
"""Response from which a loop is at its target within a period, to the last bit; avoids 0 / 0."""
NEAR_CRITICAL = 1e-4
"""Distance of the squared damping from 1 within which the loop counts as critically damped: there
the two solutions agree to a ten-thousandth, and 0 / 0 is avoided."""


@spec
class Servo:
    """Dead time, play, sag, second-order loop and top speed, joint by joint.

    Attributes:
        dead_time_s: Time from command to first motion; `null` takes the machine's.
        response_s: Inverse of the loop's natural frequency, s/rad; 0 for a joint that is at its
            target at once.
        damping: Damping ratio of the loop, above 0; 1 without overshoot.
        top_speed: Largest speed over the machine's `max_speed`.
        play_rad: Change of the target that is not followed at a reversal (m for a sliding joint).
        sag_rad: How far the joint stays below its target in the middle of its travel, in the
            negative direction (m for a sliding joint).
        sag_slope: Change of the sag over the change of the target.
        spread: Relative half width, by field name, of draws per environment and joint at reset.
    """

    label: ClassVar = "servo"
    interfaces: ClassVar = frozenset({"position"})

    dead_time_s: PerJoint | None
    response_s: PerJoint
    damping: PerJoint
    top_speed: PerJoint
    play_rad: PerJoint
    sag_rad: PerJoint
    sag_slope: PerJoint
    spread: dict[str, float]

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> "ServoModel":
        """Return a model for `num_envs` environments on `device`.

        Raises:
            ConfigError: the machine is not commanded by position, or a number makes no sense.
        """
        return ServoModel(self, machine, num_envs, device)


class ServoModel:
    """Exact solution of the loop over each part of a period with one command.

    Attributes:
        parameters: Numbers by name, `(N, J)`. Write in place or replace an entry to simulate `N`
            candidates side by side.
    """

    def __init__(
        self, config: Servo, machine: Machine, num_envs: int, device: torch.device
    ) -> None:
        check_interface(machine, "position", "a servo follows positions")
        nominal = read_parameters(
            config,
            NUMBERS,
            machine,
            positive=("damping", "top_speed"),
            not_negative=("response_s", "play_rad"),
        )
        self._parameters = SpreadParameters(
            nominal, config.spread, num_envs, device, "actuator.spread"
        )
        self.parameters = self._parameters.value
        self._period_s = machine.period_s

        def tensor(values: object) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=device)

        self._lower, self._upper = tensor(machine.lower), tensor(machine.upper)
        self._middle = (self._lower + self._upper) / 2
        self._half = (self._upper - self._lower) / 2
        self._max_speed = tensor(machine.max_speed)
        shape = (num_envs, machine.num_joints)
        self._state = {name: torch.zeros(shape, device=device) for name in ("held", "speed")}
        self._fresh = torch.ones(num_envs, dtype=torch.bool, device=device)
        self.reset(self._fresh.clone())

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """`held` target (rad or m), `speed`, each `(N, J)`; `fresh`, and the drawn parameters."""
        return {**self._state, "fresh": self._fresh, **self._parameters.state}

    def reset(self, mask: torch.Tensor) -> None:
        """Let the environments of `mask`, `(N,)` bool, start from their history; redraw."""
        for value in self._state.values():
            value.masked_fill_(mask[:, None], 0.0)
        self._fresh.logical_or_(mask)
        self._parameters.redraw(mask)

    def step(self, history: History) -> torch.Tensor:
        """Return the joint positions one control period later, shape `(N, J)`."""
        earlier, later, part = select_commands_in_force(
            history.u, self.parameters["dead_time_s"] / self._period_s
        )
        earlier, later = self.read_target(earlier), self.read_target(later)
        q, fresh = history.q[:, -1], self._fresh[:, None]
        speed = (q - history.q[:, -2]) / self._period_s
        held = torch.where(fresh, self.begin_held(earlier, q), self._state["held"])
        speed = torch.where(fresh, speed, self._state["speed"])
        first = self.hold(held, earlier)
        second = self.hold(first, later)
        moved, speed = self.move(q, speed, first, second, self.solve(part))
        self._state["held"].copy_(second)
        self._state["speed"].copy_(speed)
        self._fresh.fill_(False)
        return moved

    @property
    def delay_s(self) -> torch.Tensor:
        """Dead time, `(N, J)`."""
        return self.parameters["dead_time_s"]

    def plan_run(self, u: torch.Tensor, first: int, q: torch.Tensor | None = None) -> "ServoRun":
        """See `brokk_rl.contracts.actuator.PlannedModel`."""
        return ServoRun(self, u, first)

    @property
    def period_s(self) -> float:
        """Control period, s."""
        return self._period_s

    def read_target(self, u: torch.Tensor) -> torch.Tensor:
        """Return the targets of commands `(…, J)`, rad or m."""
        return self._middle + self._half * u

    def begin_held(self, target: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
        """Return the held target of a joint that is at `q`, as near to it as the play allows, `(N, J)`."""
        value = self.parameters
        return self.hold(q + value["sag_rad"] + value["sag_slope"] * (q - self._middle), target)

    def hold(self, held: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Return the target behind the play, `(N, J)`."""
        half = 0.5 * self.parameters["play_rad"]
        return torch.minimum(torch.maximum(held, target - half), target + half)

    def solve(self, part: torch.Tensor) -> "tuple[LoopSolution, LoopSolution]":
        """Return the motion of the loop over the two parts of a period."""
        value = self.parameters
        first_s, second_s = part * self._period_s, (1.0 - part) * self._period_s
        response_s, damping = value["response_s"], value["damping"]
        return (
            LoopSolution.build(response_s, damping, first_s),
            LoopSolution.build(response_s, damping, second_s),
        )

    def move(
        self,
        q: torch.Tensor,
        speed: torch.Tensor,
        first: torch.Tensor,
        second: torch.Tensor,
        solutions: "tuple[LoopSolution, LoopSolution]",
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return positions and speeds after a period with two held targets, each `(N, J)`."""
        value, begin = self.parameters, q
        for held, solution in zip((first, second), solutions, strict=True):
            reached = held - value["sag_rad"] - value["sag_slope"] * (held - self._middle)
            q, speed = solution.advance(q - reached, speed)
            q = q + reached
        most = value["top_speed"] * self._max_speed
        way = most * self._period_s
        limited = torch.minimum(torch.maximum(q, begin - way), begin + way)
        speed = torch.minimum(torch.maximum(speed, -most), most)
        low, high = torch.minimum(self._lower, begin), torch.maximum(self._upper, begin)
        held = torch.minimum(torch.maximum(limited, low), high)
        return held, speed.masked_fill(held != limited, 0.0)


@dataclass(frozen=True, eq=False)
class LoopSolution:
    """Linear map of error and speed over a time, `response^2 e'' + 2 damping response e' + e = 0`.

    Attributes:
        kept: Error after it for one of error, `(N, J)`.
        gained: Error for one of speed, s.
        pulled: Speed for one of error, 1/s.
        carried: Speed for one of speed.
    """

    kept: torch.Tensor
    gained: torch.Tensor
    pulled: torch.Tensor
    carried: torch.Tensor

    @classmethod
    def build(
        cls, response_s: torch.Tensor, damping: torch.Tensor, time_s: torch.Tensor
    ) -> "LoopSolution":
        """Return the map over `time_s`, `(N, J)`."""
        w = 1.0 / response_s.clamp(min=SHORTEST_RESPONSE_S)
        bend = damping.square() - 1.0
        bend = torch.where(bend.abs() < NEAR_CRITICAL, torch.full_like(bend, NEAR_CRITICAL), bend)
        rate, fade = w * bend.abs().sqrt(), damping * w
        slow, fast = torch.exp((rate - fade) * time_s), torch.exp(-(rate + fade) * time_s)
        decay, angle = torch.exp(-fade * time_s), rate * time_s
        cos = torch.where(bend > 0, 0.5 * (slow + fast), decay * torch.cos(angle))
        sin = torch.where(bend > 0, 0.5 * (slow - fast), decay * torch.sin(angle)) / rate
        return cls(cos + fade * sin, sin, -w.square() * sin, cos - fade * sin)

    def advance(
        self, error: torch.Tensor, speed: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return error and speed after the time, each `(N, J)`."""
        return (self.kept * error + self.gained * speed, self.pulled * error + self.carried * speed)


class ServoRun:
    """A run of a `ServoModel`; see `brokk_rl.contracts.actuator.PlannedRun`.

    Targets behind the play depend on commands alone: they are computed beforehand.
    """

    def __init__(self, model: ServoModel, u: torch.Tensor, first: int) -> None:
        self._model, self._first = model, first
        earlier, later, part = split_run_commands(
            u, model.parameters["dead_time_s"] / model.period_s, first
        )
        self._earlier, self._later = model.read_target(earlier), model.read_target(later)
        self._solutions = model.solve(part)
        self._held: torch.Tensor | None = None
        self._speed: torch.Tensor | None = None

    def step(self, k: int, q: torch.Tensor) -> torch.Tensor:
        """Return positions `k`, `(N, J)`."""
        model, place = self._model, k - self._first
        if self._speed is None or self._held is None:
            self._speed = (q[k - 1] - q[k - 2]) / model.period_s
            self._held = model.begin_held(self._earlier[place], q[k - 1])
        first = model.hold(self._held, self._earlier[place])
        self._held = model.hold(first, self._later[place])
        moved, self._speed = model.move(q[k - 1], self._speed, first, self._held, self._solutions)
        return moved
