"""Episodes of a task that moves the tool to a pose, and the starts from which it can be done.

A classical controller stands beside the policy: it is the baseline, and the base on which the default
policy learns a residual. A camera sees the target, with errors.

A start is kept only if the tool begins in the open and if, after the exclusive joints have brought the
target into reach, the other joints reach the wanted pose within their limits. Checked once with the
kinematics when starts are drawn, so that resets only pick rows.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import torch

from brokk_rl import distributed
from brokk_rl.errors import ConfigError
from brokk_rl.history import History
from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine
from brokk_rl.observation import PITCH, PROPOSALS, TARGET
from brokk_rl.progress import ItemProgress
from brokk_rl.sim import scene
from brokk_rl.symmetry import Mirror, compute_joint_signs
from tasks.control import (
    MIRRORED,
    REACH_DAMPING,
    ClassicalController,
    DeployedPolicy,
    ToolPoseControl,
)
from tasks.process import START, EpisodeProcess
from tasks.settings import CommandBase, ToolPoseTask
from tasks.term_task import ObservedTerm
from tasks.terms import ToolState

Starts = dict[str, torch.Tensor]

BATCH_FACTOR, MIN_BATCH = 4, 256
"""Candidates per batch for each start asked for, and least batch. Chosen by hand."""
CHUNK = 4096
"""Candidates that are checked at once: what is found is known after each. Chosen by hand: less
than a second on one core."""
MIN_CANDIDATES, MIN_SHARE = 16384, 1 / 256
"""Candidates after which a draw is given up, where no larger share of them can be done. Chosen
by hand: the default tasks accept about one in four."""

REACH_STEPS, REACH_MAX_STEP = 40, 0.1
"""Damped Newton steps of the exclusive joints towards the working range, and their largest step
(rad or m). Chosen by hand."""
POSE_STEPS, POSE_STEP_S = 120, 0.2
"""Steps of the classical controller's approach, and the time of each, s. Chosen by hand: 24 s,
longer than an episode of `borehole_insertion`."""
NEAR_MARGIN_RAD = 0.08
"""Distance from joint limits of an arm that is brought near its target; as in the default tasks."""
POSE_TOLERANCE_M, POSE_TOLERANCE_RAD = 0.01, 0.03
"""Errors up to which a pose counts as reached. Chosen by hand: the clearance of the hole, and a
fraction of the tolerance of `goal_pose`."""
FORCE_SCALE_N, MAX_SCALED_FORCE = 2000.0, 5.0
"""Scale and bound of forces in the critic's group: 10 kN, where reward terms saturate too."""
NUM_SAME = 7
"""Numbers of the critic's group behind the error of the estimate; see `_compute_privileged`."""


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
        return {"target_m": (3,), "target_pitch_rad": (), "closeness": ()}

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
        self, start: dict[str, torch.Tensor], share: float, height_m: tuple[float, float], seed: int
    ) -> dict[str, torch.Tensor]:
        """Return starts with some above their target; see `TaskProcess.bring_near`."""
        start = {name: value.cpu() for name, value in start.items()}
        search = StartSearch(self.task, self._machine)
        return self._judge_starts(search.move_near(start, share, height_m, seed))

    def _judge_starts(self, start: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        pose = Kinematics(self._machine, "cpu").pose(start["q"])
        verdict = self.task.judge(pose.tip_in_base_m, pose.pitch_rad, start)
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
        verdict = self.task.judge(values["tip_m"], values["pitch_rad"], start)
        values |= {
            "success": verdict.success,
            "target_m": start["target_m"] - self.control.down,
            "target_pitch_rad": start["target_pitch_rad"],
            "reach_m": state["reach_m"],
            "reach_range_m": self.task.switch.reach_m,
            "positioning": state["positioning"].bool(),
            "paper_success": verdict.paper_success,
            "closeness": verdict.closeness,
            "closeness_before": state["closeness"],
        }
        return ToolState(**values)

    def _remember(self, seen: Any) -> None:
        super()._remember(seen)
        self.state["closeness"].copy_(seen.closeness)

    def observe(
        self, history: History, shift_m: torch.Tensor | None = None
    ) -> dict[str, torch.Tensor]:
        """Return `policy`, `guide` (`compute_features`) and `privileged` (for the critic only).

        See `TaskProcess.observe`.
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
        return {"policy": seen.vector, "guide": seen.features, "privileged": privileged}

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

    def mirror(self) -> Mirror:
        """Return the mirror of observations and actions; see `TaskProcess.mirror`."""
        if self._observed.encoders:
            self.refuse("mirror", "of the terms in task.privileged; leave these out")
        signs = self.state["u"].new_tensor(compute_joint_signs(self._machine))
        groups = self.control.mirror(signs)
        critic = torch.cat((MIRRORED.to(signs), signs.new_ones(NUM_SAME)))
        return Mirror(groups | {"privileged": (critic, torch.zeros_like(critic))}, signs)

    def take_estimate(self, target_m: torch.Tensor) -> None:
        """Take estimated targets; see `TaskProcess.take_estimate`."""
        self._sensed_m = target_m

    def plan(
        self, q: torch.Tensor, target_m: torch.Tensor, num_times: int, step_s: float
    ) -> torch.Tensor:
        """Return the controller's plan, `(N, T, J)`; see `TaskProcess.plan`."""
        pitch_rad = self.state[f"{START}target_pitch_rad"]
        return self.control.plan(q, target_m, pitch_rad, num_times, step_s)


class DrawTally:
    """Counts of a draw, which ends where nearly nothing can be done.

    Args:
        task_name: Name of the task, for the message.
        count: Starts that are asked for.
    """

    def __init__(self, task_name: str, count: int) -> None:
        self._task_name, self._count = task_name, count
        self._candidates = self._free = self._in_range = self.done = 0

    def add(self, free: torch.Tensor, in_range: torch.Tensor, reached: torch.Tensor) -> None:
        """Count a chunk.

        Args:
            free: Which arms begin in the open, `(M,)` bool.
            in_range: Of these, whose target can be brought into the working range.
            reached: Of these, whose tool gets there with the wanted pitch.

        Raises:
            ConfigError: Nearly none of the candidates can be done; the message says why.
        """
        self._candidates += len(free)
        self._free += int(free.sum())
        self._in_range += int(in_range.sum())
        self.done += int((in_range & reached).sum())
        is_rare = self.done < MIN_SHARE * self._candidates
        if self.done < self._count and self._candidates >= MIN_CANDIDATES and is_rare:
            raise ConfigError(self._explain())

    def get_shares(self) -> dict[str, float]:
        """Return the shares of all candidates that meet one condition after the other."""
        total = max(1, self._candidates)
        return {
            "arm in the open": self._free / total,
            "target in the working range": self._in_range / total,
            "can be done": self.done / total,
        }

    def _explain(self) -> str:
        """Return the message for a draw that is given up."""
        closed = 1 - self._free / self._candidates
        outside = 1 - self._in_range / max(1, self._free)
        unreached = 1 - self.done / max(1, self._in_range)
        reasons = [f"{closed:.1%} of the arms do not begin in the open (task.arms, joint limits)"]
        if self._free:
            reasons.append(
                f"of the others {outside:.1%} of the targets cannot be brought into the working "
                "range (task.switch.reach_m)"
            )
        if self._in_range:
            reasons.append(
                f"of the rest {unreached:.1%} cannot be reached with the wanted pitch within the "
                "joint limits"
            )
        return (
            f"{self._task_name}: nearly no start can be done: {self.done} of "
            f"{self._candidates} candidates, expected 1 in {round(1 / MIN_SHARE)} at least. "
            f"{'; '.join(reasons)}. Change the ranges of the target or of the arms in the task, or "
            "the joint limits of the machine."
        )


class StartSearch:
    """Search for starts from which a tool-pose task can be done, on the CPU.

    Args:
        task: Gives targets, arms, working range and controller.
        machine: The machine.
    """

    def __init__(self, task: ToolPoseTask, machine: Machine) -> None:
        self._task, self._machine = task, machine
        self._controller = ClassicalController(task.classical, machine, torch.device("cpu"))
        self._lower = torch.as_tensor(machine.lower, dtype=torch.float32)
        self._upper = torch.as_tensor(machine.upper, dtype=torch.float32)

    def draw(self, count: int, seed: int, tally: DrawTally | None = None) -> Starts:
        """Return `count` starts from which the target can be reached.

        Args:
            count: Number of starts.
            seed: The same seed gives the same starts.
            tally: Counts the candidates; `None` makes one.

        Returns:
            `q`, `scene`, `target_m`, `target_pitch_rad`.

        Raises:
            ConfigError: Nearly none of the drawn starts can be done.
        """
        task, drawn = self._task, list[Starts]()
        tally = tally or DrawTally(type(task).__name__, count)
        down_m = torch.tensor([0.0, 0.0, task.aim_below_m])
        chunks = self._draw_chunks(max(BATCH_FACTOR * count, MIN_BATCH), seed)
        with ItemProgress("drawing starts", count, not distributed.read_rank().first) as progress:
            while tally.done < count:
                free, part = next(chunks)
                aim_m, pitch_rad = part["target_m"] - down_m, part["target_pitch_rad"]
                _, in_range, reached = self.move(part["q"], aim_m, pitch_rad, task.arms.margin_rad)
                drawn.append({name: value[in_range & reached] for name, value in part.items()})
                tally.add(free, in_range, reached)
                progress.reach(tally.done)
        return {name: torch.cat([part[name] for part in drawn])[:count] for name in drawn[0]}

    def _draw_chunks(self, batch: int, seed: int) -> Iterator[tuple[torch.Tensor, Starts]]:
        """Yield which arms of a chunk begin in the open, and these candidates, without end."""
        generator = torch.Generator().manual_seed(seed)

        def draw_uniform(bounds: tuple[float, float]) -> torch.Tensor:
            return bounds[0] + (bounds[1] - bounds[0]) * torch.rand(batch, generator=generator)

        while True:
            targets = self._task.draw_targets(draw_uniform)
            q, free = self._draw_arms(targets.object_z_m, generator)
            scenes = scene.make_nominal_scenes(batch)
            for name, value in targets.scene.items():
                scenes[:, scene.COLUMNS.index(name)] = value
            rows = {"q": q, "scene": scenes, "target_m": torch.stack(targets.place_m, 1)}
            rows["target_pitch_rad"] = targets.pitch_rad
            for first in range(0, batch, CHUNK):
                rest = slice(first, first + CHUNK)
                yield free[rest], {name: value[rest][free[rest]] for name, value in rows.items()}

    def move_near(
        self, start: Starts, share: float, height_m: tuple[float, float], seed: int
    ) -> Starts:
        """Return starts of which the first part begins upright above its target.

        A beginner that never meets the target by chance learns from these what is to be gained
        there (reverse curriculum, Florensa et al. 2017). Arms that do not get there stay as they
        are.

        Args:
            start: Starts, as `draw` returns them.
            share: Part of the starts that are brought near.
            height_m: Heights of the tool point above `target_m`, (lowest, highest).
            seed: The same seed gives the same heights.
        """
        count = round(share * len(start["q"]))
        generator = torch.Generator().manual_seed(seed)
        up = height_m[0] + (height_m[1] - height_m[0]) * torch.rand(count, 1, generator=generator)
        above = start["target_m"][:count] + up * torch.tensor([0.0, 0.0, 1.0])
        pitch_rad = start["target_pitch_rad"][:count]
        q, good, reached = self.move(start["q"][:count], above, pitch_rad, NEAR_MARGIN_RAD)
        moved = start["q"].clone()
        moved[:count] = torch.where((good & reached)[:, None], q, moved[:count])
        return start | {"q": moved}

    def _draw_arms(
        self, object_z_m: torch.Tensor, generator: torch.Generator
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Draw one arm per row of `object_z_m`.

        Returns:
            `q`, `(M, J)`, and whether it is in the open, `(M,)` bool.
        """
        arms = self._task.arms
        lower, upper = self._lower + arms.margin_rad, self._upper - arms.margin_rad
        shape = (len(object_z_m), self._machine.num_joints)
        q = lower + (upper - lower) * torch.rand(shape, generator=generator)
        pose = self._controller.kinematics.pose(q)
        tip = pose.tip_in_base_m
        free = (tip[:, 2] > object_z_m + arms.clearance_m) & (tip[:, 2] > arms.floor_m)
        free &= tip[:, :2].norm(dim=1) > arms.nearest_m
        free &= (pose.joints_in_base_m[:, 2:, 2] > arms.floor_m).all(1)
        return q, free

    def move(
        self, q: torch.Tensor, target_m: torch.Tensor, pitch_rad: torch.Tensor, margin_rad: float
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Move to target poses from `q`, `(M, J)`, under the masks.

        First the exclusive joints move until the reach lies well inside the good working range,
        then the others by damped least squares.

        Returns:
            The joint positions at the end, `(M, J)`, whether the target came into the working
            range, `(M,)` bool, and whether the tool ended at the wanted pose, `(M,)` bool.
        """
        controller, (near_m, far_m) = self._controller, self._task.switch.reach_m
        exclusive = torch.as_tensor(self._machine.is_exclusive)
        lower, upper = self._lower + margin_rad, self._upper - margin_rad
        inner = 0.25 * (far_m - near_m)
        q = q.clone()
        for _ in range(REACH_STEPS):
            reach, slope = controller.reach(q, target_m)
            wanted = reach.clamp(near_m + inner, far_m - inner)
            inside = (reach >= near_m) & (reach <= far_m)
            step = (wanted - reach)[:, None] * slope / (slope.square() + REACH_DAMPING)
            moved = (q + step.clamp(-REACH_MAX_STEP, REACH_MAX_STEP)).clamp(lower, upper)
            q = torch.where(exclusive & ~inside[:, None], moved, q)
        reach, _ = controller.reach(q, target_m)
        good = (reach > near_m) & (reach < far_m)
        for _ in range(POSE_STEPS):
            pose, jacobian = controller.kinematics.pose_and_jacobian(q)
            error, turn = target_m - pose.tip_in_base_m, pitch_rad - pose.pitch_rad
            share = controller.approach(jacobian.tip, jacobian.pitch, error, error[:, 2], turn)
            q = (q + POSE_STEP_S * share * controller.speed).clamp(lower, upper)
        pose = controller.kinematics.pose(q)
        near = (target_m - pose.tip_in_base_m).norm(dim=1) < POSE_TOLERANCE_M
        return q, good, near & ((pitch_rad - pose.pitch_rad).abs() < POSE_TOLERANCE_RAD)
