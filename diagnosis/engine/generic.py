"""Flexible columns: what one quantity alone could explain, whatever the law.

A group of columns lets the simulated speed follow any function of one quantity: place, level of the
command, motion of the other joints, a slow oscillation, or the time that the joint rested. Their marginal
likelihood pays for their number. Where a group earns much more than any effect, the cause is unknown.
Axes: `T` samples, `K` columns, `N` increments.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from diagnosis.engine.baseline import JointBaseline
from diagnosis.engine.evidence import FieldJoint, RowEvidence
from diagnosis.engine.nuisance import (
    LEAST_SQUARE,
    Projection,
    compute_gain,
    count_part,
    draw_hats,
    find_direction,
    simulate_speed,
)
from diagnosis.engine.side import Side

NUM_POSES = 8
LEVELS = np.array([0.0, 0.1, 0.25, 0.45, 0.7, 1.0])
"""Knots of the place and of the speed over the top speed."""
HUNTING_HZ = np.arange(0.1, 0.62, 0.03)
"""Slow oscillations of a pump controller."""
REST_S = np.array([0.0, 0.3, 0.8, 2.0, 5.0, 12.0])
"""Knots of the time that a joint rested. These, and the next two numbers, are chosen by hand, and no others were tried."""
START_S = 0.8
"""Time in which what holds back a start fades."""
MOVING = 0.01
"""Speed from which a joint moves, of its top speed."""
LATE_S = 0.06
"""Delay of a servo in the columns of a delay that changes with time."""
CHANGE_S = 20.0
"""Distance of the knots between which a servo changes with time."""


def list_groups(
    side: Side, joint: int, base: JointBaseline, path: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the columns of each group as paths `(K, T)`, from the simulated path `(T,)`."""
    if not side.model.integrates:
        return _list_target_groups(side, joint, path)
    speed = simulate_speed(side, path)
    out, back = (base.numbers[side.model.place[name]] for name in ("speed_out", "speed_in"))
    top = 0.5 * (out + back) * side.period_s
    forward, backward = np.maximum(speed, 0.0), np.minimum(speed, 0.0)
    place = side.poses[joint][:, 0]
    by_pose = draw_hats(place, np.linspace(-1.0, 1.0, NUM_POSES))
    groups = {"place": 0.15 * np.concatenate([forward * by_pose, backward * by_pose])}
    up, down = draw_hats(speed / top, LEVELS), draw_hats(-speed / top, LEVELS)
    groups["level"] = 0.2 * np.concatenate([forward * up, backward * down])
    others = [simulate_speed(side, one) for one in np.delete(side.q, joint, 1).T]
    groups["other joints"] = 0.1 * np.array(others).reshape(-1, side.num_samples)
    groups |= _view_rest(side, joint, speed, top)
    waves = 2.0 * np.pi * HUNTING_HZ[:, None] * side.time_s
    groups["hunting"] = 0.2 * speed * np.concatenate([np.sin(waves), np.cos(waves)])
    return {name: np.cumsum(columns, -1) - columns for name, columns in groups.items()}


def _view_rest(side: Side, joint: int, speed: np.ndarray, top: float) -> dict[str, np.ndarray]:
    """Return motion of a joint at rest, and loss of its starts, by the time that it rests; and its turns."""
    row = np.arange(side.num_samples)
    way = np.sign(speed) * (np.abs(speed) > MOVING * top)
    changes = (way != np.roll(way, 1)) | (row == side.begins)
    begin = np.maximum.accumulate(np.where(changes, row, 0))
    lasting_s = (row - begin) * side.period_s
    rested_s = np.where(way == 0.0, lasting_s, 0.0)
    newest = np.maximum.accumulate(np.where(way != 0.0, row, 0))
    turned = way * way[newest[begin - 1]] < 0.0
    resting = 0.05 * top * (way == 0.0) * draw_hats(rested_s, REST_S)
    starting = 0.5 * speed * np.maximum(1.0 - lasting_s / START_S, 0.0)
    return {
        "rest": np.concatenate([resting, resting * side.load[joint]]),
        "starts": np.stack([*starting * draw_hats(rested_s[begin - 1], REST_S), starting * turned]),
    }


def _list_target_groups(side: Side, joint: int, path: np.ndarray) -> dict[str, np.ndarray]:
    """Return the same for a joint that follows a target: columns are parts of its error."""
    direction = find_direction(side, path)
    speed = simulate_speed(side, path) / side.period_s
    machine = side.machine
    middle = (machine.upper + machine.lower)[joint] / (machine.upper - machine.lower)[joint]
    by_pose = draw_hats(path - middle, np.linspace(-1.0, 1.0, NUM_POSES))
    top = max(float(np.quantile(np.abs(speed), 0.99)), 1e-6)
    by_level = draw_hats(np.abs(speed) / top, LEVELS)
    sides = [np.maximum(direction, 0.0) * by_level, np.minimum(direction, 0.0) * by_level]
    late = ndimage.shift(path, round(LATE_S / side.period_s), order=0) - path
    late[: side.count(side.model.settling_s)] = 0.0
    knots = np.arange(0.0, side.time_s.max() + CHANGE_S, CHANGE_S)
    by_time = draw_hats(side.time_s, knots)
    changing = [0.02 * direction * by_time, 0.5 * late * by_time]
    return {
        "place": 0.02 * np.concatenate([direction * by_pose, by_pose]),
        "level": 0.02 * np.concatenate(sides),
        "time": np.concatenate(changing),
    }


def compute_evidence(
    projection: Projection, residual: np.ndarray, columns: np.ndarray, count: float
) -> float:
    """Return the log evidence of columns of prior deviation 1 beside the nuisance, nats."""
    columns = columns[np.square(columns).sum(1) > LEAST_SQUARE]
    wide = projection.add(columns)
    before = float(projection.measure_squares(residual)[0])
    gain = float(compute_gain(wide.measure_squares(residual), before, count)[0])
    return gain - 0.5 * (wide.log_determinant - projection.log_determinant)


class GenericCauses:
    """Evidence of the groups, with its price on the reference.

    Args:
        evidence: The table.
    """

    def __init__(self, evidence: RowEvidence) -> None:
        self._evidence = evidence
        self._prices = [self._price(j) for j in range(evidence.reference.num_joints)]

    def _price(self, joint: int) -> dict[str, float]:
        """Return the most that each group earns on a left-out part, nats an increment."""
        side, base = self._evidence.reference, self._evidence.bases[joint]
        path = side.simulate(joint, base.numbers)[0].astype(float)
        found = {}
        for name, columns in list_groups(side, joint, base, path).items():
            increments = base.measure(columns)
            earned = [0.0]
            for k, part in enumerate(self._evidence.nuisances[joint].parts):
                own, count = base.part == k, count_part(base, k)
                gain = compute_evidence(part, base.left_out[own], increments[:, own], count)
                earned.append(gain / count)
            found[name] = max(earned)
        return found

    def weigh(self, joint: FieldJoint) -> dict[str, float]:
        """Return what each group earns on a joint of the field, less its price, nats."""
        base = self._evidence.bases[joint.joint]
        prices, found = self._prices[joint.joint], {}
        for name, columns in list_groups(joint.side, joint.joint, base, joint.path).items():
            increments = joint.measure(columns).astype(float)
            gain = compute_evidence(joint.projection, joint.residual, increments, joint.count)
            found[name] = gain - prices[name] * joint.count
        return found
