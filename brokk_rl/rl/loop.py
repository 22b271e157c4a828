"""The control loop of many simulated machines at once, as rsl-rl wants to see it.

One control step is command → follower → actuator model → drive and physics → judgement → resets →
observation, all on the device, with fixed shapes and without a host synchronisation. Where the
world allows it (Warp on a GPU) the whole step is captured once in a CUDA graph and replayed.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator
from typing import Any, cast

import numpy as np
import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from brokk_rl.commands import accept_speeds
from brokk_rl.contracts.actuator import (
    Actuator,
    ActuatorModel,
    Effect,
    Follower,
    FollowerModel,
    SensingModel,
)
from brokk_rl.contracts.target import TargetSensor, TargetSensorSpec
from brokk_rl.contracts.task import FAULT, STEPS, Task, TaskProcess
from brokk_rl.contracts.world import ExplainedWorld, Simulator, World
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.policy_folder import TaskDescription, describe_task
from brokk_rl.rl.execution import capture_graph, limit_to_one_thread, report_compile_errors
from brokk_rl.rl.settings import NearStarts
from brokk_rl.sim.events import Event
from brokk_rl.sim.simulator import find_site, list_events
from brokk_rl.spec import spec

Starts = dict[str, torch.Tensor]

log = logging.getLogger(__name__)


@spec
class SimulatedPlant:
    """Parts of a control loop: a simulated machine and the task that is done with it.

    Attributes:
        machine: The machine.
        sim: Physics.
        task: The task.
        actuator: How commands become motion.
        effect: Effects around the actuator model, by name.
        event: Changes of the simulated machine, by name.
        follower: Who stands between policy and machine.
    """

    machine: Machine
    sim: Simulator
    task: Task
    actuator: Actuator
    effect: dict[str, Effect]
    event: dict[str, Event]
    follower: Follower

    def build(
        self,
        device: torch.device,
        num_envs: int | None,
        pool: int,
        seed: int,
        starts: Starts | None = None,
        target: TargetSensorSpec | None = None,
    ) -> ControlLoop:
        """Return the control loop on `device`.

        Args:
            device: Where to simulate.
            num_envs: Number of environments; `None` for that of the simulator's configuration.
            pool: Number of valid starts from which resets draw.
            seed: Seed of the starts.
            starts: Starts of another control loop, in the place of drawn ones.
            target: How the loop comes to know its target; `None`: the task draws errors.
        """
        more: dict[str, Any] = {}
        if site := find_site(getattr(self.task, "scene", None), self.sim):
            more["site"] = site
        if events := list_events(self.event, self.sim):
            more["events"] = events
        world: World = self.sim.build(self.machine, device, num_envs, **more)
        num = world.num_worlds
        model = self.actuator.build(self.machine, num, device)
        for effect in self.effect.values():
            model = effect.wrap(model, self.machine, num, device)
        model = accept_speeds(model, self.machine, num, device)
        follower = self.follower.build(self.machine, num, device)
        process = self.task.build(self.machine, num, device)
        # with all threads, four processes on a computer of 64 cores had no starts after three
        # minutes; with one each, after seconds
        if starts is None:
            with limit_to_one_thread("cpu"):
                drawn = process.starts(pool, seed)
            starts = {key: value.to(device) for key, value in drawn.items()}
        description = describe_task(self.task)
        sensor = target.sense(self.machine, num, seed) if target else None
        return ControlLoop(
            self.machine, world, model, follower, process, starts, description, sensor
        )


class ControlLoop(VecEnv):
    """`N` simulated machines under control, as rsl-rl wants to see them.

    Args:
        machine: The machine.
        world: Physics.
        actuator: Actuator model, effects included.
        follower: Turns the proposed command into the command given.
        task: Task process.
        starts: Valid starts from which resets draw, each entry `(pool, …)`.
        description: Description of the task, for checkpoints and policies made here.
        sensor: Estimates the targets; `None`: the task draws their errors.
    """

    def __init__(
        self,
        machine: Machine,
        world: World,
        actuator: ActuatorModel,
        follower: FollowerModel,
        task: TaskProcess,
        starts: Starts,
        description: TaskDescription,
        sensor: TargetSensor | None = None,
    ) -> None:
        self.machine, self.world, self.task = machine, world, task
        self.sensor = sensor
        if sensor:
            task.require("take_estimate", "leave the target out")
        self.description = description
        self.actuator, self.follower = actuator, follower
        self.num_envs = world.num_worlds
        self.device: torch.device = world.device
        self.num_actions = task.num_actions
        self.max_episode_length = task.max_episode_steps
        self.cfg: dict[str, Any] = {}
        self.starts = starts
        self._num_near = 0
        self._first_row = torch.zeros((), dtype=torch.int64, device=self.device)
        """First row of the starts that resets draw; those near the target come first."""
        shape = (self.num_envs, machine.num_history, machine.num_joints)
        q, u = torch.zeros(2, *shape, device=self.device)
        self.history = History(q=q.clone(), u=u.clone())
        """History that the controller sees."""
        sides = getattr(actuator, "sides", frozenset())
        self._sensing = cast(SensingModel, actuator) if "measurement" in sides else None
        self._misplacing = cast(SensingModel, actuator) if "kinematics" in sides else None
        self.truth = History(q=q, u=u) if self._sensing else self.history
        """History of the machine itself; the same object where sensors are true."""
        self.reward = torch.zeros(self.num_envs, device=self.device)
        self.done = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        self.timed_out = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        self.reason = torch.full((self.num_envs,), -1.0, device=self.device)
        self._finished = torch.zeros(len(task.episode), self.num_envs, device=self.device)
        self.finished = dict(zip(task.episode, self._finished, strict=True))
        """Figures of the episode that ended in the last step, valid where `done`."""
        self.end_q = torch.zeros_like(world.q)
        """Joint positions at the end of the last step, before finished environments began anew,
        `(N, J)`."""
        self.end_u = torch.zeros_like(world.q)
        """Commands given in the last step, `(N, J)`; the policy's own where nobody follows it."""
        self.end_force_n = torch.zeros_like(world.contact_force_n)
        """Peak contact force of the last step, likewise, `(N,)`."""
        self._total_names = (*task.episode, *(f"end/{reason}" for reason in task.reasons))
        # sums over episodes finished since `statistics` was last asked
        self._totals = torch.zeros(len(self._total_names), device=self.device)
        self._steps = 0
        self._is_known = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        self._action = torch.zeros(self.num_envs, self.num_actions, device=self.device)
        # addresses that stay: a captured graph writes to them
        self._groups = {
            name: torch.zeros_like(value) for name, value in task.observe(self.history).items()
        }
        self._graph: torch.cuda.CUDAGraph | None = None
        self.begin()

    @property
    def graph_active(self) -> bool:
        """True when a control step is one replay of a CUDA graph."""
        return self._graph is not None

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Control steps since the start of each episode, `(N,)`.

        rsl-rl may set it to put episodes out of step.
        """
        return self.task.state[STEPS].long()

    @episode_length_buf.setter
    def episode_length_buf(self, value: torch.Tensor) -> None:
        self.task.state[STEPS].copy_(value)

    def begin(self, starts: Starts | None = None) -> None:
        """Start a new episode everywhere.

        Args:
            starts: Each entry `(N, …)`; `None` for random rows of the pool.
        """
        with self._always_alike():
            start = starts or self._draw()
            self.done.fill_(True)
            self._reset_worlds(start)
            self._perceive(start)
            self.done.fill_(False)

    def bring_near(self, near: NearStarts, seed: int) -> None:
        """Move part of the starts near their targets, before `capture`.

        Raises:
            ConfigError: The task cannot do that.
        """
        self.task.require("bring_near", "give rl.near_starts=null")
        share = max(near.share)
        moved = self.task.bring_near(self.starts, share, near.height_m, near.way, seed)
        self.starts = {name: value.to(self.device) for name, value in moved.items()}
        self._num_near = round(share * len(self.starts["q"]))
        self.draw_near(near.share[0])
        self.begin()

    def draw_near(self, share: float) -> None:
        """Let `share` of the resets draw starts near the target, at most as many as there are."""
        num_far = len(self.starts["q"]) - self._num_near
        if num_far:
            kept = min(self._num_near, round(num_far * share / (1.0 - share)))
            self._first_row.fill_(self._num_near - kept)

    def capture(self, fuse: bool = False) -> None:
        """Capture the control step in a CUDA graph where device and world allow it.

        A few steps are simulated on the way.

        Args:
            fuse: First have `torch.compile` fuse the small operations around the physics, on a GPU
                only for a graph.

        Raises:
            ConfigError: There is nothing here with which to compile.
        """
        if self.sensor is not None:  # it works on the host
            return
        graphs = self.device.type == "cuda" and self.world.supports_graphs
        if fuse := fuse and (graphs or self.device.type == "cpu"):
            for name in ("_command", "_judge", "_perceive"):
                compiled = torch.compile(getattr(self, name), fullgraph=True, dynamic=False)
                setattr(self, name, compiled)
        if not graphs and not fuse:
            return
        with report_compile_errors():
            if graphs:
                self._graph = capture_graph(self._advance, self.device)
            else:
                with self._always_alike():
                    self._advance()
        self.begin()

    def get_observations(self) -> TensorDict:
        """Return the current observation groups; asking twice gives the same."""
        return TensorDict(
            {name: value.clone() for name, value in self._groups.items()},
            batch_size=[self.num_envs],
        )

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        """Advance one control period; see `rsl_rl.env.VecEnv.step`."""
        with self._always_alike():
            self._action.copy_(actions)
            self._steps += 1
            if self._graph is not None:
                self._graph.replay()
            else:
                self._advance()
            return self.get_observations(), self.reward, self.done, {"time_outs": self.timed_out}

    def record_answers(
        self, act: Callable[[TensorDict], torch.Tensor], count: int
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return present observations, `(B, O)`, and the commands proposed for them, `(B, J)`.

        Nothing changes by it: neither an episode nor a random generator.

        Args:
            act: Returns the deterministic action for observation groups.
            count: Number of environments at most.
        """
        with self._always_alike():
            tensors = [*self.task.state.values(), *self.task.episode.values()]
            kept = [(tensor, tensor.clone()) for tensor in tensors]
            groups = self.get_observations()
            command = self.task.command(act(groups)).clone()
            for tensor, before in kept:
                tensor.copy_(before)
        return groups["policy"][:count].cpu(), command[:count].cpu()

    def statistics(self) -> dict[str, float]:
        """Return figures of the episodes that finished since the last call: means, endings, number.

        Reads back from the device once. A figure of any environment that is not finite makes its
        mean not finite.
        """
        found = self._totals.tolist()
        values = dict(zip(self._total_names, found, strict=True))
        episodes = sum(found[len(self.task.episode) :])
        fault_rate = values[f"end/{FAULT}"] / max(1, self._steps * self.num_envs)
        if fault_rate and isinstance(self.world, ExplainedWorld):
            log.warning("worlds diverged: %s", self.world.explain_faults())
        self._totals.zero_()
        self._steps = 0
        means = {name: value / max(1.0, episodes) for name, value in values.items()}
        return means | {"episodes": episodes, "fault_rate": fault_rate}

    def state_dict(self) -> dict[str, Any]:
        """Return copies of all that is needed to go on exactly, but for random generators."""
        tensors = {}
        for part, values in self._list_parts().items():
            for name, value in values.items():
                tensors[f"{part}.{name}"] = value.clone()
        return {"tensors": tensors, "world": self.world.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a copy that `state_dict` returned."""
        tensors = dict(state["tensors"])
        for part, values in self._list_parts().items():
            for name, value in values.items():
                value.copy_(tensors[f"{part}.{name}"])
        self.world.load_state_dict(state["world"])

    def _list_parts(self) -> dict[str, dict[str, torch.Tensor]]:
        """Return all tensors that are needed to go on exactly, by part and name."""
        return {
            "history": {"q": self.history.q, "u": self.history.u},
            "truth": {"q": self.truth.q, "u": self.truth.u},
            "task": self.task.state,
            "episode": self.task.episode,
            "actuator": self.actuator.state,
            "follower": self.follower.state,
            "group": self._groups,
        }

    @contextlib.contextmanager
    def _always_alike(self) -> Iterator[None]:
        """Make torch's modes the same for every caller.

        rsl-rl calls in and outside of its inference mode, and at any number of threads. For each of
        them torch would compile the fused parts anew.
        """
        with limit_to_one_thread(self.device), torch.inference_mode(False), torch.no_grad():
            yield

    def _advance(self) -> None:
        """Run one control step on the device."""
        increment = self._command()
        self.world.step(increment)
        start = self._judge()
        self._reset_worlds(start)
        self._perceive(start)

    def _reset_worlds(self, start: Starts) -> None:
        """Put blocks that moved to their places, and finished environments to their starts."""
        if self.task.moved is not None:
            self.world.place(self.task.moved, self.task.state["start.scene"])
        self.world.reset(self.done, start["q"], start["scene"])

    def _command(self) -> torch.Tensor:
        """Apply the action; return the motion that the drive is to make of each joint, `(N, J)`."""
        # histories hold what was given, as the machine's log does: it is all that policy and
        # actuator model can know
        u = self.task.command(self._action)
        if self.sensor is not None:
            u = u * self._is_known[:, None]
        self.end_u.copy_(self.follower.step(u))
        self.truth.push_u(self.end_u)
        if self._sensing:
            self.history.push_u(self.end_u)
        return self.actuator.step(self.truth) - self.truth.q[:, -1]

    def _judge(self) -> Starts:
        """Judge the simulated step; return starts for the environments that finished."""
        # a world that became NaN is a fault and starts anew; its numbers must not poison the sums
        # over all worlds
        self.truth.push_q(self.world.q.nan_to_num())
        transition = self.task.step(self.truth, self.world)
        done = transition.terminated | transition.timed_out
        self.reward.copy_(transition.reward)
        self.timed_out.copy_(transition.timed_out)
        self.done.copy_(done)
        self.reason.copy_(transition.reason)
        self.end_q.copy_(self.world.q)
        self.end_force_n.copy_(self.world.contact_force_n)
        finished = torch.stack(tuple(self.task.episode.values()))
        self._finished.copy_(finished)
        reasons = torch.arange(len(self.task.reasons), device=self.device)
        ending = reasons[:, None] == transition.reason
        self._totals.add_((torch.cat((finished, ending)) * done).sum(1))
        return self._draw()

    def _perceive(self, start: Starts) -> None:
        """Reset finished environments and observes all of them."""
        self.truth.reset(self.done, start["q"])
        self.actuator.reset(self.done)
        self.follower.reset(self.done)
        if self._sensing:
            q = self._sensing.measure(self.truth.q[:, -1])
            self.history.push_q(q)
            self.history.reset(self.done, q)
        self.task.reset(self.done, start)
        if self.sensor is not None:
            self._sense(self.sensor, start)
        shift_m = self._misplacing.misplacement(self.truth.q[:, -1]) if self._misplacing else None
        for name, value in self.task.observe(self.history, shift_m).items():
            self._groups[name].copy_(value)

    def _sense(self, sensor: TargetSensor, start: Starts) -> None:
        """Give the task the targets that the sensor estimates."""
        task = self.task

        def plan(target_m: np.ndarray, num_times: int, step_s: float) -> np.ndarray:
            wanted = torch.as_tensor(target_m, dtype=torch.float32, device=self.device)
            return task.plan(self.history.q[:, -1], wanted, num_times, step_s).cpu().numpy()

        done = self.done.cpu().numpy()
        if done.any():
            sensor.reset(done, {name: value.cpu().numpy() for name, value in start.items()})
        q, measured = self.truth.q[:, -1].cpu().numpy(), self.history.q[:, -1].cpu().numpy()
        reading = sensor.read(q, measured, plan)
        self._is_known.copy_(torch.as_tensor(reading.is_known, device=self.device))
        task.take_estimate(
            torch.as_tensor(reading.target_m, dtype=torch.float32, device=self.device)
        )

    def _draw(self) -> Starts:
        num = len(self.starts["q"])
        rows = torch.randint(num, (self.num_envs,), device=self.device)
        rows = self._first_row + rows * (num - self._first_row) // num
        return {key: value[rows] for key, value in self.starts.items()}
