"""Recorder of the last states of worlds that diverge.

The states lie in a ring on the device, written by a fixed number of operations without a host
synchronisation, so that a CUDA graph can hold them. The rows of a world that diverged stay as they
are until the host fetches them, once an iteration. A control step costs some fifteen small kernels.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import torch

from brokk_rl.contracts.world import TRACE, TracedWorld
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.sim.scene import SIZE

BAD_REWARD = 1 << 20
"""Alarm of a reward that is not finite; beyond the bits of all simulators, exact in float32."""
REWARD_ALARM = "the reward is not finite"
"""The same in words."""


@dataclass
class Fault:
    """The last control steps of a world that diverged; `T` steps, `J` joints.

    Attributes:
        machine: Name of the machine.
        substeps: Physics steps per control period.
        increment: Motion that the drive was to make in each step, `(T, J)`.
        states: State before each step and after the last, by name (`TRACE`), each `(T + 1, J)`.
        scene: The scene, `(S,)`.
        properties: Factors on the machine's properties, by name.
        alarms: What the simulator said: full buffers, NaN, a reward that is not finite.
        terms: Reward terms that were not finite.
        world: Index of the world.
        cause: What began it, in words.
    """

    machine: str
    substeps: int
    increment: np.ndarray
    states: dict[str, np.ndarray]
    scene: np.ndarray
    properties: dict[str, np.ndarray]
    alarms: tuple[str, ...]
    terms: tuple[str, ...] = ()
    world: int = 0
    cause: str = field(default="")

    def save(self, path: Path) -> None:
        """Write an npz."""
        texts = {
            "machine": self.machine,
            "substeps": self.substeps,
            "alarms": self.alarms,
            "terms": self.terms,
            "world": self.world,
            "cause": self.cause,
        }
        arrays: dict[str, Any] = {f"state.{name}": value for name, value in self.states.items()}
        arrays |= {f"property.{name}": value for name, value in self.properties.items()}
        np.savez_compressed(
            path,
            increment=self.increment,
            scene=self.scene,
            about=np.array(json.dumps(texts)),
            **arrays,
        )


def load_fault(path: Path) -> Fault:
    """Return a fault that `Fault.save` wrote.

    Raises:
        ConfigError: There is no such file, or it holds something else.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        about = json.loads(str(arrays.pop("about")))
        parts: dict[str, dict[str, np.ndarray]] = {"state": {}, "property": {}}
        for name, value in arrays.items():
            kind, _, rest = name.partition(".")
            if rest:
                parts[kind][rest] = value
        return Fault(
            machine=about["machine"],
            substeps=about["substeps"],
            increment=arrays["increment"],
            states={name: parts["state"][name] for name in TRACE},
            scene=arrays["scene"],
            properties=parts["property"],
            alarms=tuple(about["alarms"]),
            terms=tuple(about["terms"]),
            world=about["world"],
            cause=about["cause"],
        )
    except (OSError, ValueError, KeyError, BadZipFile) as error:
        raise ConfigError(
            f"{path} is no recorded fault ({error!r}); expected a file faults/*.npz of a run folder"
        ) from error


class FaultRecorder:
    """Ring of the last states of all worlds.

    Args:
        world: The worlds.
        machine: Their machine.
        num_steps: Control steps kept of each world, five numbers a joint and step: 100 steps of
            five joints take 10 kB a world in float32.
        terms: Sums of the reward terms over the running episode, by name, each `(N,)`; 12 at most.
    """

    def __init__(
        self,
        world: TracedWorld,
        machine: Machine,
        num_steps: int,
        terms: Mapping[str, torch.Tensor] | None = None,
    ) -> None:
        self._world = world
        self._faults, self._machine, self._terms = world.faults, machine, dict(terms or {})
        self._state = [world.trace[name] for name in TRACE]
        self._properties: dict[str, torch.Tensor] = getattr(world, "properties", {})
        num, width = self._state[0].shape
        like = self._state[0]
        self._width, self._num_steps = width, num_steps
        self._ring = like.new_zeros(num_steps, num, width * (len(TRACE) + 1))
        self._slot = torch.zeros(1, dtype=torch.int64, device=like.device)
        self._age = like.new_zeros(num, 1)
        self.scene = like.new_zeros(num, SIZE)
        """Scenes of the running episodes, `(N, S)`."""
        self.is_held = torch.zeros(num, dtype=torch.bool, device=like.device)
        """Worlds whose last steps wait to be fetched, `(N,)`."""
        factors = sum(value.shape[1] for value in self._properties.values())
        self._end = like.new_zeros(num, width * len(TRACE) + SIZE + factors + 4)

    def record(self, increment: torch.Tensor) -> None:
        """Keep the present states and the motion, `(N, J)`, that is about to be made."""
        row = torch.cat((*self._state, increment.to(self._ring.dtype)), 1)
        before = self._ring.index_select(0, self._slot)[0]
        kept = torch.where(self.is_held[:, None], before, row)
        self._ring.index_copy_(0, self._slot, kept[None])
        self._age.add_(1.0)

    def close(self, reward: torch.Tensor) -> None:
        """Hold the worlds that diverged in the step just made, before they are reset.

        Args:
            reward: Rewards, `(N,)`; one that is not finite is a fault too.
        """
        bad = ~reward.isfinite()
        fresh = (self._faults | bad) & ~self.is_held
        alarms = self._world.read_alarms() + BAD_REWARD * bad
        terms = torch.zeros_like(alarms)
        for index, value in enumerate(self._terms.values()):
            terms = terms + ~value.isfinite() * (1 << index)
        parts = [*self._state, self.scene, *self._properties.values(), self._age]
        parts += [alarms[:, None], terms[:, None], self._slot.expand(len(reward), 1)]
        end = torch.cat([part.to(self._end.dtype) for part in parts], 1)
        torch.where(fresh[:, None], end, self._end, out=self._end)
        self.is_held.logical_or_(fresh)
        self._slot.add_(1).remainder_(self._num_steps)

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
        width = self._width
        end = self._end[world].cpu().numpy()
        age, alarms, terms, slot = (int(value) for value in end[-4:])
        num = min(age, self._num_steps)
        order = [(slot - back) % self._num_steps for back in reversed(range(num))]
        rows = self._ring[order, world].cpu().numpy().reshape(num, len(TRACE) + 1, width)
        after = end[: width * len(TRACE)].reshape(1, len(TRACE), width)
        states = np.concatenate((rows[:, :-1], after))
        place = width * len(TRACE) + SIZE
        properties = {}
        for name, value in self._properties.items():
            properties[name] = end[place : place + value.shape[1]]
            place += value.shape[1]
        names = dict(self._world.alarm_names) | {BAD_REWARD: REWARD_ALARM}
        odd = []
        for index, name in enumerate(self._terms):
            if terms >> index & 1:
                odd.append(name)
        return Fault(
            machine=self._machine.name,
            substeps=self._world.substeps,
            increment=rows[:, -1],
            states={name: states[:, index] for index, name in enumerate(TRACE)},
            scene=end[width * len(TRACE) :][:SIZE],
            properties=properties,
            alarms=tuple(text for bit, text in names.items() if alarms & bit),
            terms=tuple(odd),
            world=world,
        )
