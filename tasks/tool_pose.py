"""Episodes of a task that moves the tool to a pose.

A classical controller stands beside the policy: it is the baseline, and the base on which the default
policy learns a residual. A camera sees the target, with errors.

`tasks.starts` draws the starts, the same for every policy.
"""

from __future__ import annotations

import contextlib
import math
from dataclasses import asdict, fields
from typing import Any

import torch

from brokk_rl.errors import ConfigError
from brokk_rl.history import History
from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine
from brokk_rl.observation import PITCH, PROPOSALS, TARGET
from tasks.control import PLAN_DONE, PLAN_END_RAD, DeployedPolicy, ToolPoseControl
from tasks.process import START, EpisodeProcess
from tasks.settings import CommandBase, PoseJudgement, ToolPoseTask
from tasks.starts import DrawTally, StartSearch
from tasks.term_task import ObservedTerm
from tasks.terms import ToolState

PLAN_STEP_S = 0.1
"""Step of a planned motion: joints turn by 0.05 rad at most. Chosen by hand."""
FORCE_SCALE_N, MAX_SCALED_FORCE = 2000.0, 5.0
"""Scale and bound of forces in the critic's group: 10 kN, where reward terms saturate too."""
JUDGED = tuple(field.name for field in fields(PoseJudgement))


class ToolPoseProcess(EpisodeProcess):
    """Episodes with a target pose and a classical controller."""

    def __init__(
        self, task: ToolPoseTask, machine: Machine, num_envs: int, device: torch.device
    ) -> None:
        self.task, self.control = task, ToolPoseControl(task, machine, device)
        self._sensed_m: torch.Tensor | None = None
        super().__init__(task, machine, num_envs, device)

    def _list_shapes(self) -> dict[str, tuple[int, ...]]:
        joints = (self._machine.num_joints,)
        shapes = super()._list_shapes() | {"closeness": ()}
        # errors of this episode's observation, and the sum of the samples of the target
        shapes |= {"bias_m": (3,), "estimate_sum_m": (3,), "q_scale": (), "u_scale": ()}
        shapes |= {"estimate_m": (3,)}  # the newest, for those who watch
        # what the next command needs of an observation
        shapes |= {"positioning": (), "reach_m": ()}
        shapes |= {"command": joints, "lowest": joints, "highest": joints}
        if self.control.adviser:
            shapes["proposed"] = (self._machine.num_history, *joints)
        return shapes

    def _list_drawn_shapes(self) -> dict[str, tuple[int, ...]]:
        planned = self._machine.num_joints + 1
        return {"target_m": (3,), "target_pitch_rad": (), "closeness": (), "plan": (planned,)}

    def _list_groups(self) -> dict[str, dict[str, ObservedTerm | None]]:
        return {"privileged": self.task.privileged}

    def starts(self, count: int, seed: int) -> dict[str, torch.Tensor]:
        """Draw valid starts; see `TaskProcess.starts`."""
        return self._judge_starts(StartSearch(self.task, self._machine).draw(count, seed))

    def count_starts(self, count: int, seed: int) -> dict[str, float]:
        """Return shares of drawn candidates; see `TaskProcess.count_starts`."""
        tally = DrawTally("", count)
        with contextlib.suppress(ConfigError):  # nearly none can be done, as the shares say
            StartSearch(self.task, self._machine).draw(count, seed, tally)
        return tally.get_shares()

    def bring_near(
        self,
        start: dict[str, torch.Tensor],
        share: float,
        height_m: tuple[float, float],
        way: tuple[float, float],
        seed: int,
    ) -> dict[str, torch.Tensor]:
        """Return starts with some above their target; see `TaskProcess.bring_near`."""
        start = {name: value.cpu() for name, value in start.items()}
        search = StartSearch(self.task, self._machine)
        return self._judge_starts(search.move_near(start, share, height_m, way, seed))

    def _judge_starts(self, start: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        pose = Kinematics(self._machine, "cpu").pose(start["q"])
        untouched = torch.zeros(len(start["q"]))
        verdict = self.task.judge(pose.tip_in_base_m, pose.pitch_rad, untouched, start)
        return start | {"tip_m": pose.tip_in_base_m, "closeness": verdict.closeness}

    def _draw_errors(self, start: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        noise = self.task.noise
        uniform = torch.rand(len(start["q"]), 5, device=start["q"].device)
        # a direction spread evenly over the sphere
        turn, lift = uniform[:, 0] * (2 * math.pi), uniform[:, 1] * 2 - 1
        flat = torch.sqrt(1 - lift.square())
        bias = torch.stack((flat * turn.cos(), flat * turn.sin(), lift), 1) * uniform[:, 2:3]
        return super()._draw_errors(start) | {
            "bias_m": bias * noise.measure_bias_m(start["target_m"]),
            "q_scale": 1 + noise.q_scale * (2 * uniform[:, 3] - 1),
            "u_scale": 1 + noise.u_scale * (2 * uniform[:, 4] - 1),
            "closeness": start["closeness"],
        }

    def move_target(self, mask: torch.Tensor, shift_m: torch.Tensor) -> None:
        """Shift targets and what was estimated of them; see `TaskProcess.move_target`."""
        state = self.state
        shift_m = torch.where(mask[:, None], shift_m, 0.0)
        state[f"{START}target_m"] += shift_m
        state[f"{START}scene"][:, :3] += shift_m
        # one sample came with the reset, and one with each step since
        state["estimate_sum_m"] += (state["age"] + 1)[:, None] * shift_m
        state["estimate_m"] += shift_m

    def command(self, action: torch.Tensor) -> torch.Tensor:
        """Return masked commands or proposals; see `TaskProcess.command`."""
        state = self.state
        proposed = state.get("proposed")
        bounds = (state["command"], state["lowest"], state["highest"])
        base = CommandBase(*bounds, state["positioning"].bool())
        u = self.control.command(action, base, proposed)
        if proposed is not None:
            proposed.copy_(torch.cat((proposed[:, 1:], u[:, None]), 1))
        return self._remember_command(u)

    def _make_state(self, history: History, force_n: torch.Tensor) -> ToolState:
        state, values = self.state, self._list_values(history, force_n)
        start = values["start"]
        peak_n = values["peak_force_n"].maximum(force_n)
        verdict = self.task.judge(values["tip_m"], values["pitch_rad"], peak_n, start)
        values |= {name: getattr(verdict, name) for name in JUDGED}
        values |= {
            "inserted": verdict.reached,
            "target_m": self.control.aim(start["target_m"], start["target_pitch_rad"]),
            "target_pitch_rad": start["target_pitch_rad"],
            "reach_m": state["reach_m"],
            "reach_range_m": self.task.switch.reach_m,
            "positioning": state["positioning"].bool(),
            "closeness_before": state["closeness"],
        }
        return ToolState(**values)

    def _remember(self, seen: Any) -> None:
        super()._remember(seen)
        self.state["closeness"].copy_(seen.closeness)

    def observe(
        self, history: History, shift_m: torch.Tensor | None = None
    ) -> dict[str, torch.Tensor]:
        """Return `policy`, `guide` and `joints` (`ControlInput`), and what is for training only.

        `privileged` is for the critic, `plan` for an example. See `TaskProcess.observe`.
        """
        state = self.state
        estimate_m = self._estimate_target(shift_m)
        state["estimate_m"].copy_(estimate_m)
        values = {
            TARGET: estimate_m,
            "q": self._scale_positions(history.q),
            "u": history.u * state["u_scale"][:, None, None],
            PITCH: state[f"{START}target_pitch_rad"],
        }
        if "proposed" in state:
            values[PROPOSALS] = state["proposed"]
        seen = self.control.process(values)
        for name in ("command", "lowest", "highest", "positioning"):
            state[name].copy_(getattr(seen.base, name))
        state["reach_m"].copy_(seen.reach_m)
        privileged = self._compute_privileged(estimate_m)
        if self._observed.encoders:
            terms = self._observed.observe(self._make_state(history, state["contact_force_n"]))
            privileged = torch.cat((privileged, terms["privileged"]), 1)
        plan = state[f"{START}plan"]
        is_done = self.control.measure_rest(values, plan).abs().amax(1) < PLAN_END_RAD
        plan[:, -1].masked_fill_(is_done, PLAN_DONE)
        groups = {"policy": seen.vector, "guide": seen.features, "joints": seen.joints}
        return groups | {"privileged": privileged, "plan": plan}

    def _estimate_target(self, shift_m: torch.Tensor | None) -> torch.Tensor:
        """Return the sensed target, or draw a noisy sample and return the estimate, `(N, 3)`."""
        noise, state = self.task.noise, self.state
        if self._sensed_m is not None:
            return self._sensed_m if shift_m is None else self._sensed_m + shift_m
        true_m = state[f"{START}target_m"]
        error = (2 * torch.rand_like(true_m) - 1) * noise.measure_sample_m(true_m)
        if noise.target_relative:
            error = error + (2 * torch.rand_like(true_m) - 1) * noise.target_relative * true_m
        sample = true_m + state["bias_m"] + error
        if shift_m is not None:
            sample = sample + shift_m
        state["estimate_sum_m"] += sample
        if noise.filter == "none":
            return sample
        # the observation after the reset is the first sample
        return state["estimate_sum_m"] / (state["age"] + 1)[:, None]

    def _scale_positions(self, q: torch.Tensor) -> torch.Tensor:
        """Return measured positions `(N, H, J)` with this episode's scale error."""
        scale = self.state["q_scale"][:, None, None]
        if self.task.noise.q_scale_of == "position":
            return q * scale
        newest = q[:, -1:]
        return newest + (q - newest) * scale

    def _compute_privileged(self, estimate_m: torch.Tensor) -> torch.Tensor:
        """Return what only the critic sees, scaled to about 1, without the terms of the YAML.

        Error of the estimate (3), scale errors (2), contact force and its peak, spent share of the
        time limit, closeness, phase.
        """
        state = self.state
        rest = (
            (state["q_scale"] - 1) * 100,
            (state["u_scale"] - 1) * 10,
            (state["contact_force_n"] / FORCE_SCALE_N).clamp(max=MAX_SCALED_FORCE),
            (state["peak_force_n"] / FORCE_SCALE_N).clamp(max=MAX_SCALED_FORCE),
            state["steps"] / self.max_episode_steps,
            state["closeness"],
            state["positioning"],
        )
        error = (estimate_m - state[f"{START}target_m"]) * 100
        return torch.cat((error, torch.stack(rest, 1)), 1)

    def classical_action(self, groups: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return the classical controller's action; see `TaskProcess.classical_action`."""
        command, action = groups["guide"][:, : self.num_actions], self.task.action
        return torch.zeros_like(command) if action.kind == "residual" else command / action.scale

    def example_action(self, groups: dict[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the action of one who knows a clear path; see `TaskProcess.example_action`."""
        values = self.control.encoder.decode(groups["policy"])
        fixed_rad = torch.full_like(groups["policy"][:, 0], self.task.fixed_pitch_rad)
        action = self.task.action
        plan = groups["plan"]
        u, base = self.control.follow_plan({PITCH: fixed_rad} | values, plan)
        shown = u - base if action.kind == "residual" else u
        return shown / action.scale, plan[:, -1] != PLAN_DONE

    def describe(self) -> dict[str, Any]:
        """Return the contract of the `policy` group; see `TaskProcess.describe`."""
        task, description = self.task, self.control.encoder.describe()
        description |= {"target_filter": task.noise.filter, "switch": asdict(task.switch)}
        if task.advice:
            description["advice"] = asdict(task.advice)
        stop = {"success": task.describe_success()} | self._endings.describe()
        return description | {"masked": task.action.mask, "stop": stop}

    def deployable(self, network: torch.nn.Module) -> torch.nn.Module:
        """Return the policy as one module; see `TaskProcess.deployable`."""
        return DeployedPolicy(self.control, network, self.task.fixed_pitch_rad)

    def take_estimate(self, target_m: torch.Tensor) -> None:
        """Take estimated targets; see `TaskProcess.take_estimate`."""
        self._sensed_m = target_m

    def plan(
        self, q: torch.Tensor, target_m: torch.Tensor, num_times: int, step_s: float
    ) -> torch.Tensor:
        """Return the motion that the controller would make of an ideal machine, `(N, T, J)`.

        A learned policy corrects this controller; dead time and valves are left out. See
        `TaskProcess.plan`.
        """
        pitch_rad = self.state[f"{START}target_pitch_rad"]
        rest = torch.zeros_like(q)
        num_parts = max(1, round(step_s / PLAN_STEP_S))
        planned = [q]
        for _ in range(num_times - 1):
            for _ in range(num_parts):
                _, base = self.control.guide(q[:, None], rest[:, None], target_m, pitch_rad)
                u = self.control.command(rest, base, None)
                q = q + self.control.controller.rate(u) * (step_s / num_parts)
            planned.append(q)
        return torch.stack(planned, 1)
