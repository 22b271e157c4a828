"""A feed without a machine: a simulated state and camera, to see, try and test the page at a desk.

The state is made up from the clock alone: the exclusive joint moves with the button held, then the
others; the operator's levers follow the advice a little late. It claims nothing about a machine or
a policy.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np
from annotated_types import Ge, Interval

from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.machine import Machine
from brokk_rl.signals import Frame
from brokk_rl.spec import NonNegative, Positive, spec
from deploy.guidance import AXES, LeverPositions
from deploy.page.protocol import (
    BoreholeChoice,
    DrawReport,
    InsertionReading,
    LoopHealth,
    OperatorRequest,
    PageState,
    RecordingStatus,
    ShownAdvice,
    SourceAge,
    Vector,
)
from deploy.page.scene import locate_borehole, measure_insertion, plan_approach
from deploy.runtime.operator_state import OperatorState
from deploy.runtime.shared_memory import RecordLayout
from deploy.runtime.target import NEAR_M

# All numbers of this module are chosen by hand, to show something of everything on the page.
EXCLUSIVE_S, OTHERS_S = 5.0, 9.0
"""Length of each part of the programme."""
LEAD_IN_S = 1.5
"""Time for which the button is announced."""
LIMITS_S = {"positions": 0.15, "levers": 0.15, "advice": 0.15, "camera": 1.0, "borehole": 600.0}
"""Age from which each source is stale: about those of the loop."""
DELAY_S = 0.15
"""Delay of messages from which the guard would let nothing pass: that of `conf/guard`."""
BUS_PERIOD_S, REMOTE_PERIOD_S = 0.01, 0.02
"""Between positions, and between messages of the remote, as in the example DBC."""
BLOCK_M = ((1.9, -0.8, 0.0), (3.3, 0.8, 0.75))
UP = (0.0, 0.0, 1.0)
TARGETS = (
    BoreholeChoice("1", (2.6, 0.0, 0.75), UP, 0.06, 0.002, 0.97, False),
    BoreholeChoice("2", (2.25, 0.4, 0.75), UP, 0.06, 0.004, 0.86, False),
    BoreholeChoice("3", (2.95, -0.4, 0.75), UP, 0.06, 0.011, 0.41, False),
)
EYE_M, LOOK_AT_M = np.array([0.1, 0.33, 1.6]), np.array([2.7, 0.0, 0.5])
FOV_RAD = 1.0
"""Across the width."""
NOISE = 0.002
"""Standard deviation of depth over depth, as a stereo camera's at 2 m."""
FARTHEST_M = 12.0
"""Depth beyond which the ground is not measured."""
FINE_GRAIN, COARSE_GRAIN, GRAIN_PX = 9.0, 5.0, 8
"""Standard deviations of the grain of the picture, and the size of the coarse one."""
NOISE_STEP_PX = 37
"""Shift of the noise from frame to frame."""
SEED = 7


@spec
class DemoMachine:
    """A made-up machine: levers, joints, boreholes, camera and point cloud from the clock alone.

    Attributes:
        lag_s: Delay of the operator's levers behind the advice.
        amplitude: Of the commands, of full.
        frames: Whether there are camera pictures and a point cloud.
        width_px: Of the camera.
        height_px: Of the camera.
        rate_hz: Of the camera.
    """

    lag_s: NonNegative
    amplitude: Annotated[float, Interval(gt=0, le=1)]
    frames: bool
    width_px: Annotated[int, Ge(16)]
    height_px: Annotated[int, Ge(16)]
    rate_hz: Positive

    def build(self, machine: Machine) -> DemoFeed:
        """Return it at work."""
        return DemoFeed(self, machine, time.monotonic)


class DemoFeed:
    """Feed of a made-up machine, to try the page; a `deploy.page.protocol.PageFeed`.

    Args:
        demo: Settings.
        machine: The machine.
        clock: Monotonic time in s.
    """

    def __init__(self, demo: DemoMachine, machine: Machine, clock: Callable[[], float]) -> None:
        self._demo, self._machine, self._clock = demo, machine, clock
        self._began_s = clock()
        self._guiding, self._recorded_s = True, self._began_s
        self._recording, self._chosen = False, TARGETS[0].name
        self._camera = (
            DemoCamera(demo.width_px, demo.height_px, BLOCK_M, TARGETS) if demo.frames else None
        )
        self._exclusive = machine.is_exclusive
        self._blank = RecordLayout(OperatorState, machine.num_joints).new()

    def read_advice_number(self) -> int:
        """See `PageFeed`."""
        # Advices come at the control rate, as a policy's would.
        return int((self._clock() - self._began_s) / self._machine.period_s)

    def read_state(self) -> PageState:
        """See `PageFeed`."""
        now_s, machine = self._clock(), self._machine
        t_s = now_s - self._began_s
        number = int(t_s / machine.period_s)
        # The advice changes from period to period, not continuously.
        levers, due_s = self._run_programme(number * machine.period_s)
        targets = tuple(replace(target, chosen=target.name == self._chosen) for target in TARGETS)
        state = self._build_state(now_s, t_s)
        path, insertion = self._place_tool(state.q, targets)
        recorded_s = now_s - self._recorded_s if self._recording else 0.0
        return PageState(
            t_s=now_s,
            alive=True,
            guiding=self._guiding,
            advice=ShownAdvice(True, "valid", number, levers, due_s),
            state=state,
            commands=False,
            streams=self._measure_ages(t_s, number),
            recording=RecordingStatus(self._recording, recorded_s, 0, failed=False),
            health=LoopHealth(0.0, DELAY_S, log_behind=False, supervisor_silent=False),
            targets=targets,
            insertion=insertion,
            path_in_base_m=path,
            block_in_base_m=BLOCK_M,
        )

    def read_frame(self, after_s: float) -> Frame | None:
        """See `PageFeed`."""
        number = int((self._clock() - self._began_s) * self._demo.rate_hz)
        # Frames are numbered by the clock, so that every page sees the same one.
        t_s = self._began_s + number / self._demo.rate_hz
        return self._camera.take_frame(number, t_s) if self._camera and t_s > after_s else None

    def submit(self, request: OperatorRequest) -> bool:
        """See `PageFeed`."""
        if request.kind == "target":
            self._chosen = request.value
        elif request.kind == "point":
            return self._choose_at(*map(float, request.value.split(",")))
        elif request.kind == "record":
            self._recording, self._recorded_s = request.value == "on", self._clock()
        else:
            self._guiding = request.kind == "start"
        return True

    def confirms_stop(self) -> bool:
        """See `PageFeed`; nothing ever moves here."""
        return True

    def report_drawn(self, report: DrawReport) -> None:
        """See `PageFeed`; nothing is recorded."""

    def _build_state(self, now_s: float, t_s: float) -> OperatorState:
        # The operator follows the same programme a little later.
        own, _ = self._run_programme(max(0.0, t_s - self._demo.lag_s))
        lever = np.array([own.left_theta, own.left_psi, own.right_theta, own.right_psi])
        return replace(
            self._blank,
            t_s=now_s,
            q=self._compute_positions(t_s),
            lever=lever,
            button_right=own.button_right,
            deadman=True,
            bus_up=True,
        )

    def _measure_ages(self, t_s: float, number: int) -> tuple[SourceAge, ...]:
        ages_s: dict[str, float | None] = {
            # Ages saw between 0 and the period, as those of a cyclic sender do.
            "positions": t_s % BUS_PERIOD_S,
            "levers": t_s % REMOTE_PERIOD_S,
            "advice": t_s - number * self._machine.period_s,
            "camera": t_s % (1.0 / self._demo.rate_hz) if self._camera else None,
            "borehole": t_s,
        }
        return tuple(SourceAge(name, ages_s[name], limit_s) for name, limit_s in LIMITS_S.items())

    def _place_tool(
        self, q: np.ndarray, targets: tuple[BoreholeChoice, ...]
    ) -> tuple[tuple[Vector, ...], InsertionReading | None]:
        if not self._machine.has_bodies:
            return (), None
        # There is always a chosen one: the demo begins with the first.
        chosen = next(target for target in targets if target.chosen)
        tool = compute_tool_kinematics(self._machine, q)
        insertion = measure_insertion(tool, chosen)
        if not self._guiding:
            return (), insertion
        center_m, axis = np.array(chosen.center_in_base_m), np.array(chosen.axis_in_base)
        return plan_approach(tool.tip_in_base_m, center_m, axis), insertion

    def _choose_at(self, x: float, y: float) -> bool:
        """Choose the borehole at a point of the picture; return whether there is one."""
        # The touch means the newest picture, whatever was drawn before.
        frame = self.read_frame(-1.0)
        found = frame and locate_borehole(frame, x, y, TARGETS[0].radius_m)
        if not found:
            return False
        apart_m = {}
        for one in TARGETS:
            apart_m[one.name] = float(np.linalg.norm(np.array(one.center_in_base_m) - found[0]))
        nearest = min(apart_m, key=lambda name: apart_m[name])
        if apart_m[nearest] > NEAR_M:
            return False
        self._chosen = nearest
        return True

    def _run_programme(self, t_s: float) -> tuple[LeverPositions, float | None]:
        """Return lever positions at `t_s`, and the time until the button is due."""
        u, cycle = np.zeros(self._machine.num_joints), EXCLUSIVE_S + OTHERS_S
        at_s, number = t_s % cycle, int(t_s // cycle)
        alone = at_s < EXCLUSIVE_S and bool(self._exclusive.any())
        if alone:
            # Half a sine: the joint starts and ends at rest; every second time it goes back.
            u[self._exclusive] = (
                self._demo.amplitude
                * np.sin(np.pi * at_s / EXCLUSIVE_S)
                * (1 if number % 2 == 0 else -1)
            )
        else:
            # Others follow full sines, so that they end where they began.
            phase = 2 * np.pi * (at_s - EXCLUSIVE_S) / OTHERS_S
            joints = np.arange(self._machine.num_joints)
            u = np.where(
                self._exclusive,
                0.0,
                self._demo.amplitude
                * np.sin(phase * (1 + joints % 2))
                * (1 - 2 * (joints // 2 % 2)),
            )
        left_s = cycle - at_s
        due_s = 0.0 if alone else left_s if left_s <= LEAD_IN_S and self._exclusive.any() else None
        return compute_lever_positions(self._machine, u, alone), due_s

    def _compute_positions(self, t_s: float) -> np.ndarray:
        """Return the joint positions after these commands, kept within their limits."""
        machine, cycle = self._machine, EXCLUSIVE_S + OTHERS_S
        at_s, number = t_s % cycle, int(t_s // cycle)
        # Half of full speed: the drawn arm moves slowly enough to be followed.
        speed = 0.5 * self._demo.amplitude * machine.max_speed
        done = min(at_s, EXCLUSIVE_S) / EXCLUSIVE_S
        # The integral of the commands above: positions belong to the levers that are shown.
        forth = (1 - np.cos(np.pi * done)) / np.pi * EXCLUSIVE_S
        alone = speed * (forth if number % 2 == 0 else 2 * EXCLUSIVE_S / np.pi - forth)
        phase = 2 * np.pi * max(0.0, at_s - EXCLUSIVE_S) / OTHERS_S
        joints = np.arange(machine.num_joints)
        times = 1 + joints % 2
        others = (
            speed
            * (1 - np.cos(phase * times))
            / times
            * OTHERS_S
            / (2 * np.pi)
            * (1 - 2 * (joints // 2 % 2))
        )
        return np.clip(
            machine.home + np.where(self._exclusive, alone, others), machine.lower, machine.upper
        )


def compute_lever_positions(machine: Machine, u: np.ndarray, button: bool) -> LeverPositions:
    """Return the positions of the machine's own levers, of full, for commands `(J,)`."""
    axes = {(lever.side, lever.axis): 0.0 for lever in machine.levers}
    for lever in machine.levers:
        j = machine.joint_names.index(lever.joint)
        if bool(machine.is_exclusive[j]) == button:
            axes[lever.side, lever.axis] = float(u[j])
    return LeverPositions(*(axes.get(one, 0.0) for one in AXES), button_right=button)


class DemoCamera:
    """Makes frames; the scene stands still, the noise does not.

    Args:
        width: Of the picture, px.
        height: Of the picture, px.
        block: Two opposite corners of the block in the base frame, m.
        holes: Boreholes in its upper face.
    """

    def __init__(
        self, width: int, height: int, block: tuple[Vector, Vector], holes: Sequence[BoreholeChoice]
    ) -> None:
        ahead = (LOOK_AT_M - EYE_M) / np.linalg.norm(LOOK_AT_M - EYE_M)
        # The camera is level: its right is horizontal.
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        self._pose = np.eye(4)
        self._pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], 1)
        self._pose[:3, 3] = EYE_M
        # Pinhole camera by its field of view across the width.
        focal = width / 2 / np.tan(FOV_RAD / 2)
        self._matrix = np.array(
            [[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]]
        )
        v, u = np.mgrid[:height, :width]
        across, down = (u - self._matrix[0, 2]) / focal, (v - self._matrix[1, 2]) / focal
        rays = np.stack([across, down, np.ones_like(u, float)], -1)
        way = rays @ self._pose[:3, :3].T  # one m of depth along each
        chance = np.random.default_rng(SEED)
        self._depth_m, shade = _render_scene(way, block, holes)
        fine = chance.normal(0.0, FINE_GRAIN, (height, width, 1))
        cells = chance.normal(0.0, COARSE_GRAIN, (height // GRAIN_PX + 1, width // GRAIN_PX + 1))
        coarse = cells.repeat(GRAIN_PX, 0).repeat(GRAIN_PX, 1)[:height, :width, None]
        grain = fine + coarse
        self._color = (shade + grain).clip(0, 255).astype(np.uint8)
        # Twice as wide: a shifted window of it serves each frame as fresh noise.
        self._noise = chance.normal(0.0, NOISE, (height, 2 * width)).astype(np.float32)

    def take_frame(self, number: int, t_s: float) -> Frame:
        """Return the `number`-th frame, taken at `t_s`."""
        width = self._color.shape[1]
        start = number * NOISE_STEP_PX % width
        depth_m = self._depth_m * (1.0 + self._noise[:, start : start + width])
        return Frame(self._color, depth_m, self._matrix, self._pose, t_s)


def _render_scene(
    way: np.ndarray, block: tuple[Vector, Vector], holes: Sequence[BoreholeChoice]
) -> tuple[np.ndarray, np.ndarray]:
    """Return depth `(h, w)` in m, float32, NaN where unknown, and colour `(h, w, 3)`.

    The rays `way`, `(h, w, 3)`, begin at `EYE_M`.
    """
    low, high = np.array(block[0]), np.array(block[1])
    with np.errstate(divide="ignore", invalid="ignore"):
        enter, leave = np.sort(np.stack([(low - EYE_M) / way, (high - EYE_M) / way]), 0)
        near, face = enter.max(-1), enter.argmax(-1)
        hit = (near < leave.min(-1)) & (near > 0)
        ground = np.where(way[..., 2] < 0, -EYE_M[2] / way[..., 2], np.nan)
    ground[ground > FARTHEST_M] = np.nan
    depth_m = np.where(hit, near, ground)
    shade = np.where(hit[..., None], np.array([[150.0], [128.0], [186.0]])[face], 96.0) * np.array(
        [1.0, 0.98, 0.93]
    )
    point_m = EYE_M + np.nan_to_num(depth_m)[..., None] * way
    for hole in holes:
        beside_m = np.linalg.norm(point_m[..., :2] - hole.center_in_base_m[:2], axis=-1)
        inside = hit & (face == 2) & (beside_m < hole.radius_m)
        depth_m = np.where(inside, np.nan, depth_m)  # stereo sees nothing in a dark hole
        shade[inside] = 22.0
    shade[np.isnan(depth_m) & ~hit] = [170.0, 200.0, 225.0]
    return depth_m.astype(np.float32), shade
