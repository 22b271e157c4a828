"""Parallel worlds of the simulator.

Axes: `N` environments, `J` joints, `H` samples of history (oldest first).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    import torch

    from brokk_rl.machine import Machine


class World(Protocol):
    """Parallel physics: the machine, pushed along by its drive, beside a block with a borehole.

    All tensors are float32 on `device`, of fixed address, and refreshed in place by `step` and
    `reset`. A world in which somebody can push the machine has `joint_load`, too: torque or force
    on each joint from outside, `(N, J)`, N m or N, written in place and kept until written again.
    """

    num_worlds: int
    device: torch.device
    q: torch.Tensor
    """Joint positions, `(N, J)`, rad or m."""
    contact_force_n: torch.Tensor
    """Peak force between tool and surroundings over the last control period, `(N,)`."""
    faults: torch.Tensor
    """Worlds that diverged, lost contacts to a full buffer, or became NaN since their last reset,
    `(N,)` bool."""
    supports_graphs: bool
    """True when `step` and `reset` may be captured in a CUDA graph."""

    def step(self, increment: torch.Tensor) -> None:
        """Advance one control period.

        Args:
            increment: Motion of each joint that the drive makes unless something blocks it, `(N,
                J)`.
        """

    def reset(self, mask: torch.Tensor, q: torch.Tensor, scene: torch.Tensor) -> None:
        """Put worlds at rest.

        Args:
            mask: Worlds that are reset, `(N,)` bool.
            q: Joint positions, `(N, J)`.
            scene: Scenes, `(N, S)`; see `sim.scene`.
        """

    def place(self, mask: torch.Tensor, scene: torch.Tensor) -> None:
        """Put the block of worlds elsewhere; the machine goes on as it was.

        Args:
            mask: Worlds whose block moves, `(N,)` bool.
            scene: Scenes, `(N, S)`; see `sim.scene`.
        """

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return copies of everything that must be stored to go on exactly."""
        ...

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Restore a copy that `state_dict` returned."""


@runtime_checkable
class ExplainedWorld(Protocol):
    """A world that says why others of its kind diverged; optional."""

    def explain_faults(self) -> str:
        """Return why worlds became faults since the last call, in one line; waits for the device."""
        ...


class Simulator(Protocol):
    """A spec in `conf/sim`: builds a world.

    `build` may take two more arguments. With `events: tuple[Event, ...]`
    (`brokk_rl.sim.events`) its machines differ as they say. With `site: Path | None` it builds what
    an MJCF file holds beside the block.
    """

    def build(self, machine: Machine, device: torch.device, num_worlds: int | None = None) -> World:
        """Return a world on `device`; `num_worlds` overrides the configured number."""
        ...
