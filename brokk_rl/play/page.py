"""The browser's page of `mode=play`: scene, controls and traces, made with viser."""

from __future__ import annotations

import contextlib
import io
import logging
import queue
import socket
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import viser
import viser.uplot as uplot

from brokk_rl.contracts.task import SUCCESS
from brokk_rl.errors import BrokkError, ConfigError
from brokk_rl.play.levers import KEY_STEP, GamepadLevers
from brokk_rl.play.scene_view import SceneView
from brokk_rl.play.session import DISTANCE_M, HEIGHT_M, PERSON, PlaySession, PlayState
from brokk_rl.play.settings import SPEEDS
from brokk_rl.plot import BLUE, ORANGE, OTHERS

log = logging.getLogger(__name__)

HOST = "127.0.0.1"
"""The page listens on this computer only; from elsewhere it is reached through ssh."""
TEXT_S, TRACE_S = 0.25, 0.25
"""Time between two updates of figures and of traces, s. Chosen by hand for the eye."""
DRAWN = 64
"""Worlds that are drawn at most; a browser without a GPU draws no more. Chosen by hand."""
KEYS = (("Q", "A"), ("W", "S"), ("E", "D"), ("R", "F"), ("T", "G"), ("Y", "H"), ("U", "J"))
"""Keys that move the lever of each joint, in machine order: up and down."""
COLORS = (BLUE, ORANGE, *OTHERS)
"""Colour of each joint in the traces."""
PUSHES = {"left": (0, 1, 0), "right": (0, -1, 0), "up": (0, 0, 1), "down": (0, 0, -1)}
"""Directions of a push in the base frame."""
PUSH_N = 4000.0
"""Force of a push at first, N: above what the slewing gear of a Brokk 170 holds at 3 m."""


def require_free_port(port: int) -> None:
    """Raise an error where the page's port is taken.

    Raises:
        ConfigError: Another program listens there.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            raise ConfigError(
                f"play.port={port} cannot be used ({error.strerror}): another program, perhaps "
                f"another mode=play, listens there. End it, or give another port: "
                f"play.port={port + 1 if port < 65535 else 8080}"
            ) from error


class PlayPage:
    """The page of one session, in any number of browsers.

    Args:
        session: The session.
        port: Port on this computer.
        gamepad: Gamepad of this computer; `None` for none.
    """

    def __init__(self, session: PlaySession, port: int, gamepad: GamepadLevers | None) -> None:
        self._session, self._gamepad = session, gamepad
        self._requests: queue.SimpleQueue[Callable[[], object]] = queue.SimpleQueue()
        logging.getLogger("websockets").setLevel(logging.WARNING)
        with contextlib.redirect_stdout(io.StringIO()):  # it prints a table of its own
            self._server = viser.ViserServer(host=HOST, port=port, label="brokk play")
        self._drawn = min(session.loop.num_envs, DRAWN)
        self._scene = SceneView(self._server, session.machine, self._drawn, session.can_move_target)
        self._texts_s = self._traces_s = 0.0
        self._dirty = True
        self._build_controls()
        self._build_traces()
        self._add_keys()
        self._listen_to_handle()

    @property
    def port(self) -> int:
        """Port on which the page listens."""
        return self._server.get_port()

    def update(self) -> bool:
        """Carry out the requests of browsers and show the present state; return true.

        A browser cannot end the session.
        """
        self._follow_requests()
        if self._gamepad is not None and (levers := self._gamepad.read()) is not None:
            self._session.set_levers(levers)
        state, now_s = self._session.read(), time.monotonic()
        with self._server.atomic():
            self._scene.draw(state)
            if now_s - self._texts_s >= TEXT_S:
                self._texts_s = now_s
                self._show_figures(state)
            if now_s - self._traces_s >= TRACE_S and (not state.paused or self._dirty):
                self._traces_s, self._dirty = now_s, False
                self._show_traces()
        return True

    def close(self) -> None:
        """Stop serving."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def _ask(self, request: Callable[[], object]) -> None:
        """Have the simulating thread do something; its errors are shown in the browser."""
        self._requests.put(request)

    def _follow_requests(self) -> None:
        while not self._requests.empty():
            try:
                self._requests.get()()
            except BrokkError as error:
                log.warning("%s", error)
                for client in self._server.get_clients().values():
                    client.add_notification("Not done", str(error), color="red")
            self._dirty = True

    def _build_controls(self) -> None:
        """Build the panel with what a person can do."""
        gui, session = self._server.gui, self._session
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(214, 106, 18))
        gui.set_panel_label("brokk play")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(330)
        self._status = gui.add_markdown("")
        self._driver = gui.add_dropdown("Driver", session.drivers, initial_value=session.driver)
        self._driver.on_update(
            lambda event: self._from_person(event, session.choose_driver, event.target.value)
        )
        if session.loop.num_envs > 1:
            self._world = gui.add_slider("World", 0, session.loop.num_envs - 1, 1, 0)
            self._world.on_update(
                lambda event: self._from_person(event, session.select_world, event.target.value)
            )
        run = gui.add_button_group("Time", ("Pause", "Step", "Reset", "Reset all"))
        run.on_click(lambda event: self._ask(partial(self._press, event.target.value)))
        self._speed = gui.add_slider(
            "Speed", SPEEDS[0], SPEEDS[1], 0.1, session.speed, hint="Share of real time"
        )
        self._speed.on_update(
            lambda event: self._from_person(event, session.set_speed, event.target.value)
        )
        tabs = gui.add_tab_group()
        with tabs.add_tab("Touch"):
            self._build_touch()
        with tabs.add_tab("Levers"):
            self._build_levers()
        with tabs.add_tab("Effects"):
            self._build_dials()

    def _build_touch(self) -> None:
        gui, session = self._server.gui, self._session
        if session.can_move_target:
            place = session.read().target_m
            assert place is not None
            self._target = gui.add_vector3(
                "Target / m",
                tuple(np.round(place[0], 3)),
                min=(-DISTANCE_M[1], -DISTANCE_M[1], HEIGHT_M[0]),
                max=(DISTANCE_M[1], DISTANCE_M[1], HEIGHT_M[1]),
                step=0.01,
                hint="Drag the arrows at the hole, or type: x, y, z from the machine's base",
            )
            self._target.on_update(
                lambda event: self._from_person(
                    event, session.move_target, np.array(event.target.value)
                )
            )
            free = gui.add_button("Draw the target again at each reset")
            free.on_click(lambda _: self._ask(session.free_target))
        if session.can_push:
            force = gui.add_slider("Push / kN", 0.5, 20.0, 0.5, PUSH_N / 1000)
            push = gui.add_button_group("Push the tip", tuple(PUSHES))
            push.on_click(
                lambda event: self._ask(
                    partial(
                        session.push, 1000.0 * force.value * np.array(PUSHES[event.target.value])
                    )
                )
            )
        else:
            gui.add_markdown("*The arm can be pushed with `sim=native`.*")

    def _build_levers(self) -> None:
        gui, session = self._server.gui, self._session
        gui.add_markdown(
            f"Driver **{PERSON}** moves the selected machine. Levers stay where they are; **X** "
            "centres them. An exclusive joint rules out the others."
        )
        self._levers = []
        for joint, name in enumerate(session.machine.joint_names):
            keys = " / ".join(KEYS[joint]) if joint < len(KEYS) else "no key"
            lever = gui.add_slider(f"{name}  ({keys})", -1.0, 1.0, 0.05, 0.0)
            lever.on_update(
                lambda event, joint=joint: self._from_person(
                    event, self._put_lever, joint, event.target.value
                )
            )
            self._levers.append(lever)
        centre = gui.add_button("Centre all levers (X)")
        centre.on_click(lambda _: self._ask(session.release_levers))

    def _build_dials(self) -> None:
        gui, session = self._server.gui, self._session
        if not session.dials:
            gui.add_markdown("*No effects: start with `effect=[library]`, or `effect=[backlash]`.*")
            return
        gui.add_markdown("0 is none, 1 is typical of a machine that has the effect.")
        neutral = gui.add_button("All effects off")
        dials = {}
        for label, dial in session.dials.items():
            size = 0.0 if session.starts_neutral else 1.0
            dials[label] = gui.add_slider(
                f"{dial.effect}: {dial.number}",
                dial.low,
                dial.high,
                0.1,
                min(max(size, dial.low), dial.high),
                hint=f"typical: {dial.typical.tolist()}",
            )
            dials[label].on_update(
                lambda event, label=label: self._from_person(
                    event, session.turn_dial, label, event.target.value
                )
            )

        def turn_all_off() -> None:
            for label, slider in dials.items():
                session.turn_dial(label, 0.0)
                slider.value = 0.0

        neutral.on_click(lambda _: self._ask(turn_all_off))

    def _build_traces(self) -> None:
        """Build the panel with commands, error and observation over time."""
        panel = self._server.gui.add_panel()
        names = self._session.machine.joint_names
        none = np.zeros(1)
        with panel.add_tab("Traces"):
            lines = [uplot.Series(label="t / s")]
            for joint, name in enumerate(names):
                color = COLORS[joint % len(COLORS)]
                lines.append(uplot.Series(label=name, stroke=color, width=1.6))
            for joint, name in enumerate(names):
                color = COLORS[joint % len(COLORS)]
                lines.append(uplot.Series(label=f"{name} proposed", stroke=color, dash=(4, 4)))
            colored = ", ".join(
                f'<b style="color: {COLORS[joint % len(COLORS)]}">{name}</b>'
                for joint, name in enumerate(names)
            )
            self._server.gui.add_html(f"<div style='padding: 0 1em'>Joints: {colored}</div>")
            self._commands = self._plot("Commands in force; dashed: proposed", lines, (-1.05, 1.05))
            self._error = self._plot(
                "Tip from target / cm",
                [
                    uplot.Series(label="t / s"),
                    uplot.Series(label="beside", stroke=COLORS[0], width=1.6),
                    uplot.Series(label="above", stroke=COLORS[1], width=1.6),
                ],
            )
            self._force = self._plot(
                "Contact force / kN",
                [
                    uplot.Series(label="t / s"),
                    uplot.Series(label="force", stroke=COLORS[2], width=1.6),
                ],
            )
        with panel.add_tab("Observation"):
            self._seen = self._server.gui.add_markdown("")
            self._vector = self._server.gui.add_uplot(
                (none, none),
                (
                    uplot.Series(label="entry"),
                    uplot.Series(label="value", stroke=COLORS[0], width=1.2),
                ),
                title="Vector that the policy sees",
                scales={"x": uplot.Scale(time=False), "y": uplot.Scale(range=(-4.0, 4.0))},
                height=230,
            )
        panel.dock_left()
        panel.set_width(380)

    def _plot(
        self, title: str, lines: list[uplot.Series], bounds: tuple[float, float] | None = None
    ) -> Any:
        none = np.zeros(1)
        scales: dict[str, uplot.Scale] = {"x": uplot.Scale(time=False)}
        if bounds:
            scales["y"] = uplot.Scale(range=bounds)
        return self._server.gui.add_uplot(
            (none,) * len(lines),
            tuple(lines),
            title=title,
            scales=scales,
            legend=uplot.Legend(show=False),
            height=190,
        )

    def _add_keys(self) -> None:
        """Bind keys; they work while the pointer is over the page and no field is being edited."""
        gui, session = self._server.gui, self._session

        def bind(label: str, key: Any, request: Callable[[], object]) -> None:
            command = gui.add_command(label, hotkey=key)
            command.on_trigger(lambda _: self._ask(request))

        bind("Pause or go on", "space", partial(self._press, "Pause"))
        bind("One step", "N", partial(self._press, "Step"))
        bind("New episode", "backspace", partial(self._press, "Reset"))
        bind("Centre all levers", "X", session.release_levers)
        for joint, (name, keys) in enumerate(zip(session.machine.joint_names, KEYS, strict=False)):
            for key, sign in zip(keys, (1, -1), strict=True):
                bind(
                    f"{name} {'+' if sign > 0 else '-'}",
                    key,
                    partial(session.nudge_lever, joint, sign * KEY_STEP),
                )

    def _listen_to_handle(self) -> None:
        """Let the target follow the handle that is dragged."""
        handle = self._scene.handle
        if handle is None:
            return

        # a coroutine: viser keeps the order of its calls, which threads would not
        @handle.on_update
        async def _(event: Any) -> None:
            self._scene.hold_handle(event.phase != "end")
            world = self._session.selected
            self._ask(partial(self._session.move_target, self._scene.read_handle(world)))

    def _from_person(self, event: Any, request: Callable[..., object], *values: Any) -> None:
        """Ask for something that a person has changed; what we have set ourselves is left out."""
        if event.client_id is not None:
            self._ask(partial(request, *values))

    def _press(self, button: str) -> None:
        session = self._session
        if button == "Pause":
            session.pause(not session.paused)
        elif button == "Step":
            session.pause(True)
            session.step()
        else:
            session.reset(session.selected if button == "Reset" else None)

    def _put_lever(self, joint: int, value: float) -> None:
        self._session.nudge_lever(joint, value - float(self._session.levers[joint]))

    def _show_figures(self, state: PlayState) -> None:
        """Show status and levers as they are."""
        finished = sum(state.endings.values())
        title = self._session.loop.task.figures[SUCCESS].title
        share = f"{title}: {state.successes} of {finished}" if finished else "no episode finished"
        time_text = "**paused**" if state.paused else f"**{state.rate:.2f} × real time**"
        note = f" · {state.note}" if state.note else ""
        worlds = self._session.loop.num_envs
        shown = f" ({self._drawn} drawn)" if worlds > self._drawn else ""
        endings = ", ".join(f"{name} {count}" for name, count in state.endings.items())
        _assign(
            self._status,
            "content",
            f"{time_text} · {worlds} world{'s' if worlds > 1 else ''}{shown}{note}\n\n"
            f"Episode {state.episode_s:.1f} s · {share}" + (f" ({endings})" if endings else ""),
        )
        for lever, value in zip(self._levers, self._session.levers, strict=True):
            _assign(lever, "value", round(float(value), 2))
        _assign(self._driver, "value", state.driver)
        if state.target_m is not None and self._session.can_move_target:
            place = tuple(round(float(v), 3) for v in state.target_m[state.selected])
            _assign(self._target, "value", place)

    def _show_traces(self) -> None:
        """Show the last seconds of the selected world."""
        traces = self._session.read_traces()
        if not len(traces.t_s):
            return
        t = traces.t_s
        self._commands.data = (t, *traces.given.T, *traces.proposed.T)
        self._error.data = (t, 100 * traces.lateral_m, 100 * traces.height_m)
        self._force.data = (t, traces.force_n / 1000)
        vector = self._session.read_observation()
        self._vector.data = (np.arange(len(vector), dtype=float), vector.astype(float))
        state = self._session.read()
        if state.estimate_m is not None and state.target_m is not None:
            seen, true = state.estimate_m[state.selected], state.target_m[state.selected]
            millimetres = 1000 * np.linalg.norm(seen - true)
            self._seen.content = (
                f"Target seen (blue): {_write_place(seen)}\n\n"
                f"Target true (orange): {_write_place(true)}, {millimetres:.0f} mm away"
            )


def _assign(handle: Any, name: str, value: Any) -> None:
    """Set a property of the page where it differs."""
    if getattr(handle, name) != value:
        setattr(handle, name, value)


def _write_place(point_m: np.ndarray) -> str:
    return ", ".join(f"{value:.3f}" for value in point_m) + " m"
