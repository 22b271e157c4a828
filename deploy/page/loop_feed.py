"""The page beside the loop: a process of its own that reads the outlet and hands wishes to the supervisor.

The slots it reads are overwritten by their writers, who wait for nobody; what it writes are two
pipes that count what they must drop. However slow a browser is, or if this process dies, the loop
feels nothing of it.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.signals import Frame
from deploy.guidance import LeverGuidance, find_full_angles_rad
from deploy.page.protocol import (
    BoreholeChoice,
    DrawReport,
    OperatorRequest,
    PageState,
    RecordingStatus,
    Safety,
    ShownAdvice,
    SourceAge,
    Vector,
)
from deploy.page.scene import locate_borehole, plan_approach
from deploy.page.settings import LINK, PageSettings
from deploy.runtime import operator_state
from deploy.runtime.bus_process import TEXT
from deploy.runtime.perception_process import read_frame
from deploy.runtime.process import Stop
from deploy.runtime.shm_layout import LoopMemory
from deploy.runtime.target import TargetPosition, find_nearest, locate_hole, read_holes

log = logging.getLogger(__name__)

ADVICE_PERIODS = 3
"""Control periods without a new advice from which the last one is stale."""
UP: Vector = (0.0, 0.0, 1.0)
GIVEN = "+"
"""Name of a borehole that perception does not know: one from a file, from the configuration, or
pointed at."""


@dataclass(frozen=True)
class PageProcessConfig:
    """What a page process is to do.

    Attributes:
        page: How to serve.
        machine: The machine.
        guidance: How the levers are shown.
        session: Where the link goes.
        positions_s: Age from which positions are stale.
        levers_s: Age from which the operator's levers are.
        borehole_s: Age from which the borehole is.
        camera_s: Age from which the camera's picture is; `None`: there is no camera.
    """

    page: PageSettings
    machine: Machine
    guidance: LeverGuidance
    session: Session
    positions_s: float
    levers_s: float
    borehole_s: float
    camera_s: float | None = None


def run(stop: Stop, beside: PageProcessConfig, memory: LoopMemory) -> None:
    """Serves the page until it is asked to stop.

    Raises:
        LinkError: the address is taken.
    """
    link = beside.session.folder / LINK

    def tell(address: str) -> None:
        log.info(
            "%s; the link that may also have things done stands in %s",
            address.partition("#")[0],
            link,
        )

    beside.page.serve(stop, beside.machine, LoopFeed(beside, memory), beside.session, tell)


class LoopFeed:
    """See `deploy.page.protocol.PageFeed`.

    Args:
        beside: What is shown, and how.
        memory: Where to read and write.
        clock: Monotonic time in s.
    """

    def __init__(
        self,
        beside: PageProcessConfig,
        memory: LoopMemory,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._beside, self._memory, self._clock = beside, memory, clock
        self._guiding, self._began_s = True, clock()
        machine = beside.machine
        self._full_rad = find_full_angles_rad(beside.guidance.levers or machine.levers)
        self._exclusive = machine.is_exclusive

    def news(self) -> int | None:
        """See `Feed`."""
        return self._memory.advice.peek("number")

    def shown(self) -> PageState:
        """See `Feed`."""
        seen, beside = operator_state.read_snapshot(self._memory), self._beside
        target, controls = self._memory.target.read(), self._memory.controls.read()
        found = self._targets(target)
        aimed = next((one for one in found if one.chosen), None)
        machine, proposed, safety = seen.machine, seen.advice, seen.safety
        recording = controls is not None and bool(controls["recording"])
        ages_s = {
            "positions": (machine and machine.q_age_s, beside.positions_s),
            "levers": (machine and machine.levers_age_s, beside.levers_s),
            "advice": (proposed and proposed.age_s, ADVICE_PERIODS * beside.machine.period_s),
            "borehole": (
                None if target is None else seen.t_s - float(target["t_s"]),
                beside.borehole_s,
            ),
        }
        if beside.camera_s is not None:
            taken_s = self._frame_t_s()
            ages_s["camera"] = (None if taken_s is None else seen.t_s - taken_s, beside.camera_s)
        return PageState(
            t_s=seen.t_s,
            alive=seen.alive,
            guiding=self._guiding,
            advice=proposed and self._advice(proposed),
            own=machine and machine.levers,
            q=machine and machine.q,
            streams=tuple(SourceAge(name, *age) for name, age in ages_s.items()),
            safety=safety
            and Safety(
                safety.commands,
                safety.state,
                safety.trip,
                safety.deadman,
                safety.estop,
                safety.bus_up,
            ),
            recording=RecordingStatus(
                recording,
                seen.t_s - float(controls["recording_t_s"])
                if recording and controls is not None
                else 0.0,
                safety.log_dropped if safety else 0,
            ),
            targets=found,
            path_in_base_m=() if aimed is None or machine is None else self._path(machine.q, aimed),
            block_in_base_m=None,
        )

    def frame(self, after_s: float) -> Frame | None:
        """See `Feed`."""
        slot, taken_s = self._memory.frame, self._frame_t_s()
        if slot is None or taken_s is None or taken_s <= after_s or (record := slot.read()) is None:
            return None
        return read_frame(record)

    def wish(self, wish: OperatorRequest) -> bool:
        """See `Feed`."""
        facts: dict[str, Any] = {}
        if wish.kind in ("target", "point"):
            if any(one.chosen and one.name == wish.value for one in self.shown().targets):
                return True
            place = self._named(wish.value) if wish.kind == "target" else self._pointed(wish.value)
            if place is None:
                return False
            facts = {
                "center_in_base_m": place.center_in_base_m.tolist(),
                "std_m": place.std_m,
                "t_s": place.t_s,
            }
        taken = self._memory.wishes.put(
            json.dumps({"kind": wish.kind, "value": wish.value, **facts}).encode()
        )
        self._say("wish", {"kind": wish.kind, "value": wish.value, "taken": taken, **facts})
        if wish.kind in ("start", "stop"):
            self._guiding = wish.kind == "start"
            return taken or wish.kind == "stop"
        return taken

    def drawn(self, drawn: DrawReport) -> None:
        """See `Feed`; goes into the recording as topic `drawn`."""
        self._say(
            "drawn",
            {
                "advice": drawn.number,
                "at_s": drawn.t_s,
                "round_trip_s": drawn.round_trip_s,
                "page": drawn.page,
            },
        )

    def _say(self, topic: str, values: dict[str, Any]) -> None:
        self._memory.page_log.put(
            TEXT + json.dumps({"topic": topic, "t_s": self._clock(), **values}).encode()
        )

    def _advice(self, proposed: operator_state.Advice) -> ShownAdvice:
        levers = proposed.levers.parts(self._full_rad)
        due_s = 0.0 if levers.button_right else None
        if (
            not levers.button_right
            and proposed.valid
            and np.asarray(proposed.command)[self._exclusive].any()
        ):
            # the policy wants it already; what is shown goes through neutral first, as fast as a
            # hand can
            most_rad = max(map(abs, proposed.levers.angles_rad))
            due_s = max(
                self._beside.machine.period_s, most_rad / self._beside.guidance.max_rate_rad_s
            )
        return ShownAdvice(proposed.valid, proposed.reason, proposed.number, levers, due_s)

    def _frame_t_s(self) -> float | None:
        return self._memory.frame and self._memory.frame.peek("t_s")

    def _targets(self, aim: Any | None) -> tuple[BoreholeChoice, ...]:
        """Returns the boreholes that perception knows, and the one that the advice is for, whoever named it."""
        holes = read_holes(self._memory.holes)
        chosen = None if aim is None else find_nearest(holes, np.array(aim["center_in_base_m"]))
        found = [
            BoreholeChoice(
                str(int(hole["name"])), _to_vector(hole["center_in_base_m"]), _to_vector(hole["axis_in_base"]),
                float(hole["radius_m"]), float(hole["std_m"]), float(hole["score"]), hole is chosen,
            )
            for hole in holes
        ]  # fmt: skip
        if aim is not None and chosen is None:
            radius_m = self._beside.page.borehole_radius_m
            found.append(
                BoreholeChoice(
                    GIVEN,
                    _to_vector(aim["center_in_base_m"]),
                    UP,
                    radius_m,
                    float(aim["std_m"]) or None,
                    None,
                    True,
                )
            )
        return tuple(found)

    def _named(self, name: str) -> TargetPosition | None:
        """Returns where the borehole of that name is."""
        one = next(
            (hole for hole in read_holes(self._memory.holes) if str(int(hole["name"])) == name),
            None,
        )
        return None if one is None else locate_hole(one)

    def _pointed(self, value: str) -> TargetPosition | None:
        """Returns the borehole that a person points at: one that perception knows, else what is measured there."""
        frame = self.frame(-1.0)
        x, y = (float(part) for part in value.split(","))
        found = frame and locate_borehole(frame, x, y, self._beside.page.borehole_radius_m)
        if not frame or not found:
            return None
        known = find_nearest(read_holes(self._memory.holes), found[0])
        return TargetPosition(*found, frame.t_s) if known is None else locate_hole(known)

    def _path(self, q: tuple[float, ...], target: BoreholeChoice) -> tuple[Vector, ...]:
        if not self._guiding or not self._beside.machine.has_bodies:
            return ()
        tip_m = compute_tool_kinematics(self._beside.machine, np.array(q)).tip_in_base_m
        return plan_approach(
            tip_m, np.array(target.center_in_base_m), np.array(target.axis_in_base)
        )


def _to_vector(values: Any) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z
