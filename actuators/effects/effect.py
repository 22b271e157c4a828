"""What all effects share: the spec's part that a diagnosis reads, and the actuator model with one effect around it."""

import re
import zlib
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import ClassVar, Literal

import torch

from actuators.effects.ranges import CHANCE, EffectNumber, Joints, ParameterRanges
from actuators.models import random_draws
from brokk_rl.contracts.actuator import ActuatorModel
from brokk_rl.gravity import Gravity
from brokk_rl.history import History
from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine

Memory = dict[str, torch.Tensor]
Side = Literal["command", "speed", "joints", "measurement", "kinematics"]


class MachineTensors:
    """What effects need of the machine: `full_step` (way at full speed in one period) and the like, `(J,)`; weight; geometry.

    Weight and geometry are made when an effect asks for them: most do not, and work on machines
    known by their joints only. Those
    that always do say so beforehand: a traced step can hold their work, but not their making.

    Args:
        machine: The machine.
        device: Where the tensors live.
        weighed: Whether the weight is asked for in every step.
        placed: Whether the geometry is.
    """

    def __init__(
        self, machine: Machine, device: torch.device, weighed: bool = False, placed: bool = False
    ) -> None:
        def tensor(values: object) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=device)

        self.period_s = machine.period_s
        self.full_step = tensor(machine.max_speed * machine.period_s)
        self.lower, self.upper = tensor(machine.lower), tensor(machine.upper)
        self._machine, self._device = machine, device
        if weighed:
            self.weight(torch.zeros(1, machine.num_joints, device=device))
        if placed:
            self.kinematics  # noqa: B018

    @cached_property
    def yield_force(self) -> torch.Tensor:
        """`Body.yield_force` of each joint, `(J,)`."""
        values = [body.yield_force.value for body in self._machine.bodies]
        return torch.tensor(values, dtype=torch.float32, device=self._device)

    @cached_property
    def gravity(self) -> Gravity:
        """The weight on each joint."""
        return Gravity(self._machine, self._device)

    def weight(self, q: torch.Tensor) -> torch.Tensor:
        """Returns how hard the weight pushes each joint in its positive direction at `q`, over its yield force, `(N, J)`."""
        return self.gravity.load(q) / self.yield_force

    @cached_property
    def kinematics(self) -> Kinematics:
        """The geometry."""
        return Kinematics(self._machine, self._device)


@dataclass(frozen=True)
class StepInputs:
    """What an effect looks at in one control period.

    Attributes:
        value: Parameters by name, `(N, J)` or `(N, 1)`.
        memory: What the effect returned as its memory one period ago.
        history: Positions and commands; the newest command has just come into force.
        plant: The machine.
        moved: Increment of the inner model, `(N, J)`; speed side only.
        counter: Counter of random draws, `(N,)`; stochastic effects only.
        weight: `plant.weight` here where someone has worked it out already.
    """

    value: dict[str, torch.Tensor]
    memory: Memory
    history: History
    plant: MachineTensors
    moved: torch.Tensor
    counter: torch.Tensor | None
    weight: torch.Tensor | None = None

    @property
    def chance(self) -> torch.Tensor:
        """A number in [0, 1) for each environment, the same for all joints: they share frames. `(N, 1)`."""
        assert self.counter is not None, "only a stochastic effect has chances"
        return random_draws.draw_uniform(self.counter, CHANCE, 1)


class EffectSpec:
    """An effect; a spec in `conf/effect` overrides what it changes. Class attributes say what a diagnosis must know.

    Attributes:
        side: What it acts on; see `actuators.effects`.
        stage: Where on the way from command to estimate it lies (`where.stage` of
            `diagnosis.json`).
        numbers: Unit, neutral value, typical size and bounds of each number.
        stochastic: Whether it draws random numbers in every step.
        smooth: Whether its numbers can be fitted by gradient.
        delays: Whether it shifts all commands that the inner model sees, not only the newest.
        weighed: Whether it asks for the weight on the joints.
        shared: Whether it has one cause for all joints (frames, clocks), so that it is hardly ever
            on a few of them.
        running: Name of the number that is the time since the machine was started, which is known
            and not fitted.
    """

    side: ClassVar[Side]
    stage: ClassVar[Literal["actuation", "sensing", "kinematics", "timing", "perception"]] = (
        "actuation"
    )
    numbers: ClassVar[dict[str, EffectNumber]]
    stochastic: ClassVar[bool] = False
    smooth: ClassVar[bool] = True
    delays: ClassVar[bool] = False
    weighed: ClassVar[bool] = False
    shared: ClassVar[bool] = False
    running: ClassVar[str | None] = None

    @classmethod
    def name(cls) -> str:
        """Returns the name of the effect, as in `effect=[name]`."""
        return re.sub(r"(?<!^)(?=[A-Z])", "_", cls.__name__).lower()

    def wrap(
        self, model: ActuatorModel, machine: Machine, num_envs: int, device: torch.device
    ) -> "Wrapped":
        """Returns `model` with the effect around it.

        Raises:
            ConfigError: a number is out of bounds, or a joint unknown.
        """
        return Wrapped(self, model, machine, num_envs, device)

    def begin(self, now: StepInputs) -> Memory:
        """Returns the memory with which the effect begins at `now`, at rest or in the middle of a recording."""
        return {}

    def commands(self, now: StepInputs) -> tuple[torch.Tensor, Memory]:
        """Returns the commands that the inner model sees, `(N, H, J)`, and the memory; command side."""
        return now.history.u, {}

    def extra(self, now: StepInputs) -> tuple[torch.Tensor, Memory]:
        """Returns how much further than `now.moved` the joints move, `(N, J)`, and the memory; speed side."""
        return torch.zeros_like(now.moved), {}

    def measured(
        self, q: torch.Tensor, value: dict[str, torch.Tensor], counter: torch.Tensor | None
    ) -> torch.Tensor:
        """Returns what the sensors say at the true positions `q`, `(N, J)`; measurement side."""
        return q

    def truth(self, q: torch.Tensor, value: dict[str, torch.Tensor]) -> torch.Tensor:
        """Returns the likeliest true positions where the sensors say `q`, `(N, J)` or `(N, H, J)`; measurement side."""
        return q

    def tool(
        self,
        point_m: torch.Tensor,
        q: torch.Tensor,
        value: dict[str, torch.Tensor],
        plant: MachineTensors,
    ) -> torch.Tensor:
        """Returns where the tool point is that the model has at `point_m`, `(N, 3)`; kinematics."""
        return point_m

    def target(self, point_m: torch.Tensor, value: dict[str, torch.Tensor]) -> torch.Tensor:
        """Returns where the camera sees a point, `(N, 3)` in the base frame; kinematics."""
        return point_m


class Wrapped:
    """An actuator model with one effect around it, again an actuator model; a neutral effect leaves the inner one bit for bit.

    Attributes:
        effect: The spec.
        inner: The model inside.
        parameters: Numbers by name, `(N, J)` or `(N, 1)`. Write in place or replace an entry to
            simulate `N` candidates side by side; gradients flow to an entry that wants them until
            the next `reset`.
    """

    def __init__(
        self,
        effect: EffectSpec,
        inner: ActuatorModel,
        machine: Machine,
        num_envs: int,
        device: torch.device,
    ) -> None:
        self.effect, self.inner = effect, inner
        name = effect.name()
        given = {field.name: getattr(effect, field.name) for field in fields(effect)}  # pyright: ignore[reportArgumentType]
        joints: Joints = given.pop("joints", "all")
        salt = zlib.crc32(name.encode()) + len(inner.state)
        where = f"effect.{name}"
        self._ranges = ParameterRanges(
            given, effect.numbers, joints, machine, num_envs, device, effect.stochastic, salt, where
        )
        self.parameters = self._ranges.value
        self.plant = MachineTensors(
            machine, device, weighed=effect.weighed, placed=effect.side == "kinematics"
        )
        rest = torch.zeros(num_envs, machine.num_history, machine.num_joints, device=device)
        self._fresh = torch.ones(num_envs, dtype=torch.bool, device=device)
        self._memory = {
            key: value.clone()
            for key, value in self._begin(self._moment(History(q=rest, u=rest), None)).items()
        }
        self._ranges.redraw(self._fresh)

    @property
    def state(self) -> Memory:
        """The effect's memory and what it has drawn; `inner.…` for the model inside."""
        own = {"fresh": self._fresh, **self._memory} if self._memory else {}
        return (
            own
            | self._ranges.state
            | {f"inner.{name}": value for name, value in self.inner.state.items()}
        )

    @property
    def sides(self) -> frozenset[str]:
        """Sides of all effects from here inwards; says which of `measure` and `misplacement` do anything."""
        return frozenset({self.effect.side}) | getattr(self.inner, "sides", frozenset())

    def reset(self, mask: torch.Tensor) -> None:
        """Forgets in the environments of `mask`, shape `(N,)` bool, and draws their parameters; cuts all gradients."""
        self.inner.reset(mask)
        for value in self._memory.values():
            if value.requires_grad:
                value.detach_()
        self._fresh.logical_or_(mask)
        self._ranges.redraw(mask)

    def step(self, history: History) -> torch.Tensor:
        """Returns the joint positions one control period later, shape `(N, J)`."""
        if self.effect.side not in ("command", "speed", "joints"):
            return self.inner.step(history)
        if (
            torch.is_grad_enabled()
        ):  # the history is written in place, and autograd may need what it was
            history = History(q=history.q.clone(), u=history.u.clone())
        now = self._moment(history, self._ranges.advance() if self.effect.stochastic else None)
        begun, fresh = self._begin(now), self._fresh.clone()
        memory = {
            key: torch.where(broadcast_rows(fresh, value), begun[key], value)
            for key, value in self._memory.items()
        }
        now = replace(now, memory=memory)
        result, memory = self._commanded(now) if self.effect.side == "command" else self._moved(now)
        for key, value in memory.items():
            self._memory[key].copy_(value)
        self._fresh.fill_(False)
        return result

    def measure(self, q: torch.Tensor) -> torch.Tensor:
        """Returns what the sensors say at the true positions `q`, `(N, J)`; to be called once a control period."""
        q = getattr(self.inner, "measure", _keep_unchanged)(q)
        if self.effect.side != "measurement":
            return q
        return self.effect.measured(
            q, self.parameters, self._ranges.advance() if self.effect.stochastic else None
        )

    def truth(self, q: torch.Tensor) -> torch.Tensor:
        """Returns the likeliest true positions where the sensors say `q`, `(N, J)` or `(N, H, J)`."""
        q = self.effect.truth(q, self.parameters)
        return getattr(self.inner, "truth", _keep_unchanged)(q)

    def tool(self, point_m: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
        """Returns where an outside instrument finds the tool that the model has at `point_m`, `(N, 3)` in the base frame."""
        point_m = getattr(self.inner, "tool", _keep_unchanged)(point_m, q)
        return self.effect.tool(point_m, q, self.parameters, self.plant)

    def target(self, point_m: torch.Tensor) -> torch.Tensor:
        """Returns where the camera sees a point, `(N, 3)` in the base frame."""
        point_m = getattr(self.inner, "target", _keep_unchanged)(point_m)
        return self.effect.target(point_m, self.parameters)

    def misplacement(self, q: torch.Tensor) -> torch.Tensor:
        """Returns how far from the truth the controller believes a target near the tool, `(N, 3)` in m, at the positions `q`.

        A controller that works with the drawings' kinematics on a machine that differs misses by as
        much as one whose kinematics is right and whose target is displaced; so the simulated
        geometry stays and the estimate moves.
        """
        tip_m = self.plant.kinematics.pose(q).tip_in_base_m
        return self.target(self.tool(tip_m, q)) - tip_m

    def _moment(self, history: History, counter: torch.Tensor | None) -> StepInputs:
        return StepInputs(
            self.parameters, {}, history, self.plant, torch.zeros_like(history.q[:, -1]), counter
        )

    def _begin(self, now: StepInputs) -> Memory:
        begun = self.effect.begin(now)
        return begun | (
            {"shift": torch.zeros_like(now.history.q)}
            if self.effect.side in ("speed", "joints")
            else {}
        )

    def _commanded(self, now: StepInputs) -> tuple[torch.Tensor, Memory]:
        u, memory = self.effect.commands(now)
        return self.inner.step(History(q=now.history.q, u=u)), memory

    def _moved(self, now: StepInputs) -> tuple[torch.Tensor, Memory]:
        """Steps the inner model on positions from which past doings of the effect are taken out.

        A learned model goes on from the increments that it sees; a gain on them would compound from
        step to step. So it is shown
        increments as they would have been without the effect, ending at the true position: `shift`
        is added to its history.
        """
        history, shift, plant = now.history, now.memory["shift"], self.plant
        predicted = self.inner.step(History(q=history.q + shift, u=history.u))
        extra, memory = self.effect.extra(replace(now, moved=predicted - history.q[:, -1]))
        lower, upper = (
            torch.minimum(plant.lower, predicted),
            torch.maximum(plant.upper, predicted),
        )  # never through a stop
        result = torch.minimum(torch.maximum(predicted + extra, lower), upper)
        added = (result - predicted)[:, None]
        return result, memory | {
            "shift": torch.cat((shift[:, 1:] + added, torch.zeros_like(added)), 1)
        }


def _keep_unchanged(value: torch.Tensor, *_: torch.Tensor) -> torch.Tensor:
    return value


def broadcast_rows(mask: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    """Returns `mask`, `(N,)`, so that it broadcasts over rows of `like`."""
    return mask.reshape(-1, *[1] * (like.dim() - 1))
