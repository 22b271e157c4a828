"""Starts from which a tool-pose task can be done by some motion under the masks.

Nothing here depends on a controller or a policy: inverse kinematics finds poses at the target, and
straight and detoured joint paths lead there, clear of block and ground. First the
exclusive joints bring the target into the working range, then the others move. Checked once when
starts are drawn, so that resets only pick rows.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch

from brokk_rl import distributed
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.progress import ItemProgress
from brokk_rl.sim import scene
from tasks.control import REACH_DAMPING, ClassicalController
from tasks.settings import ToolPoseTask, find_tool_direction

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
POSE_STEPS, POSE_MAX_STEP, POSE_DAMPING = 30, 0.3, 0.02
"""Damped Newton steps of the inverse kinematics, their largest step (rad or m), and their damping (m).
From the arm of the start and from the middle of the travel they find all of 1,271 candidates that 24
seeds and twice the steps find."""
POSE_MARGIN = 0.03
"""Distance from joint limits, rad or m, of poses that count as reachable: episodes end at 0.01."""
POSE_TOLERANCE_M, POSE_TOLERANCE_RAD = 0.01, 0.03
"""Errors up to which a pose counts as reached. Chosen by hand: the clearance of the hole, and a
fraction of the tolerance of `goal_pose`."""
PATH_POINTS = 12
"""Points of each leg of a path that are checked. Four times as many refuse 2 more of 1,250."""
PATH_CLEARANCE_M = 0.12
"""Distance of the arm's axis from block and ground; the radius of the breaker of `brokk170`."""
PLAN_RISE_M = 0.2
"""Height of the end of a planned path above `arms.clearance_m`. From there the controller inserts 0.93
of 192 chisels with less than 10 kN, from the clearance itself 0.76."""
CONDITIONS = (
    "arm in the open",
    "target in the working range",
    "pose within the joint limits",
    "path clear of block and ground",
)
"""Conditions that a start fulfils, in the order in which they are checked."""
CURES = (
    "task.arms, joint limits",
    "task.switch.reach_m",
    "the ranges of the target, joint limits",
    "the ranges of the target, task.arms",
)
"""Advice for each condition that drops too many starts."""


class DrawTally:
    """Counts of a draw, which ends where nearly nothing can be done.

    Args:
        task_name: Name of the task, for the message.
        count: Starts that are asked for.
    """

    def __init__(self, task_name: str, count: int) -> None:
        self._task_name, self._count = task_name, count
        self._candidates = 0
        self._passed = [0] * len(CONDITIONS)

    @property
    def done(self) -> int:
        """Candidates that can be done."""
        return self._passed[-1]

    def add(self, num_candidates: int, passed: list[torch.Tensor]) -> None:
        """Count a chunk.

        Args:
            num_candidates: Candidates of the chunk.
            passed: Which of them fulfil `CONDITIONS` up to each, bool, of any length.

        Raises:
            ConfigError: Nearly none of the candidates can be done; the message says why.
        """
        self._candidates += num_candidates
        for index, one in enumerate(passed):
            self._passed[index] += int(one.sum())
        is_rare = self.done < MIN_SHARE * self._candidates
        if self.done < self._count and self._candidates >= MIN_CANDIDATES and is_rare:
            raise ConfigError(self._explain())

    def get_shares(self) -> dict[str, float]:
        """Return the shares of all candidates that fulfil one condition after the other."""
        total = max(1, self._candidates)
        shares = {name: n / total for name, n in zip(CONDITIONS, self._passed, strict=True)}
        return shares | {"can be done": self.done / total}

    def _explain(self) -> str:
        """Return the message for a draw that is given up."""
        reasons, left = [], self._candidates
        for name, cure, passed in zip(CONDITIONS, CURES, self._passed, strict=True):
            if left:
                reasons.append(f"{1 - passed / left:.1%} fail by '{name}' (change {cure})")
            left = passed
        return (
            f"{self._task_name}: nearly no start can be done: {self.done} of "
            f"{self._candidates} candidates, expected 1 in {round(1 / MIN_SHARE)} at least; of those "
            f"that are left each time {', '.join(reasons)}"
        )


class StartSearch:
    """Search for starts from which a tool-pose task can be done, on the CPU.

    Args:
        task: Gives targets, arms and working range.
        machine: The machine.
    """

    def __init__(self, task: ToolPoseTask, machine: Machine) -> None:
        self._task, self._machine = task, machine
        self._controller = ClassicalController(task.classical, machine, torch.device("cpu"))
        self._kinematics = self._controller.kinematics
        self._exclusive = torch.as_tensor(machine.is_exclusive)
        self._lower = torch.as_tensor(machine.lower, dtype=torch.float32)
        self._upper = torch.as_tensor(machine.upper, dtype=torch.float32)
        self._middle = (self._lower + self._upper) / 2

    def draw(self, count: int, seed: int, tally: DrawTally | None = None) -> Starts:
        """Return `count` starts from which the target can be reached.

        Args:
            count: Number of starts.
            seed: The same seed gives the same starts.
            tally: Counts the candidates; `None` makes one.

        Returns:
            `q`, `scene`, `target_m`, `target_pitch_rad`, `plan`.

        Raises:
            ConfigError: Nearly none of the drawn starts can be done.
        """
        drawn = list[Starts]()
        tally = tally or DrawTally(type(self._task).__name__, count)
        chunks = self._draw_chunks(max(BATCH_FACTOR * count, MIN_BATCH), seed)
        with ItemProgress("drawing starts", count, not distributed.read_rank().first) as progress:
            while tally.done < count:
                free, part = next(chunks)
                passed, part["plan"] = self.check(part)
                drawn.append({name: value[passed[-1]] for name, value in part.items()})
                tally.add(len(free), [free, *passed])
                progress.reach(tally.done)
        return {name: torch.cat([part[name] for part in drawn])[:count] for name in drawn[0]}

    def check(self, start: Starts) -> tuple[list[torch.Tensor], torch.Tensor]:
        """Return which starts fulfil `CONDITIONS` but the first, and a path from each.

        Returns:
            Which fulfil them up to each, `(M,)` bool, and the plan, `(M, J + 1)`: joint positions
            above the target, and 1 where the slew comes after the other joints.
        """
        ready, in_range = self._bring_into_range(start["q"], start["target_m"])
        in_range = in_range & self._is_clear(start["q"], ready, start)
        has_pose, is_done = torch.zeros(2, len(ready), dtype=torch.bool)
        plan = torch.cat((start["q"], torch.zeros(len(ready), 1)), 1)
        for seed in (ready, torch.where(self._exclusive, ready, self._middle)):
            rows = (in_range & ~is_done).nonzero()[:, 0]
            part = {name: value[rows] for name, value in start.items()}
            goal, found = self._find_pose(seed[rows], part, -self._task.aim_below_m)
            hover, above = self._find_pose(goal, part, self._task.arms.clearance_m)
            found = found & above
            has_pose[rows] |= found
            is_straight, has_path = self._find_path(ready[rows], hover, part)
            good = found & has_path
            is_done[rows] = good
            rise_m = self._task.arms.clearance_m + PLAN_RISE_M
            high, reached = self._find_pose(hover, part, rise_m)
            end = torch.where(reached[:, None], high, hover)
            plan[rows[good]] = torch.cat((end, ~is_straight[:, None]), 1)[good]
        return [in_range, has_pose, is_done], plan

    def move_near(
        self,
        start: Starts,
        share: float,
        height_m: tuple[float, float],
        way: tuple[float, float],
        seed: int,
    ) -> Starts:
        """Return starts of which the first part begins above its target, or on the way there.

        A beginner that never meets the target by chance learns from these what is to be gained
        there (reverse curriculum, Florensa et al. 2017). Arms that do not get there stay as they
        are.

        Args:
            start: Starts, as `draw` returns them.
            share: Part of the starts that are brought near.
            height_m: Heights of the tool point above `target_m`, (lowest, highest).
            way: Parts of the way back to the drawn arm, (least, most).
            seed: The same seed gives the same heights.
        """
        count = round(share * len(start["q"]))
        part = {name: value[:count] for name, value in start.items()}
        generator = torch.Generator().manual_seed(seed)
        up_m, back = torch.rand(2, count, 1, generator=generator)
        up_m = height_m[0] + (height_m[1] - height_m[0]) * up_m
        back = way[0] + (way[1] - way[0]) * back
        ready, good = self._bring_into_range(part["q"], part["target_m"])
        near, reached = self._find_pose(ready, part, up_m[:, 0])
        middle = torch.where(self._exclusive, ready, self._middle)
        other, also = self._find_pose(middle, part, up_m[:, 0])
        near, reached = torch.where(reached[:, None], near, other), reached | also
        moved = near + back * (part["q"] - near)
        at_target = back[:, 0] == 0.0
        good = good & reached & (at_target | self._is_clear(moved, moved, part))
        q = start["q"].clone()
        q[:count] = torch.where(good[:, None], moved, part["q"])
        return start | {"q": q}

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
        pose = self._kinematics.pose(q)
        tip = pose.tip_in_base_m
        free = (tip[:, 2] > object_z_m + arms.clearance_m) & (tip[:, 2] > arms.floor_m)
        free &= tip[:, :2].norm(dim=1) > arms.nearest_m
        free &= (pose.joints_in_base_m[:, 2:, 2] > arms.floor_m).all(1)
        return q, free

    def _bring_into_range(
        self, q: torch.Tensor, target_m: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Move the exclusive joints until the reach is in the working range.

        Returns:
            Joint positions, `(M, J)`, and whether they are in range, `(M,)` bool.
        """
        near_m, far_m = self._task.switch.reach_m
        lower, upper = self._lower + POSE_MARGIN, self._upper - POSE_MARGIN
        inner = 0.25 * (far_m - near_m)
        q = q.clone()
        for _ in range(REACH_STEPS):
            reach, slope = self._controller.reach(q, target_m)
            wanted = reach.clamp(near_m + inner, far_m - inner)
            inside = (reach >= near_m) & (reach <= far_m)
            step = (wanted - reach)[:, None] * slope / (slope.square() + REACH_DAMPING)
            moved = (q + step.clamp(-REACH_MAX_STEP, REACH_MAX_STEP)).clamp(lower, upper)
            q = torch.where(self._exclusive & ~inside[:, None], moved, q)
        reach, _ = self._controller.reach(q, target_m)
        return q, (reach > near_m) & (reach < far_m)

    def _find_pose(
        self, q: torch.Tensor, start: Starts, up_m: torch.Tensor | float
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Seek joint positions with the tool `up_m` above the target, by damped Newton steps.

        Exclusive joints rest.

        Returns:
            Joint positions, `(M, J)`, and whether the tool is there, `(M,)` bool.
        """
        target_m, pitch_rad = start["target_m"].clone(), start["target_pitch_rad"]
        if self._task.leans:
            back = torch.as_tensor(up_m).expand(len(q))[:, None]
            target_m -= back * find_tool_direction(target_m, pitch_rad)
        else:
            target_m[:, 2] += up_m
        lower, upper = self._lower + POSE_MARGIN, self._upper - POSE_MARGIN
        damping = POSE_DAMPING**2 * torch.eye(4)
        q = torch.where(self._exclusive, q, q.clamp(lower, upper))
        for _ in range(POSE_STEPS):
            pose, slopes = self._kinematics.pose_and_jacobian(q)
            left = torch.cat(
                (target_m - pose.tip_in_base_m, (pitch_rad - pose.pitch_rad)[:, None]), 1
            )
            jacobian = torch.cat((slopes.tip, slopes.pitch[:, None]), 1) * ~self._exclusive
            across = jacobian.transpose(1, 2)
            step = (across @ torch.linalg.solve(jacobian @ across + damping, left[..., None]))[
                ..., 0
            ]
            moved = (q + step.clamp(-POSE_MAX_STEP, POSE_MAX_STEP)).clamp(lower, upper)
            q = torch.where(self._exclusive, q, moved)
        pose = self._kinematics.pose(q)
        near = (target_m - pose.tip_in_base_m).norm(dim=1) < POSE_TOLERANCE_M
        return q, near & ((pitch_rad - pose.pitch_rad).abs() < POSE_TOLERANCE_RAD)

    def _find_path(
        self, begin: torch.Tensor, end: torch.Tensor, start: Starts
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return whether the straight path is clear, and whether there is one at all, `(M,)` bool.

        Tried are the straight one and the slew after the other joints. Of 1,261 candidates with a
        pose they find 1,244; the way by the arm of home would find 6 more.
        """
        slew_last = end.clone()
        slew_last[:, 0] = begin[:, 0]
        around = self._is_clear(begin, slew_last, start) & self._is_clear(slew_last, end, start)
        straight = self._is_clear(begin, end, start)
        return straight, straight | around

    def _is_clear(self, first: torch.Tensor, last: torch.Tensor, start: Starts) -> torch.Tensor:
        """Return whether straight joint paths stay clear of block and ground, `(M,)` bool."""
        parts = torch.linspace(0.0, 1.0, PATH_POINTS)[:, None, None]
        pose = self._kinematics.pose(first + parts * (last - first))
        points = torch.cat((pose.joints_in_base_m[:, :, 2:], pose.tip_in_base_m[:, :, None]), 2)
        points = torch.cat((points, (points[:, :, 1:] + points[:, :, :-1]) / 2), 2)
        columns = dict(zip(scene.COLUMNS, start["scene"].T, strict=True))
        hole_m = torch.stack((columns["hole_x_m"], columns["hole_y_m"]), 1)
        around_m = scene.OUTER_RADIUS_M * columns["block_scale"] + PATH_CLEARANCE_M
        beside = (points[..., :2] - hole_m[:, None]).norm(dim=-1) > around_m[:, None]
        # the face rises towards the machine where the hole leans away from it
        outward_m = points[..., :2].norm(dim=-1) - hole_m.norm(dim=1)[:, None]
        face_z_m = columns["rim_z_m"][:, None] - columns["lean_rad"].tan()[:, None] * outward_m
        above = points[..., 2] > face_z_m + PATH_CLEARANCE_M
        off_ground = points[..., 2] > PATH_CLEARANCE_M
        return ((beside | above) & off_ground).all(2).all(0)
