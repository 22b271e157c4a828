"""Events: properties of the simulated machine that change at start-up, at resets or in between.

An event draws a factor on one property of the machine's bodies. Effects change how commands become
motion; events change what the arm weighs, how it grips, and how hard it pushes.

A world that can vary its machine fulfils `brokk_rl.contracts.world.VariedWorld`.
"""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Annotated, Any, Literal

from brokk_rl.contracts.world import ExplainedWorld, LoadedWorld, Property, Simulator, VariedWorld
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.spec import Finite, Interval, Ordered, name_spec, spec

if TYPE_CHECKING:
    import torch

Least = Annotated[Finite, Interval(ge=0.05)]
"""A factor or a time in s: below a twentieth contacts get stiff, and a draw needs a control step."""
LeastRange = Annotated[tuple[Least, Least], Ordered()]


@spec
class Event:
    """A factor on one property of the simulated machine, drawn evenly from a range.

    Attributes:
        property: `mass` and inertia of the links, sliding `friction` of chisel and links,
            `stiffness` of the drives (their damping ratio stays), or their `yield_force`.
        factor: Range of the factor; [1, 1] changes nothing.
        when: `startup` once and for all, `reset` with each episode, `interval` also during it.
        interval_s: Range of the time between two draws; for `interval` only.
        joints_alike: Whether all joints have the same factor. Friction has one anyway.
    """

    property: Property
    factor: LeastRange
    when: Literal["startup", "reset", "interval"]
    interval_s: LeastRange | None
    joints_alike: bool

    def check(self) -> None:
        if self.when == "interval" and self.interval_s is None:
            raise ConfigError("interval_s: expected [low, high] in s, got null")


def build_varied_world(
    sim: Simulator,
    events: dict[str, Event],
    machine: Machine,
    device: torch.device,
    num_worlds: int | None,
    **more: Any,
) -> EventWorld:
    """Return a world of `sim` under `events`; `more` goes to its `build`.

    Raises:
        ConfigError: The simulator cannot vary the machine, or two events change the same property.
    """
    names = [event.property for event in events.values()]
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"event: two of {', '.join(events)} change {name}; leave one out")
    build: Any = sim.build
    if "varied" not in inspect.signature(build).parameters:
        raise ConfigError(
            f"event={','.join(events)}: sim={name_spec(sim)} cannot vary the machine; choose "
            "sim=native or sim=warp, or event=[]"
        )
    world = build(machine, device, num_worlds, varied=tuple(names), **more)
    return EventWorld(world, list(events.values()), machine)


class EventWorld:
    """A world whose machine changes by events; fulfils `brokk_rl.contracts.world.World`.

    Nothing synchronises with the host, so that a CUDA graph can hold the draws.

    Args:
        world: The world.
        events: One a property.
        machine: Gives the control period.
    """

    def __init__(self, world: VariedWorld, events: list[Event], machine: Machine) -> None:
        import torch

        self._world, self._events, self._period_s = world, events, machine.period_s
        self.num_worlds, self.device = world.num_worlds, world.device
        self.q, self.contact_force_n = world.q, world.contact_force_n
        self.faults, self.supports_graphs = world.faults, world.supports_graphs
        if isinstance(world, LoadedWorld):
            self.joint_load = world.joint_load
        if isinstance(world, ExplainedWorld):
            self.explain_faults = world.explain_faults
        self._left_s = torch.zeros(len(events), world.num_worlds, device=world.device)
        everywhere = torch.ones_like(world.faults)
        for event in events:
            self._draw(event, everywhere)
        self._restart(everywhere)
        world.apply_properties()

    @property
    def properties(self) -> dict[str, torch.Tensor]:
        """Factors by property; see `brokk_rl.contracts.world.VariedWorld`."""
        return self._world.properties

    def step(self, increment: torch.Tensor) -> None:
        """Advance one control period; draw where an interval is over."""
        if any(event.when == "interval" for event in self._events):
            self._left_s.sub_(self._period_s)
            for left_s, event in zip(self._left_s, self._events, strict=True):
                if event.when == "interval":
                    due = left_s <= 0
                    self._draw(event, due)
                    left_s.copy_(self._draw_interval(event).where(due, left_s))
            self._world.apply_properties()
        self._world.step(increment)

    def reset(self, mask: torch.Tensor, q: torch.Tensor, scene: torch.Tensor) -> None:
        """Put the worlds of `mask` at rest, with properties of their own."""
        for event in self._events:
            if event.when != "startup":
                self._draw(event, mask)
        self._restart(mask)
        self._world.apply_properties()
        self._world.reset(mask, q, scene)

    def place(self, mask: torch.Tensor, scene: torch.Tensor) -> None:
        """Put blocks elsewhere; see `brokk_rl.contracts.world.World`."""
        self._world.place(mask, scene)

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return copies of everything that must be stored to go on exactly."""
        own = {"event.left_s": self._left_s.clone()}
        for name, value in self._world.properties.items():
            own[f"event.{name}"] = value.clone()
        return self._world.state_dict() | own

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Restore a copy that `state_dict` returned."""
        self._left_s.copy_(state["event.left_s"])
        for name, value in self._world.properties.items():
            value.copy_(state[f"event.{name}"])
        self._world.apply_properties()
        self._world.load_state_dict(state)

    def _draw(self, event: Event, mask: torch.Tensor) -> None:
        """Draw the factors of an event in the worlds of `mask`, `(N,)` bool."""
        import torch

        value = self._world.properties[event.property]
        low, high = event.factor
        width = 1 if event.joints_alike else value.shape[1]
        drawn = low + (high - low) * torch.rand(len(mask), width, device=mask.device)
        value.copy_(drawn.to(value.dtype).expand_as(value).where(mask[:, None], value))

    def _restart(self, mask: torch.Tensor) -> None:
        """Let the intervals of the worlds of `mask` begin anew."""
        for left_s, event in zip(self._left_s, self._events, strict=True):
            if event.when == "interval":
                left_s.copy_(self._draw_interval(event).where(mask, left_s))

    def _draw_interval(self, event: Event) -> torch.Tensor:
        """Return times until the next draw, `(N,)`, s."""
        import torch

        assert event.interval_s is not None, "checked by the spec"
        low, high = event.interval_s
        return low + (high - low) * torch.rand(self.num_worlds, device=self.device)
