"""The control loop of many simulated machines at once, as rsl-rl wants to see it.

One control step is command → actuator model → drive and physics → judgement → resets → observation, all on the device, with fixed shapes
and without a host synchronisation. Where the world allows it (Warp on a GPU) the whole step is captured once in a CUDA graph and replayed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from brokk_rl.contracts import Actuator, ActuatorModel, Effect, Simulator, Task, TaskProcess, World
from brokk_rl.history import History
from brokk_rl.machine import Machine

Starts = dict[str, torch.Tensor]


@dataclass(frozen=True)
class Plant:
    """What a control loop is made of: specs, not yet built.

    Attributes:
        machine: The machine.
        sim: Builds the world.
        task: Builds the task.
        actuator: Builds the actuator model.
        effects: Effects around the actuator model, by name.
    """

    machine: Machine
    sim: Simulator
    task: Task
    actuator: Actuator
    effects: dict[str, Effect]

    def build(self, device: torch.device, num_envs: int | None, pool: int, seed: int) -> ControlLoop:
        """Returns the control loop on `device`.

        Args:
            device: Where to simulate.
            num_envs: Number of environments; `None` for what the simulator's configuration says.
            pool: Number of valid starts from which resets draw.
            seed: Seed of the starts.
        """
        world = self.sim.build(self.machine, device, num_envs)
        num = world.num_worlds
        model = self.actuator.build(self.machine, num, device)
        for effect in self.effects.values():
            model = effect.wrap(model, self.machine, num, device)
        process = self.task.build(self.machine, num, device)
        starts = {key: value.to(device) for key, value in process.starts(pool, seed).items()}
        return ControlLoop(self.machine, world, model, process, starts)


class ControlLoop(VecEnv):
    """`N` simulated machines under control; see the module.

    Args:
        machine: The machine.
        world: Physics.
        actuator: Actuator model, effects included.
        task: Task process.
        starts: Valid starts from which resets draw, each entry `(pool, …)`.
    """

    def __init__(self, machine: Machine, world: World, actuator: ActuatorModel, task: TaskProcess, starts: Starts) -> None:
        self.machine, self.world, self.actuator, self.task = machine, world, actuator, task
        self.num_envs, self.device = world.num_worlds, world.device
        self.num_actions = task.num_actions
        self.max_episode_length = task.max_episode_steps
        self.cfg: dict[str, Any] = {}
        self.starts = starts
        shape = (self.num_envs, machine.num_history, machine.num_joints)
        self.history = History(q=torch.zeros(shape, device=self.device), u=torch.zeros(shape, device=self.device))
        self.reward = torch.zeros(self.num_envs, device=self.device)
        self.done = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        self.timed_out = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        self.reason = torch.full((self.num_envs,), -1.0, device=self.device)
        self.finished = {name: torch.zeros_like(value) for name, value in task.episode.items()}
        """Figures of the episode that ended in the last step, valid where `done`."""
        self.totals = {name: torch.zeros((), device=self.device) for name in (*task.episode, *(f"end/{r}" for r in task.reasons))}
        """Sums over finished episodes since `statistics` was last asked."""
        self._steps = 0
        self._action = torch.zeros(self.num_envs, self.num_actions, device=self.device)
        self._groups: dict[str, torch.Tensor] = {}
        self._graph: torch.cuda.CUDAGraph | None = None
        self.begin()

    @property
    def graph_active(self) -> bool:
        """Whether a control step is one replay of a CUDA graph."""
        return self._graph is not None

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Control steps since the start of each episode, `(N,)`; rsl-rl may set it to put episodes out of step."""
        return self.task.state["steps"].long()

    @episode_length_buf.setter
    def episode_length_buf(self, value: torch.Tensor) -> None:
        self.task.state["steps"].copy_(value)

    @torch.no_grad()
    def begin(self, starts: Starts | None = None) -> None:
        """Starts a new episode everywhere: from `starts`, each entry `(N, …)`, else from random rows of the pool."""
        everywhere = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        self._reset(everywhere, starts or self._draw())
        self._groups = {name: value.clone() for name, value in self.task.observe(self.history).items()}

    def capture(self) -> None:
        """Captures the control step in a CUDA graph where device and world allow it; a few steps are simulated on the way."""
        if self.device.type != "cuda" or not self.world.supports_graphs:
            return
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream), torch.no_grad():
            for _ in range(3):  # kernels are compiled and buffers allocated before anything is recorded
                self._advance()
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.no_grad(), torch.cuda.graph(graph):
            self._advance()
        self._graph = graph
        self.begin()

    def get_observations(self) -> TensorDict:
        """Returns the current observation groups; asking twice gives the same."""
        return TensorDict({name: value.clone() for name, value in self._groups.items()}, batch_size=[self.num_envs])

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        """Advances one control period; see `rsl_rl.env.VecEnv.step`."""
        self._action.copy_(actions)
        self._steps += 1
        if self._graph is not None:
            self._graph.replay()
        else:
            with torch.no_grad():
                self._advance()
        return self.get_observations(), self.reward, self.done, {"time_outs": self.timed_out}

    def statistics(self) -> dict[str, float]:
        """Returns means over the episodes finished since the last call, shares of their endings, and their number; one synchronisation."""
        values = dict(zip(self.totals, torch.stack(tuple(self.totals.values())).tolist(), strict=True))
        endings = {name: value for name, value in values.items() if name.startswith("end/")}
        episodes = sum(endings.values())
        fault_rate = values["end/fault"] / max(1, self._steps * self.num_envs)
        for total in self.totals.values():
            total.zero_()
        self._steps = 0
        return {name: value / max(1.0, episodes) for name, value in values.items()} | {"episodes": episodes, "fault_rate": fault_rate}

    def state_dict(self) -> dict[str, Any]:
        """Returns copies of everything that must be stored to go on exactly; random generators are the session's."""
        state: dict[str, torch.Tensor] = {"history.q": self.history.q, "history.u": self.history.u}
        state |= {f"task.{name}": value for name, value in self.task.state.items()}
        state |= {f"episode.{name}": value for name, value in self.task.episode.items()}
        state |= {f"actuator.{name}": value for name, value in self.actuator.state.items()}
        state |= {f"group.{name}": value for name, value in self._groups.items()}
        return {"tensors": {name: value.clone() for name, value in state.items()}, "world": self.world.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what `state_dict` returned."""
        tensors = state["tensors"]
        self.history.q.copy_(tensors["history.q"])
        self.history.u.copy_(tensors["history.u"])
        parts = {"task": self.task.state, "episode": self.task.episode, "actuator": self.actuator.state, "group": self._groups}
        for prefix, part in parts.items():
            for name, value in part.items():
                value.copy_(tensors[f"{prefix}.{name}"])
        self.world.load_state_dict(state["world"])

    def _advance(self) -> None:
        """One control step on the device."""
        self.history.push_u(self.task.command(self._action))
        ahead = self.actuator.step(self.history)
        self.world.step(ahead - self.history.q[:, -1])
        self.history.push_q(self.world.q)
        transition = self.task.step(self.history, self.world)
        self.reward.copy_(transition.reward)
        self.timed_out.copy_(transition.timed_out)
        self.done.copy_(transition.terminated | transition.timed_out)
        self.reason.copy_(transition.reason)
        for name, value in self.task.episode.items():
            self.finished[name].copy_(value)
            self.totals[name] += (value * self.done).sum()
        for index, name in enumerate(self.task.reasons):
            self.totals[f"end/{name}"] += (self.done & (self.reason == index)).sum()
        self._reset(self.done, self._draw())
        for name, value in self.task.observe(self.history).items():
            self._groups[name].copy_(value)

    def _draw(self) -> Starts:
        rows = torch.randint(len(self.starts["q"]), (self.num_envs,), device=self.device)
        return {key: value[rows] for key, value in self.starts.items()}

    def _reset(self, mask: torch.Tensor, start: Starts) -> None:
        self.world.reset(mask, start["q"], start["scene"])
        self.history.reset(mask, start["q"])
        self.actuator.reset(mask)
        self.task.reset(mask, start)
