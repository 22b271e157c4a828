"""Recorder of the last states of worlds that diverge, as mjlab's `NanGuard` keeps them.

The states lie in a ring on the device, written by a fixed number of operations without a host
synchronisation, so that a CUDA graph can hold them. The rows of a world that diverged stay as they
are until the host fetches them, once an iteration.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from brokk_rl.contracts.world import TRACE, TracedWorld
from brokk_rl.machine import Machine
from brokk_rl.sim.scene import SIZE

BAD_REWARD = 1 << 20
"""Alarm of a reward that is not finite; beyond the bits of all simulators, exact in float32."""
QUANTITIES = {
    "increment": "the actuator model's increment",
    "reference": "the drive's reference",
    "q": "the position",
    "speed": "the speed",
}
"""Quantities in the order in which a step computes them, in words."""


@dataclass(frozen=True)
class Fault:
    """The last control steps of a world that diverged; `T` steps, `J` joints.

    Attributes:
        states: By name, each `(T, J)`: `increment` that the drive was to make in each step, and
            after it `q`, `speed` and `reference`.
        scene: The scene, `(S,)`.
        properties: Factors on the machine's properties, by name.
        cause: What was wrong first, in one line.
        is_reward: Whether a reward was not finite.
    """

    states: dict[str, np.ndarray]
    scene: np.ndarray
    properties: dict[str, np.ndarray]
    cause: str
    is_reward: bool

    def save(self, path: Path) -> None:
        """Write an npz with one array for each name, and the cause."""
        arrays = {**self.states, "scene": self.scene, "cause": np.array(self.cause)}
        arrays |= {f"property_{name}": value for name, value in self.properties.items()}
        np.savez_compressed(path, allow_pickle=False, **arrays)


class FaultRecorder:
    """Ring of the last states of all worlds.

    Args:
        world: The worlds.
        machine: Their machine.
        num_steps: Control steps kept of each world: 100 steps of five joints take 12 kB a world in
            float32.
        terms: Sums of the reward terms over the running episode, by name, each `(N,)`; 20 at most.
    """

    def __init__(
        self,
        world: TracedWorld,
        machine: Machine,
        num_steps: int,
        terms: Mapping[str, torch.Tensor] | None = None,
    ) -> None:
        self._world, self._machine, self._terms = world, machine, dict(terms or {})
        self._properties: dict[str, torch.Tensor] = getattr(world, "properties", {})
        like = world.trace["q"]
        num, width = like.shape
        self._widths = dict.fromkeys((*TRACE, "increment"), width) | {"scene": SIZE}
        self._widths |= {name: value.shape[1] for name, value in self._properties.items()}
        self._widths |= {"age": 1, "alarms": 1, "terms": 1}
        self._ring = like.new_zeros(num_steps, num, sum(self._widths.values()))
        self._slot = torch.zeros(1, dtype=torch.int64, device=like.device)
        self._last_slot = torch.zeros(num, dtype=torch.int64, device=like.device)
        self._age = like.new_zeros(num, 1)
        self.scene = like.new_zeros(num, SIZE)
        """Scenes of the running episodes, `(N, S)`."""
        self.is_held = torch.zeros(num, dtype=torch.bool, device=like.device)
        """Worlds whose last steps wait to be fetched, `(N,)`."""

    def record(self, increment: torch.Tensor, reward: torch.Tensor) -> None:
        """Keep the step just made, before worlds are reset; hold those that diverged in it.

        Args:
            increment: Motion that the drives were to make, `(N, J)`.
            reward: Rewards, `(N,)`; one that is not finite is a fault too.
        """
        is_bad = ~reward.isfinite()
        alarms = self._world.read_alarms() + BAD_REWARD * is_bad
        terms = torch.zeros_like(alarms)
        for index, value in enumerate(self._terms.values()):
            terms = terms + ~value.isfinite() * (1 << index)
        parts = [self._world.trace[name] for name in TRACE]
        parts += [increment, self.scene, *self._properties.values()]
        parts += [self._age, alarms[:, None], terms[:, None]]
        row = torch.cat([part.to(self._ring.dtype) for part in parts], 1)
        before = self._ring.index_select(0, self._slot)[0]
        kept = torch.where(self.is_held[:, None], before, row)
        self._ring.index_copy_(0, self._slot, kept[None])
        fresh = (self._world.faults | is_bad) & ~self.is_held
        torch.where(fresh, self._slot, self._last_slot, out=self._last_slot)
        self.is_held.logical_or_(fresh)
        self._slot.add_(1).remainder_(len(self._ring))
        self._age.add_(1.0)

    def begin(self, mask: torch.Tensor, scene: torch.Tensor) -> None:
        """Begin new episodes in the worlds of `mask`, `(N,)` bool, with `scene`, `(N, S)`."""
        rows = mask[:, None]
        torch.where(rows, scene.to(self.scene.dtype), self.scene, out=self.scene)
        self._age.masked_fill_(rows, 0.0)

    def fetch(self, most: int) -> list[Fault]:
        """Return the faults held, `most` at most, and release all worlds.

        The host waits for the device.
        """
        worlds = self.is_held.nonzero()[:, 0].tolist()
        found = [self._read(world) for world in worlds[:most]]
        # steps of a held world are missing in its ring
        self._age.masked_fill_(self.is_held[:, None], 0.0)
        self.is_held.zero_()
        return found

    def _read(self, world: int) -> Fault:
        num_steps = len(self._ring)
        last = int(self._last_slot[world])
        order = [(last - back) % num_steps for back in reversed(range(num_steps))]
        rows = self._ring[order, world].cpu().numpy()
        ends = np.cumsum(list(self._widths.values()))[:-1]
        parts = dict(zip(self._widths, np.split(rows, ends, axis=1), strict=True))
        num = min(int(parts["age"][-1, 0]) + 1, num_steps)
        states = {name: parts[name][-num:] for name in (*TRACE, "increment")}
        alarms, terms = int(parts["alarms"][-1, 0]), int(parts["terms"][-1, 0])
        return Fault(
            states=states,
            scene=parts["scene"][-1],
            properties={name: parts[name][-1] for name in self._properties},
            cause=self._describe_cause(states, alarms, terms),
            is_reward=bool(alarms & BAD_REWARD),
        )

    def _describe_cause(self, states: dict[str, np.ndarray], alarms: int, terms: int) -> str:
        """Return what was wrong first: a term, a quantity that is not finite, an alarm, a speed."""
        odd = [name for index, name in enumerate(self._terms) if terms >> index & 1]
        if odd:
            return f"the reward term {', '.join(odd)} was not finite"
        if alarms & BAD_REWARD:
            return "the reward was not finite"
        joints = self._machine.joints
        for name, words in QUANTITIES.items():
            is_finite = np.isfinite(states[name]).all(0)
            if not is_finite.all():
                return f"{words} of {joints[int(is_finite.argmin())].name} was not finite"
        fastest = int(np.abs(states["speed"]).max(0).argmax())
        speed, joint = np.abs(states["speed"][:, fastest]).max(), joints[fastest]
        said = [text for bit, text in self._world.alarm_names.items() if alarms & bit]
        said.append(f"the speed of {joint.name} came to {speed:,.3g} {joint.unit}/s")
        return "; ".join(said)
