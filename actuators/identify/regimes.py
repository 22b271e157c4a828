"""Where a model fails: how fast its free runs drift while a joint rests, moves alone or with others, reverses, or nears a stop.

Each free run is cut into seconds; a second belongs to a joint's regimes by the commands that were
acting in it (those of a dead time before) and by where the joint was. What counts is the error that
is added within the second, not what was there before.
Axes: `W` windows, `S` seconds of a window, `J` joints.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from actuators.identify.scores import Scores, interval
from brokk_rl.split import COMMANDED

SECOND_S = 1.0
NEAR_STOP = 0.05
"""Part of the travel that counts as near a stop."""
SMALL, LARGE = 0.3, 0.7
"""Largest command of a second below which it is small, and above which it is large."""
REGIMES = (
    "at rest",
    "alone",
    "with others",
    "after a reversal",
    "near a stop",
    "small commands",
    "medium commands",
    "large commands",
)


def memberships(scores: Scores, delay_s: np.ndarray) -> dict[str, np.ndarray]:
    """Returns which seconds belong to each regime, `(W, S, J)` bool.

    Args:
        scores: Holds windows and machine.
        delay_s: Dead time of each joint, `(J,)`.
    """
    cut, machine = scores.cut, scores.machine
    steps = _steps(scores)
    num_seconds = cut.measured.shape[1] // steps
    shape = (len(cut.q), num_seconds, steps, machine.num_joints)
    acting, turned = np.zeros(shape), np.zeros(shape, dtype=bool)
    for j in range(machine.num_joints):
        back = min(round(delay_s[j] / machine.period_s), cut.num_before - 2)
        begin = cut.num_before - 1 - back
        u = cut.u[..., j]
        acting[..., j] = u[:, begin : begin + num_seconds * steps].reshape(shape[:-1])
        turned[..., j] = _reversals(u)[:, begin : begin + num_seconds * steps].reshape(shape[:-1])
    size = np.abs(acting).max(2)
    q = cut.measured[:, : num_seconds * steps].reshape(shape)
    margin = NEAR_STOP * scores.travel
    with np.errstate(invalid="ignore"):
        near = ((q < machine.lower + margin) | (q > machine.upper - margin)).any(2)
    moving = size > COMMANDED
    others = moving.sum(2, keepdims=True) - moving > 0
    found = (
        ~moving, moving & ~others, moving & others, turned.any(2), moving & near,
        moving & (size < SMALL), moving & (size >= SMALL) & (size <= LARGE), moving & (size > LARGE),
    )  # fmt: skip
    whole = np.isfinite(q).all(2)
    return {name: np.asarray(members & whole) for name, members in zip(REGIMES, found, strict=True)}


def by_regime(scores: Scores, delay_s: np.ndarray) -> dict[str, dict[str, dict[str, Any]]]:
    """Returns, by joint and regime, the part of the `time` spent in it and, by model, the drift.

    Drift: root mean square of the error added within a second, `drift_per_s` in rad/s or m/s with
    `ci95`, and `share` of all that the model's squared drift amounts to. Regimes overlap (a large
    command can also be a reversal), so shares do not add up to 1.
    """
    members = memberships(scores, delay_s)
    steps = _steps(scores)
    squares = {}
    for name, error in scores.error.items():
        at_end = np.concatenate([np.zeros_like(error[:, :1]), error[:, steps - 1 :: steps]], 1)
        squares[name] = (np.diff(at_end, axis=1) / SECOND_S) ** 2
    whole = np.any(list(members.values()), axis=0)
    table: dict[str, dict[str, dict[str, Any]]] = {name: {} for name in scores.machine.joint_names}
    for regime, inside in members.items():
        drift = {}
        for name, square in squares.items():
            within = np.where(inside, square, 0.0).sum(1)
            every = np.where(whole, square, 0.0).sum((0, 1))
            share = within.sum(0) / np.maximum(every, np.finfo(float).tiny)
            drift[name] = scores.ratio(within, inside.sum(1)), share
        for j, joint in enumerate(scores.machine.joint_names):
            if not inside[..., j].any():
                continue
            table[joint][regime] = {
                "time": float(inside[..., j].sum() / whole[..., j].sum()),
                "models": {
                    name: {
                        "drift_per_s": float(np.sqrt(mean[j])),
                        "ci95": interval(np.sqrt(again[:, j])),
                        "share": float(share[j]),
                    }
                    for name, ((mean, again), share) in drift.items()
                },
            }
    return table


def _steps(scores: Scores) -> int:
    return max(1, round(SECOND_S / scores.machine.period_s))


def _reversals(u: np.ndarray) -> np.ndarray:
    """Says at which samples a command, `(W, T)`, has just changed its sign, whatever time it rested in between."""
    sign = np.where(np.abs(u) > COMMANDED, np.sign(u), 0.0)
    place = np.where(sign != 0, np.arange(u.shape[1]), 0)
    last = np.take_along_axis(sign, np.maximum.accumulate(place, 1), 1)
    before = np.pad(last[:, :-1], ((0, 0), (1, 0)))
    return (sign * before) < 0
