"""Random starts from which a tool-pose task can be done.

A start is kept only if the tool begins in the open and if, after the exclusive joints have brought
the target into reach, the other joints reach the wanted pose within their limits. Checked once with
the kinematics when starts are drawn, so that resets only pick rows.
"""

from __future__ import annotations

import logging
import time

import torch

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.sim import scene
from tasks.classical import REACH_DAMPING, ClassicalController
from tasks.settings import CandidateTargets, ToolPoseTask

log = logging.getLogger(__name__)

Starts = dict[str, torch.Tensor]

BATCH_FACTOR, MIN_BATCH = 4, 256
"""Candidates per batch for each start asked for, and least batch. Chosen by hand."""
CHUNK = 4096
"""Candidates that are checked at once: what is found is known after each. Chosen by hand: less
than a second on one core."""
MIN_CANDIDATES, MIN_SHARE = 16384, 1 / 256
"""Candidates after which a draw is given up, where no larger share of them can be done. Chosen
by hand: the default tasks accept about one in four."""
REPORT_S = 5.0
"""Seconds between two lines about the progress. Chosen by hand."""

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


class DrawTally:
    """Counts of a draw: reports progress, and ends a draw of which nearly nothing can be done."""

    def __init__(self, task_name: str, count: int) -> None:
        self._task_name, self._count = task_name, count
        self._candidates = self._free = self._in_range = self.done = 0
        self._begun_s = self._reported_s = time.monotonic()

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
        if self.done >= self._count:
            return
        if self._candidates >= MIN_CANDIDATES and self.done < MIN_SHARE * self._candidates:
            raise ConfigError(self._explain())
        now_s = time.monotonic()
        if now_s - self._reported_s >= REPORT_S:
            self._reported_s = now_s
            log.info(
                "%s: %d of %d starts drawn in %.0f s; %.1f %% of the candidates can be done",
                self._task_name,
                self.done,
                self._count,
                now_s - self._begun_s,
                100 * self.done / self._candidates,
            )

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
        task, generator = self._task, torch.Generator().manual_seed(seed)
        batch = max(BATCH_FACTOR * count, MIN_BATCH)
        down_m = torch.tensor([0.0, 0.0, task.aim_below_m])

        def draw_uniform(bounds: tuple[float, float]) -> torch.Tensor:
            return bounds[0] + (bounds[1] - bounds[0]) * torch.rand(batch, generator=generator)

        drawn: list[Starts] = []
        tally = tally or DrawTally(type(task).__name__, count)
        while tally.done < count:
            targets = task.draw_targets(draw_uniform)
            q, free = self._draw_arms(targets.object_z_m, generator)
            rows = {"q": q} | _stack_targets(targets)
            for first in range(0, batch, CHUNK):
                inside = free[first : first + CHUNK]
                part = {name: value[first : first + CHUNK][inside] for name, value in rows.items()}
                aim_m, pitch_rad = part["target_m"] - down_m, part["target_pitch_rad"]
                _, in_range, reached = self.move(part["q"], aim_m, pitch_rad, task.arms.margin_rad)
                drawn.append({name: value[in_range & reached] for name, value in part.items()})
                tally.add(inside, in_range, reached)
                if tally.done >= count:
                    break
        return {name: torch.cat([part[name] for part in drawn])[:count] for name in drawn[0]}

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


def _stack_targets(targets: CandidateTargets) -> Starts:
    """Return scene, target and pitch of candidates."""
    scenes = scene.make_nominal_scenes(len(targets.pitch_rad))
    for name, value in targets.scene.items():
        scenes[:, scene.COLUMNS.index(name)] = value
    return {
        "scene": scenes,
        "target_m": torch.stack(targets.place_m, 1),
        "target_pitch_rad": targets.pitch_rad,
    }
