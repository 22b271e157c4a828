"""A simulated machine beside a block with a borehole, at the end of a link: contact and all, for a twin in real time."""

from __future__ import annotations

import math
from typing import Any, Self

import numpy as np
import torch

from brokk_rl.contracts.actuator import Actuator
from brokk_rl.contracts.world import Simulator
from brokk_rl.errors import ConfigError
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.signals import Command, JointState
from brokk_rl.sim.link import LOGGED
from brokk_rl.sim.scene import nominal
from brokk_rl.spec import spec


@spec
class Site:
    """One simulated machine in the world: an actuator model with effects, physics, a block with a borehole.

    Attributes:
        sim: Builds the world.
        actuator: The machine; with effects around it, as recordings show it.
        noise: Standard deviation of the measured positions, rad or m.
        hole_in_base_m: Centre of the borehole's rim.
        start: Joint positions at the beginning, rad or m; `null`: home.
    """

    sim: Simulator
    actuator: Actuator
    noise: float
    hole_in_base_m: tuple[float, float, float]
    start: tuple[float, ...] | None

    def check(self) -> None:
        if self.noise < 0:
            raise ConfigError(f"link.noise: expected 0 or more, got {self.noise}")

    @property
    def source(self) -> str:
        """That it is simulated, with contact."""
        return "simulated site"

    def build(self, machine: Machine, num_runs: int, session: Session) -> SiteLink:
        """Returns a link to the machine.

        Raises:
            ConfigError: more than one machine is asked for, or the start does not fit the machine.
        """
        if num_runs != 1:
            raise ConfigError(
                f"link=site has one machine, not {num_runs}; link=simulated has as many as you like"
            )
        if self.start is not None and len(self.start) != machine.num_joints:
            raise ConfigError(
                f"link.start: expected {machine.num_joints} joint positions, got {len(self.start)}"
            )
        return SiteLink(self, machine, session)


class SiteLink:
    """The link at work; each `send` is one control period."""

    def __init__(self, site: Site, machine: Machine, session: Session) -> None:
        self._site, self._machine = site, machine
        self._generator = session.generator("link")
        cpu = torch.device("cpu")
        self._world = site.sim.build(machine, cpu, 1)
        shape = (1, machine.num_history, machine.num_joints)
        with torch.random.fork_rng([]):
            torch.manual_seed(session.stream("link"))
            self._model = site.actuator.build(machine, 1, cpu)
        self._history = History(q=torch.zeros(shape), u=torch.zeros(shape))
        self._logged = {
            path.rpartition(".")[2]: path
            for path in self._model.state
            if path.rpartition(".")[2] in LOGGED
        }
        self._steps, self._measured = 0, np.zeros(machine.num_joints)
        self.place(
            np.array(site.start if site.start is not None else machine.home),
            np.array(site.hole_in_base_m),
        )

    def read(self) -> JointState:
        """Returns the state after the last control period; reading twice gives the same."""
        return JointState(self._steps * self._machine.period_s, self._measured.copy())

    def send(self, command: Command) -> Command:
        """Drives the machine for one control period; what is no number is a standstill."""
        u = np.nan_to_num(
            np.asarray(command.u, dtype=np.float64), nan=0.0, posinf=0.0, neginf=0.0
        ).clip(-1.0, 1.0)
        with torch.inference_mode():
            self._history.push_u(torch.as_tensor(u[None], dtype=torch.float32))
            self._world.step(self._model.step(self._history) - self._history.q[:, -1])
            self._history.push_q(self._world.q)
        self._steps += 1
        self._measure()
        return Command(u)

    def place(self, q: np.ndarray, hole_in_base_m: np.ndarray) -> None:
        """Puts the machine, at rest, at `q`, `(J,)`, and the block with the rim of its hole at `hole_in_base_m`, its side to it."""
        everywhere = torch.ones(1, dtype=torch.bool)
        start, scene = torch.as_tensor(q[None], dtype=torch.float32), nominal(1)
        x, y, z = hole_in_base_m.tolist()
        scene[0, :4] = torch.tensor([x, y, z, math.atan2(y, x)])
        with torch.random.fork_rng([]):
            torch.manual_seed(int(self._generator.integers(2**31)))
            self._model.reset(everywhere)
        self._world.reset(everywhere, start, scene)
        self._history.reset(everywhere, start)
        self._measure()

    def extra(self) -> dict[str, np.ndarray]:
        """Returns the contact force, and the oil's temperature where the model knows one, each `(1,)`."""
        found = {
            name: self._model.state[path].numpy().copy() for name, path in self._logged.items()
        }
        return found | {"force_n": self._world.contact_force_n.numpy().copy()}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: Any) -> None:
        pass

    def _measure(self) -> None:
        q = self._history.q[0, -1].numpy().astype(np.float64)
        self._measured = q + self._site.noise * self._generator.standard_normal(q.shape)
