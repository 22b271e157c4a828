"""Frames of an MJCF against the kinematics of the machine's YAML."""

from __future__ import annotations

import mujoco
import numpy as np

from brokk_rl.errors import ConfigError
from brokk_rl.kinematics import LinkChain, compute_tool_kinematics
from brokk_rl.machine import Machine

NUM_POSES, FRAME_TOLERANCE_M = 16, 1e-6
"""Random poses in which YAML and MJCF are compared, and the difference allowed: both are computed in
double precision."""


def check_frames(model: mujoco.MjModel, machine: Machine) -> None:
    """Refuse a model whose joints or tool point do not stand where the machine's YAML has them.

    A policy is judged by the kinematics of the YAML; the simulated tool must be there.

    Raises:
        ConfigError: They differ in random poses; the message names the first joint.
    """
    chain, data = LinkChain(machine.joints), mujoco.MjData(model)
    poses = np.random.default_rng(0).uniform(machine.lower, machine.upper, (NUM_POSES, model.nq))
    tips_m = compute_tool_kinematics(machine, poses).tip_in_base_m
    names = [*machine.joint_names, "tip"]
    found_m = np.zeros((NUM_POSES, len(names), 3))
    for row, q in enumerate(poses):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        for column, name in enumerate(machine.joint_names):
            found_m[row, column] = data.xpos[model.joint(name).bodyid[0]]
        found_m[row, -1] = data.site("tip").xpos
    expected_m = np.concatenate((chain.place(poses).place_m, tips_m[:, None]), 1)
    away_m = np.linalg.norm(found_m - expected_m, axis=-1).max(0)
    if (away_m <= FRAME_TOLERANCE_M).all():
        return
    first = int((away_m > FRAME_TOLERANCE_M).argmax())
    # a link that is turned moves what hangs on it, not its own origin
    joint = names[max(0, first - 1)]
    raise ConfigError(
        f"machine {machine.name}: expected {names[first]} of {machine.mjcf} where the machine's YAML has "
        f"it, got it {away_m[first]:.3g} m away in random poses: joint {joint} stands or turns otherwise; "
        "change euler, quat or ref of its link, or pos of what carries it"
    )
