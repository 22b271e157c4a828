"""Response of the joints to single valves: which joint moves, which way, how late and how fast.

For the bring-up. Each valve is driven alone from rest, both ways; a valve that moves another joint, a
joint that is turned, and one that moves twice as fast as the machine's file says are named.
Axes: `T` samples, `J` joints.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from brokk_rl.machine import Machine

SMALLEST_FLOW = 0.1
"""Flow, of full, that counts as a command; less may lie in a valve's dead band. Chosen by hand."""
MOVED = 0.004
"""Part of the travel that counts as motion. Chosen by hand: well above the noise of a position."""
LONGEST_S = 2.0
"""Time after the beginning of flow within which the joint must have moved. Chosen by hand: longer
than any dead time that a policy could be trained for."""
REST_S = 0.5
"""Time for which the joint must have been at rest before. Chosen by hand."""
ONSET_S = 0.15
"""Length of the line that is drawn back to the beginning of a motion. Chosen by hand: longer
averages more noise, shorter bends less with the acceleration."""
SPEED_S = 0.2
"""Time over which a speed is measured. Chosen by hand: longer averages more noise."""
DOUBLED = 1.6
"""Speed over that of the machine's file from which a joint is doubled: the geometric mean of 1.3, by
which retracting cylinders are faster (conf/actuator/hydraulic.yaml), and 2."""


@dataclass(frozen=True)
class ValvePush:
    """One valve driven alone and what it moved.

    Attributes:
        joint: Number of the valve's joint.
        sign: Sign of its flow.
        moves: Numbers of the joint that moved most, by its travel, and of those that moved half as
            much or more.
        agrees: Whether the joint that moved most went in the direction of the flow.
        dead_time_s: From the beginning of flow to the first motion.
        speed: Its largest speed, rad/s or m/s.
        ratio: This speed over the one that the flow gives by the machine's file.
    """

    joint: int
    sign: int
    moves: tuple[int, ...]
    agrees: bool
    dead_time_s: float
    speed: float
    ratio: float


@dataclass(frozen=True)
class JointResponse:
    """Response of the machine to one valve.

    Attributes:
        valve: Joint whose valve was driven.
        moves: Joints that moved; the valve's own alone where all is right.
        agrees: Whether it moves in the direction of its flow, both ways.
        dead_time_s: From the beginning of flow to the first motion, median.
        speed: Largest speed seen, rad/s or m/s.
        ratio: Speed over the one that the machine's file gives, median.
    """

    valve: str
    moves: tuple[str, ...]
    agrees: bool
    dead_time_s: float
    speed: float
    ratio: float

    @property
    def faults(self) -> list[str]:
        """Each fault in words."""
        if self.moves != (self.valve,):
            return [f"the valve of {self.valve} moves {' and '.join(self.moves)}"]
        found = []
        if not self.agrees:
            found.append(f"{self.valve} is turned: it moves against its flow")
        if self.ratio > DOUBLED:
            text = f"{self.valve} is doubled: it moves {self.ratio:.1f} times as fast as the machine's file says"
            found.append(text)
        return found

    @property
    def text(self) -> str:
        """The response in words."""
        faults = "; ".join(self.faults) or "moves as its flow"
        return f"{faults}, dead time {self.dead_time_s:.2f} s, up to {self.speed:.2f} rad/s"


def find_pushes(
    t_s: np.ndarray, q: np.ndarray, flow: np.ndarray, machine: Machine
) -> list[ValvePush]:
    """Return the pushes of one valve alone from rest that moved anything, in order of time.

    A push counts once its response is over: after `LONGEST_S`, or when the next one begins.

    Args:
        t_s: Times, `(T,)`.
        q: Positions, `(T, J)`, rad or m.
        flow: Flow of the valves, `(T, J)`, of full.
        machine: Travels and speeds.
    """
    # Flow marks the beginning of a response: levers move earlier, valves answer later.
    is_flowing = np.abs(flow) >= SMALLEST_FLOW
    is_any: np.ndarray = np.any(is_flowing, axis=1)
    began = np.flatnonzero(is_any[1:] & ~is_any[:-1]) + 1
    travel, pushes = machine.upper - machine.lower, []
    ends = np.append(began, len(t_s))[1:]
    for row, following in zip(began, ends, strict=True):
        end = min(following, int(np.searchsorted(t_s, t_s[row] + LONGEST_S)))
        driven = np.flatnonzero(is_flowing[row:end].any(0))
        rest = int(np.searchsorted(t_s, t_s[row] - REST_S, side="right"))
        is_moving = np.ptp(q[rest : row + 1], axis=0) > MOVED * travel / 2
        # What several valves move, or what moved before, answers more than one question.
        if end == len(t_s) or len(driven) != 1 or is_moving.any():
            continue
        ways = np.abs(q[row:end] - q[row]).max(0) / travel
        moves = np.flatnonzero((ways > MOVED) & (ways > ways.max() / 2))
        if len(moves):
            first = int(ways.argmax())
            one = t_s[row:end], q[row:end, first], flow[row:end, driven[0]]
            full_speed, least = float(machine.max_speed[first]), MOVED * float(travel[first])
            push = _measure_push(int(driven[0]), tuple(moves.tolist()), *one, full_speed, least)
            pushes.append(push)
    return pushes


def _measure_push(
    joint: int,
    moves: tuple[int, ...],
    t_s: np.ndarray,
    q: np.ndarray,
    flow: np.ndarray,
    full_speed: float,
    least: float,
) -> ValvePush:
    """Return a push from the positions of the joint that moved most and the flow of the driven valve.

    Args:
        joint: Of the driven valve.
        moves: Joints that moved.
        t_s: Times, `(T,)`.
        q: Positions, `(T,)`.
        flow: Flow of the valve, `(T,)`.
        full_speed: Of the joint by the machine's file.
        least: Way that counts as motion.
    """
    way = q - q[0]
    first = int(np.argmax(np.abs(way) > least))
    sign = int(np.sign(flow[0]))
    # Differences over a longer step: noise over one sample would look like speed.
    step = max(1, round(SPEED_S / max(1e-3, float(np.median(np.diff(t_s))))))
    speed = float((np.abs(q[step:] - q[:-step]) / (t_s[step:] - t_s[:-step])).max(initial=0.0))
    return ValvePush(
        joint=joint,
        sign=sign,
        moves=moves,
        agrees=bool(np.sign(way[first]) == sign),
        dead_time_s=_estimate_onset_s(t_s, way, first) - float(t_s[0]),
        speed=speed,
        ratio=speed / (float(np.abs(flow).max()) * full_speed),
    )


def describe_joint(
    pushes: Sequence[ValvePush], joint: int, names: Sequence[str]
) -> JointResponse | None:
    """Return the response to one valve; `None` before it has been pushed both ways.

    A joint that moved one way only proves neither its sign nor its valve.
    """
    own = [one for one in pushes if one.joint == joint]
    if {one.sign for one in own} != {1, -1}:
        return None
    moved: Counter[int] = Counter()
    for one in own:
        moved.update(one.moves)
    # A joint that moved once among many was moved by somebody else.
    steady = [number for number, count in moved.items() if 2 * count > len(own)]
    return JointResponse(
        valve=names[joint],
        moves=tuple(names[number] for number in sorted(steady)),
        agrees=all(one.agrees for one in own),
        dead_time_s=float(np.median([one.dead_time_s for one in own])),
        speed=max(one.speed for one in own),
        ratio=float(np.median([one.ratio for one in own])),
    )


def _estimate_onset_s(t_s: np.ndarray, moved: np.ndarray, row: int) -> float:
    """Return the beginning of a motion noticed at `row`: a line through the motion, back to zero."""
    # A line through two points of the motion: the threshold itself is passed only after the
    # onset.
    later = min(len(t_s) - 1, int(np.searchsorted(t_s, t_s[row] + ONSET_S)))
    speed = (moved[later] - moved[row]) / max(1e-6, t_s[later] - t_s[row])
    return float(t_s[row] - (moved[row] / speed if speed * moved[row] > 0 else 0.0))
