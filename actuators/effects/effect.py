"""Effects around an actuator model: the base class of their specs, and the one model of all.

An effect of a package of your own is a spec that derives from `EffectSpec`, sets `side` and
`numbers`, which become its fields, and overrides the method of its side. `EffectChain` does the rest: parameters per
environment, memory, resets and random draws.
"""

from __future__ import annotations

import inspect
import re
import zlib
from collections.abc import Mapping
from dataclasses import fields
from types import MappingProxyType
from typing import Any, ClassVar, Literal

import torch

from actuators.contracts import PlannedRun
from actuators.effects.planned_run import ChainRun, change_run_commands
from actuators.effects.ranges import EffectNumber, Joints, ParameterRanges, Value, check_numbers
from actuators.effects.step_inputs import Memory, RunMemory, StepInputs, StepMemory, join_name
from actuators.models.force_drive import change_drive
from actuators.models.machine_tensors import MachineTensors
from brokk_rl.contracts.actuator import ActuatorModel
from brokk_rl.errors import ConfigError
from brokk_rl.history import History
from brokk_rl.machine import Machine

Side = Literal["drive", "command", "speed", "joints", "measurement", "kinematics"]
MOTION: tuple[Side, ...] = ("speed", "joints")
"""Sides that change the increment which the inner model returns."""
ANY_INTERFACE = frozenset({"speed", "position", "torque"})
"""Machines of all interfaces, see `Machine.interface`."""
SALT_STEP = 2_654_435_761
"""Knuth's multiplicative hash constant (2^32 / golden ratio): spreads the salts of effects."""


class EffectSpec:
    """Base class of effects: an effect overrides the method of its side and keeps the others.

    The class attributes are read by the diagnosis too.

    Attributes:
        side: Where the effect acts; see `actuators.effects`.
        stage: Where it lies on the way from command to estimate (`where.stage` of
            `diagnosis.json`).
        numbers: Unit, neutral value, typical size and bounds of each number.
        stochastic: Whether it draws random numbers in every step.
        smooth: Whether small changes of its numbers change the motion a little.
        delays: Whether it shifts all commands that the inner model sees, not only the newest; its
            number is then the shift, s.
        recent: Number of newest commands that it looks at, where it changes the newest only and
            asks for no positions but in `begin`; `None`: any. With 1 each command that it returns depends
            on the same command only. See `EffectChain.plan_run`.
        layer: Place among the effects of its side, from the machine outwards; a command passes the
            largest first.
        placed: Whether its `begin` asks for the positions of the joints.
        shared: Whether it has one cause for all joints (frames, clocks), so that it is hardly ever
            on a few of them.
        running: Name of the number that is the time since the machine was started. That number is
            known and not fitted.
        interfaces: Quantities commanded of the machines that it is on; see `Machine.interface`.
        variants: Classes with the same fields that are this effect on machines of other interfaces.
        label: Its name where it is not that of the class: the name of the effect it is a variant of.
    """

    side: ClassVar[Side]
    stage: ClassVar[Literal["actuation", "sensing", "kinematics", "timing", "perception"]] = (
        "actuation"
    )
    numbers: ClassVar[dict[str, EffectNumber]]
    stochastic: ClassVar[bool] = False
    smooth: ClassVar[bool] = True
    delays: ClassVar[bool] = False
    recent: ClassVar[int | None] = None
    layer: ClassVar[int] = 0
    placed: ClassVar[bool] = False
    shared: ClassVar[bool] = False
    running: ClassVar[str | None] = None
    interfaces: ClassVar[frozenset[str]] = frozenset({"speed"})
    variants: ClassVar[Mapping[str, type[EffectSpec]]] = MappingProxyType({})
    label: ClassVar[str] = ""

    def __init_subclass__(cls) -> None:
        """Give the spec a field for each of its numbers, and `joints` where they are by joint.

        A subclass states a number itself only to give it a value that older files mean.
        """
        numbers: dict[str, EffectNumber] = cls.__dict__.get("numbers", {})
        fields: dict[str, Any] = dict.fromkeys(numbers, Value)
        if any(number.per_joint for number in numbers.values()):
            fields = {"joints": Joints} | fields
        cls.__annotations__ = fields | inspect.get_annotations(cls)

    @classmethod
    def find_variant(cls, machine: Machine) -> type[EffectSpec] | None:
        """Return the class that is this effect on the machine; `None`: the machine cannot have it."""
        if machine.interface in cls.interfaces:
            return cls
        return cls.variants.get(machine.interface)

    def adapt(self, machine: Machine) -> EffectSpec | None:
        """Return the effect as it is on the machine; `None`: the machine cannot have it."""
        variant = self.find_variant(machine)
        if variant is None or variant is type(self):
            return self if variant else None
        return variant(**{field.name: getattr(self, field.name) for field in fields(self)})  # pyright: ignore[reportArgumentType]

    @classmethod
    def name(cls) -> str:
        """Return the name of the effect, as in `effect=[name]`."""
        return cls.label or re.sub(r"(?<!^)(?=[A-Z])", "_", cls.__name__).lower()

    def wrap(
        self, model: ActuatorModel, machine: Machine, num_envs: int, device: torch.device
    ) -> EffectChain:
        """Return `model` with the effect around it."""
        self.check_machine(machine)
        return EffectChain(
            {"": self},
            model,
            machine,
            num_envs,
            device,
            salt=zlib.crc32(self.name().encode()),
            where=f"effect.{self.name()}",
        )

    def check_machine(self, machine: Machine, above: str = "effect") -> None:
        """Refuse an effect that does not occur on a machine; needs no torch.

        Args:
            machine: The machine.
            above: Config node that holds the effect, for messages.

        Raises:
            ConfigError: A number is out of bounds, or a joint is unknown.
        """
        name = self.name()
        variant = self.find_variant(machine)
        if variant is None:
            raise ConfigError(
                f"effect={name}: joints of machine '{machine.name}' are commanded by {machine.interface}, where it does not "
                f"occur; it is for joints commanded by {', '.join(sorted({*self.interfaces, *self.variants}))}"
            )
        check_numbers(vars(self), variant.numbers, machine, f"{above}.{name}")

    def begin(self, now: StepInputs) -> Memory:
        """Return the initial memory at `now`, at rest or in the middle of a recording."""
        return {}

    def commands(self, now: StepInputs) -> tuple[torch.Tensor, Memory]:
        """Return the commands for the inner model, `(N, H, J)`, and the memory."""
        return now.history.u, {}

    def extra(self, now: StepInputs) -> tuple[torch.Tensor, Memory]:
        """Return the motion beyond `now.moved`, `(N, J)`, and the memory; speed side."""
        return torch.zeros_like(now.moved), {}

    def measured(
        self, q: torch.Tensor, value: dict[str, torch.Tensor], counter: torch.Tensor | None
    ) -> torch.Tensor:
        """Return the sensor readings at the true positions `q`, `(N, J)`; measurement side."""
        return q

    def truth(self, q: torch.Tensor, value: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return likely true positions for readings `q`, `(N, J)` or `(N, H, J)`."""
        return q

    def tool(
        self,
        point_m: torch.Tensor,
        q: torch.Tensor,
        value: dict[str, torch.Tensor],
        plant: MachineTensors,
    ) -> torch.Tensor:
        """Return the true place of the tool that the model has at `point_m`, `(N, 3)`."""
        return point_m

    def target(self, point_m: torch.Tensor, value: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return where the camera sees a point, `(N, 3)` in the base frame; kinematics."""
        return point_m


class EffectChain:
    """An actuator model with effects around it; fulfils `brokk_rl.contracts.actuator.SensingModel`.

    A command passes from the last effect to the first, motion and measurement from the first to
    the last. A neutral effect leaves the inner model unchanged bit for bit.

    Args:
        effects: Effects by name, the first nearest to the machine. The name is a prefix of the
            names of its parameters and its state; a single effect has the empty name.
        inner: The model inside.
        machine: The machine.
        num_envs: Number of environments, `N`.
        device: Where the tensors live.
        salt: Keeps the random draws of several chains apart.
        where: Config node named in messages.
        shares: Part of the environments that have an effect, by effect; see `ParameterRanges`.
        num_recent: Number of commands that effects on commands see; they are then applied once to
            each command, and commands from before an episode stay as they are. `None`: the whole
            history, at each step anew.

    Attributes:
        effects: The effects by name.
        inner: The model inside.
        commands: Effects on commands, in the order in which a command passes through them.
        motions: Effects on motion, the first nearest to the machine.
        plant: Constants of the machine.
        parameters: Numbers by name, `(N, J)` or `(N, 1)`. Write in place or replace an entry to
            simulate `N` candidates side by side.
    """

    def __init__(
        self,
        effects: Mapping[str, EffectSpec],
        inner: ActuatorModel,
        machine: Machine,
        num_envs: int,
        device: torch.device,
        *,
        salt: int,
        where: str,
        shares: Mapping[str, float] = MappingProxyType({}),
        num_recent: int | None = None,
    ) -> None:
        self.inner: Any = inner
        self._num_recent = num_recent
        known = {name: effect.adapt(machine) for name, effect in effects.items()}
        self.effects = effects = {name: one for name, one in known.items() if one is not None}
        given: dict[str, Value] = {}
        numbers: dict[str, EffectNumber] = {}
        joints: dict[str, Joints] = {}
        for name, effect in effects.items():
            values = {field.name: getattr(effect, field.name) for field in fields(effect)}  # pyright: ignore[reportArgumentType]
            joints[name] = values.pop("joints", "all")
            given |= {join_name(name, key): value for key, value in values.items()}
            numbers |= {join_name(name, key): number for key, number in effect.numbers.items()}
        stochastic = any(effect.stochastic for effect in effects.values())
        salt += len(inner.state)
        self._ranges = ParameterRanges(
            given, numbers, joints, machine, num_envs, device, stochastic, salt, where, shares
        )
        self.parameters = self._ranges.value
        self._salts: dict[str, int] = {}
        for name, effect in effects.items():
            if effect.stochastic:
                self._salts[name] = zlib.crc32(name.encode()) * SALT_STEP
        commanding = {name: e for name, e in effects.items() if e.side == "command"}
        self._delays = {name: effect for name, effect in commanding.items() if effect.delays}
        self._others = {n: e for n, e in reversed(commanding.items()) if not e.delays}
        self.commands: dict[str, Any] = self._others | self._delays
        self.motions: dict[str, Any] = {name: e for name, e in effects.items() if e.side in MOTION}
        self._drives: dict[str, Any] = {n: e for n, e in effects.items() if e.side == "drive"}
        self._change_drives(where)
        self._measured = {name: e for name, e in effects.items() if e.side == "measurement"}
        self._placed = {name: e for name, e in effects.items() if e.side == "kinematics"}
        self.plant = MachineTensors(machine, device)
        if machine.has_bodies:
            self.plant.prepare()
        self._fresh = torch.ones(num_envs, dtype=torch.bool, device=device)
        self._memory = self._build_memory(machine, num_envs, device)
        self._ranges.redraw(self._fresh)

    @property
    def state(self) -> Memory:
        """Memory and drawn parameters of the effects; `inner.…` for the model inside."""
        own = {"fresh": self._fresh, **self._memory} if self._memory else {}
        inner = {f"inner.{name}": value for name, value in self.inner.state.items()}
        return own | self._ranges.state | inner

    @property
    def sides(self) -> frozenset[str]:
        """Sides of all effects, of the models inside too."""
        own = frozenset(effect.side for effect in self.effects.values())
        return own | getattr(self.inner, "sides", frozenset())

    def reset(self, mask: torch.Tensor) -> None:
        """Forget in the environments of `mask`, `(N,)`; draw parameters."""
        self.inner.reset(mask)
        self._fresh.logical_or_(mask)
        self._ranges.redraw(mask)

    def step(self, history: History) -> torch.Tensor:
        """Return the joint positions one control period later, shape `(N, J)`."""
        self._change_drives()
        if not (self.commands or self.motions):
            return self.inner.step(history)
        counter, memory = self.advance_draws(), StepMemory(self._memory, self._fresh)
        u = self._change_commands(history, memory, counter)
        if self.motions:
            q = self._change_motion(history, u, memory, counter)
        else:
            q = self.inner.step(History(q=history.q, u=u))
        self._fresh.fill_(False)
        return q

    def plan_run(
        self, u: torch.Tensor, first: int, q: torch.Tensor | None = None
    ) -> PlannedRun | None:
        """See `PlannableModel.plan_run`; effects on commands are applied to the whole run first."""
        self._change_drives()
        if not self.is_plannable:
            return None
        if q is None and any(effect.placed for effect in self.commands.values()):
            return None
        seen = u
        for name in self.commands:
            seen = change_run_commands(self, name, seen, first, q)
        inner = self.inner.plan_run(seen, first, q)
        if inner is None or not self.motions:
            return inner
        return ChainRun(self, inner, u, first)

    @property
    def is_plannable(self) -> bool:
        """True if all commands of a run can be given to its effects, and to the model inside, beforehand."""
        if not hasattr(self.inner, "plan_run") or not getattr(self.inner, "is_plannable", True):
            return False
        told = all(e.delays or e.recent for e in self.commands.values())
        told &= all(len(effect.numbers) == 1 for effect in self._delays.values())
        # One counter a step: several effects that draw would draw in another order.
        return told and self._num_recent is None and (not self._salts or len(self.effects) == 1)

    @property
    def delay_s(self) -> torch.Tensor:
        """See `PlannableModel.plan_run`."""
        own_s = [value for name in self._delays for value in self.get_values(name).values()]
        return (self.inner.delay_s + sum(own_s)).clamp(min=0.0)

    def advance_draws(self) -> torch.Tensor | None:
        """Advance to the next draws and return their counter, `(N,)`; `None` without draws."""
        return self._ranges.advance() if self._salts else None

    def measure(self, q: torch.Tensor) -> torch.Tensor:
        """Return the readings at true positions `q`, `(N, J)`; once a control period."""
        q = getattr(self.inner, "measure", _keep_unchanged)(q)
        if not self._measured:
            return q
        counter = self.advance_draws()
        for name, effect in self._measured.items():
            q = effect.measured(q, self.get_values(name), self.salt_counter(name, counter))
        return q

    def truth(self, q: torch.Tensor) -> torch.Tensor:
        """Return the likeliest true positions for readings `q`, `(N, J)` or `(N, H, J)`."""
        for name, effect in reversed(self._measured.items()):
            q = effect.truth(q, self.get_values(name))
        return getattr(self.inner, "truth", _keep_unchanged)(q)

    def tool(self, point_m: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
        """Return the true place of the tool that the model has at `point_m`, `(N, 3)`."""
        point_m = getattr(self.inner, "tool", _keep_unchanged)(point_m, q)
        for name, effect in self._placed.items():
            point_m = effect.tool(point_m, q, self.get_values(name), self.plant)
        return point_m

    def target(self, point_m: torch.Tensor) -> torch.Tensor:
        """Return where the camera sees a point, `(N, 3)` in the base frame."""
        point_m = getattr(self.inner, "target", _keep_unchanged)(point_m)
        for name, effect in self._placed.items():
            point_m = effect.target(point_m, self.get_values(name))
        return point_m

    def misplacement(self, q: torch.Tensor) -> torch.Tensor:
        """Return the error of the controller's estimate of a target near the tool, `(N, 3)` in m.

        A controller with the drawn kinematics misses by as much as one with right kinematics and a
        displaced target: the simulated geometry stays and the estimate moves.
        """
        if self._placed:
            tip_m = self.plant.kinematics.pose(q).tip_in_base_m
            return self.target(self.tool(tip_m, q)) - tip_m
        inner = getattr(self.inner, "misplacement", None)
        return torch.zeros_like(q[:, :3]) if inner is None else inner(q)

    def _change_drives(self, where: str = "effect") -> None:
        """Write the numbers of effects on drives into the drive; an entry may have been replaced."""
        for name, effect in self._drives.items():
            values = self.get_values(name)
            changes = {effect.drives.get(key, key): value for key, value in values.items()}
            change_drive(self.inner, changes, where)

    def move(
        self,
        history: History,
        predicted: torch.Tensor,
        counter: torch.Tensor | None,
        memory: StepMemory | RunMemory,
    ) -> torch.Tensor:
        """Return the next positions with all effects on motion; these never move a joint through a stop.

        Args:
            history: Positions and commands, `(N, H, J)`.
            predicted: Next positions without the effects, `(N, J)`.
            counter: Of the draws.
            memory: Of the effects.
        """
        q, moved_to = history.q[:, -1], predicted
        for name, effect in self.motions.items():
            now = self.describe(name, history, moved_to - q, counter)
            extra, kept = effect.extra(memory.recall(name, effect, now))
            memory.keep(name, kept)
            moved_to = moved_to + extra
        lower = torch.minimum(self.plant.lower, predicted)
        return moved_to.clamp(lower, torch.maximum(self.plant.upper, predicted))

    def describe(
        self, name: str, history: History, moved: torch.Tensor, counter: torch.Tensor | None
    ) -> StepInputs:
        """Return the inputs of one effect, without a memory."""
        values, draws = self.get_values(name), self.salt_counter(name, counter)
        return StepInputs(values, {}, history, self.plant, moved, draws)

    def _change_commands(
        self, history: History, memory: StepMemory, counter: torch.Tensor | None
    ) -> torch.Tensor:
        """Return the commands that the inner model gets, `(N, H, J)`."""

        def apply(name: str, seen: History) -> torch.Tensor:
            effect = self.commands[name]
            now = self.describe(name, seen, torch.zeros_like(history.q[:, -1]), counter)
            u, kept = effect.commands(memory.recall(name, effect, now))
            memory.keep(name, kept)
            return u

        recent = slice(-(self._num_recent or history.u.shape[1]), None)
        u = history.u[:, recent]
        for name in self._others:
            u = apply(name, History(q=history.q[:, recent], u=u))
        if self._num_recent is not None:
            valve = self._memory["valve"]
            before = torch.where(memory.fresh[:, None, None], history.u[:, :-1], valve[:, 1:])
            valve.copy_(torch.cat((before, u[:, -1:]), 1))
            u = valve
        for name in self._delays:
            u = apply(name, History(q=history.q, u=u))
        return u

    def _change_motion(
        self, history: History, u: torch.Tensor, memory: StepMemory, counter: torch.Tensor | None
    ) -> torch.Tensor:
        """Return the next positions, `(N, J)`, with all effects on speed.

        A learned model continues the increments that it sees, and a gain would compound from step to
        step. So it sees them as they would be without the effects: `shift` is added to its history.
        """
        shift = self._memory["shift"]
        shift = torch.where(memory.fresh[:, None, None], torch.zeros_like(shift), shift)
        predicted = self.inner.step(History(q=history.q + shift, u=u))
        moved_to = self.move(history, predicted, counter, memory)
        added = (moved_to - predicted)[:, None]
        self._memory["shift"].copy_(torch.cat((shift[:, 1:] + added, torch.zeros_like(added)), 1))
        return moved_to

    def _build_memory(self, machine: Machine, num_envs: int, device: torch.device) -> Memory:
        """Return memory of the right shapes, as it begins at rest."""
        rest = torch.zeros(num_envs, machine.num_history, machine.num_joints, device=device)
        found: Memory = {}
        if self.motions or self._num_recent is not None:
            found["shift"] = rest.clone()
        if self._num_recent is not None:
            found["valve"] = rest.clone()
        for name, effect in (self.commands | self.motions).items():
            u = rest if name in self._delays else rest[:, -(self._num_recent or len(rest[0])) :]
            now = self.describe(name, History(q=rest, u=u), rest[:, -1], None)
            for key, value in effect.begin(now).items():
                found[join_name(name, key)] = value.clone()
        return found

    def get_values(self, name: str) -> dict[str, torch.Tensor]:
        """Return the parameters of one effect, by their own names."""
        return {key: self.parameters[join_name(name, key)] for key in self.effects[name].numbers}

    def salt_counter(self, name: str, counter: torch.Tensor | None) -> torch.Tensor | None:
        """Return the counter of one effect's draws; `None` for an effect that draws none."""
        if counter is None or name not in self._salts:
            return None
        return counter + self._salts[name]


def _keep_unchanged(value: torch.Tensor, *_: torch.Tensor) -> torch.Tensor:
    return value
