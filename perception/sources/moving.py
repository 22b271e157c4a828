"""A simulated camera on a mount that moves to where it sees the hole, for a desk."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from brokk_rl.contracts.vision import CameraView, TrackedHole
from brokk_rl.errors import FrameError
from brokk_rl.machine import Machine
from brokk_rl.signals import Frame
from brokk_rl.spec import Positive, spec
from perception.mount.mounts import AxesMount, ExpectedCovariance, HoleBelief, ViewPlanner
from perception.sources.simulator import SimulatedCamera


@spec
class MovingCamera:
    """Render the twin's block and arm from a mount that follows the hole.

    Attributes:
        camera: Rig, light and scene; the arm stands where the machine's sensors say.
        mount: Carries the camera.
        next_view: Chooses where it looks.
        machine: The machine.
        hint_m: Error of the place at which the hole is expected before it was seen, 1 sigma.
    """

    camera: SimulatedCamera
    mount: AxesMount
    next_view: ExpectedCovariance
    machine: Machine
    hint_m: Positive

    def build(self) -> MovingSource:
        """Return the source, not yet opened."""
        return MovingSource(self)


class MovingSource:
    """An open moving camera; see `FrameSource` and `AimedSource` of `brokk_rl.contracts.vision`."""

    num_frames = None

    def __init__(self, settings: MovingCamera) -> None:
        self._settings = settings
        self._mount = settings.mount.build(settings.machine)
        rig = settings.camera.rig
        self._planner = ViewPlanner(
            settings.next_view, settings.machine, self._mount, rig, settings.camera.arm
        )
        self._q: np.ndarray | None = None
        self._seen_s, self._t_s = -np.inf, 0.0
        self._count, self._is_taken = -1, False

    def __enter__(self) -> MovingSource:
        self._count = 0
        return self

    def __exit__(self, *exc: Any) -> None:
        self._count = -1

    def aim(self, q: np.ndarray | None, hole: TrackedHole | None, t_s: float) -> CameraView | None:
        """Choose where to look; see `AimedSource.aim`."""
        self._t_s = t_s
        if q is None or not np.isfinite(q).all():
            return None
        self._q, s, planner = q, self._settings, self._planner
        if t_s < planner.arrives_s:  # one motion at a time
            return planner.view
        seen_s = -np.inf if hole is None else hole.seen_s
        if self._is_taken:
            planner.num_missed = 0 if seen_s > self._seen_s else planner.num_missed + 1
        self._seen_s, self._is_taken = seen_s, False
        scene = s.camera.task_scene
        belief = HoleBelief.expect(hole, np.array(scene[:3]), scene[5], s.hint_m)
        # No plan of the arm is known here: it is taken to rest.
        return planner.aim(belief, np.stack([q] * s.next_view.num_times), t_s)

    def read_latest(self) -> Frame:
        """Return a frame of the present scene from the present view.

        Raises:
            FrameError: the source is not open, the machine's positions are unknown, or the camera
                is on its way.
        """
        if self._count < 0:
            raise FrameError("moving camera: not open; use it in a `with` block")
        if self._q is None:
            raise FrameError("moving camera: the machine's positions are not known yet")
        if self._t_s < self._planner.arrives_s:
            raise FrameError("moving camera: on its way, its pictures are not used")
        s, number = self._settings, self._count
        self._count, self._is_taken = number + 1, True
        pose = self._mount.locate(self._planner.position, self._q)
        noise = np.random.default_rng((s.camera.seed, number))
        chain_m = s.camera.arm.trace(s.machine, self._q)
        shot = s.camera.shoot(s.camera.task_scene, chain_m, noise, pose)
        camera = replace(s.camera.rig.model, base_from_camera=pose)
        return camera.build_frame(shot.color, shot.depth_m, self._t_s, shot.right)
