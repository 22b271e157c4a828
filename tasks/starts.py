"""Random starts from which a tool-pose task can be done.

A start is kept only if the tool begins in the open and if, after the exclusive joints have brought
the target into reach, the other joints reach the wanted pose within their limits. Checked once with
the kinematics when a task is built, so that resets only pick rows.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.spec import spec
from tasks.classical import REACH_DAMPING, ClassicalController

BATCH_FACTOR, MIN_BATCH, MAX_BATCHES = 4, 256, 64
"""Candidates per batch for each start asked for, least batch, and batches until `draw_starts` gives
up. Chosen by hand."""

REACH_STEPS, REACH_MAX_STEP = 40, 0.1
"""Damped Newton steps of the exclusive joints towards the working range, and their largest step
(rad or m). Chosen by hand."""
POSE_STEPS, POSE_STEP_S = 120, 0.2
"""Steps of the classical controller's approach, and the time of each, s. Chosen by hand: 24 s,
longer than an episode of `borehole_insertion`."""
POSE_TOLERANCE_M, POSE_TOLERANCE_RAD = 0.01, 0.03
"""Errors up to which a pose counts as reached. Chosen by hand: the clearance of the hole, and a
fraction of the tolerance of `goal_pose`."""


@spec
class ArmStarts:
    """Ranges of the arm at the start of an episode.

    Attributes:
        margin_rad: Distance from joint limits.
        floor_m: Height above the ground that no joint behind the second and no tool point starts
            below.
        clearance_m: Height above the object that the tool point does not start below.
        nearest_m: Horizontal distance from the slew axis that the tool point does not start within.
    """

    margin_rad: float
    floor_m: float
    clearance_m: float
    nearest_m: float


@dataclass
class CandidateTargets:
    """Candidate targets; `M` of them.

    Attributes:
        target_m: Target point in the base frame, `(M, 3)`.
        pitch_rad: Wanted pitch of the tool, `(M,)`.
        scene: Scene around it, `(M, S)`; see `sim.scene`.
        object_z_m: Height of the top of the object, `(M,)`.
    """

    target_m: torch.Tensor
    pitch_rad: torch.Tensor
    scene: torch.Tensor
    object_z_m: torch.Tensor


Uniform = Callable[[tuple[float, float]], torch.Tensor]
"""Draws `(M,)` numbers between two bounds."""


def draw_starts(
    count: int,
    seed: int,
    draw: Callable[[Uniform], CandidateTargets],
    arms: ArmStarts,
    machine: Machine,
    controller: ClassicalController,
    reach_m: tuple[float, float],
    depth_m: float,
    task_name: str,
) -> dict[str, torch.Tensor]:
    """Return `count` starts from which the target can be reached.

    Args:
        count: Number of starts.
        seed: The same seed gives the same starts.
        draw: Draws targets.
        arms: Where the arm may begin.
        machine: The machine.
        controller: Gives kinematics and reach.
        reach_m: Good working range.
        depth_m: How far below `target_m` the tool must get.
        task_name: Name of the task, for the message when too few are found.

    Returns:
        `q`, `scene`, `target_m`, `target_pitch_rad`.
    """
    generator = torch.Generator().manual_seed(seed)
    batch = max(BATCH_FACTOR * count, MIN_BATCH)

    def uniform(bounds: tuple[float, float]) -> torch.Tensor:
        return bounds[0] + (bounds[1] - bounds[0]) * torch.rand(batch, generator=generator)

    drawn = []
    for _ in range(MAX_BATCHES):
        targets = draw(uniform)
        q, free = draw_arms(arms, machine, controller, targets.object_z_m, generator)
        rows = {
            "q": q,
            "scene": targets.scene,
            "target_m": targets.target_m,
            "target_pitch_rad": targets.pitch_rad,
        }
        rows = {name: value[free] for name, value in rows.items()}
        deep = rows["target_m"] - torch.tensor([0.0, 0.0, depth_m])
        done = check_reachable(
            controller, machine, rows["q"], deep, rows["target_pitch_rad"], reach_m, arms.margin_rad
        )
        drawn.append({name: value[done] for name, value in rows.items()})
        if sum(len(found["q"]) for found in drawn) >= count:
            break
    return join_starts(count, drawn, task_name)


def draw_arms(
    arms: ArmStarts,
    machine: Machine,
    controller: ClassicalController,
    object_z_m: torch.Tensor,
    generator: torch.Generator,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Draw one arm per row of `object_z_m`.

    Returns:
        `q`, `(M, J)`, and whether it is in the open, `(M,)` bool.
    """
    lower = torch.as_tensor(machine.lower, dtype=torch.float32) + arms.margin_rad
    upper = torch.as_tensor(machine.upper, dtype=torch.float32) - arms.margin_rad
    q = lower + (upper - lower) * torch.rand(
        len(object_z_m), machine.num_joints, generator=generator
    )
    pose = controller.kinematics.pose(q)
    tip = pose.tip_in_base_m
    free = (tip[:, 2] > object_z_m + arms.clearance_m) & (tip[:, 2] > arms.floor_m)
    free &= tip[:, :2].norm(dim=1) > arms.nearest_m
    free &= (pose.joints_in_base_m[:, 2:, 2] > arms.floor_m).all(1)
    return q, free


def check_reachable(
    controller: ClassicalController,
    machine: Machine,
    q: torch.Tensor,
    target_m: torch.Tensor,
    pitch_rad: torch.Tensor,
    reach_m: tuple[float, float],
    margin_rad: float,
) -> torch.Tensor:
    """Return from which `q`, `(M, J)`, the target pose can be reached under the masks, `(M,)` bool.

    First the exclusive joints move until the reach lies well inside the good working range, then
    the others by damped least squares.
    """
    exclusive = torch.as_tensor(machine.is_exclusive)
    lower = torch.as_tensor(machine.lower, dtype=torch.float32) + margin_rad
    upper = torch.as_tensor(machine.upper, dtype=torch.float32) - margin_rad
    inner = 0.25 * (reach_m[1] - reach_m[0])
    q = q.clone()
    for _ in range(REACH_STEPS):
        reach, slope = controller.reach(q, target_m)
        wanted = reach.clamp(reach_m[0] + inner, reach_m[1] - inner)
        inside = (reach >= reach_m[0]) & (reach <= reach_m[1])
        step = ((wanted - reach)[:, None] * slope / (slope.square() + REACH_DAMPING)).clamp(
            -REACH_MAX_STEP, REACH_MAX_STEP
        )
        q = torch.where(exclusive & ~inside[:, None], (q + step).clamp(lower, upper), q)
    reach, _ = controller.reach(q, target_m)
    good = (reach > reach_m[0]) & (reach < reach_m[1])
    for _ in range(POSE_STEPS):
        pose, jacobian = controller.kinematics.pose_and_jacobian(q)
        error = target_m - pose.tip_in_base_m
        share = controller.approach(
            jacobian.tip, jacobian.pitch, error, error[:, 2], pitch_rad - pose.pitch_rad
        )
        q = (q + POSE_STEP_S * share * controller.speed).clamp(lower, upper)
    pose = controller.kinematics.pose(q)
    near = (target_m - pose.tip_in_base_m).norm(dim=1) < POSE_TOLERANCE_M
    return good & near & ((pitch_rad - pose.pitch_rad).abs() < POSE_TOLERANCE_RAD)


def join_starts(
    count: int, drawn: list[dict[str, torch.Tensor]], task_name: str
) -> dict[str, torch.Tensor]:
    """Join batches of accepted starts and cuts them to `count`.

    Raises:
        ConfigError: If too few were accepted.
    """
    joined = {}
    for key in drawn[0]:
        joined[key] = torch.cat([batch[key] for batch in drawn])
    found = len(joined["q"])
    if found < count:
        raise ConfigError(
            f"{task_name}: only {found} of {count} starts were reachable; "
            "widen the joint limits or narrow the ranges of the task"
        )
    return {key: value[:count] for key, value in joined.items()}
