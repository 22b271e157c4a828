"""The window of `mode=play`: one world in MuJoCo's own viewer, moved by keys and mouse."""

from __future__ import annotations

import logging
import queue

import numpy as np

from brokk_rl.play.levers import KEY_STEP, GamepadLevers
from brokk_rl.play.session import PERSON, PlaySession
from brokk_rl.sim.window import SceneWindow

log = logging.getLogger(__name__)

SPACE, ENTER, BACKSPACE, RIGHT, LEFT, DOWN, UP = 32, 257, 259, 262, 263, 264, 265
PAGE_UP, PAGE_DOWN, MINUS, EQUAL = 266, 267, 45, 61
"""Codes of keys, as GLFW has them (`glfw3.h`)."""
FASTER = 1.5
"""Factor of one press of the keys that change the speed. Chosen by hand."""
HELP = (
    "space: pause, enter: one step, backspace: new episode, - and =: speed, page up and down: "
    "driver, up and down: joint, left and right: its lever; ctrl and mouse: pull at a link"
)


class WindowView:
    """The window of one session.

    Args:
        session: The session.
        gamepad: Gamepad of this computer; `None` for none.
    """

    def __init__(self, session: PlaySession, gamepad: GamepadLevers | None) -> None:
        self._session, self._gamepad = session, gamepad
        self._keys: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._joint = 0
        self._window = SceneWindow(session.machine, self._keys.put)
        log.info("%s", HELP)

    def update(self) -> bool:
        """Do what keys and mouse ask for, and show the state; false once the window is closed."""
        if not self._window.is_open:
            return False
        while not self._keys.empty():
            self.press(self._keys.get())
        if self._gamepad is not None and (levers := self._gamepad.read()) is not None:
            self._session.set_levers(levers)
        if self._session.can_push:
            pull = self._window.read_pull()
            self._session.pull_joints(pull if pull.any() else None)
        state = self._session.read()
        scene = None if state.scene is None else state.scene[state.selected]
        self._window.draw(state.q[state.selected], scene, self._write_text())
        return True

    def close(self) -> None:
        """Close the window."""
        self._window.close()

    def press(self, key: int) -> None:
        """Do what a key stands for; see `HELP`."""
        session = self._session
        if key == SPACE:
            session.pause(not session.paused)
        elif key == ENTER:
            session.pause(True)
            session.step()
        elif key == BACKSPACE:
            session.reset(session.selected)
        elif key in (MINUS, EQUAL):
            session.set_speed(session.speed * (FASTER if key == EQUAL else 1 / FASTER))
        elif key in (PAGE_UP, PAGE_DOWN):
            turn = 1 if key == PAGE_DOWN else -1
            number = session.drivers.index(session.driver) + turn
            session.choose_driver(session.drivers[number % len(session.drivers)])
        elif key in (UP, DOWN):
            self._joint = (self._joint + (1 if key == DOWN else -1)) % session.machine.num_joints
        elif key in (LEFT, RIGHT):
            session.nudge_lever(self._joint, KEY_STEP if key == RIGHT else -KEY_STEP)

    def _write_text(self) -> str:
        session, state = self._session, self._session.read()
        pace = "paused" if state.paused else f"{state.rate:.2f} x real time"
        lines = [f"{state.driver}  {state.note}".rstrip(), pace, f"{state.episode_s:.1f} s"]
        if state.driver == PERSON:
            for index, name in enumerate(session.machine.joint_names):
                mark = ">" if index == self._joint else " "
                lines.append(f"{mark} {name} {session.levers[index]:+.2f}")
        finished = int(np.sum(list(state.endings.values())))
        lines.append(f"{state.successes} of {finished} episodes with success")
        return "\n".join(lines)
