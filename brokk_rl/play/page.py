"""The browser's page of `mode=play`: scene, controls and traces, made with viser."""

from __future__ import annotations

import contextlib
import io
import itertools
import logging
import math
import queue
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import viser
import viser.uplot as uplot
from mjviser import ViserMujocoScene
from mjviser.conversions import merge_geoms

from brokk_rl.contracts.task import SUCCESS
from brokk_rl.errors import BrokkError
from brokk_rl.machine import Machine
from brokk_rl.play.session import KEY_STEP, PERSON, PlaySession
from brokk_rl.play.settings import SPEEDS
from brokk_rl.plot import BLUE, ORANGE, OTHERS
from brokk_rl.sim.posed_scene import PosedScene
from brokk_rl.sim.scene import FAR_M

log = logging.getLogger(__name__)

HOST = "127.0.0.1"
"""The page listens on this computer only; from elsewhere it is reached through ssh."""
SHOW_S = 0.25
"""Time between two updates of figures and traces, s. Chosen by hand for the eye."""
MOST_DRAWN = 64
"""Worlds that are drawn at most; a browser without a GPU draws no more. Chosen by hand."""
KEYS = (("Q", "A"), ("W", "S"), ("E", "D"), ("R", "F"), ("T", "G"), ("Y", "H"), ("U", "J"))
"""Keys that move the lever of each joint, in machine order: up and down."""
COLORS = (BLUE, ORANGE, *OTHERS)
"""Colour of each joint in the traces."""
PUSHES = {"left": (0, 1, 0), "right": (0, -1, 0), "up": (0, 0, 1), "down": (0, 0, -1)}
"""Directions of a push in the base frame."""
PUSH_N = 4000.0
"""Force of a push at first, N: above what the slewing gear of a Brokk 170 holds at 3 m."""
SPACING_M = (9.0, 6.5)
"""Distance of neighbouring worlds along x and y. Chosen by hand: arms of two do not meet."""
TRUE, SEEN = (230, 90, 40), (40, 120, 220)
"""Colours of the true target and of the policy's estimate."""
CAMERA_M, LOOK_AT_M = (4.9, -5.4, 3.3), (1.3, 0.0, 0.8)
"""Place of the camera and what it looks at, for one world. Chosen by hand for the eye."""
MARK_M = 0.05
"""Diameter of the mark at a target, m. Chosen by hand for the eye."""


class PlayPage:
    """The page of one session, in any number of browsers.

    Args:
        session: The session.
        port: Port on this computer; the next free one where it is taken.
    """

    def __init__(self, session: PlaySession, port: int) -> None:
        self._session = session
        self._requests: queue.SimpleQueue[Callable[[], object]] = queue.SimpleQueue()
        logging.getLogger("websockets").setLevel(logging.WARNING)
        with contextlib.redirect_stdout(io.StringIO()):  # it prints a table of its own
            self._server = viser.ViserServer(host=HOST, port=port, label="brokk play")
        self._num_drawn = min(session.loop.num_envs, MOST_DRAWN)
        self._scene = SceneView(
            self._server, session.machine, self._num_drawn, session.can_move_target
        )
        self._shown_s = 0.0
        self._build_controls()
        self._build_traces()
        self._add_keys()
        self._listen_to_handle()
        at = self._server.get_port()
        log.info("open http://localhost:%d in a browser; end with Ctrl-C", at)
        log.info("over ssh: ssh -L %d:localhost:%d <this computer>, then the same link", at, at)

    def update(self) -> None:
        """Carry out the requests of browsers and show the present state."""
        self._follow_requests()
        state, now_s = self._session.read(), time.monotonic()
        with self._server.atomic():
            self._scene.draw(state, self._session.selected)
            if now_s - self._shown_s >= SHOW_S:
                self._shown_s = now_s
                self._show_figures()
                self._show_traces()

    def close(self) -> None:
        """Stop serving."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def _ask(self, request: Callable[..., object], *values: Any) -> None:
        """Have the simulating thread do something; its errors are shown in the browser."""
        self._requests.put(partial(request, *values))

    def _ask_on_change(self, control: Any, request: Callable[[Any], object]) -> None:
        """Have `request(value)` done whenever a person, not the program, changes a control."""

        @control.on_update
        def _(event: Any) -> None:
            if event.client_id is not None:
                self._ask(request, event.target.value)

    def _ask_on_click(self, control: Any, request: Callable[[Any], object]) -> None:
        """Have `request(value)` done whenever a person clicks a button, or one of a group."""
        control.on_click(lambda event: self._ask(request, event.target.value))

    def _follow_requests(self) -> None:
        """Do what was asked for."""
        while not self._requests.empty():
            try:
                self._requests.get()()
            except BrokkError as error:
                log.warning("%s", error)
                for client in self._server.get_clients().values():
                    client.add_notification("Not done", str(error), color="red")

    def _build_controls(self) -> None:
        """Build the panel with what a person can do."""
        gui, session = self._server.gui, self._session
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(214, 106, 18))
        gui.set_panel_label("brokk play")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(330)
        self._status = gui.add_markdown("")
        driver = gui.add_dropdown("Driver", session.drivers, initial_value=session.driver)
        self._ask_on_change(driver, session.choose_driver)
        if session.loop.num_envs > 1:
            world = gui.add_slider("World", 0, session.loop.num_envs - 1, 1, 0)
            self._ask_on_change(world, session.select_world)
        run = gui.add_button_group("Time", ("Pause", "Step", "Reset", "Reset all"))
        self._ask_on_click(run, self._press)
        speed = gui.add_slider("Speed", *SPEEDS, 0.1, session.speed, hint="Share of real time")
        self._ask_on_change(speed, partial(setattr, session, "speed"))
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
            gui.add_markdown("Drag the arrows at the target; it stays there until **Reset**.")
        if not session.can_push:
            gui.add_markdown("*The arm can be pushed with `sim=native`.*")
            return
        force = gui.add_slider("Push / kN", 0.5, 20.0, 0.5, PUSH_N / 1000)
        push = gui.add_button_group("Push the tip", tuple(PUSHES))
        self._ask_on_click(
            push, lambda name: session.push(1000.0 * force.value * np.array(PUSHES[name]))
        )

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
            self._ask_on_change(lever, partial(session.put_lever, joint))
            self._levers.append(lever)

    def _build_dials(self) -> None:
        gui, session = self._server.gui, self._session
        if not session.dials:
            gui.add_markdown("*No effects: start with `effect=[library]`, or `effect=[backlash]`.*")
            return
        gui.add_markdown("0 is none, 1 is typical of a machine that has the effect.")
        size = 0.0 if session.starts_neutral else 1.0
        for name, dial in session.dials.items():
            slider = gui.add_slider(
                name,
                dial.low,
                dial.high,
                0.1,
                min(max(size, dial.low), dial.high),
                hint=f"typical: {dial.typical.tolist()}",
            )
            self._ask_on_change(slider, dial.turn)

    def _build_traces(self) -> None:
        """Build the panel with commands, error and observation over time."""
        gui, panel = self._server.gui, self._server.gui.add_panel()
        colors = list(itertools.islice(itertools.cycle(COLORS), self._session.machine.num_joints))
        names = self._session.machine.joint_names
        with panel.add_tab("Traces"):
            pairs = zip(names, colors, strict=True)
            colored = [f'<b style="color: {color}">{name}</b>' for name, color in pairs]
            gui.add_html(f"<div style='padding: 0 1em'>Joints: {', '.join(colored)}</div>")
            title = "Commands in force; dashed: proposed"
            self._commands = self._plot(title, colors, dashed=colors, bounds=(-1.05, 1.05))
            self._error = self._plot("Tip from target / cm: beside, above", COLORS[:2])
            self._force = self._plot("Contact force / kN", COLORS[2:3])
        panel.dock_left()
        panel.set_width(380)

    def _plot(
        self,
        title: str,
        colors: Sequence[str],
        dashed: Sequence[str] = (),
        bounds: tuple[float, float] | None = None,
    ) -> viser.GuiUplotHandle:
        """Return a plot over time with a line of each colour, and dashed ones after them."""
        lines = [uplot.Series(stroke=color, width=1.6) for color in colors]
        lines += [uplot.Series(stroke=color, dash=(4, 4)) for color in dashed]
        scales = {"x": uplot.Scale(time=False)}
        if bounds:
            scales["y"] = uplot.Scale(range=bounds)
        return self._server.gui.add_uplot(
            (np.zeros(1),) * (1 + len(lines)),
            (uplot.Series(), *lines),
            title=title,
            scales=scales,
            legend=uplot.Legend(show=False),
            height=190,
        )

    def _add_keys(self) -> None:
        """Bind keys; they work while the pointer is over the page and no field is being edited."""
        session = self._session
        self._bind_key("Pause or go on", "space", self._press, "Pause")
        self._bind_key("One step", "N", self._press, "Step")
        self._bind_key("New episode", "backspace", self._press, "Reset")
        self._bind_key("Centre all levers", "X", session.release_levers)
        for joint, (name, keys) in enumerate(zip(session.machine.joint_names, KEYS, strict=False)):
            up, down = keys
            self._bind_key(f"{name} +", up, session.nudge_lever, joint, KEY_STEP)
            self._bind_key(f"{name} -", down, session.nudge_lever, joint, -KEY_STEP)

    def _bind_key(self, label: str, key: Any, request: Callable[..., object], *values: Any) -> None:
        command = self._server.gui.add_command(label, hotkey=key)
        command.on_trigger(lambda _: self._ask(request, *values))

    def _listen_to_handle(self) -> None:
        """Let the target follow the handle that is dragged."""
        handle = self._scene.handle
        if handle is None:
            return

        # A coroutine: viser keeps the order of its calls, which threads would not.
        @handle.on_update
        async def _(event: Any) -> None:
            self._scene.is_dragged = event.phase != "end"
            self._ask(self._session.move_target, self._scene.read_handle(self._session.selected))

    def _press(self, button: str) -> None:
        session = self._session
        if button == "Pause":
            session.paused = not session.paused
        elif button == "Step":
            session.paused = True
            session.step()
        else:
            session.reset(session.selected if button == "Reset" else None)

    def _show_figures(self) -> None:
        """Show status and levers as they are."""
        session = self._session
        pace = "paused" if session.paused else f"{session.measure_rate():.2f} × real time"
        worlds = f"worlds: {session.loop.num_envs}, drawn: {self._num_drawn}"
        finished = sum(session.endings.values())
        endings = ", ".join(f"{name} {count}" for name, count in session.endings.items())
        title = session.loop.task.figures[SUCCESS].title
        results = f"{title}: {session.successes} of {finished} {endings and f'({endings})'}"
        lines = [f"**{pace}** · {worlds}", session.note]
        lines.append(f"Episode {session.episode_s:.1f} s · {results}")
        # viser sends a browser only what differs
        self._status.content = "\n\n".join(filter(None, lines))
        for lever, value in zip(self._levers, session.levers, strict=True):
            lever.value = round(float(value), 2)

    def _show_traces(self) -> None:
        """Show the last seconds of the selected world."""
        traces = self._session.read_traces()
        if not traces:
            return
        t_s = traces["t_s"]
        self._commands.data = (t_s, *traces["given"].T, *traces["proposed"].T)
        self._error.data = (t_s, 100 * traces["lateral_m"], 100 * traces["height_m"])
        self._force.data = (t_s, traces["force_n"] / 1000)


class SceneView:
    """Everything in the scene; mjviser draws a link of all worlds at once.

    Args:
        server: Browser's server.
        machine: The machine.
        num_worlds: Worlds that are drawn.
        can_move: Whether the target has a handle.
    """

    def __init__(
        self, server: viser.ViserServer, machine: Machine, num_worlds: int, can_move: bool
    ) -> None:
        self._server, self._num_worlds = server, num_worlds
        self._posed = PosedScene(machine)
        self._offsets = place_worlds(num_worlds)
        self._blocks: dict[int, tuple[np.ndarray, viser.GlbHandle]] = {}
        self.is_dragged = False
        model = self._posed.model
        # mjviser draws once what is welded to the ground; a base stands in every world.
        model.body_weldid[1:] = np.arange(1, model.nbody)
        # Blocks differ between worlds and are drawn one by one: the shared one is transparent.
        model.geom_rgba[self._posed.block_geoms, 3] = 0.0
        self._machines = ViserMujocoScene(server, model, num_worlds)
        self._machines.camera_tracking_enabled = False
        model.geom_rgba[self._posed.block_geoms, 3] = 1.0
        self._set_up_stage()
        self._marks = {}
        for name, color in (("target_m", TRUE), ("estimate_m", SEEN)):
            self._marks[name] = server.scene.add_point_cloud(
                f"/{name}",
                self._offsets.astype(np.float32),
                color,
                point_size=MARK_M,
                point_shape="circle",
                precision="float32",
                visible=False,
            )
        self.handle: viser.TransformControlsHandle | None = None
        if can_move:
            self.handle = server.scene.add_transform_controls(
                "/hole", scale=0.55, disable_rotations=True, depth_test=False, opacity=0.85
            )

    def draw(self, state: Mapping[str, np.ndarray], selected: int) -> None:
        """Show a state; the handle is at the target of the `selected` world."""
        places, turns = self._posed.locate_bodies(state["q"][: self._num_worlds])
        self._machines.update_from_arrays(places + self._offsets[:, None], turns)
        for name, mark in self._marks.items():
            mark.visible = name in state
            if name in state:
                points = state[name][: self._num_worlds] + self._offsets
                mark.points = points.astype(np.float32)
        for world, scene in enumerate(state.get("scene", ())[: self._num_worlds]):
            self._draw_block(world, scene)
        if self.handle is not None and not self.is_dragged:
            offset = self._offsets[min(selected, self._num_worlds - 1)]
            self.handle.position = tuple(state["target_m"][selected] + offset)

    def read_handle(self, world: int) -> np.ndarray:
        """Return the place of the handle in the base frame of a world, `(3,)`."""
        assert self.handle is not None
        return np.asarray(self.handle.position, float) - self._offsets[world]

    def _set_up_stage(self) -> None:
        """Set light, ground and camera."""
        scene = self._server.scene
        scene.set_up_direction("+z")
        scene.configure_environment_map("park", environment_intensity=0.9)
        scene.add_grid("/ground", width=60.0, height=60.0, plane_opacity=1.0, shadow_opacity=0.35)
        camera = self._server.initial_camera
        middle, extent = self._offsets.mean(0), np.ptp(self._offsets, axis=0)
        away = 1.0 + float(np.hypot(*extent[:2])) / 9.0
        camera.position = tuple(np.array(CAMERA_M) * away + middle)
        camera.look_at = tuple(np.array(LOOK_AT_M) + middle)
        camera.fov = math.radians(50.0)

    def _draw_block(self, world: int, scene: np.ndarray) -> None:
        """Put the block of a world in its place; its shape is sent anew only where it differs."""
        shape, handle = self._blocks.get(world, ((), None))
        if handle is None or not np.array_equal(shape, scene[4:]):
            self._posed.set_scene(scene)
            mesh = merge_geoms(self._posed.model, self._posed.block_geoms)
            handle = self._server.scene.add_mesh_trimesh(f"/block/{world}", mesh)
            self._blocks[world] = scene[4:].copy(), handle
        x, y, rim_z, yaw = scene[:4]
        handle.position = tuple(np.array([x, y, rim_z]) + self._offsets[world])
        handle.wxyz = (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
        handle.visible = math.hypot(x, y) < FAR_M


def place_worlds(num_worlds: int) -> np.ndarray:
    """Return the place of each world in the scene, `(N, 3)`: rows along x, the first at the origin."""
    columns = math.ceil(math.sqrt(num_worlds))
    index = np.arange(num_worlds)
    x_m, y_m = index // columns * -SPACING_M[0], index % columns * SPACING_M[1]
    return np.stack((x_m, y_m, np.zeros(num_worlds)), 1)
