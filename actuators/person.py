"""Model of a human at the levers who follows the policy's proposals imperfectly.

One control period, for a proposal `p` that is shown during it:

    attention    looks at the display every `attention_s` and keeps the last proposal seen
    reaction     a seen proposal acts `delay_s` later; within the period where it changes, to the
    fraction choice       an exclusive joint or the others, whichever is asked for more; of those
    the `joints_at_once` largest, and a lever
                 once taken is kept for `grip_s`: nobody changes hands twenty times a second
    hand         first-order lag `lag_s` towards it, integrated exactly; a lever that is let go
    springs back amplitude    gain, tremor, the lever's dead zone, the lever's stops

The command of a period is the lever's mean over it, as a logger of 20 Hz would have it. Delay and
lag are the usual range of compensatory tracking (McRuer et al., AFFDL-TR-65-15, 1965: 0.1 to 0.4 s
and 0.1 to 0.2 s), intermittent attention is that of Loram et al. (J. Physiol. 589, 2011), tremor in
proportion to the deflection that of Harris and Wolpert (Nature 394, 1998).
"""

from __future__ import annotations

import math
import zlib
from typing import ClassVar

import torch

from actuators.effects.ranges import CHANCE, EffectNumber, ParameterRanges, Value
from actuators.models.parameters import draw_normal, open_valve, select_commands_in_force
from brokk_rl.commands import select_levers
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine, mask_exclusive_joints
from brokk_rl.spec import spec

Range = float | tuple[float, float]
"""A number of a person, or a range [low, high] from which each environment draws at each reset."""


@spec
class HumanFollower:
    """A person at the levers: reaction delay, hand lag, dead zone, gain error, few levers at once.

    Each number may be a range `[low, high]`, drawn per environment at each reset: another person.

    Attributes:
        delay_s: Reaction delay, from the display to the hand.
        lag_s: Time constant of the hand.
        attention_s: Time between two looks at the display; 0: never looks away.
        gain: Deflection over the one asked for.
        tremor: Standard deviation of the deflection, as a part of it; new in each control period.
        dead_zone: Deflection below which a lever commands nothing; a full one still commands fully.
            May be given by joint.
        joints_at_once: Levers moved at the same time, the largest first; `null`: all.
        grip_s: Time for which a lever once taken is kept, as long as it is asked for, before a
            larger request draws the hand away.
    """

    label: ClassVar = "person"

    delay_s: Range
    lag_s: Range
    attention_s: Range
    gain: Range
    tremor: Range
    dead_zone: Value
    joints_at_once: int | tuple[int, int] | None
    grip_s: Range

    numbers: ClassVar = {
        "delay_s": EffectNumber("s", none=0.0, typical=0.3, bounds=(0.0, 2.0), per_joint=False),
        "lag_s": EffectNumber("s", none=0.0, typical=0.15, bounds=(0.0, 2.0), per_joint=False),
        "attention_s": EffectNumber("s", none=0.0, typical=0.3, bounds=(0.0, 5.0), per_joint=False),
        "gain": EffectNumber("1", none=1.0, typical=0.85, bounds=(0.1, 3.0), per_joint=False),
        "tremor": EffectNumber("1", none=0.0, typical=0.03, bounds=(0.0, 1.0), per_joint=False),
        "dead_zone": EffectNumber("1", none=0.0, typical=0.05, bounds=(0.0, 0.5)),
        "grip_s": EffectNumber("s", none=0.0, typical=0.5, bounds=(0.0, 5.0), per_joint=False),
    }
    """What is known about each number; `joints_at_once` is a count."""

    def check(self) -> None:
        low, high = self.levers(1)
        if not 1 <= low <= high:
            raise ConfigError(
                f"follower.joints_at_once: expected 1 or more, a range of it, or null, got {self.joints_at_once}"
            )

    def levers(self, num_joints: int) -> tuple[int, int]:
        """Return the smallest and largest number of levers moved at once."""
        number = num_joints if self.joints_at_once is None else self.joints_at_once
        return number if isinstance(number, tuple) else (number, number)

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> HumanFollowerModel:
        """Return `num_envs` persons; see `brokk_rl.contracts.actuator.Follower`.

        Raises:
            ConfigError: A number is out of bounds, a range upside down, or a joint unknown.
        """
        return HumanFollowerModel(self, machine, num_envs, device)


class HumanFollowerModel:
    """Persons at the levers; fulfils `brokk_rl.contracts.actuator.FollowerModel`.

    Attributes:
        state: Proposals seen, levers held, personal parameters and draw counters.
    """

    def __init__(
        self, person: HumanFollower, machine: Machine, num_envs: int, device: torch.device
    ) -> None:
        self._period_s = machine.period_s
        self._exclusive = torch.as_tensor(machine.is_exclusive, device=device)
        self._levers = person.levers(machine.num_joints)
        fields = {name: getattr(person, name) for name in person.numbers}
        low, high = self._levers
        # The whole numbers are equally likely: each is the middle of an interval of its own.
        if low < high:
            fields["joints_at_once"] = (low - 0.5, high + 0.5)
        else:
            fields["joints_at_once"] = float(low)
        numbers = person.numbers | {
            "joints_at_once": EffectNumber("1", None, 2.0, (0.0, math.inf), per_joint=False)
        }
        self._trembles = person.tremor not in (0.0, (0.0, 0.0))
        salt = zlib.crc32(b"follower")
        self._ranges = ParameterRanges(
            fields, numbers, "all", machine, num_envs, device, self._trembles, salt, "follower"
        )
        longest_s = person.delay_s[1] if isinstance(person.delay_s, tuple) else person.delay_s
        num_seen = math.ceil(longest_s / machine.period_s - 1e-6) + 2
        shape = (num_envs, machine.num_joints)
        self.state = {
            "seen": torch.zeros((num_envs, num_seen, machine.num_joints), device=device),
            "hand": torch.zeros(shape, device=device),
            "held_s": torch.zeros(shape, device=device),
            "since_look": torch.zeros((num_envs, 1), device=device),
            **self._ranges.state,
        }
        self.reset(torch.ones(num_envs, dtype=torch.bool, device=device))

    def reset(self, mask: torch.Tensor) -> None:
        """Put a new person at the levers in the environments of `mask`, `(N,)` bool."""
        self._ranges.redraw(mask)
        self.state["seen"].masked_fill_(mask[:, None, None], 0.0)
        self.state["hand"].masked_fill_(mask[:, None], 0.0)
        self.state["held_s"].masked_fill_(mask[:, None], 0.0)
        looking = self._ranges.value["attention_s"] / self._period_s
        self.state["since_look"].copy_(
            torch.where(mask[:, None], looking, self.state["since_look"])
        )

    def step(self, proposed: torch.Tensor) -> torch.Tensor:
        """Return the given command, `(N, J)`, while `proposed`, `(N, J)`, is shown."""
        value, state = self._ranges.value, self.state
        self._look(proposed)
        delay = (value["delay_s"] / self._period_s).expand_as(proposed)
        earlier, later, part = select_commands_in_force(state["seen"], delay)
        held = self._held(later)
        after, first = self._reach(state["hand"], earlier, part)
        hand, second = self._reach(after, later, 1.0 - part)
        state["hand"].copy_(torch.where(held, hand, 0.0))
        deflection = torch.where(held, first + second, 0.0) * value["gain"]
        if self._trembles:
            counter = self._ranges.advance()
            assert counter is not None
            deflection = deflection * (
                1.0 + value["tremor"] * draw_normal(counter, CHANCE, proposed.shape[1])
            )
        return open_valve(deflection.clamp(-1.0, 1.0), value["dead_zone"], value["dead_zone"])

    def _look(self, proposed: torch.Tensor) -> None:
        """Append the proposal where it is time to look, else the one seen before."""
        seen, since = self.state["seen"], self.state["since_look"]
        between = self._ranges.value["attention_s"] / self._period_s
        looks = since >= between - 1e-4
        # what is over counts towards the next look, so that looks are `attention_s` apart on
        # average
        since.copy_(torch.where(looks, (since - between).clamp(0.0, 1.0), since) + 1.0)
        newest = torch.where(looks, proposed, seen[:, -1])
        seen.copy_(seen.roll(-1, 1))
        seen[:, -1] = newest

    def _held(self, asked: torch.Tensor) -> torch.Tensor:
        """Return the levers that the person holds, `(N, J)` bool, for requests `asked`, `(N, J)`."""
        # of what is asked for equally, not at all for example, the lever that is in the hand
        priority = asked.abs() + 1e-6 * self.state["hand"].abs()
        alone = torch.where(self._exclusive, priority, 0.0).amax(1)
        among = torch.where(self._exclusive, 0.0, priority).amax(1)
        free = mask_exclusive_joints(self._exclusive, alone > among)
        if self._levers[0] >= asked.shape[1]:
            return free
        taken, held_s = asked != 0, self.state["held_s"]
        kept = taken & (held_s > 0) & (held_s < self._ranges.value["grip_s"] - 1e-6)
        most = self._ranges.value["joints_at_once"].round().clamp(*self._levers)
        held = free & select_levers(torch.where(free, priority + 2.0 * kept, -1.0), most)
        held_s.copy_(torch.where(held & taken, held_s + self._period_s, 0.0))
        return held

    def _reach(
        self, hand: torch.Tensor, target: torch.Tensor, part: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the hand after `part` of a period toward `target`, and its share of the mean."""
        lag = self._ranges.value["lag_s"] / self._period_s
        left = torch.exp(-part / lag.clamp(min=1e-9))
        moved = (hand - target) * left
        return target + moved, target * part + (hand - target) * lag * (1.0 - left)
