"""Perception in the loop of a policy: a rendered camera on its mount, the finder and the tracker.

Each environment has a camera of its own. At the camera's rate its view is rendered, with the block
and the arm as they stand, and searched. What was found reaches the tracker after a delay. Then the
next view is chosen. While the camera moves, its pictures are not used. The scene is rendered in a
part of the picture around the expected hole: a person has pointed at the hole, as on the page.

Axes: `N` environments, `J` joints.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge

from brokk_rl.contracts.target import MotionPlan, TargetReading
from brokk_rl.contracts.vision import FinderSpec, HolePose, TrackedHole, TrackerSpec
from brokk_rl.errors import FrameError
from brokk_rl.machine import Machine
from brokk_rl.parallel import map_parallel, use_workers
from brokk_rl.spec import Count, NonNegative, Positive, spec
from perception.calibrate import transforms
from perception.calibrate.extrinsics import CameraExtrinsics
from perception.mount.mounts import AxesMount, ExpectedCovariance, HoleBelief, ViewPlanner
from perception.segment.window import Window
from perception.sources.simulator import SimulatedCamera

Stream = tuple[int, ...]
"""Seed of a stream of random numbers."""
LEAST_HINT_M = 1e-3
"""Least error of a pointed place as the choice of a view takes it: nobody points better."""


@spec
class PerceivedTarget:
    """Find the borehole in rendered pictures of a camera on a mount, in the loop of a policy.

    Attributes:
        camera: Rig, light and stereo; its scene is that of each episode.
        finder: Finds boreholes.
        tracker: Fuses their detections from all views.
        mount: Carries the camera.
        next_view: Chooses where it looks.
        rate_hz: Frames a second.
        delay_s: From the picture to the estimate.
        window_px: Columns and rows of the picture that are rendered and searched.
        hint_m: Error of the place at which a person has pointed, 1 sigma in each direction.
        steady_rad_s: Fastest turn of the camera at which its pictures are sharp.
        num_processes: Processes that render.
    """

    camera: SimulatedCamera
    finder: FinderSpec
    tracker: TrackerSpec
    mount: AxesMount
    next_view: ExpectedCovariance
    rate_hz: Positive
    delay_s: NonNegative
    window_px: tuple[Annotated[int, Ge(64)], Annotated[int, Ge(64)]]
    hint_m: NonNegative
    steady_rad_s: Positive
    num_processes: Count

    def sense(self, machine: Machine, num_envs: int, seed: int) -> PerceivedTargets:
        """Return the cameras of `num_envs` environments."""
        return PerceivedTargets(self, machine, num_envs, seed)


@dataclass(frozen=True)
class _Exposure:
    """One picture to be taken: all that a process needs for it."""

    task_scene: tuple[float, ...]
    chain_m: np.ndarray
    true_pose: np.ndarray
    part: Window
    believed_pose: np.ndarray
    t_s: float
    seed: Stream


class WatchedHole:
    """The camera of one environment: its mount, its tracker and what is known.

    Attributes:
        planner: Where the camera looks.
        hole: The tracked hole, `None` before the first detection.
        history: Of each frame, whether it showed a hole, and the error of the tracked one, m;
            `None` before the first.
    """

    def __init__(
        self, settings: PerceivedTarget, machine: Machine, task_scene: np.ndarray, seed: Stream
    ) -> None:
        generator = np.random.default_rng(seed)
        mount, camera = settings.mount.build(machine), settings.camera
        self._settings, self._machine, self._mount = settings, machine, mount
        self._generator = generator
        self.planner = ViewPlanner(settings.next_view, machine, mount, camera.rig, camera.arm)
        self.task_scene = tuple(float(value) for value in task_scene)
        self.true_m = np.array(self.task_scene[:3])
        self._hint_m = self.true_m + settings.hint_m * generator.standard_normal(3)
        self._tracker = settings.tracker.build()
        self._shared = mount.error.draw(generator, "shared")
        self._view = mount.error.draw(generator, "view")
        self._waiting: deque[tuple[float, Sequence[HolePose] | None, float]] = deque()
        self.hole: TrackedHole | None = None
        self.history: list[tuple[bool, float | None]] = []

    @property
    def center_m(self) -> np.ndarray:
        """Where the hole is believed, `(3,)`: as tracked, else where the person pointed."""
        return self._hint_m if self.hole is None else self.hole.pose.center_m

    def believe(self) -> HoleBelief:
        """Return what is known, for the choice of a view."""
        std_m = max(self._settings.hint_m, LEAST_HINT_M)
        return HoleBelief.expect(self.hole, self._hint_m, self.task_scene[5], std_m)

    def aim(self, plan_q: np.ndarray, t_s: float) -> None:
        """Choose the next view by the arm's planned motion, `(T, J)`, and send the mount there."""
        if self.planner.aim(self.believe(), plan_q, t_s).is_moving:
            self._view = self._mount.error.draw(self._generator, "view")

    def expose(
        self, q: np.ndarray, measured_q: np.ndarray, t_s: float, seed: Stream
    ) -> _Exposure | None:
        """Return the picture to take, `None` where the hole is out of the picture."""
        rig, window = self._settings.camera.rig, self._settings.window_px
        believed = self._mount.locate(self.planner.position, measured_q)
        true = self._mount.locate(self.planner.position, q)
        true = transforms.apply_motion(transforms.apply_motion(true, self._shared), self._view)
        away_m = np.linalg.inv(believed) @ np.append(self.center_m, 1.0)
        if away_m[2] < self._settings.camera.stereo.nearest_m:
            return None
        pixel = rig.left.project(away_m[:3])
        size = np.array([rig.width, rig.height])
        if (pixel < 0).any() or (pixel > size - 1).any():
            return None
        corner = np.clip(np.round(pixel - np.array(window) / 2), 0, size - window).astype(int)
        part = Window(int(corner[0]), int(corner[1]), *window)
        chain_m = self._settings.camera.arm.trace(self._machine, q)
        return _Exposure(self.task_scene, chain_m, true, part, believed, t_s, seed)

    def wait_for(self, holes: Sequence[HolePose] | None, t_s: float) -> None:
        """Take the holes of a picture at `t_s`, known after the delay; `None`: no sharp picture."""
        self._waiting.append((t_s + self._settings.delay_s, holes, t_s))

    def learn(self, now_s: float) -> None:
        """Hand to the tracker what has become known by now."""
        while self._waiting and self._waiting[0][0] <= now_s + 1e-9:
            _, holes, t_s = self._waiting.popleft()
            if holes is not None and t_s >= self.planner.arrives_s - 1e-9:
                self.planner.num_missed = 0 if holes else self.planner.num_missed + 1
            tracked = self._tracker.update(holes or (), t_s)
            near = []
            for hole in tracked:
                if np.linalg.norm(hole.pose.center_m - self._hint_m) < 4 * self._settings.hint_m:
                    near.append(hole)
            # The person's choice: of several holes the surest that was seen most often.
            self.hole = max(near, key=lambda hole: hole.num_frames, default=self.hole)
            error_m = None
            if self.hole is not None:
                error_m = float(np.linalg.norm(self.hole.pose.center_m - self.true_m))
            self.history.append((bool(holes), error_m))


class PerceivedTargets:
    """Rendered cameras, finder and trackers of all environments; a `brokk_rl.contracts.target.TargetSensor`."""

    def __init__(
        self, settings: PerceivedTarget, machine: Machine, num_envs: int, seed: int
    ) -> None:
        self._settings, self._machine, self._seed = settings, machine, seed
        self._mount = settings.mount.build(machine)
        self._finder = settings.finder.build()
        self._attended = np.zeros(num_envs, bool)
        self._steps = np.zeros(num_envs, int)
        self._before: np.ndarray | None = None
        self._episodes = np.zeros(num_envs, int)
        self.watched: list[WatchedHole] = []
        self.ended: list[WatchedHole] = []
        """Episodes that have ended, in this order."""
        self._every = max(1, round(1.0 / (settings.rate_hz * machine.period_s)))

    def reset(self, mask: np.ndarray, start: dict[str, np.ndarray]) -> None:
        """Begin new episodes; see `TargetSensor.reset`."""
        for number in np.flatnonzero(mask):
            stream = (self._seed, int(number), int(self._episodes[number]))
            one = WatchedHole(self._settings, self._machine, start["scene"][number], stream)
            if len(self.watched) <= number:
                self.watched.append(one)
            else:
                if self._attended[number]:
                    self.ended.append(self.watched[number])
                self.watched[number] = one
            self._steps[number] = 0
            self._episodes[number] += 1

    def begin(self) -> None:
        """Forget all episodes, and look everywhere; see `TargetSensor.begin`."""
        self.watched, self.ended = [], []
        self._episodes[:], self._attended[:] = 0, True

    def attend(self, mask: np.ndarray) -> None:
        """Sense in some environments alone; see `TargetSensor.attend`."""
        self._attended = mask.copy()

    def read(self, q: np.ndarray, measured_q: np.ndarray, plan: MotionPlan) -> TargetReading:
        """Return the estimates; see `TargetSensor.read`."""
        due = np.flatnonzero(self._attended & (self._steps % self._every == 0))
        if len(due):
            self._look(due, q, measured_q)
            self._choose_views(due, measured_q, plan)
        self._before = q.copy()
        now_s = self._steps * self._machine.period_s
        for number in np.flatnonzero(self._attended):
            self.watched[number].learn(float(now_s[number]))
        self._steps[self._attended] += 1
        target_m = np.stack([one.center_m for one in self.watched])
        is_known = np.array([one.hole is not None for one in self.watched])
        return TargetReading(target_m, is_known & self._attended)

    def summarize(self) -> dict[str, Any]:
        """Return figures of the episodes; see `TargetSensor.summarize`."""
        seen, errors_m, num_known = [], [], 0
        for one in self.ended:
            seen += [is_seen for is_seen, _ in one.history]
            num_known += sum(error_m is not None for _, error_m in one.history)
            if one.history and one.history[-1][1] is not None:
                errors_m.append(one.history[-1][1])
        return {
            "frames": len(seen),
            "seen_share": float(np.mean(seen)) if seen else None,
            "known_share": num_known / len(seen) if seen else None,
            "never_seen": sum(one.hole is None for one in self.ended),
            "last_error_m": {
                "median": float(np.median(errors_m)) if errors_m else None,
                "p95": float(np.quantile(errors_m, 0.95)) if errors_m else None,
            },
        }

    def _look(self, due: np.ndarray, q: np.ndarray, measured_q: np.ndarray) -> None:
        """Take and search the pictures that are due."""
        asked: list[tuple[int, _Exposure]] = []
        for number in due:
            one, t_s = self.watched[number], float(self._steps[number] * self._machine.period_s)
            seed = (self._seed, int(number), int(self._steps[number]))
            if t_s < one.planner.arrives_s - 1e-9 or not self._is_steady(one, int(number), q):
                one.wait_for(None, t_s)
                continue
            exposure = one.expose(q[number], measured_q[number], t_s, seed)
            if exposure is None:
                one.wait_for((), t_s)
            else:
                asked.append((int(number), exposure))
        with use_workers(self._settings.num_processes):
            found = map_parallel(lambda item: self._search(item[1]), asked)
        for (number, exposure), holes in zip(asked, found, strict=True):
            self.watched[number].wait_for(holes, exposure.t_s)

    def _is_steady(self, one: WatchedHole, number: int, q: np.ndarray) -> bool:
        """Return whether the arm does not swing the camera faster than a picture allows."""
        if self._before is None or self._steps[number] == 0:
            return True
        poses = self._mount.locate(
            one.planner.position, np.stack([self._before[number], q[number]])
        )
        if poses.ndim == 2:
            return True
        cosine = (np.trace(poses[0, :3, :3].T @ poses[1, :3, :3]) - 1.0) / 2.0
        turn_rad = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
        return turn_rad <= self._settings.steady_rad_s * self._machine.period_s

    def _choose_views(self, due: np.ndarray, q: np.ndarray, plan: MotionPlan) -> None:
        s = self._settings.next_view
        target_m = np.stack([one.center_m for one in self.watched])
        if len(self._mount.views) < 2:
            return
        step_s = s.horizon_s / (s.num_times - 1)
        planned = plan(target_m, s.num_times, step_s)
        for number in due:
            one, t_s = self.watched[number], float(self._steps[number] * self._machine.period_s)
            if t_s >= one.planner.arrives_s - 1e-9:  # one motion at a time
                plan_q = planned[number]
                if one.hole is None:  # the machine rests until the hole was seen
                    plan_q = np.repeat(q[number][None], s.num_times, 0)
                one.aim(plan_q, t_s)

    def _search(self, exposure: _Exposure) -> list[HolePose]:
        """Render a picture, and return the holes that are found in it, in the base frame."""
        camera, noise = self._settings.camera, np.random.default_rng(exposure.seed)
        place = exposure.true_pose, exposure.part
        shot = camera.shoot(exposure.task_scene, exposure.chain_m, noise, *place)
        believed = CameraExtrinsics(exposure.believed_pose, self._mount.error.covariance)
        model = camera.rig.model.crop(exposure.part).place(believed)
        frame = model.build_frame(shot.color, shot.depth_m, exposure.t_s, shot.right)
        try:
            return list(self._finder.find(frame).in_base_frame(frame).holes)
        except FrameError:  # the arm fills the picture: no depth
            return []
