"""Servo of a joint that is commanded by position: a second-order loop behind a dead time.

Once a control period, joint by joint:

    target   command of `dead_time_s` ago, as a position; the two commands of a period act one after the
             other
    held     play operator of width `play_rad` on the target: gear play, or Coulomb friction that the
             stiffness of the loop does not overcome (the width is twice friction over stiffness)
    reached  held target less the sag under gravity, `sag_rad + sag_slope * (held - middle of travel)`
    joint    `response_s^2 q'' + 2 damping response_s q' + q = reached`, solved exactly; viscous friction
             and the derivative gain are in the damping
    torque   the pull `held - q - 2 firmware_damping damping response_s q'` is at most `limit_rad`; weight
             and the other damping (back EMF, friction) act beside it: where the limit is below the sag,
             the joint falls
    limits   speed at most `top_speed` of the machine's `max_speed`

With `response_s`, play and sag of 0 the joint is at its target after one period: the ideal servo.
"""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch

from actuators.models.parameters import (
    PerJoint,
    SpreadParameters,
    check_interface,
    read_parameters,
    select_commands_in_force,
    split_run_commands,
)
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.spec import spec

NUMBERS = (
    "dead_time_s", "response_s", "damping", "top_speed", "play_rad", "sag_rad", "sag_slope",
)  # fmt: skip
LIMIT_NUMBERS = ("limit_rad", "firmware_damping")
SHORTEST_RESPONSE_S = 1e-5
"""Response from which a loop is at its target within a period, to the last bit; avoids 0 / 0."""
NEAR_CRITICAL = 1e-4
"""Distance of the squared damping from 1 within which the loop counts as critically damped: there
the two solutions agree to a ten-thousandth, and 0 / 0 is avoided."""
FULL_TORQUE_TRAVEL = 0.05
"""Error of position, over the travel, that `shortage` counts in; as in `diagnosis.mjcf.plant`."""
NO_LIMIT_RAD = 1e6
"""Pull without a limit; finite, so that no gradient is NaN."""
SMALL_SHARE = 0.05
"""Time over the time constant below which a series of three terms is exact to 2e-6."""
LEAST_OUTSIDE = 0.02
"""Part of the damping that always acts beside the limit; avoids 0 / 0."""
SUBSTEPS = 2
"""Steps of a part of a period in which the limit acts. At 50 Hz, 20 loops and limits moved by steps of
the target keep within 0.06 mrad of scipy's solution with 2, within 0.11 mrad with 1; within 0.4 mrad
where damping lies within the limit."""


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
        limit_rad: Error of the held target from which on the motor pulls no harder: its largest torque
            over the stiffness of the loop (m for a sliding joint); `null` for no limit.
        firmware_damping: Part of the damping that the loop itself commands, so that it lies within the
            limit; the rest is back EMF and viscous friction. Nothing without a limit.
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
    # Files from before there was a limit lack it; neutral.
    limit_rad: PerJoint | None = None
    firmware_damping: PerJoint = 0.5

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> "ServoModel":
        """Return a model for `num_envs` environments on `device`.

        Raises:
            ConfigError: the machine is not commanded by position, or a number makes no sense.
        """
        return ServoModel(self, machine, num_envs, device)


class ServoModel:
    """Exact solution of the loop over each part of a period with one command.

    Attributes:
        parameters: Numbers by name, `(N, J)`, those of `LIMIT_NUMBERS` only where there is a limit.
            Write in place or replace an entry to simulate `N` candidates side by side.
        drive_changes: Changes by effects, `(N, J)` by name: `shortage`, the error of 5 % of the travel
            over another limit, 0 for none, and its `firmware_damping`. The lower limit counts.
    """

    def __init__(
        self, config: Servo, machine: Machine, num_envs: int, device: torch.device
    ) -> None:
        check_interface(machine, "position", "a servo follows positions")
        nominal = read_parameters(
            config,
            NUMBERS if config.limit_rad is None else (*NUMBERS, *LIMIT_NUMBERS),
            machine,
            positive=("damping", "top_speed", "limit_rad"),
            not_negative=("response_s", "play_rad", "firmware_damping"),
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
        moved, speed = self.move(q, speed, first, second, self.solve(part, self.read_limit()))
        self._state["held"].copy_(second)
        self._state["speed"].copy_(speed)
        self._fresh.fill_(False)
        return moved

    @property
    def delay_s(self) -> torch.Tensor:
        """Dead time, `(N, J)`."""
        return self.parameters["dead_time_s"]

    def plan_run(self, u: torch.Tensor, first: int, q: torch.Tensor | None = None) -> "ServoRun":
        """See `actuators.contracts.PlannedModel`."""
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

    def read_limit(self) -> "PullLimit | None":
        """Return the limit of the torque; `None` where there can be none."""
        own, changes = self.parameters, self.drive_changes
        if "shortage" not in changes:
            if "limit_rad" not in own:
                return None
            return PullLimit(own["limit_rad"], own["firmware_damping"])
        full = 2.0 * FULL_TORQUE_TRAVEL * self._half
        limit_rad = full / torch.maximum(changes["shortage"], full / NO_LIMIT_RAD)
        inside = changes["firmware_damping"]
        if "limit_rad" not in own:
            return PullLimit(limit_rad, inside)
        inside = torch.where(own["limit_rad"] < limit_rad, own["firmware_damping"], inside)
        return PullLimit(torch.minimum(own["limit_rad"], limit_rad), inside)

    def solve(
        self, part: torch.Tensor, limit: "PullLimit | None"
    ) -> "tuple[PartSolution, PartSolution]":
        """Return the motion over the two parts of a period; `limit`: see `read_limit`."""
        value = self.parameters
        found = []
        for share in (part, 1.0 - part):
            loop = value["response_s"], value["damping"], share * self._period_s
            limited = None if limit is None else LimitedSolution.build(*loop, limit)
            found.append(PartSolution(LoopSolution.build(*loop), limited))
        first, second = found
        return first, second

    def move(
        self,
        q: torch.Tensor,
        speed: torch.Tensor,
        first: torch.Tensor,
        second: torch.Tensor,
        solutions: "tuple[PartSolution, PartSolution]",
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return positions and speeds after a period with two held targets, each `(N, J)`."""
        value, begin = self.parameters, q
        for held, solution in zip((first, second), solutions, strict=True):
            reached = held - value["sag_rad"] - value["sag_slope"] * (held - self._middle)
            error, free_speed = solution.loop.advance(q - reached, speed)
            free = error + reached, free_speed
            if solution.limited is not None:
                weight = value["sag_rad"] + value["sag_slope"] * (q - self._middle)
                free = solution.limited.advance(q, speed, held, reached, weight, free)
            q, speed = free
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


class PullLimit(NamedTuple):
    """Limit of a servo's torque.

    Attributes:
        limit_rad: Largest pull, `(N, J)`, rad or m.
        inside: Part of the damping within the limit, `(N, J)`.
    """

    limit_rad: torch.Tensor
    inside: torch.Tensor


@dataclass(frozen=True, eq=False)
class LimitedSolution:
    """Motion in `SUBSTEPS` equal steps, each of them with a pull at the limit or below it.

    Attributes:
        limit_rad: Largest pull, `(N, J)`, rad or m.
        brake: Pull for one of speed that the damping within the limit takes, s.
        loop: The loop below the limit, over a step.
        slipped: Motion over a step for one of speed, under a constant pull, s.
        faded: Speed for one of speed.
        moved: Motion for one of pull.
        pushed: Speed for one of pull, 1/s.
    """

    limit_rad: torch.Tensor
    brake: torch.Tensor
    loop: LoopSolution
    slipped: torch.Tensor
    faded: torch.Tensor
    moved: torch.Tensor
    pushed: torch.Tensor

    @classmethod
    def build(
        cls, response_s: torch.Tensor, damping: torch.Tensor, time_s: torch.Tensor, limit: PullLimit
    ) -> "LimitedSolution":
        """Return the motion over `time_s`, `(N, J)`, with a limit."""
        step_s, response_s = time_s / SUBSTEPS, response_s.clamp(min=SHORTEST_RESPONSE_S)
        outside = damping * (1.0 - limit.inside).clamp(min=LEAST_OUTSIDE)
        fade_s = 0.5 * response_s / outside
        share = step_s / fade_s
        left = -torch.expm1(-share)
        # The difference of the two loses all its digits for a small share: there a series.
        series = share.square() * (0.5 - share * (1.0 / 6.0 - share / 24.0))
        behind = torch.where(share < SMALL_SHARE, series, share - left)
        final_1_s = 0.5 / (outside * response_s)  # final speed for one of pull
        return cls(
            limit.limit_rad,
            2.0 * limit.inside * damping * response_s,
            LoopSolution.build(response_s, damping, step_s),
            fade_s * left,
            1.0 - left,
            final_1_s * fade_s * behind,
            final_1_s * left,
        )

    def advance(
        self,
        q: torch.Tensor,
        speed: torch.Tensor,
        held: torch.Tensor,
        reached: torch.Tensor,
        weight: torch.Tensor,
        free: tuple[torch.Tensor, torch.Tensor],
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return positions and speeds after the time, each `(N, J)`.

        Args:
            q: Positions before, rad or m.
            speed: Speeds before, rad/s or m/s.
            held: Held targets.
            reached: Held targets less the sag.
            weight: Pull of the weight in the negative direction.
            free: Positions and speeds after the time without a limit; exact where it never acts.
        """
        acts, twice_held, twice_limit = None, held + held, self.limit_rad + self.limit_rad
        for _ in range(SUBSTEPS):
            error, loop_speed = self.loop.advance(q - reached, speed)
            loop_q, away = error + reached, twice_held - q - self.brake * speed
            side = torch.sign(away - loop_q - self.brake * loop_speed)
            pull = side * self.limit_rad - weight
            limited_q = q + self.slipped * speed + self.moved * pull
            limited_speed = self.faded * speed + self.pushed * pull
            # The mean pull over the step decides; a stiff loop is past its target by then.
            mean = away - limited_q - self.brake * limited_speed
            is_limited = side * mean > twice_limit
            q = torch.where(is_limited, limited_q, loop_q)
            speed = torch.where(is_limited, limited_speed, loop_speed)
            acts = is_limited if acts is None else acts | is_limited
        assert acts is not None, "there is a step"
        return torch.where(acts, q, free[0]), torch.where(acts, speed, free[1])


@dataclass(frozen=True, eq=False)
class PartSolution:
    """Motion over a part of a period with one command.

    Attributes:
        loop: Without a limit of the torque.
        limited: With one; `None` where there is none.
    """

    loop: LoopSolution
    limited: LimitedSolution | None


class ServoRun:
    """A run of a `ServoModel`; see `actuators.contracts.PlannedRun`.

    Targets behind the play depend on commands alone: they are computed beforehand.
    """

    def __init__(self, model: ServoModel, u: torch.Tensor, first: int) -> None:
        self._model, self._first = model, first
        earlier, later, part = split_run_commands(
            u, model.parameters["dead_time_s"] / model.period_s, first
        )
        self._earlier, self._later = model.read_target(earlier), model.read_target(later)
        limit = model.read_limit()
        if limit is not None and not bool((limit.limit_rad < NO_LIMIT_RAD).any()):
            limit = None
        self._solutions = model.solve(part, limit)
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
