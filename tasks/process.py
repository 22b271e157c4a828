"""Episodes of a task in `N` environments at once, by its terms.

No method synchronises with the host, and every tensor of `state` and `episode` keeps its address:
the whole control step can be captured in one CUDA graph.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import torch

from brokk_rl.contracts.task import REWARD, STEPS, SUCCESS, TaskProcess, Transition
from brokk_rl.contracts.world import World
from brokk_rl.history import History
from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine, mask_exclusive_joints
from brokk_rl.sim import scene
from tasks.managers import FigureManager, ObservationManager, RewardManager, TerminationManager
from tasks.step_state import StepState
from tasks.term_task import BLOCK_AWAY_M, EpisodeTask, JointAction, TermTask
from tasks.terms import ObservedTerm

START = "start."
"""Begins the entries of `state` that were drawn for the episode."""


class EpisodeProcess(TaskProcess):
    """Common part of all tasks' episodes: state, judgement, rewards, figures.

    Args:
        task: The spec.
        machine: The machine.
        num_envs: `N`.
        device: Where to compute.
    """

    def __init__(
        self, task: EpisodeTask, machine: Machine, num_envs: int, device: torch.device
    ) -> None:
        def to_constant(values: object) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=device)

        def make_zeros(*shape: int) -> torch.Tensor:
            return torch.zeros(num_envs, *shape, device=device)

        self.num_actions = machine.num_joints
        self.max_episode_steps = round(task.episode_s / machine.period_s)
        self._machine, self._kinematics = machine, Kinematics(machine, device)
        self._lower, self._upper = to_constant(machine.lower), to_constant(machine.upper)
        self._exclusive = to_constant(machine.is_exclusive).bool()
        self._rewards = RewardManager(task.reward, task.curriculum)
        self._endings = TerminationManager(task.termination)
        self.reasons = self._endings.reasons
        self._figures = FigureManager(task.figures)
        self.figures = self._figures.figures
        self.state = {name: make_zeros(*shape) for name, shape in self._list_shapes().items()}
        terms = (f"{REWARD}{name}" for name in task.reward)
        self.episode = {name: make_zeros() for name in (*self.figures, "return", "length", *terms)}
        rest = make_zeros(machine.num_history, machine.num_joints)
        example = self._make_state(History(q=rest, u=rest), make_zeros())
        self._observed = ObservationManager(self._list_groups(), example)
        self.state |= self._observed.state

    def _list_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shape of each entry of `state` but those of observations, without `N`."""
        joints = (self._machine.num_joints,)
        # `steps` decides about the time limit and may be set from outside (episodes out of step);
        # `age` counts since the reset
        one_each = (STEPS, "age", "succeeded", "held", "contact_force_n", "peak_force_n")
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(one_each, ())
        shapes |= {"u": joints, "u_before": joints}
        drawn = {"q": joints, "scene": (scene.SIZE,), "tip_m": (3,)} | self._list_drawn_shapes()
        return shapes | {START + name: shape for name, shape in drawn.items()}

    def _list_drawn_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shapes of what the task asks for in an episode, without `N`."""
        return {}

    def _list_groups(self) -> dict[str, dict[str, ObservedTerm | None]]:
        """Return the terms of each observation group."""
        return {}

    def reset(self, mask: torch.Tensor, start: dict[str, torch.Tensor]) -> None:
        """Begin new episodes; see `TaskProcess.reset`."""
        fresh = {START + name: value for name, value in start.items()}
        fresh |= {"succeeded": self.episode[SUCCESS]} | self._draw_errors(start)
        zero = torch.zeros((), device=mask.device)
        for name, value in self.state.items():
            rows = mask.reshape(-1, *[1] * (value.dim() - 1))
            value.copy_(torch.where(rows, fresh.get(name, zero), value))
        for value in self.episode.values():
            value.masked_fill_(mask, 0.0)

    def _draw_errors(self, start: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Return what else begins anew in an episode, by its entry of `state`."""
        return self._observed.draw_biases()

    def _remember_command(self, u: torch.Tensor) -> torch.Tensor:
        self.state["u_before"].copy_(self.state["u"])
        self.state["u"].copy_(u)
        return u

    def step(self, history: History, world: World) -> Transition:
        """Judge a control step; see `TaskProcess.step`."""
        state = self.state
        state[STEPS] += 1
        state["age"] += 1
        # forces of a diverged world may be NaN, and one NaN would poison the sums over all worlds
        force_n = torch.where(world.faults, 0.0, world.contact_force_n)
        seen = self._make_state(history, force_n)
        self._judge_success(seen, world.faults)
        endings = self._endings.judge(seen, world.faults)
        reward = self._rewards.sum(seen, endings.is_sound, state["succeeded"], self.episode)
        self._figures.update(seen, reward, self.episode)
        self._remember(seen)
        return Transition(
            reward=reward,
            terminated=endings.terminated,
            timed_out=endings.timed_out,
            reason=endings.reason,
        )

    def _judge_success(self, seen: StepState, faults: torch.Tensor) -> None:
        """Write `success` of the state, the criterion alone."""

    def _remember(self, seen: StepState) -> None:
        """Keep what the next step needs of this one."""
        state, force_n = self.state, seen.contact_force_n
        state["contact_force_n"].copy_(force_n)
        state["peak_force_n"].copy_(torch.maximum(state["peak_force_n"], force_n))

    def _make_state(self, history: History, force_n: torch.Tensor) -> StepState:
        return StepState(**self._list_values(history, force_n))

    def _list_values(self, history: History, force_n: torch.Tensor) -> dict[str, Any]:
        """Return the fields of a `StepState` by name."""
        state = self.state
        pose = self._kinematics.pose(history.q[:, -1])
        nowhere = state["age"] < 0
        start = {}
        for name, value in state.items():
            if name.startswith(START):
                start[name.removeprefix(START)] = value
        return {
            "history": history,
            "lower": self._lower,
            "upper": self._upper,
            "tip_m": pose.tip_in_base_m,
            "pitch_rad": pose.pitch_rad,
            "u": state["u"],
            "u_before": state["u_before"],
            "contact_force_n": force_n,
            "peak_force_n": state["peak_force_n"],
            "steps": state[STEPS],
            "max_steps": self.max_episode_steps,
            "age": state["age"],
            "period_s": self._machine.period_s,
            "start": start,
            "kinematics": self._kinematics,
            "success": nowhere,
            "failed": nowhere,
            "held_share": state["held"],
        }


class TermProcess(EpisodeProcess):
    """Episodes of a task whose particulars are all terms."""

    def __init__(
        self, task: TermTask, machine: Machine, num_envs: int, device: torch.device
    ) -> None:
        self.task = task
        super().__init__(task, machine, num_envs, device)
        self._is_good = task.success.resolve()
        self._after_steps = round(task.success.after_s / machine.period_s)
        self._needed_steps = task.success.share * (self.max_episode_steps - self._after_steps)

    def _list_drawn_shapes(self) -> dict[str, tuple[int, ...]]:
        return {name: (len(ranges.lowest),) for name, ranges in self.task.command.items()}

    def _list_groups(self) -> dict[str, dict[str, ObservedTerm | None]]:
        return {"policy": self.task.observation, "privileged": self.task.privileged}

    def starts(self, count: int, seed: int) -> dict[str, torch.Tensor]:
        """Draw arms and commands; see `TaskProcess.starts`."""
        task, machine = self.task, self._machine
        generator = torch.Generator().manual_seed(seed)

        def draw(low: torch.Tensor, high: torch.Tensor) -> torch.Tensor:
            return low + (high - low) * torch.rand(count, len(low), generator=generator)

        lower, upper, home = (
            torch.tensor(value, dtype=torch.float32)
            for value in (machine.lower, machine.upper, machine.home)
        )
        reach = task.start.spread * (upper - lower) / 2
        lowest, highest = lower + task.start.margin, upper - task.start.margin
        q = draw(home - reach, home + reach).maximum(lowest).minimum(highest)
        place = scene.make_nominal_scenes(count)
        place[:, scene.COLUMNS.index("hole_x_m")] = BLOCK_AWAY_M
        tip_m = Kinematics(machine, "cpu").pose(q).tip_in_base_m
        start = {"q": q, "scene": place, "tip_m": tip_m}
        for name, ranges in task.command.items():
            start[name] = draw(torch.tensor(ranges.lowest), torch.tensor(ranges.highest))
        return start

    def command(self, action: torch.Tensor) -> torch.Tensor:
        """Return masked commands; see `TaskProcess.command`."""
        return self._remember_command(compute_command(self.task.action, action, self._exclusive))

    def _judge_success(self, seen: StepState, faults: torch.Tensor) -> None:
        state = self.state
        holds = self._is_good(seen) & ~faults
        state["held"] += holds & (state["age"] > self._after_steps)
        seen.success = state["held"] >= self._needed_steps
        seen.held_share = state["held"] / (state["age"] - self._after_steps).clamp(min=1.0)

    def observe(
        self, history: History, shift_m: torch.Tensor | None = None
    ) -> dict[str, torch.Tensor]:
        """Return the groups that have terms; see `TaskProcess.observe`.

        A wrong calibration (`shift_m`) moves nothing: a task made of terms has no seen target.
        """
        return self._observed.observe(self._make_state(history, self.state["contact_force_n"]))

    def describe(self) -> dict[str, Any]:
        """Return the contract of the `policy` group; see `TaskProcess.describe`."""
        description = self._observed.encoders["policy"].describe()
        for part in description["parts"]:
            term = self.task.observation[part["name"]]
            assert term is not None
            part |= {"function": term.function, "params": term.params}
        criterion = dataclasses.asdict(self.task.success)
        stop = {"success": {}, "criterion": criterion} | self._endings.describe()
        return description | {"masked": self.task.action.mask, "stop": stop}

    def deployable(self, network: torch.nn.Module) -> torch.nn.Module:
        """Return the policy as one module; see `TaskProcess.deployable`."""
        return TermPolicy(network, self.task.action, self._exclusive)


class TermPolicy(torch.nn.Module):
    """The policy as it runs on the machine: `(B, O)` observations to `(B, J)` masked commands.

    Args:
        network: Takes a dictionary of observation groups, returns the action.
        action: Map from the action to commands.
        exclusive: Which joints are exclusive, `(J,)` bool.
    """

    def __init__(
        self, network: torch.nn.Module, action: JointAction, exclusive: torch.Tensor
    ) -> None:
        super().__init__()
        self.network = network
        self._action, self._exclusive = action, exclusive

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Return valve commands, `(B, J)` in [-1, 1]."""
        return compute_command(self._action, self.network({"policy": observation}), self._exclusive)


def compute_command(
    action: JointAction, output: torch.Tensor, exclusive: torch.Tensor
) -> torch.Tensor:
    """Return valve commands in [-1, 1], `(N, J)`.

    Args:
        action: The map.
        output: Output of the network, `(N, J)`.
        exclusive: Which joints are exclusive, `(J,)` bool.
    """
    u = (action.scale * output).clamp(-1.0, 1.0)
    if not action.mask:
        return u
    size = u.abs()
    alone, others = (size * exclusive).amax(1), (size * ~exclusive).amax(1)
    return u.where(mask_exclusive_joints(exclusive, alone > others), 0.0)
