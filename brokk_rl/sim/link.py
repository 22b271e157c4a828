"""Links to simulated machines: actuator models alone, or one machine beside a block with a hole."""

from __future__ import annotations

import math
from typing import Any, Self

import numpy as np
import torch

from brokk_rl.commands import find_rest
from brokk_rl.contracts.actuator import Actuator, ActuatorModel
from brokk_rl.contracts.world import Simulator
from brokk_rl.errors import ConfigError
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.signals import Command, JointState
from brokk_rl.sim.scene import make_nominal_scenes
from brokk_rl.spec import NonNegative, name_spec, spec

OIL_C = "oil_c"
"""State of an actuator model, one number a machine, that the machine's sensors show."""


class SimulatedLink:
    """Link to simulated machines, as fast as they compute; each `send` is one control period.

    Args:
        config: Gives the actuator and the noise of the measured positions.
        machine: The machine.
        num_runs: Machines side by side, `N`.
        session: Gives the streams of random numbers.
        device: Where they are computed.
    """

    def __init__(
        self,
        config: SimulatedMachines | SimulatedWorksite,
        machine: Machine,
        num_runs: int,
        session: Session,
        device: torch.device,
    ) -> None:
        self._noise, self._machine, self._device = config.noise, machine, device
        self._generator = session.generator("link")
        self._shape = (num_runs, machine.num_joints) if num_runs > 1 else (machine.num_joints,)
        self._everywhere = torch.ones(num_runs, dtype=torch.bool, device=device)
        shape = (num_runs, machine.num_history, machine.num_joints)
        self._history = History(
            q=torch.zeros(shape, device=device), u=torch.zeros(shape, device=device)
        )
        devices = [device] if device.type == "cuda" else []
        with torch.random.fork_rng(devices):  # differences between machines are drawn here
            torch.manual_seed(session.stream("link"))
            self._model = config.actuator.build(machine, num_runs, device)
            self._model.reset(self._everywhere)
        # paths of effects have dots
        self._oil = [path for path in self._model.state if path.rpartition(".")[2] == OIL_C]
        self._steps = 0
        self._begin(config)

    def _begin(self, config: Any) -> None:
        """Put the machines at rest at home."""
        ends = []
        for values in (self._machine.home, find_rest(self._machine.home, self._machine)):
            row = torch.as_tensor(values, dtype=torch.float32, device=self._device)
            ends.append(row.repeat(len(self._everywhere), 1))
        self._history.reset(self._everywhere, *ends)
        if config.one_machine:
            _share_drawn_numbers(self._model)
        self._measure()

    def read(self) -> JointState:
        """Return the state after the last control period; reading twice gives the same."""
        q = self._measured.reshape(self._shape).copy()
        return JointState(self._steps * self._machine.period_s, q)

    def send(self, command: Command) -> Command:
        """Drive the machines for one control period; NaN and infinity are a standstill."""
        u = _limit_command(command).astype(np.float32)  # recorded as it was computed with
        with torch.inference_mode():
            rows = u.reshape(self._measured.shape)
            self._history.push_u(torch.as_tensor(rows, device=self._device))
            self._history.push_q(self._move(self._model.step(self._history)))
        self._steps += 1
        self._measure()
        return Command(u)

    def extra(self) -> dict[str, np.ndarray]:
        """Return further sensors, each `(N,)`: the oil's temperature where the model has one."""
        if not self._oil:
            return {}
        return {OIL_C: self._model.state[self._oil[-1]].cpu().numpy().copy()}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        pass

    def _move(self, wanted: torch.Tensor) -> torch.Tensor:
        """Return the positions to which the model's wanted ones lead, `(N, J)`."""
        return wanted

    def _measure(self) -> None:
        q = self._history.q[:, -1].cpu().numpy().astype(np.float64)
        self._measured = q + self._noise * self._generator.standard_normal(q.shape)


@spec
class SimulatedMachines:
    """Simulated machines side by side from home, as fast as they compute: an actuator model.

    Attributes:
        actuator: The machine that is driven; with effects around it, as recordings show it.
        noise: Standard deviation of the measured positions, rad or m.
        one_machine: Numbers of effects that are drawn from ranges are drawn once: all runs record
            the same machine. `False` draws them for each run.
    """

    actuator: Actuator
    noise: NonNegative
    one_machine: bool

    @property
    def source(self) -> str:
        """The actuator and its effects."""
        inner = getattr(self.actuator, "actuator", self.actuator)
        effects = getattr(self.actuator, "effects", {})
        return "simulator: " + " + ".join([name_spec(inner).capitalize(), *effects])

    def build(self, machine: Machine, num_runs: int, session: Session) -> SimulatedLink:
        """Return a link to `num_runs` machines."""
        # a few dozen machines are faster on a CPU
        device = torch.device("cpu") if session.device == "auto" else session.torch_device()
        return SimulatedLink(self, machine, num_runs, session, device)


@spec
class SimulatedWorksite:
    """One simulated machine beside a block with a borehole: actuator model and physics.

    Attributes:
        sim: Builds the world.
        actuator: The machine; with effects around it, as recordings show it.
        noise: Standard deviation of the measured positions, rad or m.
        hole_in_base_m: Centre of the borehole's rim.
        start: Joint positions at the beginning, rad or m; `null`: home.
    """

    sim: Simulator
    actuator: Actuator
    noise: NonNegative
    hole_in_base_m: tuple[float, float, float]
    start: tuple[float, ...] | None

    @property
    def source(self) -> str:
        """Name of the source in recordings."""
        return "simulated site"

    def build(self, machine: Machine, num_runs: int, session: Session) -> SimulatedWorksiteLink:
        """Return a link to the machine.

        Raises:
            ConfigError: More than one machine is asked for, or the start does not fit the machine.
        """
        if num_runs != 1:
            raise ConfigError(
                f"link=site has one machine, not {num_runs}; link=simulated has as many as you like"
            )
        if self.start is not None and len(self.start) != machine.num_joints:
            raise ConfigError(
                f"link.start: expected {machine.num_joints} joint positions, got {len(self.start)}"
            )
        return SimulatedWorksiteLink(self, machine, 1, session, torch.device("cpu"))


class SimulatedWorksiteLink(SimulatedLink):
    """Link to a simulated worksite."""

    def _begin(self, config: Any) -> None:
        """Build the world and put the machine at its start."""
        self._world = config.sim.build(self._machine, self._device, 1)
        start = config.start if config.start is not None else self._machine.home
        self.place(np.array(start), np.array(config.hole_in_base_m))

    def place(self, q: np.ndarray, hole_in_base_m: np.ndarray) -> None:
        """Put the machine at rest, and the block so that it faces the machine.

        Args:
            q: Joint positions, `(J,)`.
            hole_in_base_m: Centre of the hole's rim, `(3,)`.
        """
        start, scene = torch.as_tensor(q[None], dtype=torch.float32), make_nominal_scenes(1)
        x, y, z = hole_in_base_m.tolist()
        scene[0, :4] = torch.tensor([x, y, z, math.atan2(y, x)])
        with torch.random.fork_rng([]):
            torch.manual_seed(int(self._generator.integers(2**31)))
            self._model.reset(self._everywhere)
        self._world.reset(self._everywhere, start, scene)
        self._history.reset(self._everywhere, start)
        self._measure()

    def extra(self) -> dict[str, np.ndarray]:
        """Return contact force, and oil temperature where the model has one, each `(1,)`."""
        return super().extra() | {"force_n": self._world.contact_force_n.numpy().copy()}

    def _move(self, wanted: torch.Tensor) -> torch.Tensor:
        self._world.step(wanted - self._history.q[:, -1])
        return self._world.q


def _share_drawn_numbers(model: ActuatorModel) -> None:
    """Give all environments the drawn numbers of the first; noise stays different."""
    for path, value in model.state.items():
        if "drawn" in path.split("."):
            value.copy_(value[:1].clone().expand_as(value))


def _limit_command(command: Command) -> np.ndarray:
    """Return the command in [-1, 1], zero where it is not finite."""
    u = np.nan_to_num(np.asarray(command.u, dtype=np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    return u.clip(-1.0, 1.0)
