"""Recordings of an arm of position servos: a loop of second order, with frames that are lost or late."""

from __future__ import annotations

import numpy as np
from scipy.signal import cont2discrete

from brokk_rl.machine import Machine
from brokk_rl.record import Recording

RESPONSE_S, DAMPING = 0.03, 0.8
SUBSTEPS = 10
"""Steps of the plant in a control period."""


def record_arm(arm: Machine, seed: int, lost: float, late_s: float) -> Recording:
    """Returns a minute and a half of ramps to and fro, followed by a loop of second order.

    A frame is lost with the chance `lost`, else late by up to `late_s`; none overtakes another.
    """
    random = np.random.default_rng(seed)
    count, size = 4500, (5,)
    slopes = random.uniform(0.3, 1.2, (count // 45, 5)) * arm.period_s
    slopes[1::2] *= -1.0
    u = np.cumsum(np.repeat(slopes, 45, 0), 0)
    u = np.clip(u - u.mean(0), -0.9, 0.9)
    come_s = arm.period_s * np.arange(count) + random.uniform(0.0, 1.0, count) * late_s
    arrives = random.random(count) >= lost
    come_s = np.maximum.accumulate(come_s[arrives])
    fine_s = arm.period_s / SUBSTEPS * np.arange(count * SUBSTEPS)
    sent = u[arrives][np.maximum(np.searchsorted(come_s, fine_s, "right") - 1, 0)]
    middle, half = (arm.upper + arm.lower) / 2, (arm.upper - arm.lower) / 2
    loop = np.array([[0.0, 1.0], [-(RESPONSE_S**-2), -2.0 * DAMPING / RESPONSE_S]])
    drive = np.array([[0.0], [RESPONSE_S**-2]])
    a, b, *_ = cont2discrete((loop, drive, np.eye(2), 0.0 * drive), arm.period_s / SUBSTEPS)
    state, q = np.stack([middle + half * u[0], np.zeros(size)]), []
    for k, command in enumerate(sent):
        if k % SUBSTEPS == 0:
            q.append(state[0].copy())
        state = a @ state + b * (middle + half * command)
    noise = 3e-4 * random.standard_normal((count, 5))
    return Recording(
        machine=arm.name,
        joints=arm.joint_names,
        units=tuple(joint.unit for joint in arm.joints),
        rate_hz=1.0 / arm.period_s,
        t_s=arm.period_s * np.arange(count),
        u=u.astype(np.float32),
        q=(np.array(q) + noise).astype(np.float32),
        extra={},
        metadata={"run": f"{seed}"},
    )
