"""`brokk mode=play`: shows a policy at work, live, and lets a person touch it."""

from __future__ import annotations

import logging
import time
from pathlib import Path

from brokk_rl.errors import CheckpointError
from brokk_rl.play.page import PlayPage
from brokk_rl.play.session import PlaySession
from brokk_rl.play.settings import PlaySettings
from brokk_rl.policy_folder import find_policy
from brokk_rl.rl.loop import SimulatedPlant
from brokk_rl.rl.policy import ClassicalPolicy, PolicySpec, TrainedPolicy, load_policy
from brokk_rl.session import Session
from brokk_rl.spec import name_spec, spec

log = logging.getLogger(__name__)

POLICY, CLASSICAL = "policy", "classical"
"""Names of the drivers, beside the person."""
NUM_STARTS = 256
"""Starts from which episodes begin. Chosen by hand: drawn in less than a second."""
FRAME_S = 1 / 30
"""Time between two pictures, s. Chosen by hand for the eye."""
POLL_S = 2.0
"""Seconds between two looks for a newer checkpoint. Chosen by hand."""


@spec
class Play(SimulatedPlant):
    """Shows a policy at work, live, and lets a person touch it.

    Attributes:
        machine: The machine.
        sim: Physics.
        task: The task.
        actuator: How commands become motion.
        effect: Effects around the actuator model, by name.
        event: Changes of the simulated machine, by name.
        follower: Who stands between policy and machine.
        policy: The policy; that of a running training is loaded anew with each checkpoint.
        play: Page, worlds and pace.
    """

    policy: PolicySpec
    play: PlaySettings

    def run(self) -> None:
        """Show the machines until the person ends it.

        Raises:
            ConfigError: A driver is missing.
            CheckpointError: There is no policy, or it is of another machine or task.
            DeviceError: There is no such GPU.
        """
        session, watch = self._build_session()
        page = PlayPage(session, self.play.port)
        begun_s = last_s = time.monotonic()
        try:
            while self.play.seconds is None or last_s - begun_s < self.play.seconds:
                if watch is not None:
                    watch.poll()
                now_s = time.monotonic()
                session.advance(now_s - last_s)
                last_s = now_s
                page.update()
                time.sleep(max(0.0, FRAME_S - (time.monotonic() - now_s)))
        finally:
            page.close()

    def _build_session(self) -> tuple[PlaySession, CheckpointWatch | None]:
        """Return the session, and the watch of the training that is followed, if any."""
        settings = self.play
        session = Session(out=".", seed=settings.seed, device=settings.device)
        device = session.torch_device()
        session.seed_all()
        pool = max(NUM_STARTS, settings.worlds)
        loop = self.build(device, settings.worlds, pool, session.stream("starts"))
        policies = {}
        if not isinstance(self.policy, ClassicalPolicy):
            policies[POLICY] = self.policy.build(loop, settings.seed)
        if not policies or "classical_action" in loop.task.offers:
            policies[CLASSICAL] = ClassicalPolicy(task=None).build(loop, settings.seed)
        played = PlaySession(loop, policies, settings.neutral)
        if settings.driver not in (POLICY, played.driver):
            played.choose_driver(settings.driver)
        played.speed = settings.speed
        name = f"{name_spec(self.policy)} {getattr(self.policy, 'path', '')}".rstrip()
        log.info("%s drives; policy=%s", played.driver, name)
        if isinstance(self.policy, TrainedPolicy) and find_policy(self.policy.path).is_checkpoint:
            return played, CheckpointWatch(self.policy.path, played)
        return played, None


class CheckpointWatch:
    """Follows a training: the policy that is played is loaded anew with each checkpoint.

    Args:
        path: Run folder, policy folder or checkpoint.
        session: Session in which the policy acts.
    """

    def __init__(self, path: str, session: PlaySession) -> None:
        self._path, self._session = path, session
        self._next_s = 0.0
        self._loaded: Path | None = None

    def poll(self) -> None:
        """Play a policy that is newer than the last one, if there is one.

        A checkpoint that cannot be read, because the training has just replaced it, is tried again.
        """
        now_s = time.monotonic()
        if now_s < self._next_s:
            return
        self._next_s = now_s + POLL_S
        try:
            stored = find_policy(self._path)
            if stored.file == self._loaded:
                return
            policy = load_policy(stored, self._session.loop)
        except CheckpointError as error:
            log.warning("the newest checkpoint is left out: %s", error)
            return
        self._loaded = stored.file
        note = f"{stored.file.parent.name}/{stored.file.name}"
        self._session.replace_policy(POLICY, policy, note)
        log.info("playing %s", note)
