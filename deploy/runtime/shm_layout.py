"""The records that the processes of the loop share, as numpy fields.

`J` joints; times are monotonic, in s; 0 where nothing has come.

`STATE` is written by the bus process, `ADVICE` by the policy, `REQUEST` by whoever commands valves
on purpose, `TARGET` by what knows the borehole, `CONTROLS` by the operator's side, `FRAME` and
`HOLES` by perception.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from deploy.runtime.shared_memory import Pipe, Slot

PIPE_BYTES = 8 << 20
"""About two minutes of a full bus."""


def build_state_fields(num_joints: int) -> np.dtype:
    """Returns the fields of the machine's state as the bus has it."""
    each = (float, (num_joints,))
    return np.dtype(
        [
            ("t_s", float),
            ("q", *each),  # rad or m
            ("q_t_s", float),  # of the oldest of them
            ("q_plausible", bool),
            ("flow", *each),  # what the valves got last, of full
            ("flow_sum", *each),  # over all messages so far, for means over any period
            ("flow_number", np.uint64),
            ("flow_t_s", float),
            (
                "lever",
                float,
                (4,),
            ),  # the operator's own, of full: left theta, psi, right theta, psi
            ("button_right", bool),
            ("deadman", bool),
            ("remote_on", bool),
            ("levers_t_s", float),
            ("estop", bool),
            ("exclusive_selected", bool),
            ("status_t_s", float),
            ("oil_c", float),
            (
                "held_up_s",
                float,
            ),  # how much later than at best the last positions came, by the gateway's clock
            ("bus_up", bool),
            ("trusted", bool),
            ("alone", bool),
            ("guard", np.int8),  # deploy.guard.guard.GuardState
            ("trip", np.int8),  # index into deploy.guard.guard.GuardTrip
            ("cause", np.int8),
            ("sent", *each),
            ("frames", np.uint64),
            ("refused", np.uint64),
            ("lost", np.uint64),
            ("missed", np.uint64),  # cycles
        ]
    )


def build_advice_fields(num_joints: int) -> np.dtype:
    """Returns the fields of what the policy proposes."""
    return np.dtype(
        [
            ("t_s", float),
            ("number", np.uint64),
            ("reason", np.int8),  # index into deploy.runtime.adviser.Advised; 0: valid
            ("u", float, (num_joints,)),  # zero unless valid
            ("lever_rad", float, (4,)),  # to show: left theta, psi, right theta, psi
            ("button_right", bool),
            ("target_in_base_m", float, (3,)),
            ("infer_s", float),
        ]
    )


def build_request_fields(num_joints: int) -> np.dtype:
    """Returns the fields of a command that somebody wants sent."""
    return np.dtype([("t_s", float), ("u", float, (num_joints,))])


def build_frame_fields(num_px: int) -> np.dtype:
    """Returns the fields of a camera's frame of `num_px` pixels at most; see `brokk_rl.signals.Frame`."""
    return np.dtype(
        [
            ("t_s", float),
            ("width", np.uint16),
            ("height", np.uint16),
            ("color", np.uint8, (num_px, 3)),  # RGB, row by row
            ("depth_m", np.float32, (num_px,)),  # NaN where unknown
            ("camera_matrix", float, (3, 3)),
            ("base_from_camera", float, (4, 4)),  # NaN where nobody knows it
        ]
    )


MOST_HOLES = 8
HOLE = np.dtype(
    [
        ("name", np.uint16),
        ("center_in_base_m", float, (3,)),
        ("axis_in_base", float, (3,)),
        ("radius_m", float),
        ("std_m", float),
        ("score", float),  # that it is one, in [0, 1]
        ("t_s", float),  # when it was seen last
    ]
)
"""A borehole that perception knows."""

HOLES = np.dtype([("t_s", float), ("count", np.uint8), ("holes", HOLE, (MOST_HOLES,))])
"""All that it knows."""

TARGET = np.dtype([("t_s", float), ("center_in_base_m", float, (3,)), ("std_m", float)])
"""The borehole: when it was found, the centre of its rim, and the standard deviation of that."""

CONTROLS = np.dtype(
    [("t_s", float), ("armed", bool), ("recording", bool), ("recording_t_s", float)]
)
"""What the operator's side wants: commands to be sent at all; and whether all this is recorded,
since when."""


@dataclass
class LoopMemory:
    """Everything that the processes share; goes to each of them as it is.

    Attributes:
        state: From the bus process.
        advice: From the policy.
        request: Commands to be sent; `None` where nothing ever is.
        target: The borehole.
        controls: From the operator's side.
        frame: Newest frame of the camera; `None` without one.
        holes: Boreholes that perception knows.
        bus_log: From the bus process to the log.
        policy_log: From the policy to the log.
        page_log: From the operator's page to the log.
        sight_log: From perception to the log.
        wishes: From the operator's page to the supervisor, a JSON text each.
        reports: What each process says of its timing when it ends; one after the other.
    """

    state: Slot
    advice: Slot
    request: Slot | None
    target: Slot
    controls: Slot
    frame: Slot | None
    holes: Slot
    bus_log: Pipe
    policy_log: Pipe
    page_log: Pipe
    sight_log: Pipe
    wishes: Pipe
    reports: Pipe

    @classmethod
    def new(cls, num_joints: int, commands: bool, frame_px: int = 0) -> LoopMemory:
        """Returns a fresh one.

        Args:
            num_joints: Of the machine.
            commands: Without, there is no way from anybody to the valves.
            frame_px: Pixels of a camera's frame; 0: no camera.
        """
        return cls(
            state=Slot("state", build_state_fields(num_joints)),
            advice=Slot("advice", build_advice_fields(num_joints)),
            request=Slot("request", build_request_fields(num_joints)) if commands else None,
            target=Slot("target", TARGET),
            controls=Slot("controls", CONTROLS),
            frame=Slot("frame", build_frame_fields(frame_px)) if frame_px else None,
            holes=Slot("holes", HOLES),
            bus_log=Pipe("bus_log", PIPE_BYTES),
            policy_log=Pipe("policy_log", PIPE_BYTES),
            page_log=Pipe("page_log", PIPE_BYTES),
            sight_log=Pipe("sight_log", 1 << 20),
            wishes=Pipe("wishes", 1 << 12),
            reports=Pipe("reports", 1 << 16),
        )

    @property
    def logs(self) -> tuple[Pipe, ...]:
        """All that goes to the log."""
        return self.bus_log, self.policy_log, self.page_log, self.sight_log

    @property
    def files(self) -> list[int]:
        """File descriptors that child processes inherit."""
        return [part.memory.fd for part in vars(self).values() if part is not None]

    def close(self) -> None:
        """Lets go of all of it."""
        for part in vars(self).values():
            if part is not None:
                part.memory.close()


def measure_wall_offset_ns() -> int:
    """Returns what makes a wall-clock time of a monotonic one, taken once: later steps of the wall clock change nothing."""
    return time.time_ns() - time.monotonic_ns()
