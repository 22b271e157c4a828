"""Machines that differ: in each episode some effects of the library are there and others are not."""

import zlib
from dataclasses import fields, replace

import torch

from actuators.effects.effect import EffectSpec, MachineTensors, Memory, StepInputs, broadcast_rows
from actuators.effects.ranges import EffectNumber, Joints, ParameterRanges, Value
from actuators.effects.timing import DelayJitter
from actuators.models.parameters import OTHER, PerJoint
from brokk_rl.contracts.actuator import ActuatorModel
from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.spec import spec

RECENT = 4
"""Commands that the effects on commands are shown; they look back no further, and short windows are
cheap."""
SPEED = ("speed", "joints")
ORDER = ("command", *SPEED, "measurement")


@spec
class Library:
    """Machines that differ: each effect is there in a share of the environments, with a size of its own, drawn at each reset.

    The same as its effects one around the other, the first of each side nearest to the machine, at
    a third of the cost: they share one draw, one window of commands, and one account of what they
    have added to the motion.

    Attributes:
        share: Part of the environments that have an effect; or by effect, `other` for the rest.
        effects: Effects by name; on actuation and sensing, an added dead time before the other
            effects on commands, jitter last.
    """

    share: float | dict[str, float]
    effects: dict[str, EffectSpec]

    def check(self) -> None:
        for name, share in self._shares().items():
            if not 0 <= share <= 1:
                raise ConfigError(f"effect.library.share: expected 0 to 1, got {share} for {name}")
        for name in self.share if isinstance(self.share, dict) else ():
            if name not in (*self.effects, OTHER):
                raise ConfigError(
                    f"effect.library.share: '{name}' is no effect of it; {list_choices(name, (*self.effects, OTHER))}"
                )
        on_commands = [name for name, effect in self.effects.items() if effect.side == "command"]
        for name, effect in self.effects.items():
            if effect.side not in ORDER:
                raise ConfigError(
                    f"effect.library.effects.{name}: acts on {effect.side}; put it beside the library, effect=[library,{name}]"
                )
            if effect.delays and name != on_commands[0]:
                raise ConfigError(
                    f"effect.library.effects: '{name}' must come before {on_commands[0]}: nearest to the machine"
                )
            if isinstance(effect, DelayJitter) and name != on_commands[-1]:
                raise ConfigError(
                    f"effect.library.effects: '{name}' must come behind {on_commands[-1]}: it delays what is sent"
                )

    def _shares(self) -> dict[str, float]:
        share: PerJoint = self.share
        if not isinstance(share, dict):
            return dict.fromkeys(self.effects, share)
        return {name: share.get(name, share.get(OTHER, 1.0)) for name in self.effects}

    def wrap(
        self, model: ActuatorModel, machine: Machine, num_envs: int, device: torch.device
    ) -> "LibraryModel":
        """Returns `model` with the effects around it; see `brokk_rl.contracts.actuator.Effect`.

        Raises:
            ConfigError: a number is out of bounds, or a joint unknown.
        """
        return LibraryModel(self, self._shares(), model, machine, num_envs, device)


class LibraryModel:
    """An actuator model with the effects around it; fulfils `brokk_rl.contracts.actuator.SensingModel`.

    An episode begins at rest: commands from before it reach the valves as they are.

    Attributes:
        inner: The model inside.
        parameters: Numbers by name, `effect.number`, `(N, J)` or `(N, 1)`.
    """

    def __init__(
        self,
        library: Library,
        shares: dict[str, float],
        inner: ActuatorModel,
        machine: Machine,
        num_envs: int,
        device: torch.device,
    ) -> None:
        self.inner = inner
        given: dict[str, Value] = {}
        numbers: dict[str, EffectNumber] = {}
        joints: dict[str, Joints] = {}
        for name, effect in library.effects.items():
            values = {field.name: getattr(effect, field.name) for field in fields(effect)}  # pyright: ignore[reportArgumentType]
            joints[name] = values.pop("joints", "all")
            given |= {f"{name}.{key}": value for key, value in values.items()}
            numbers |= {f"{name}.{key}": number for key, number in effect.numbers.items()}
        effects = library.effects
        chance = any(effect.stochastic for effect in effects.values())
        salt = zlib.crc32(b"library") + len(inner.state)
        where = "effect.library.effects"
        self._ranges = ParameterRanges(
            given, numbers, joints, machine, num_envs, device, chance, salt, where, shares
        )
        self.parameters = self._ranges.value
        self._value = {
            name: {key: self.parameters[f"{name}.{key}"] for key in effect.numbers}
            for name, effect in effects.items()
        }
        self._salt = {
            name: zlib.crc32(name.encode()) * 2_654_435_761
            for name, effect in effects.items()
            if effect.stochastic
        }
        # a command passes from the last effect to the first, motion and measurement from the first
        # to the last
        self._delays = {name: effect for name, effect in effects.items() if effect.delays}
        commanded = [
            name
            for name, effect in effects.items()
            if effect.side == "command" and name not in self._delays
        ]
        self._commands = {name: effects[name] for name in reversed(commanded)}
        self._motions = {name: effect for name, effect in effects.items() if effect.side in SPEED}
        self._measured = {
            name: effect for name, effect in effects.items() if effect.side == "measurement"
        }
        self._weighed = any(effect.weighed for effect in self._motions.values())
        self._plant = MachineTensors(machine, device, weighed=self._weighed)
        rest = torch.zeros(num_envs, machine.num_history, machine.num_joints, device=device)
        self._fresh = torch.ones(num_envs, dtype=torch.bool, device=device)
        self._state = {"fresh": self._fresh, "shift": rest.clone(), "valve": rest.clone()}
        for name, effect in (
            *self._commands.items(),
            *self._delays.items(),
            *self._motions.items(),
        ):
            history = History(q=rest, u=rest if name in self._delays else rest[:, -RECENT:])
            begun = effect.begin(self._moment(name, {}, history, rest[:, -1], None, None))
            self._state |= {f"{name}.{key}": value.clone() for key, value in begun.items()}
        self.reset(self._fresh)

    @property
    def state(self) -> Memory:
        """What the effects remember and which are there, as `effect.…` and `drawn.effect.…`; `inner.…` for the model inside."""
        return (
            self._state
            | self._ranges.state
            | {f"inner.{name}": value for name, value in self.inner.state.items()}
        )

    @property
    def sides(self) -> frozenset[str]:
        """Sides of all effects from here inwards."""
        own = {
            name
            for name, those in (("measurement", self._measured), ("speed", self._motions))
            if those
        }
        return frozenset(own) | getattr(self.inner, "sides", frozenset())

    def reset(self, mask: torch.Tensor) -> None:
        """Forgets in the environments of `mask`, shape `(N,)` bool, and draws which effects they have, of which size."""
        self.inner.reset(mask)
        self._fresh.logical_or_(mask)
        self._ranges.redraw(mask)

    def step(self, history: History) -> torch.Tensor:
        """Returns the joint positions one control period later, shape `(N, J)`."""
        state, fresh = self._state, self._fresh[:, None, None]
        counter = self._ranges.advance() if self._salt else None
        still = torch.zeros_like(history.q[:, -1])
        u = history.u[:, -RECENT:]
        for name, effect in self._commands.items():
            recent = History(q=history.q[:, -RECENT:], u=u)
            u = self._after(
                name, effect.commands(self._now(name, effect, recent, still, counter, None))
            )
        before = torch.where(fresh, history.u[:, :-1], state["valve"][:, 1:])
        state["valve"].copy_(torch.cat((before, u[:, -1:]), 1))
        valve = state["valve"]
        for name, effect in self._delays.items():
            delayed = History(q=history.q, u=valve)
            valve = self._after(
                name, effect.commands(self._now(name, effect, delayed, still, counter, None))
            )

        # what the inner model sees of the past is its own doing; see `Wrapped`
        shift = state["shift"].masked_fill(fresh, 0.0)
        predicted = moved_to = self.inner.step(History(q=history.q + shift, u=valve))
        weight = self._plant.weight(history.q[:, -1]) if self._weighed else None
        for name, effect in self._motions.items():
            now = self._now(name, effect, history, moved_to - history.q[:, -1], counter, weight)
            moved_to = moved_to + self._after(name, effect.extra(now))
        lower, upper = (
            torch.minimum(self._plant.lower, predicted),
            torch.maximum(self._plant.upper, predicted),
        )
        moved_to = torch.minimum(torch.maximum(moved_to, lower), upper)
        added = (moved_to - predicted)[:, None]
        state["shift"].copy_(torch.cat((shift[:, 1:] + added, torch.zeros_like(added)), 1))
        self._fresh.fill_(False)
        return moved_to

    def measure(self, q: torch.Tensor) -> torch.Tensor:
        """Returns what the sensors say at the true positions `q`, `(N, J)`; to be called once a control period."""
        q = getattr(self.inner, "measure", _keep_unchanged)(q)
        counter = self._ranges.advance() if self._salt else None
        for name, effect in self._measured.items():
            q = effect.measured(
                q, self._value[name], None if counter is None else counter + self._salt.get(name, 0)
            )
        return q

    def truth(self, q: torch.Tensor) -> torch.Tensor:
        """Returns the likeliest true positions where the sensors say `q`, `(N, J)` or `(N, H, J)`."""
        for name, effect in reversed(self._measured.items()):
            q = effect.truth(q, self._value[name])
        return getattr(self.inner, "truth", _keep_unchanged)(q)

    def tool(self, point_m: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
        """Returns where an outside instrument finds the tool that the model has at `point_m`, `(N, 3)`: nothing here moves it."""
        return getattr(self.inner, "tool", _keep_unchanged)(point_m, q)

    def target(self, point_m: torch.Tensor) -> torch.Tensor:
        """Returns where the camera sees a point, `(N, 3)`: nothing here moves it."""
        return getattr(self.inner, "target", _keep_unchanged)(point_m)

    def misplacement(self, q: torch.Tensor) -> torch.Tensor:
        """Returns how far off the controller believes a target near the tool, `(N, 3)` in m, at the positions `q`."""
        inner = getattr(self.inner, "misplacement", None)
        return torch.zeros_like(q[:, :3]) if inner is None else inner(q)

    def _now(
        self,
        name: str,
        effect: EffectSpec,
        history: History,
        moved: torch.Tensor,
        counter: torch.Tensor | None,
        weight: torch.Tensor | None,
    ) -> StepInputs:
        """Returns the moment as an effect sees it, with what it remembers; after a reset with what it begins with."""
        now = self._moment(name, {}, history, moved, counter, weight)
        begun = effect.begin(now)
        memory = {
            key: torch.where(
                broadcast_rows(self._fresh, value), value, self._state[f"{name}.{key}"]
            )
            for key, value in begun.items()
        }
        return replace(now, memory=memory)

    def _moment(
        self,
        name: str,
        memory: Memory,
        history: History,
        moved: torch.Tensor,
        counter: torch.Tensor | None,
        weight: torch.Tensor | None,
    ) -> StepInputs:
        own = counter + self._salt[name] if counter is not None and name in self._salt else None
        return StepInputs(self._value[name], memory, history, self._plant, moved, own, weight)

    def _after(self, name: str, result: tuple[torch.Tensor, Memory]) -> torch.Tensor:
        """Keeps the memory of an effect; returns what it made."""
        for key, value in result[1].items():
            self._state[f"{name}.{key}"].copy_(value)
        return result[0]


def _keep_unchanged(value: torch.Tensor, *_: torch.Tensor) -> torch.Tensor:
    return value
