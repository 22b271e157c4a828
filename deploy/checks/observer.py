"""Observer: does each joint move as its commands say? Pure: numpy, no clock, no file.

Once a control period the shipped valve model predicts the motion from the valves' feedback. Over
the last `window_s` the residual is the measured motion less the predicted one. A fault is named
when it exceeds

    slack_s * max_speed + share * (way that was predicted),

thresholds of the observer's file, which `brokk mode=observe` takes from recordings of the very
machine. Where the chisel may touch a borehole, contact can withhold all of the predicted motion, so
that the share is 1: a joint may stand still there.

The fault is named by the ratio of measured to predicted motion: about none is a joint that stands
still, a negative one a turned sign, less than one a joint that moves too little. A residual without
predicted motion, or beyond it, is a joint that moves unasked. A sensor that drifts against the
motion looks like a weak valve at first.

A named fault stays until `clear`. Axes: `J` joints.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from brokk_rl.machine import Machine
from deploy.checks.valve_model import ValvePredictor
from deploy.kernel.guard import GuardTrip, Observation

STILL, TURNED = 0.3, -0.3
"""Ratio of measured to predicted motion below which a joint stands still, and moves the wrong way.
Chosen by hand: the newest part of the window may still hold motion from before the fault."""
NEWEST = 4
"""The newest part of the window, by which a fault is named, is one in so many. Chosen by hand: a
turned sensor is noticed after a fifth of a second, and noise counts more in a shorter part."""
MOST = 3.0
"""Ratio from which the predicted motion counts as none. Chosen by hand."""
BLIND_S = 0.3
"""Time after the dead time until the commands before the first look have come to rest. By hand."""
LATE = 1.5
"""Periods between two updates above which the windows begin anew."""


@dataclass(frozen=True)
class ObservedWindow:
    """Motions of the joints in a window, each `(J,)`, rad or m.

    Attributes:
        moved: Measured motion.
        wanted: Predicted motion.
        way: Sum of the predicted steps, without sign.
        limit: Difference of both above which a fault is named.
    """

    moved: np.ndarray
    wanted: np.ndarray
    way: np.ndarray
    limit: np.ndarray


class Observer:
    """Comparison of predicted and measured motion of each joint over the last `window_s`.

    Args:
        content: Of the observer's file: tables of the model, and thresholds.
        machine: Limits, speeds and period.

    Attributes:
        window_s: Length of the window.
    """

    def __init__(self, content: Mapping[str, Any], machine: Machine) -> None:
        thresholds = content["thresholds"]
        self._share, self._machine = float(thresholds["share"]), machine
        self.window_s = float(thresholds["window_s"])
        self._predictor = ValvePredictor(content["model"], machine)
        length = round(self.window_s / machine.period_s)
        self._measured = deque[np.ndarray]([], length)
        self._predicted = deque[np.ndarray]([], length)
        # By how much each step may be missed.
        self._borne = deque[np.ndarray]([], length)
        self._slack = np.array(thresholds["slack_s"], float) * machine.max_speed
        # Commands that were given before the first look act for so long.
        self._num_blind = round((machine.dead_time_s + BLIND_S) / machine.period_s)
        self._blind = self._num_blind
        self._q: np.ndarray | None = None
        self._t_s = 0.0
        self._fault, self._joint = GuardTrip.NONE, -1

    @property
    def observation(self) -> Observation:
        """The newest result."""
        return Observation(self._fault, self._joint)

    def is_due(self, now_s: float) -> bool:
        """Return whether a control period has gone by since the last update."""
        # A tenth of a period early is on time: the caller's cycle is shorter than that.
        return self._q is None or now_s - self._t_s > 0.9 * self._machine.period_s

    def forget(self) -> None:
        """Begin anew: positions are missing or not plausible."""
        self._q = None

    def clear(self) -> None:
        """Take back the named fault, when the operator has let go of the dead-man."""
        if self._fault is not GuardTrip.NONE:
            self._fault, self._joint = GuardTrip.NONE, -1
            self._begin_window()

    def update(self, now_s: float, q: np.ndarray, u: np.ndarray, may_touch: bool) -> None:
        """Take in one control period.

        Args:
            now_s: Its end.
            q: Joint positions at its end, `(J,)`.
            u: Mean flow of the valves in it, `(J,)`.
            may_touch: Whether contact may hold the arm.
        """
        late = self._q is None or now_s - self._t_s > LATE * self._machine.period_s
        if late or self._q is None:
            self._begin_window()
            self._predictor.reset()
            self._blind = self._num_blind
        else:
            predicted, measured = self._predictor.predict(u, self._q), q - self._q
            self._blind -= 1
            if self._blind < 0:
                self._compare(measured, predicted, 1.0 if may_touch else self._share)
        self._q, self._t_s = q.copy(), now_s

    def _begin_window(self) -> None:
        for steps in (self._measured, self._predicted, self._borne):
            steps.clear()

    def _compare(self, measured: np.ndarray, predicted: np.ndarray, share: float) -> None:
        self._measured.append(measured)
        self._predicted.append(predicted)
        self._borne.append(share * np.abs(predicted))
        if self._fault is GuardTrip.NONE:
            self._find_fault()

    @property
    def window(self) -> ObservedWindow:
        """The motions of the newest window; zeros before the first."""
        predicted, measured = np.array(self._predicted), np.array(self._measured)
        way = np.abs(predicted).sum(0)
        limit = self._slack + np.array(self._borne).sum(0)
        return ObservedWindow(measured.sum(0), predicted.sum(0), way, limit)

    def _find_fault(self) -> None:
        predicted, measured = np.array(self._predicted), np.array(self._measured)
        window = self.window
        moved, way = window.moved, window.way
        excess = np.abs(moved - window.wanted) / window.limit
        joint = int(excess.argmax())
        if excess[joint] <= 1.0:
            return
        self._joint = joint
        # The newest part tells what is wrong: the others may be from before.
        recent = max(1, len(predicted) // NEWEST)
        newer_moved = float(measured[-recent:, joint].sum())
        newer_way = float(np.abs(predicted[-recent:, joint]).sum())
        # A joint at rest tells nothing: then the whole window does.
        if newer_way == 0.0 and abs(newer_moved) <= self._slack[joint]:
            recent, newer_moved, newer_way = 0, float(moved[joint]), float(way[joint])
        newer_wanted = float(predicted[-recent:, joint].sum())
        self._fault = classify_fault(newer_moved, newer_wanted, newer_way)


def classify_fault(moved: float, wanted: float, way: float) -> GuardTrip:
    """Return the fault of a joint whose residual is too large.

    Args:
        moved: Measured motion in the window, rad or m.
        wanted: Predicted motion.
        way: Sum of the predicted steps, without sign.
    """
    # At rest, or to and fro: a ratio of small numbers says nothing.
    if wanted == 0.0 or abs(wanted) < way / 2 or abs(wanted) < abs(moved) / MOST:
        return GuardTrip.JOINT_DRIFTS
    ratio = moved / wanted
    if ratio < TURNED:
        return GuardTrip.JOINT_TURNED
    if ratio < STILL:
        return GuardTrip.JOINT_STILL
    return GuardTrip.JOINT_WEAK if ratio < 1.0 else GuardTrip.JOINT_DRIFTS
