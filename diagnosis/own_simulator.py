"""A simulator from outside as an actuator: a function `step(state, command) -> state`, or an MJCF file.

It is run on the recorded commands as it is. Effects act on the commands before it and on the motion
after it; the motion after it does not come back into it.
Axes: `N` rows, `T` samples of a run, `J` joints, `S` numbers of a state.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from actuators.contracts import PlannedRun
from actuators.effects.simulator import EFFECTS
from actuators.open_loop import WARM_UP_S
from brokk_rl.errors import BrokkError, ConfigError
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.spec import spec
from diagnosis.plant import FunctionPlant, Plant, read_commands

MIN_WARM_UP = 15
"""Samples before a run that give its speed; a simulator with a memory gets the whole warm-up."""


def is_named_in(simulator: str) -> bool:
    """Return whether a simulator is one's own: `module:function`, or an MJCF file."""
    return ":" in simulator or simulator.endswith(".xml")


@spec
class OwnSimulator:
    """A simulator of the user: a function or an MJCF file, run unchanged.

    A function `step(state, command)` returns the state one control period later. A state is an array: the
    positions of the joints, their speeds, then whatever the simulator keeps. A command is in the unit of
    the machine's interface: a target (rad, m), a speed, or a torque. With more than positions and speeds in
    the state, a function `start(position, speed)` of the same module returns the first one. Write
    `state[..., 0]`, and many rows are simulated at once.

    An MJCF file has joints with the names of the machine, and one actuator on each.

    Attributes:
        source: `module:function`, seen from the current folder, or the path of an MJCF file.
    """

    source: str

    @property
    def path(self) -> Path | None:
        """The MJCF file; `None` for a function."""
        return Path(self.source).expanduser() if self.source.endswith(".xml") else None

    def check(self) -> None:
        if self.path is not None and not self.path.is_file():
            raise ConfigError(
                f"simulator={self.source}: there is no such file (seen from {Path.cwd()})"
            )
        if self.path is None and len(self.source.split(":")) != 2:
            raise ConfigError(
                f"simulator={self.source}: expected module:function, such as my_sim:step, or an MJCF file, such as my.xml"
            )

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> OwnSimulatorModel:
        """Return a model for `num_envs` environments.

        Raises:
            ConfigError: The function or the file cannot be used with the machine.
        """
        return OwnSimulatorModel(self.load(machine), machine, num_envs, device)

    def load(self, machine: Machine) -> Plant:
        """Return the plant, the same one until file or function changes.

        Raises:
            ConfigError: The function or the file cannot be used with the machine.
        """
        if self.path is not None:
            path = self.path.resolve()
            return _load_file(path, path.stat().st_mtime_ns, machine)
        step, start = _import_function(self.source)
        return _load_function(step, start, machine, self.source)

    def list_effects(self) -> dict[str, Any]:
        """Return effects on numbers inside of the simulator, by name; none for a function."""
        return dict(EFFECTS) if self.path is not None else {}

    def list_left_out(self) -> dict[str, str]:
        """Return the effects that cannot be applied around the simulator, by name, each with its reason."""
        if self.path is not None:
            return {}
        return dict.fromkeys(
            EFFECTS, f"{self.source} has no numbers that could be changed; an MJCF file has"
        )


class OwnSimulatorModel:
    """A plant as an actuator model.

    Attributes:
        plant: The plant.
        drive_changes: Changes of numbers of the plant by effects, `(N, J)` by quantity; see
            `actuators.effects.simulator`.
    """

    def __init__(self, plant: Plant, machine: Machine, num_envs: int, device: torch.device) -> None:
        if device.type != "cpu":
            raise ConfigError("a simulator of your own runs on the CPU; set session.device=cpu")
        self.plant = plant
        self.drive_changes: dict[str, torch.Tensor] = {}
        self.delay_s = torch.zeros(num_envs, machine.num_joints)
        self._machine, self._period_s = machine, machine.period_s
        self._fresh = torch.ones(num_envs, dtype=torch.bool)
        start = plant.start(np.zeros((1, machine.num_joints)), np.zeros((1, machine.num_joints)))
        self._state = torch.zeros(num_envs, start.shape[1], dtype=torch.float64)
        self._seen = torch.zeros(num_envs, machine.num_joints, dtype=torch.float64)

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """`plant`, the state of the simulator `(N, S)`; `seen`, its last positions; `fresh`."""
        return {"plant": self._state, "seen": self._seen, "fresh": self._fresh}

    def reset(self, mask: torch.Tensor) -> None:
        """Let the environments of `mask`, `(N,)` bool, start from their history."""
        self._fresh.logical_or_(mask)

    def step(self, history: History) -> torch.Tensor:
        """Return the joint positions one control period later, shape `(N, J)`.

        Where the history says something else than the last step did, the joints are put there.
        """
        past = history.q[:, -2:].double().numpy()
        q, fresh, state = past[:, 1], self._fresh.numpy(), self._state.numpy()
        if fresh.any():
            begun = self.plant.start(q, (q - past[:, 0]) / self._period_s)
            state = np.where(fresh[:, None], begun, state)
        # Single precision of the history is no motion.
        moved = np.abs(q - self._seen.numpy()).max(1) > 1e-6
        corrected = self.plant.correct(state, q, self._period_s)
        state = np.where((moved & ~fresh)[:, None], corrected, state)
        commands = read_commands(history.u[:, -1:].double().numpy(), self._machine)
        state = self.plant.run(state, commands, self._read_changes())[:, 0]
        found = torch.as_tensor(self.plant.read(state)[0].astype(np.float32))
        self._state.copy_(torch.as_tensor(state))
        self._seen.copy_(found.double())
        self._fresh.fill_(False)
        return found

    def plan_run(
        self, u: torch.Tensor, first: int, q: torch.Tensor | None = None
    ) -> PlannedRun | None:
        """See `PlannableModel.plan_run`.

        `q` holds the positions of the warm-up too. The run begins behind it, where it does in
        `actuators.open_loop`.
        """
        if q is None:
            return None
        begin = first + round(WARM_UP_S / self._period_s)
        if begin > len(u):
            return None
        known = q[:begin].double().numpy()
        commands = read_commands(u.double().numpy(), self._machine)
        changes = self._read_changes()
        first = first if self.plant.has_memory else max(first, begin - MIN_WARM_UP)
        speed = (known[first - 1] - known[first - 2]) / self._period_s
        state = self.plant.start(known[first - 1], speed)
        for k in range(first, begin):
            state = self.plant.run(state, commands[k - 1][:, None], changes)[:, 0]
            state = self.plant.correct(state, known[k], self._period_s)
        states = self.plant.run(state, commands[begin - 1 :].swapaxes(0, 1), changes)
        ahead = self.plant.read(states)[0].swapaxes(0, 1)
        if not np.isfinite(ahead).all():
            raise BrokkError(
                "the simulator gave NaN or infinity on the recorded commands; run it on one recording by itself"
            )
        path = np.concatenate([known, ahead]).astype(np.float32)
        return _RolledRun(torch.as_tensor(path), begin)

    def _read_changes(self) -> dict[str, np.ndarray]:
        return {name: value.double().numpy() for name, value in self.drive_changes.items()}


class _RolledRun:
    """A run whose positions are known: effects add to its increments."""

    def __init__(self, path: torch.Tensor, begin: int) -> None:
        self._path, self._begin = path, begin

    def step(self, k: int, q: torch.Tensor) -> torch.Tensor:
        """Return positions `k`, `(N, J)`; see `actuators.contracts.PlannedRun`."""
        if k < self._begin:
            return self._path[k]
        return q[k - 1] + (self._path[k] - self._path[k - 1])


@lru_cache(maxsize=8)
def _load_file(path: Path, changed_ns: int, machine: Machine) -> Plant:
    from diagnosis.mjcf.plant import MjcfPlant  # MuJoCo is not in every installation

    return MjcfPlant(path, machine)


_load_function = lru_cache(maxsize=8)(FunctionPlant)


def _import_function(source: str) -> tuple[Callable[..., Any], Callable[..., Any] | None]:
    """Return the function `module:function`, and `start` of the same module where it has one."""
    module_name, _, function = source.partition(":")
    if (here := str(Path.cwd())) not in sys.path:
        sys.path.insert(0, here)
    try:
        module = importlib.import_module(module_name)
    except Exception as error:  # the module is somebody's own: anything may fail in it
        missing = isinstance(error, ModuleNotFoundError) and error.name == module_name
        advice = f"run the command in the folder of {module_name}.py" if missing else "mend it"
        raise ConfigError(
            f"simulator={source}: module '{module_name}' cannot be imported ({type(error).__name__}: {error}); {advice}"
        ) from error
    step = getattr(module, function, None)
    if not callable(step):
        raise ConfigError(
            f"simulator={source}: module '{module_name}' has no function '{function}'"
        )
    return step, getattr(module, "start", None)
