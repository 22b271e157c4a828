"""A simulated machine at the end of a link: an actuator model driven by commands, seen by its sensors."""

from typing import Any, Self

import numpy as np
import torch

from brokk_rl.contracts.actuator import Actuator
from brokk_rl.errors import ConfigError
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.signals import Command, JointState
from brokk_rl.spec import spec

LOGGED = ("oil_c",)
"""States of an actuator model, one number a machine, that its sensors show."""


@spec
class Simulated:
    """Simulated machines side by side: an actuator model, with effects, from home; as fast as it computes.

    Attributes:
        actuator: The machine that is driven; with effects around it, as recordings show it.
        noise: Standard deviation of the measured positions, rad or m.
    """

    actuator: Actuator
    noise: float

    def check(self) -> None:
        if self.noise < 0:
            raise ConfigError(f"link.noise: expected 0 or more, got {self.noise}")

    @property
    def source(self) -> str:
        """The actuator and its effects."""
        inner, effects = (
            getattr(self.actuator, "actuator", self.actuator),
            getattr(self.actuator, "effects", {}),
        )
        return "simulator: " + " + ".join([type(inner).__name__, *effects])

    def build(self, machine: Machine, num_runs: int, session: Session) -> "SimulatedLink":
        """Returns a link to `num_runs` machines."""
        # a few dozen machines are faster on a CPU
        device = torch.device("cpu") if session.device == "auto" else session.torch_device()
        return SimulatedLink(self, machine, num_runs, session, device)


class SimulatedLink:
    """The link at work; each `send` is one control period."""

    def __init__(
        self,
        config: Simulated,
        machine: Machine,
        num_runs: int,
        session: Session,
        device: torch.device,
    ) -> None:
        self._config, self._machine, self._device = config, machine, device
        self._generator = session.generator("link")
        self._form = (num_runs, machine.num_joints) if num_runs > 1 else (machine.num_joints,)
        everywhere = torch.ones(num_runs, dtype=torch.bool, device=device)
        shape = (num_runs, machine.num_history, machine.num_joints)
        self._history = History(
            q=torch.zeros(shape, device=device), u=torch.zeros(shape, device=device)
        )
        self._history.reset(
            everywhere,
            torch.as_tensor(machine.home, dtype=torch.float32, device=device).repeat(num_runs, 1),
        )
        devices = [device] if device.type == "cuda" else []
        with torch.random.fork_rng(devices):  # what differs from machine to machine is drawn here
            torch.manual_seed(session.stream("link"))
            self._model = config.actuator.build(machine, num_runs, device)
            self._model.reset(everywhere)
        self._logged = {
            path.rpartition(".")[2]: path
            for path in self._model.state
            if path.rpartition(".")[2] in LOGGED
        }
        self._steps = 0
        self._measure()

    def read(self) -> JointState:
        """Returns the state after the last control period; reading twice gives the same."""
        return JointState(self._steps * self._machine.period_s, self._measured.reshape(self._form))

    def send(self, command: Command) -> Command:
        """Drives the machines for one control period; what is no number is a standstill."""
        u = np.nan_to_num(
            np.asarray(command.u, dtype=np.float64), nan=0.0, posinf=0.0, neginf=0.0
        ).clip(-1.0, 1.0)
        u = u.astype(np.float32)  # recorded as it was computed with
        with torch.inference_mode():
            self._history.push_u(
                torch.as_tensor(u.reshape(self._measured.shape), device=self._device)
            )
            self._history.push_q(self._model.step(self._history))
        self._steps += 1
        self._measure()
        return Command(u)

    def extra(self) -> dict[str, np.ndarray]:
        """Returns what the sensors show besides, each `(N,)`: the oil's temperature where the model knows one."""
        state = self._model.state if self._logged else {}
        return {name: state[path].cpu().numpy().copy() for name, path in self._logged.items()}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: Any) -> None:
        pass

    def _measure(self) -> None:
        q = self._history.q[:, -1].cpu().numpy().astype(np.float64)
        self._measured = q + self._config.noise * self._generator.standard_normal(q.shape)
