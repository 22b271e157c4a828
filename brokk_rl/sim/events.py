"""Events: properties of the simulated machine that change at start-up or at resets.

An event draws a factor on one property of the machine's bodies. Effects change how commands become
motion; events change what the arm weighs, how it grips, and how hard it pushes.

`brokk_rl.sim.properties` draws them and writes what follows into the worlds.
"""

from __future__ import annotations

from typing import Annotated, Literal

from brokk_rl.spec import Finite, Interval, Ordered, spec

Property = Literal["mass", "friction", "stiffness", "yield_force"]
"""Properties of the machine that can change from world to world."""
Least = Annotated[Finite, Interval(ge=0.05)]
"""A factor: below a twentieth contacts get stiff."""
LeastRange = Annotated[tuple[Least, Least], Ordered()]


@spec
class Event:
    """A factor on one property of the simulated machine, drawn evenly from a range.

    Attributes:
        property: `mass` and inertia of the links, sliding `friction` of chisel and links,
            `stiffness` of the drives (their damping ratio stays), or their `yield_force`.
        factor: Range of the factor; [1, 1] changes nothing.
        when: `startup` once and for all, `reset` with each episode.
        joints_alike: Whether all joints have the same factor. Friction has one anyway.
    """

    property: Property
    factor: LeastRange
    when: Literal["startup", "reset"]
    joints_alike: bool
