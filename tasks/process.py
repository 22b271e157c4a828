"""Episodes of a tool-pose task: observations, masks and judgement in `N` environments at once.

Tasks differ in their `ToolPoseGoal` (targets, meaning of success); the rest is the same for all of
them. No method synchronises with the host, and every tensor of `state` and `episode` keeps its
address: the whole control step can be captured in one CUDA graph.
"""

from __future__ import annotations

import contextlib
import math
from dataclasses import asdict
from typing import Any, Protocol

import torch

from brokk_rl.contracts.task import REWARD, TaskProcess, Transition
from brokk_rl.contracts.world import World
from brokk_rl.errors import ConfigError
from brokk_rl.history import History
from brokk_rl.kinematics import Kinematics, ToolPose
from brokk_rl.machine import Machine
from brokk_rl.symmetry import Mirror, compute_joint_signs
from tasks.classical import ClassicalController
from tasks.control import DeployedPolicy, ToolPoseControl, list_feature_signs
from tasks.options import ToolPoseOptions
from tasks.reward import RewardSum
from tasks.starts import DrawTally, move_starts_near
from tasks.step_state import ToolState
from tasks.termination import EpisodeTerms

FIGURES = (
    "success_strict",
    "success_paper",
    "time_to_insert_s",
    "lateral_error_m",
    "peak_force_n",
    "valve_travel",
    "return",
    "length",
)
"""Figures of an episode, in the order of `evaluation.json`."""
NUM_PRIVILEGED = 10
"""Length of the critic's own group; see `_compute_privileged`."""
FORCE_SCALE_N, MAX_SCALED_FORCE = 2000.0, 5.0
"""Scale and bound of forces in the critic's group: 10 kN, where reward terms saturate too."""


class ToolPoseGoal(Protocol):
    """Targets and criteria by which tool-pose tasks differ."""

    def starts(
        self, count: int, seed: int, tally: DrawTally | None = None
    ) -> dict[str, torch.Tensor]:
        """Draw valid starts; `tally` counts the candidates.

        Returns:
            `q`, `scene`, `target_m` `(count, 3)` and `target_pitch_rad` `(count,)` at least.
        """
        ...

    def judge(
        self, tip_m: torch.Tensor, pitch_rad: torch.Tensor, start: dict[str, torch.Tensor]
    ) -> dict[str, torch.Tensor]:
        """Return `success`, `paper_success` (bool) and `closeness`, each `(N,)`."""
        ...

    def describe_success(self) -> dict[str, float]:
        """Return the bounds of the strict criterion by name, with units, for `policy.json`."""
        ...


class ToolPoseProcess(TaskProcess):
    """Episodes in `N` environments.

    Args:
        goal: Targets and criteria.
        options: The task's configuration.
        machine: The machine.
        num_envs: `N`.
        device: Where to compute.
    """

    def __init__(
        self,
        goal: ToolPoseGoal,
        options: ToolPoseOptions,
        machine: Machine,
        num_envs: int,
        device: torch.device,
    ) -> None:
        def to_constant(values: object) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=device)

        self.goal, self.options = goal, options
        self.num_actions = machine.num_joints
        self.max_episode_steps = round(options.episode_s / machine.period_s)
        self.control = ToolPoseControl(
            machine,
            device,
            scaling=options.scaling,
            classical=options.classical,
            switch=options.switch,
            action=options.action,
            advice=options.advice,
            memory=options.memory,
            depth_m=options.depth_m,
        )
        self._machine = machine
        self._sensed_m: torch.Tensor | None = None
        self._kinematics = Kinematics(machine, device)
        self._lower, self._upper = to_constant(machine.lower), to_constant(machine.upper)
        self._endings = EpisodeTerms(options.termination)
        self.reasons = self._endings.reasons
        self._rewards = RewardSum(options.reward, options.curriculum)
        self.state = {
            name: torch.zeros((num_envs, *shape), device=device)
            for name, shape in self._list_state_shapes().items()
        }
        figures = (*FIGURES, *(f"{REWARD}{name}" for name in options.reward))
        self.episode = {name: torch.zeros(num_envs, device=device) for name in figures}

    def _list_state_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shape of each entry of `state`, without `N`."""
        joints = (self._machine.num_joints,)
        start = self.starts(1, 0)
        shapes: dict[str, tuple[int, ...]] = {
            f"start.{key}": tuple(value.shape[1:]) for key, value in start.items()
        }
        # errors of this episode's observation, and the running estimate of the target
        shapes |= {"bias_m": (3,), "estimate_sum_m": (3,), "estimate_m": (3,)}
        shapes |= {"q_scale": (), "u_scale": ()}
        shapes |= {"steps": (), "age": ()}
        if self.options.curriculum:
            shapes["succeeded"] = ()
        # the step before
        shapes |= {"u": joints, "u_before": joints, "closeness": (), "contact_force_n": ()}
        # the observation, and what the next command needs of it
        shapes |= {
            "command": joints,
            "features": (self.control.num_features,),
            "policy": (self.control.encoder.size,),
            "privileged": (NUM_PRIVILEGED,),
        }
        shapes |= {"positioning": (), "rule_reach_m": (), "lowest": joints, "highest": joints}
        if self.control.adviser:
            shapes["proposed"] = (self._machine.num_history, *joints)
        return shapes

    def starts(self, count: int, seed: int) -> dict[str, torch.Tensor]:
        """Draw valid starts; see `TaskProcess.starts`."""
        return self._judge_starts(self.goal.starts(count, seed))

    def count_starts(self, count: int, seed: int) -> dict[str, float]:
        """Return shares of drawn candidates; see `TaskProcess.count_starts`."""
        tally = DrawTally("", count)
        with contextlib.suppress(ConfigError):  # nearly none can be done, as the shares say
            self.goal.starts(count, seed, tally)
        return tally.get_shares()

    def bring_near(
        self, start: dict[str, torch.Tensor], share: float, height_m: tuple[float, float], seed: int
    ) -> dict[str, torch.Tensor]:
        """Return starts of which the first part begins upright above its target, on the CPU.

        Args:
            start: Starts, as `starts` returns them.
            share: Part of the starts that are brought near.
            height_m: Heights of the tool point above the target, (lowest, highest).
            seed: The same seed gives the same heights.
        """
        options, cpu = self.options, torch.device("cpu")
        controller = ClassicalController(options.classical, self._machine, cpu)
        start = {name: value.cpu() for name, value in start.items()}
        return self._judge_starts(
            move_starts_near(
                start, share, height_m, seed, self._machine, controller, options.switch.reach_m
            )
        )

    def _judge_starts(self, start: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        pose = Kinematics(self._machine, "cpu").pose(start["q"])
        verdict = self.goal.judge(pose.tip_in_base_m, pose.pitch_rad, start)
        return start | {"closeness": verdict["closeness"]}

    def reset(self, mask: torch.Tensor, start: dict[str, torch.Tensor]) -> None:
        """Begin new episodes; see `TaskProcess.reset`."""
        noise, state = self.options.noise, self.state
        uniform = torch.rand(len(mask), 5, device=mask.device)
        # a direction spread evenly over the sphere
        turn, lift = uniform[:, 0] * (2 * math.pi), uniform[:, 1] * 2 - 1
        flat = torch.sqrt(1 - lift.square())
        bias = torch.stack((flat * turn.cos(), flat * turn.sin(), lift), 1) * uniform[:, 2:3]
        bias = bias * noise.bias_m(start["target_m"])
        fresh = {f"start.{key}": value for key, value in start.items()}
        fresh |= {
            "bias_m": bias,
            "q_scale": 1 + noise.q_scale * (2 * uniform[:, 3] - 1),
            "u_scale": 1 + noise.u_scale * (2 * uniform[:, 4] - 1),
            "closeness": start["closeness"],
            "succeeded": self.episode["success_strict"],
        }
        zero = torch.zeros((), device=mask.device)
        for name, value in state.items():
            rows = mask.reshape(-1, *[1] * (value.dim() - 1))
            value.copy_(torch.where(rows, fresh.get(name, zero), value))
        for value in self.episode.values():
            value.masked_fill_(mask, 0.0)

    def move_target(self, mask: torch.Tensor, shift_m: torch.Tensor) -> None:
        """Shift targets and what was estimated of them; see `TaskProcess.move_target`."""
        state = self.state
        shift_m = torch.where(mask[:, None], shift_m, 0.0)
        state["start.target_m"] += shift_m
        state["start.scene"][:, :3] += shift_m
        # one sample came with the reset, and one with each step since
        state["estimate_sum_m"] += (state["age"] + 1)[:, None] * shift_m
        state["estimate_m"] += shift_m

    def command(self, action: torch.Tensor) -> torch.Tensor:
        """Return masked commands or proposals; see `TaskProcess.command`."""
        state = self.state
        proposed = state.get("proposed")
        u = self.control.command(
            action,
            state["command"],
            state["lowest"],
            state["highest"],
            state["positioning"].bool(),
            proposed,
        )
        if proposed is not None:
            proposed.copy_(torch.cat((proposed[:, 1:], u[:, None]), 1))
        state["u_before"].copy_(state["u"])
        state["u"].copy_(u)
        return u

    def step(self, history: History, world: World) -> Transition:
        """Judge a control step; see `TaskProcess.step`."""
        state = self.state
        q = history.q[:, -1]
        pose = self._kinematics.pose(q)
        verdict = self.goal.judge(pose.tip_in_base_m, pose.pitch_rad, self._get_start())
        # `steps` decides about the time limit and may be set from outside (episodes out of step);
        # `age` counts since the reset
        state["steps"] += 1
        state["age"] += 1
        # forces of a diverged world may be NaN, and one NaN would poison the sums over all worlds
        force_n = torch.where(world.faults, 0.0, world.contact_force_n)
        tool = self._make_tool_state(q, pose, verdict, force_n)
        endings = self._endings.judge(tool, world.faults)
        succeeded = state.get("succeeded", state["steps"])  # read with a curriculum only
        reward = self._rewards(tool, endings.is_sound, succeeded, self.episode)
        self._count(tool, history.u, reward)
        state["closeness"].copy_(verdict["closeness"])
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
        """Return `policy`, `guide` (`compute_features`) and `privileged` (for the critic only).

        See `TaskProcess.observe`.
        """
        state = self.state
        estimate_m = self._estimate_target(shift_m)
        seen = self.control.process(
            estimate_m,
            self._scale_positions(history.q),
            history.u * state["u_scale"][:, None, None],
            state["start.target_pitch_rad"],
            state.get("proposed"),
        )
        guidance = seen.guidance
        state["positioning"].copy_(seen.positioning)
        state["rule_reach_m"].copy_(self.options.switch.reach(guidance))
        state["command"].copy_(guidance.command)
        state["lowest"].copy_(guidance.lowest)
        state["highest"].copy_(guidance.highest)
        state["policy"].copy_(seen.vector)
        state["features"].copy_(seen.features)
        state["privileged"].copy_(self._compute_privileged(estimate_m))
        return {
            "policy": state["policy"],
            "guide": state["features"],
            "privileged": state["privileged"],
        }

    def classical_action(self, groups: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return the classical controller's action; see `TaskProcess.classical_action`."""
        command, action = groups["guide"][:, : self.num_actions], self.options.action
        return torch.zeros_like(command) if action.kind == "residual" else command / action.scale

    def describe(self) -> dict[str, Any]:
        """Return the contract of the `policy` group; see `TaskProcess.describe`."""
        options = self.options
        description = self.control.encoder.describe()
        description |= {"target_filter": options.noise.filter, "switch": asdict(options.switch)}
        if options.advice:
            description["advice"] = asdict(options.advice)
        success = self.goal.describe_success()
        description["masked"] = options.action.mask
        description["stop"] = {
            "joint_margin": self._endings.find_joint_margin(),
            "success": success,
            "endings": self._endings.describe(),
        }
        return description

    def mirror(self) -> Mirror:
        """Return the mirror of observations and actions; see `TaskProcess.mirror`."""
        policy, privileged = self.state["policy"], self.state["privileged"]
        signs = policy.new_tensor(compute_joint_signs(self._machine))
        encoder = self.control.encoder
        # the mirror is a factor and a shift for each number; two vectors give both
        shift = encoder.mirror(torch.zeros_like(policy[:1]), signs)[0]
        factor = encoder.mirror(torch.ones_like(policy[:1]), signs)[0] - shift
        # of the critic's group only the error along y changes sides
        across = torch.ones_like(privileged[0])
        across[1] = -1.0
        factors = {"guide": list_feature_signs(signs), "privileged": across}
        groups = {name: (value, torch.zeros_like(value)) for name, value in factors.items()}
        return Mirror({"policy": (factor, shift)} | groups, signs)

    def deployable(self, network: torch.nn.Module) -> torch.nn.Module:
        """Return the policy as one module; see `TaskProcess.deployable`."""
        pitch_rad = float(self.starts(1, 0)["target_pitch_rad"][0])
        return DeployedPolicy(self.control, network, pitch_rad)

    def take_estimate(self, target_m: torch.Tensor) -> None:
        """Take estimated targets; see `TaskProcess.take_estimate`."""
        self._sensed_m = target_m

    def plan(
        self, q: torch.Tensor, target_m: torch.Tensor, num_times: int, step_s: float
    ) -> torch.Tensor:
        """Return the controller's plan, `(N, T, J)`; see `TaskProcess.plan`."""
        pitch_rad = self.state["start.target_pitch_rad"]
        return self.control.plan(q, target_m, pitch_rad, num_times, step_s)

    def _get_start(self) -> dict[str, torch.Tensor]:
        start = {}
        for name, value in self.state.items():
            if name.startswith("start."):
                start[name.removeprefix("start.")] = value
        return start

    def _make_tool_state(
        self,
        q: torch.Tensor,
        pose: ToolPose,
        verdict: dict[str, torch.Tensor],
        force_n: torch.Tensor,
    ) -> ToolState:
        state = self.state
        target_m = state["start.target_m"]
        return ToolState(
            q=q,
            lower=self._lower,
            upper=self._upper,
            steps=state["steps"],
            max_steps=self.max_episode_steps,
            is_first=state["age"] == 1,
            tip_m=pose.tip_in_base_m,
            pitch_rad=pose.pitch_rad,
            target_m=target_m - self.control.down,
            target_pitch_rad=state["start.target_pitch_rad"],
            reach_m=state["rule_reach_m"],
            reach_range_m=self.options.switch.reach_m,
            positioning=state["positioning"].bool(),
            contact_force_n=force_n,
            peak_force_n=self.episode["peak_force_n"],
            u=state["u"],
            u_before=state["u_before"],
            lateral_m=(target_m - pose.tip_in_base_m)[:, :2].norm(dim=1),
            success=verdict["success"],
            failed=torch.zeros_like(verdict["success"]),  # until the endings are judged
            paper_success=verdict["paper_success"],
            closeness=verdict["closeness"],
            closeness_before=state["closeness"],
        )

    def _count(self, tool: ToolState, given: torch.Tensor, reward: torch.Tensor) -> None:
        """Update the figures of the running episode; `given`: commands in force, `(N, H, J)`."""
        episode, period_s = self.episode, self._machine.period_s
        episode["length"] += 1
        episode["return"] += reward
        # time and lateral error stop at the first success
        success = tool.success
        is_open = episode["success_strict"] == 0
        time_s = torch.where(
            success & is_open, episode["length"] * period_s, episode["time_to_insert_s"]
        )
        lateral_m = torch.where(is_open, tool.lateral_m, episode["lateral_error_m"])
        paper = torch.where(tool.paper_success, 1.0, episode["success_paper"])
        episode["time_to_insert_s"].copy_(time_s)
        episode["lateral_error_m"].copy_(lateral_m)
        episode["success_strict"].copy_(torch.where(success, 1.0, episode["success_strict"]))
        episode["success_paper"].copy_(paper)
        episode["peak_force_n"].copy_(torch.maximum(episode["peak_force_n"], tool.contact_force_n))
        # of the commands given, not of those proposed
        travel = (given[:, -1] - given[:, -2]).abs().sum(1) / period_s
        episode["valve_travel"] += (travel - episode["valve_travel"]) / episode["length"]

    def _estimate_target(self, shift_m: torch.Tensor | None) -> torch.Tensor:
        """Return the sensed target, or draw a noisy sample and return the estimate, `(N, 3)`."""
        noise, state = self.options.noise, self.state
        if self._sensed_m is not None:
            sample = self._sensed_m if shift_m is None else self._sensed_m + shift_m
            state["estimate_m"].copy_(sample)
            return sample
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
        return sample

    def _scale_positions(self, q: torch.Tensor) -> torch.Tensor:
        """Return measured positions `(N, H, J)` with this episode's scale error."""
        scale = self.state["q_scale"][:, None, None]
        if self.options.noise.q_scale_of == "position":
            return q * scale
        newest = q[:, -1:]
        return newest + (q - newest) * scale

    def _compute_privileged(self, estimate_m: torch.Tensor) -> torch.Tensor:
        """Return the group that only the critic sees, scaled to about 1.

        Error of the estimate (3), scale errors (2), contact force and its peak, spent share of the
        time limit, closeness, phase.
        """
        state = self.state
        rest = (
            (state["q_scale"] - 1) * 100,
            (state["u_scale"] - 1) * 10,
            (state["contact_force_n"] / FORCE_SCALE_N).clamp(max=MAX_SCALED_FORCE),
            (self.episode["peak_force_n"] / FORCE_SCALE_N).clamp(max=MAX_SCALED_FORCE),
            state["steps"] / self.max_episode_steps,
            state["closeness"],
            state["positioning"],
        )
        error = (estimate_m - state["start.target_m"]) * 100
        return torch.cat((error, torch.stack(rest, 1)), 1)
