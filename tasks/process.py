"""A tool-pose task at work: episodes, observations, masks and judgement for `N` environments at once.

What differs between tasks (which target, what success means) is in the `Goal` that a task hands in;
everything here is the same for all of them. No method synchronises with the host, and every tensor
of `state` and `episode` keeps its address, so that the whole control step can be captured in one
CUDA graph.
"""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pkgutil import resolve_name
from typing import Any, Protocol, Self

import torch

from brokk_rl.contracts.task import Transition
from brokk_rl.contracts.world import World
from brokk_rl.history import History
from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine
from brokk_rl.observation import ObservationEncoder, TargetScaling
from tasks.advice import AdviceConfig
from tasks.classical import ClassicalConfig, ClassicalController
from tasks.control import ActionMapping, ObservationNoise, PhaseSwitch
from tasks.deployable import DeployedPolicy, compute_features
from tasks.noise import MeasuredNoise
from tasks.reward import RewardTerm, ToolState

REASONS = ("success", "joint_limit", "start_in_contact", "fault", "time_limit")


class ToolPoseGoal(Protocol):
    """What a tool-pose task must say about itself."""

    def starts(self, count: int, seed: int) -> dict[str, torch.Tensor]:
        """Draws valid starts; `q`, `scene`, `target_m` `(count, 3)` and `target_pitch_rad` `(count,)` at least."""
        ...

    def judge(
        self, tip_m: torch.Tensor, pitch_rad: torch.Tensor, start: dict[str, torch.Tensor]
    ) -> dict[str, torch.Tensor]:
        """Returns `success`, `paper_success` (bool) and `closeness`, each `(N,)`."""
        ...


@dataclass
class ToolPoseOptions:
    """The parts of a task's configuration that the process itself uses; see `tasks.control` and the task's spec.

    The target point of the process lies `depth_m` below that of the goal.
    """

    episode_s: float
    end_on_success: bool
    limit_margin: float
    depth_m: float
    memory: int
    advice: AdviceConfig | None
    noise: ObservationNoise | MeasuredNoise
    switch: PhaseSwitch
    action: ActionMapping
    scaling: TargetScaling
    classical: ClassicalConfig
    reward: dict[str, RewardTerm]

    @classmethod
    def of(cls, task: object, **fixed: Any) -> Self:
        """Returns the options of a task's spec, whose fields have the same names; the task does not leave `fixed` open."""
        return cls(
            **{
                field.name: fixed[field.name] if field.name in fixed else getattr(task, field.name)
                for field in fields(cls)
            }
        )


class ToolPoseProcess:
    """See the module; fulfils `brokk_rl.contracts.task.TaskProcess`."""

    reasons: tuple[str, ...] = REASONS

    def __init__(
        self,
        goal: ToolPoseGoal,
        options: ToolPoseOptions,
        machine: Machine,
        num_envs: int,
        device: torch.device,
    ) -> None:
        def constant(values: object) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=device)

        self.goal, self.options = goal, options
        self.num_actions = machine.num_joints
        self.max_episode_steps = round(options.episode_s / machine.period_s)
        self._machine = machine
        self._kinematics = Kinematics(machine, device)
        self._controller: ClassicalController = options.classical.build(machine, device)
        self.adviser = options.advice.build(machine, device) if options.advice else None
        self._encoder = ObservationEncoder(
            machine, options.scaling, constant, torch.cat, with_proposals=self.adviser is not None
        )
        self._exclusive = constant(machine.is_exclusive).bool()
        self._lower = constant(machine.lower) + options.limit_margin
        self._upper = constant(machine.upper) - options.limit_margin
        self._down = constant([0.0, 0.0, options.depth_m])
        self._terms: list[tuple[Callable[[ToolState], torch.Tensor], float]] = [
            (resolve_name(term.function), term.weight) for term in options.reward.values()
        ]
        num_joints = machine.num_joints
        start = self.starts(1, 0)
        shapes = {f"start.{key}": tuple(value.shape[1:]) for key, value in start.items()}
        shapes |= {
            "bias_m": (3,),
            "estimate_sum_m": (3,),
            "estimate_m": (3,),
            "q_scale": (),
            "u_scale": (),
            "steps": (),
            "age": (),
        }
        shapes |= {
            "u": (num_joints,),
            "u_before": (num_joints,),
            "closeness": (),
            "contact_force_n": (),
        }
        shapes |= {
            "command": (num_joints,),
            "features": (self.num_features,),
            "policy": (self._encoder.size,),
            "privileged": (10,),
        }
        shapes |= {
            "positioning": (),
            "rule_reach_m": (),
            "lowest": (num_joints,),
            "highest": (num_joints,),
        }
        if self.adviser:
            shapes["proposed"] = (machine.num_history, num_joints)
        self.state = {
            name: torch.zeros((num_envs, *shape), device=device) for name, shape in shapes.items()
        }
        figures = (
            "success_strict",
            "success_paper",
            "time_to_insert_s",
            "lateral_error_m",
            "peak_force_n",
            "valve_travel",
        )
        self.episode = {
            name: torch.zeros(num_envs, device=device) for name in (*figures, "return", "length")
        }

    @property
    def num_features(self) -> int:
        """Size of the `guide` group: commands of the classical controller, errors at three scales, pitch errors, reach, phase."""
        return 2 * self.num_actions + 4 * 3 + 2 + 2

    def starts(self, count: int, seed: int) -> dict[str, torch.Tensor]:
        """See `TaskProcess.starts`."""
        start = self.goal.starts(count, seed)
        pose = Kinematics(self._machine, "cpu").pose(start["q"])
        return start | {
            "closeness": self.goal.judge(pose.tip_in_base_m, pose.pitch_rad, start)["closeness"]
        }

    def reset(self, mask: torch.Tensor, start: dict[str, torch.Tensor]) -> None:
        """See `TaskProcess.reset`."""
        noise, state = self.options.noise, self.state
        uniform = torch.rand(len(mask), 5, device=mask.device)
        turn, lift = uniform[:, 0] * (2 * math.pi), uniform[:, 1] * 2 - 1
        flat = torch.sqrt(1 - lift.square())
        bias = torch.stack((flat * turn.cos(), flat * turn.sin(), lift), 1) * uniform[:, 2:3]
        bias = bias * noise.bias_m(start["target_m"])
        fresh = {f"start.{key}": value for key, value in start.items()}
        fresh |= {
            "bias_m": bias,
            "q_scale": 1 + noise.q_scale * (2 * uniform[:, 3] - 1),
            "u_scale": 1 + noise.u_scale * (2 * uniform[:, 4] - 1),
        }
        fresh["closeness"] = start["closeness"]
        zero = torch.zeros((), device=mask.device)
        for name, value in state.items():
            rows = mask.reshape(-1, *[1] * (value.dim() - 1))
            value.copy_(torch.where(rows, fresh.get(name, zero), value))
        for value in self.episode.values():
            value.masked_fill_(mask, 0.0)

    def command(self, action: torch.Tensor) -> torch.Tensor:
        """See `TaskProcess.command`."""
        base, lowest, highest = (self.state[name] for name in ("command", "lowest", "highest"))
        u = self.options.action.command(
            action, base, lowest, highest, self.state["positioning"].bool(), self._exclusive
        )
        if self.adviser:
            proposed = self.state["proposed"]
            u = self.adviser.proposal(u, self.recalled(proposed))
            proposed.copy_(torch.cat((proposed[:, 1:], u[:, None]), 1))
        self.state["u_before"].copy_(self.state["u"])
        self.state["u"].copy_(u)
        return u

    def step(self, history: History, world: World) -> Transition:
        """See `TaskProcess.step`."""
        state, options = self.state, self.options
        q = history.q[:, -1]
        pose = self._kinematics.pose(q)
        start = self._start()
        verdict = self.goal.judge(pose.tip_in_base_m, pose.pitch_rad, start)
        # `steps` decides about the time limit and may be set from outside (episodes out of step);
        # `age` counts since the reset
        state["steps"] += 1
        state["age"] += 1
        first = state["age"] == 1
        failed = ((q < self._lower) | (q > self._upper)).any(1)
        touching = first & (world.contact_force_n > 0)
        fault = world.faults
        # what a diverged world says about forces may be NaN, and one NaN would poison the sums over
        # all worlds
        force_n = torch.where(fault, 0.0, world.contact_force_n)
        success = verdict["success"] & ~fault & ~touching
        seen = ToolState(
            tip_m=pose.tip_in_base_m,
            pitch_rad=pose.pitch_rad,
            target_m=start["target_m"] - self._down,
            target_pitch_rad=start["target_pitch_rad"],
            reach_m=state["rule_reach_m"],
            reach_range_m=options.switch.reach_m,
            positioning=state["positioning"].bool(),
            contact_force_n=force_n,
            peak_force_n=self.episode["peak_force_n"],
            u=state["u"],
            u_before=state["u_before"],
            lateral_m=(start["target_m"] - pose.tip_in_base_m)[:, :2].norm(dim=1),
            success=success,
            paper_success=verdict["paper_success"],
            failed=failed,
            closeness=verdict["closeness"],
            closeness_before=state["closeness"],
        )
        reward = sum(weight * term(seen) for term, weight in self._terms)
        reward = torch.where(fault | touching, 0.0, reward)
        timed_out = state["steps"] >= self.max_episode_steps
        ended = failed | touching | fault
        if options.end_on_success:
            ended = ended | success
        # the order of REASONS decides when several hold; -1 while the episode goes on
        reason = torch.full_like(state["steps"], -1.0)
        endings = (
            success if options.end_on_success else torch.zeros_like(success),
            failed,
            touching,
            fault,
            timed_out,
        )
        for index in reversed(range(len(REASONS))):
            reason = torch.where(endings[index], float(index), reason)
        self._count(seen, history.u, reward, success)
        state["closeness"].copy_(verdict["closeness"])
        state["contact_force_n"].copy_(force_n)
        return Transition(
            reward=reward, terminated=ended, timed_out=timed_out & ~ended, reason=reason
        )

    def observe(
        self, history: History, shift_m: torch.Tensor | None = None
    ) -> dict[str, torch.Tensor]:
        """See `TaskProcess.observe`: `policy`, `guide` (what the classical controller makes of it), `privileged` (critic only)."""
        self._perceive(history, shift_m)
        return {
            "policy": self.state["policy"],
            "guide": self.state["features"],
            "privileged": self.state["privileged"],
        }

    def classical_action(self, groups: dict[str, torch.Tensor]) -> torch.Tensor:
        """See `TaskProcess.classical_action`."""
        command, action = groups["guide"][:, : self.num_actions], self.options.action
        return torch.zeros_like(command) if action.kind == "residual" else command / action.scale

    def describe(self) -> dict[str, Any]:
        """See `TaskProcess.describe`."""
        options = self.options
        advice = {"advice": asdict(options.advice)} if options.advice else {}
        return (
            self._encoder.describe()
            | {"target_filter": options.noise.filter, "switch": asdict(options.switch)}
            | advice
        )

    def deployable(self, network: torch.nn.Module) -> torch.nn.Module:
        """See `TaskProcess.deployable`."""
        return DeployedPolicy(self, network)

    def remembered(self, q: torch.Tensor, u: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the history that the policy sees, `(N, H, J)` each; before its last `memory` samples all looks at rest."""
        forgotten = q.shape[1] - self.options.memory
        if forgotten <= 0:
            return q, u
        still = q[:, forgotten : forgotten + 1].expand(-1, forgotten, -1)
        return torch.cat((still, q[:, forgotten:]), 1), self.recalled(u)

    def recalled(self, u: torch.Tensor) -> torch.Tensor:
        """Returns commands, `(N, H, J)`, with none before the last `memory` samples."""
        forgotten = u.shape[1] - self.options.memory
        return (
            u
            if forgotten <= 0
            else torch.cat((torch.zeros_like(u[:, :forgotten]), u[:, forgotten:]), 1)
        )

    def _start(self) -> dict[str, torch.Tensor]:
        return {
            name.removeprefix("start."): value
            for name, value in self.state.items()
            if name.startswith("start.")
        }

    def _count(
        self, seen: ToolState, given: torch.Tensor, reward: torch.Tensor, success: torch.Tensor
    ) -> None:
        """Updates the figures of the running episode; `given` are the commands in force, `(N, H, J)`."""
        episode, period_s = self.episode, self._machine.period_s
        new = success & (episode["success_strict"] == 0)
        episode["length"] += 1
        episode["return"] += reward
        episode["time_to_insert_s"].copy_(
            torch.where(new, episode["length"] * period_s, episode["time_to_insert_s"])
        )
        open_ = episode["success_strict"] == 0
        episode["lateral_error_m"].copy_(
            torch.where(open_, seen.lateral_m, episode["lateral_error_m"])
        )
        episode["success_strict"].copy_(torch.where(success, 1.0, episode["success_strict"]))
        episode["success_paper"].copy_(
            torch.where(seen.paper_success, 1.0, episode["success_paper"])
        )
        episode["peak_force_n"].copy_(torch.maximum(episode["peak_force_n"], seen.contact_force_n))
        travel = (given[:, -1] - given[:, -2]).abs().sum(
            1
        ) / period_s  # what was given, not what was proposed
        episode["valve_travel"] += (travel - episode["valve_travel"]) / episode["length"]

    def _perceive(self, history: History, shift_m: torch.Tensor | None) -> None:
        """Writes what the policy is told: estimate, guidance, phase and the observation groups."""
        noise, state = self.options.noise, self.state
        true_m = state["start.target_m"]
        error = (2 * torch.rand_like(true_m) - 1) * noise.sample_m(true_m)
        if noise.target_relative:
            error = error + (2 * torch.rand_like(true_m) - 1) * noise.target_relative * true_m
        sample = true_m + state["bias_m"] + error
        if shift_m is not None:
            sample = sample + shift_m
        state["estimate_sum_m"] += sample
        if noise.filter == "mean":
            # the observation after the reset is the first sample
            sample = state["estimate_sum_m"] / (state["age"] + 1)[:, None]
        state["estimate_m"].copy_(sample)
        q, u = self.remembered(
            history.q * state["q_scale"][:, None, None], history.u * state["u_scale"][:, None, None]
        )
        pitch_rad = state["start.target_pitch_rad"]
        proposed = coming = None
        if self.adviser:
            proposed = self.recalled(state["proposed"])
            coming = self.adviser.coming(proposed, u[:, -1])
        guidance = self._controller.guide(
            q, u, sample - self._down, pitch_rad, self.options.switch.reach_m, coming
        )
        positioning = self.options.switch.positioning(guidance)
        state["positioning"].copy_(positioning)
        state["rule_reach_m"].copy_(
            guidance.reach_m if self.options.switch.rule == "planar" else guidance.reach_3d_m
        )
        state["command"].copy_(guidance.command)
        state["lowest"].copy_(guidance.lowest)
        state["highest"].copy_(guidance.highest)
        state["policy"].copy_(self._encoder.encode(sample, q, u, pitch_rad, proposed))
        state["features"].copy_(compute_features(guidance, positioning, u[:, -1]))
        state["privileged"].copy_(self._privileged(sample))

    def _privileged(self, sample: torch.Tensor) -> torch.Tensor:
        """Returns what only the critic sees: error of the estimate, scales, contact, time left, closeness."""
        state = self.state
        rest = (
            (state["q_scale"] - 1) * 100,
            (state["u_scale"] - 1) * 10,
            (state["contact_force_n"] / 2000).clamp(max=5.0),
            (self.episode["peak_force_n"] / 2000).clamp(max=5.0),
            state["steps"] / self.max_episode_steps,
            state["closeness"],
            state["positioning"],
        )
        return torch.cat(((sample - state["start.target_m"]) * 100, torch.stack(rest, 1)), 1)
