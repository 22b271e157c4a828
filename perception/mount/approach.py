"""Planned motion of the tool towards a hole, for computers without the simulator.

The tool goes over the hole first and then down, upright, each joint as fast as it can at most. It is
the plan of the guidance, and the policy's own motion differs from it by what the policy learned.
"""

from __future__ import annotations

import numpy as np

from brokk_rl.kinematics import compute_tool_kinematics, solve_joint_step
from brokk_rl.machine import Machine

STEP_S = 0.1
"""Step of the plan: joints turn by 0.05 rad at most. Chosen by hand."""
HOVER_M = 0.24
"""Height over the aim at which the tool is aligned first; as the task's controller has it."""
FUNNEL_M = 0.06
"""Lateral distance below which the tool goes down; as the task's controller has it."""
DEPTH_M = 0.14
"""Depth of the aim below the rim; as the task has it."""
GAIN_1_S = 1.5
"""Speed of the tool per distance left; as the task's controller has it."""
DAMPING = 0.05
"""Damping of the least squares, m/s; as the task's controller has it."""
DOWN = np.array([0.0, 0.0, -1.0])
"""Direction of the tool in the hole."""


def plan_approach_motion(
    machine: Machine, q: np.ndarray, hole_m: np.ndarray, num_times: int, step_s: float
) -> np.ndarray:
    """Return joint positions on the way into a vertical hole, `(T, J)`.

    Args:
        machine: The machine.
        q: Present joint positions, `(J,)`.
        hole_m: Centre of the hole's rim in the base frame, `(3,)`.
        num_times: `T`; the first time is now.
        step_s: Time between two of them.
    """
    q, planned = np.asarray(q, float), []
    num_parts = max(1, round(step_s / STEP_S))
    for number in range(num_times * num_parts):
        if number % num_parts == 0:
            planned.append(q)
        arm = compute_tool_kinematics(machine, q)
        error_m = hole_m + DEPTH_M * DOWN - arm.tip_in_base_m
        if np.hypot(error_m[0], error_m[1]) > FUNNEL_M:
            error_m = error_m - HOVER_M * DOWN
        wanted = GAIN_1_S * np.concatenate([error_m, DOWN - arm.axis_in_base])
        share = solve_joint_step(arm, wanted, machine.max_speed, DAMPING)
        share = share / max(1.0, float(np.abs(share).max()))
        q = np.clip(
            q + share * machine.max_speed * (step_s / num_parts), machine.lower, machine.upper
        )
    return np.stack(planned)
