"""Episodes of a task made of terms, in `N` environments at once.

No method synchronises with the host, and every tensor of `state` and `episode` keeps its address:
the whole control step can be captured in one CUDA graph.
"""

from __future__ import annotations

import dataclasses
from pkgutil import resolve_name
from typing import Any

import torch

from brokk_rl.contracts.task import REWARD, STEPS, SUCCESS, TaskProcess, Transition
from brokk_rl.contracts.world import World
from brokk_rl.history import History
from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine, mask_exclusive_joints
from brokk_rl.observation import ObservationPart, PartsEncoder
from brokk_rl.sim import scene
from tasks.reward import RewardSum
from tasks.term_task import JointAction, ObservedTerm, TermState, TermTask, select_terms
from tasks.termination import EpisodeTerms

BLOCK_AWAY_M = -20.0
"""Place of the block along x where a task has none: behind the machine and out of its reach."""
COMMAND = "command."
"""Begins the entries of a start that the task asks for."""
GROUPS = {"policy": "observation", "privileged": "privileged"}
"""Field of the spec that holds the terms of each observation group."""


class TermProcess(TaskProcess):
    """Episodes in `N` environments.

    Args:
        task: The spec.
        machine: The machine.
        num_envs: `N`.
        device: Where to compute.
    """

    def __init__(
        self, task: TermTask, machine: Machine, num_envs: int, device: torch.device
    ) -> None:
        def to_constant(values: object) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=device)

        self.task = task
        self.num_actions = machine.num_joints
        self.max_episode_steps = round(task.episode_s / machine.period_s)
        self._machine, self._kinematics = machine, Kinematics(machine, device)
        self._lower, self._upper = to_constant(machine.lower), to_constant(machine.upper)
        self._exclusive = to_constant(machine.is_exclusive).bool()
        self._rewards = RewardSum(task.reward, task.curriculum)
        self._endings = EpisodeTerms(task.termination)
        self.reasons = self._endings.reasons
        self._after_steps = round(task.success.after_s / machine.period_s)
        self._needed_steps = task.success.share * (self.max_episode_steps - self._after_steps)
        start = self.starts(1, 0)
        one_each = ("age", STEPS, "held", "contact_force_n", "succeeded")
        self.state = {name: torch.zeros(num_envs, device=device) for name in one_each}
        self.state["start_tip_m"] = torch.zeros(num_envs, 3, device=device)
        for name, value in start.items():
            if name.startswith(COMMAND):
                self.state[name] = torch.zeros(num_envs, *value.shape[1:], device=device)
        figures = (SUCCESS, "held_share", "peak_force_n", "return", "length")
        names = (*figures, *(f"{REWARD}{name}" for name in task.reward))
        self.episode = {name: torch.zeros(num_envs, device=device) for name in names}
        self._terms = {group: select_terms(getattr(task, field)) for group, field in GROUPS.items()}
        # found once: a compiled step cannot import
        self._is_good = resolve_name(task.success.function)
        self._functions = {
            term.function: resolve_name(term.function)
            for terms in self._terms.values()
            for term in terms.values()
        }
        self._encoders = self._build_encoders(num_envs, device)

    def _build_encoders(self, num_envs: int, device: torch.device) -> dict[str, PartsEncoder]:
        """Return the encoder of each group that has terms; adds what the terms remember to `state`."""
        still = torch.zeros(num_envs, 2, self._machine.num_joints, device=device)
        state = self._make_state(History(q=still, u=still), self.state["contact_force_n"])
        encoders = {}
        for group, terms in self._terms.items():
            parts = []
            for name, term in terms.items():
                width = self._call(term, state).shape[1]
                parts.append(
                    ObservationPart(
                        name=name, samples=term.samples, width=width, mean=term.mean, std=term.std
                    )
                )
                key = f"{group}.{name}"
                self.state[f"samples.{key}"] = still.new_zeros(num_envs, term.samples, width)
                if term.bias:
                    self.state[f"bias.{key}"] = still.new_zeros(num_envs, width)
            if parts:
                encoders[group] = PartsEncoder(parts, torch.cat)
                self.state[group] = still.new_zeros(num_envs, encoders[group].size)
        return encoders

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
        start = {"q": q, "scene": place}
        for name, ranges in task.command.items():
            start[COMMAND + name] = draw(torch.tensor(ranges.lowest), torch.tensor(ranges.highest))
        return start

    def reset(self, mask: torch.Tensor, start: dict[str, torch.Tensor]) -> None:
        """Begin new episodes; see `TaskProcess.reset`."""
        tip_m = self._kinematics.pose(start["q"]).tip_in_base_m
        fresh = {"start_tip_m": tip_m, "succeeded": self.episode[SUCCESS]}
        fresh |= {name: value for name, value in start.items() if name.startswith(COMMAND)}
        for group, terms in self._terms.items():
            for name, term in terms.items():
                if term.bias:
                    key = f"bias.{group}.{name}"
                    fresh[key] = _draw_error(term.bias, self.state[key])
        for name, value in self.state.items():
            rows = mask.reshape(-1, *[1] * (value.dim() - 1))
            value.copy_(
                fresh[name].where(rows, value) if name in fresh else value.where(~rows, 0.0)
            )
        for value in self.episode.values():
            value.masked_fill_(mask, 0.0)

    def command(self, action: torch.Tensor) -> torch.Tensor:
        """Return masked commands; see `TaskProcess.command`."""
        return compute_command(self.task.action, action, self._exclusive)

    def step(self, history: History, world: World) -> Transition:
        """Judge a control step; see `TaskProcess.step`."""
        state = self.state
        state[STEPS] += 1
        state["age"] += 1
        # forces of a diverged world may be NaN, and one NaN would poison the sums over all worlds
        force_n = torch.where(world.faults, 0.0, world.contact_force_n)
        seen = self._make_state(history, force_n)
        holds = self._is_good(seen) & ~world.faults
        state["held"] += holds & (state["age"] > self._after_steps)
        seen.success = state["held"] >= self._needed_steps
        endings = self._endings.judge(seen, world.faults)
        reward = self._rewards(seen, endings.is_sound, state["succeeded"], self.episode)
        self._count(seen, reward)
        state["contact_force_n"].copy_(force_n)
        return Transition(
            reward=reward,
            terminated=endings.terminated,
            timed_out=endings.timed_out,
            reason=endings.reason,
        )

    def observe(
        self, history: History, shift_m: torch.Tensor | None = None
    ) -> dict[str, torch.Tensor]:
        """Return the groups that have terms; see `TaskProcess.observe`.

        A wrong calibration (`shift_m`) moves nothing: a task made of terms has no seen target.
        """
        seen = self._make_state(history, self.state["contact_force_n"])
        is_new = (self.state["age"] == 0)[:, None, None]
        for group, encoder in self._encoders.items():
            samples = {}
            for name, term in self._terms[group].items():
                kept = self.state[f"samples.{group}.{name}"]
                newest = self._measure(group, name, term, seen)[:, None]
                moved = torch.cat((kept[:, 1:], newest), 1)
                kept.copy_(torch.where(is_new, newest.expand_as(kept), moved))
                samples[name] = kept
            self.state[group].copy_(encoder.encode(samples))
        return {group: self.state[group] for group in self._encoders}

    def describe(self) -> dict[str, Any]:
        """Return the contract of the `policy` group; see `TaskProcess.describe`."""
        description = self._encoders["policy"].describe()
        for part in description["parts"]:
            part["function"] = self._terms["policy"][part["name"]].function
        criterion = dataclasses.asdict(self.task.success)
        stop = {
            "joint_margin": self._endings.find_joint_margin(),
            "success": {},
            "criterion": criterion,
            "endings": self._endings.describe(),
        }
        return description | {"masked": self.task.action.mask, "stop": stop}

    def deployable(self, network: torch.nn.Module) -> torch.nn.Module:
        """Return the policy as one module; see `TaskProcess.deployable`."""
        return TermPolicy(network, self.task.action, self._exclusive)

    def _measure(self, group: str, name: str, term: ObservedTerm, seen: TermState) -> torch.Tensor:
        """Return the newest sample of a term with its errors, `(N, K)`."""
        value = self._call(term, seen)
        if term.noise:
            value = value + _draw_error(term.noise, value)
        if term.bias:
            value = value + self.state[f"bias.{group}.{name}"]
        return value

    def _call(self, term: ObservedTerm, seen: TermState) -> torch.Tensor:
        """Return the newest sample of a term without error, `(N, K)`."""
        value = self._functions[term.function](seen)
        return value[:, None] if value.dim() == 1 else value

    def _make_state(self, history: History, force_n: torch.Tensor) -> TermState:
        state, period_s = self.state, self._machine.period_s
        q, q_before = history.q[:, -1], history.q[:, -2]
        pose, before = self._kinematics.pose(q), self._kinematics.pose(q_before)
        nowhere = state["age"] < 0
        return TermState(
            q=q,
            lower=self._lower,
            upper=self._upper,
            tip_m=pose.tip_in_base_m,
            pitch_rad=pose.pitch_rad,
            u=history.u[:, -1],
            u_before=history.u[:, -2],
            contact_force_n=force_n,
            peak_force_n=self.episode["peak_force_n"],
            steps=state[STEPS],
            max_steps=self.max_episode_steps,
            is_first=state["age"] == 1,
            success=nowhere,
            failed=nowhere,
            time_s=state["age"] * period_s,
            speed=(q - q_before) / period_s,
            tip_before_m=before.tip_in_base_m,
            start_tip_m=state["start_tip_m"],
            command={
                name.removeprefix(COMMAND): value
                for name, value in state.items()
                if name.startswith(COMMAND)
            },
            period_s=period_s,
        )

    def _count(self, seen: TermState, reward: torch.Tensor) -> None:
        """Update the figures of the running episode."""
        episode, state = self.episode, self.state
        episode["length"] += 1
        episode["return"] += reward
        episode[SUCCESS].copy_(seen.success)
        counted = (state["age"] - self._after_steps).clamp(min=1.0)
        episode["held_share"].copy_(state["held"] / counted)
        episode["peak_force_n"].copy_(torch.maximum(episode["peak_force_n"], seen.contact_force_n))


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


def _draw_error(size: float, like: torch.Tensor) -> torch.Tensor:
    """Return uniform errors between `-size` and `size`, of the shape of `like`."""
    return (2.0 * torch.rand_like(like) - 1.0) * size
