"""A simulated participant at the twin, in real time: a browser's connections, a remote on the bus, a person's hands between them.

The participant gets only the messages to the page, presses the same buttons as a person, and
moves the remote's levers as the simulated operators of `conf/operator` do. All its results are
marked as simulated.
"""

from __future__ import annotations

import asyncio
import json
import logging
import math
import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from websockets.asyncio.client import ClientConnection, connect

from brokk_rl.contracts.link import Connection
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.spec import name_spec, spec
from deploy.bus.can_bus import CanBus
from deploy.bus.description import BusDescription
from deploy.guidance import AXES, LeverGuidance, LeverMap, find_full_angles_rad
from deploy.page.settings import LINK
from deploy.runtime.process import CycleTimer, Stop
from deploy.runtime.shm_layout import LoopMemory
from deploy.runtime.supervisor import CompanionProcess
from deploy.twin.remote import RadioRemote
from deploy.twin.twin import TWIN_PRIORITY, Twin
from study.simulation import answer_questionnaire
from study.trial_contract import Operator, OperatorModel, OperatorView

log = logging.getLogger(__name__)

STARTING_S = 60.0
"""Longest wait for the page, s."""
SCREEN_FIELDS = ("kind", "who", "period", "phase", "number", "done")
"""Fields of the view that tell one screen from another."""
AGAIN_S = 2.0
"""Time after which a button that had no effect is pressed again."""


@spec
class Participant:
    """The twin, and a simulated participant who does sittings at it from consent to questionnaire.

    Attributes:
        twin: The twin.
        plant: The simulated machine behind it.
        guidance: How the levers are shown.
        guided: Whose hands and eyes these are in trials with advice.
        unguided: In trials without.
        sittings: How many participants of the plan come one after the other; `null`: all that have
            not finished.
    """

    twin: Twin
    plant: Connection
    guidance: LeverGuidance
    guided: Operator
    unguided: Operator
    sittings: int | None

    @property
    def operators(self) -> dict[str, str]:
        """Who is at the levers, by condition."""
        return {"guided": name_spec(self.guided), "unguided": name_spec(self.unguided)}

    def companions(self, machine: Machine, session: Session) -> list[CompanionProcess]:
        """Return the processes to run beside the loop."""
        person = Person(
            self, machine, session.folder.resolve() / LINK, session.stream("study operators")
        )
        return [
            CompanionProcess(
                "twin",
                "deploy.twin.twin:run",
                (self.twin, machine, self.plant, session),
                TWIN_PRIORITY,
            ),
            CompanionProcess(
                "participant", "study.participant:take_part", (person,), TWIN_PRIORITY
            ),
        ]


@dataclass(frozen=True)
class Person:
    """Settings of the process of a simulated participant.

    Attributes:
        bench: Who it is.
        machine: The machine.
        link: File with the page's address.
        seed: Who the persons of the plan are.
    """

    bench: Participant
    machine: Machine
    link: Path
    seed: int


def take_part(stop: Stop, person: Person, memory: LoopMemory) -> None:
    """Take part until it is asked to stop; asks its parent to stop once all sittings are done."""
    asyncio.run(_SimulatedSittings(person).run(stop))


class _SimulatedSittings:
    """Connections, hands and eyes of a simulated participant; `run` ends with the last sitting."""

    def __init__(self, person: Person) -> None:
        bench, machine = person.bench, person.machine
        self._person, self._bench, self._machine = person, bench, machine
        levers = bench.guidance.levers or machine.levers
        self._shown_map, self._own = LeverMap(levers, machine), LeverMap(machine.levers, machine)
        self._shown_full_rad = find_full_angles_rad(levers)
        self._shown: dict[str, Any] = {}
        self._study: dict[str, Any] = {}
        self._model: OperatorModel | None = None
        self._left = math.inf if bench.sittings is None else bench.sittings
        self._began_s, self._took_s = 0.0, list[float]()
        # Set when the parent has been asked to stop, so that it is asked once.
        self._finished = False

    async def run(self, stop: Stop) -> None:
        host, token = await self._address(stop)
        async with (
            connect(f"ws://{host}/state", proxy=None, close_timeout=0.5) as state,
            connect(
                f"ws://{host}/study",
                origin=f"http://{host}",  # type: ignore[arg-type]
                proxy=None,
                close_timeout=0.5,
            ) as study,
        ):
            # The server lets nobody lead a sitting without it.
            await study.send(json.dumps({"token": token}))
            tasks = [
                asyncio.create_task(self._look(state)),
                asyncio.create_task(self._press(study)),
            ]
            # Ends too when a connection breaks: its task is then done.
            try:
                await self._hold(stop, self._bench.twin.wire, tasks)
            finally:
                for task in tasks:
                    task.cancel()

    async def _address(self, stop: Stop) -> tuple[str, str]:
        end_s = time.monotonic() + STARTING_S
        # The server writes the file once it listens; it starts in another process.
        while not self._person.link.exists() and not stop():
            if time.monotonic() > end_s:
                raise TimeoutError(f"no page after {STARTING_S:g} s ({self._person.link})")
            await asyncio.sleep(0.2)
        host, _, token = (
            self._person.link.read_text().strip().removeprefix("http://").partition("/#token=")
        )
        return host, token

    async def _look(self, state: ClientConnection) -> None:
        """Read the messages to the page, and report them as drawn."""
        async for text in state:
            said, now_ms = json.loads(text), 1000 * time.monotonic()
            self._shown = said["shown"]
            # All three times are the same: nothing is painted here.
            await state.send(json.dumps([said["number"], now_ms, now_ms, now_ms]))

    async def _press(self, study: ClientConnection) -> None:
        """Press the next button, as a person would."""
        pressed, pressed_s = list[Any](), 0.0
        async for text in study:
            said = json.loads(text)
            if "study" not in said:
                continue
            shown = self._study = said["study"]
            # A person waits until the arm is at its start and the advice is valid.
            if shown.get("phase") == "ready" and not self._ready(shown):
                continue
            screen = list(map(shown.get, SCREEN_FIELDS))
            # Each screen is answered once, and again if nothing happens.
            if screen != pressed or time.monotonic() - pressed_s > AGAIN_S:
                pressed, pressed_s = screen, time.monotonic()
                for one in self._presses(shown):
                    await study.send(json.dumps(one))

    def _presses(self, study: dict[str, Any]) -> list[dict[str, Any]]:
        kind, phase = study["kind"], study.get("phase")
        if kind == "choose":
            waiting = []
            for one in study["participants"]:
                if one["state"] in ("new", "begun"):
                    waiting.append(one["name"])
            # Participants are taken in the order of the plan.
            if waiting and self._left > 0:
                return [{"do": "choose", "who": waiting[0]}]
            self._end()
        elif kind in ("done", "stopped"):
            self._left -= 1
            return [{"do": "leave"}]
        elif kind == "consent":
            return [{"do": "consent", "agreed": True, "language": "en"}]
        elif kind == "trial" and phase == "ready":
            return [{"do": "begin"}]
        elif kind == "trial" and phase == "over":
            self._took_s.append(float(study["seconds"]))
            return [{"do": "next"}]
        elif kind == "questionnaire" and study["at"] < study["last"]:
            return self._answers(study)
        return []

    def _ready(self, study: dict[str, Any]) -> bool:
        # No joints: the state is not known yet.
        there = bool(study["joints"]) and all(joint["there"] for joint in study["joints"])
        return there and (study["condition"] == "unguided" or study["advised"] == "valid")

    def _answers(self, study: dict[str, Any]) -> list[dict[str, Any]]:
        """Return a whole questionnaire, made up from how long the trials took."""
        # Seeded by person and period: the same answers come again after an interruption.
        generator = np.random.default_rng((self._person.seed, self._number, study["period"]))
        # 100 s make a load of 1. Chosen by hand; not searched.
        made = answer_questionnaire(float(np.mean(self._took_s or [0.0])) / 100.0, 0.0, generator)
        chosen = {frozenset(answer["pair"]): answer["chosen"] for answer in made["pairs"]}
        self._took_s.clear()
        found = []
        for scale, value in made["ratings"].items():
            found.append({"do": "rate", "scale": scale, "value": value})
        for number, pair in enumerate(study["pairs"]):
            found.append({"do": "pair", "pair": number, "chosen": chosen[frozenset(pair)]})
        return [*found, {"do": "to", "to": study["last"]}, {"do": "finish"}]

    @property
    def _number(self) -> int:
        """Number of the participant whose sitting it is."""
        # Pseudonyms end in the number of the participant.
        return int("".join(filter(str.isdigit, self._study.get("who") or "0")))

    async def _hold(self, stop: Stop, wire: CanBus, tasks: list[asyncio.Task[None]]) -> None:
        """Hold the remote, dead-man pressed."""
        remote = RadioRemote(BusDescription(self._bench.twin.dbc, self._machine))
        remote.deadman = True
        every, pace, cycle, full_rad = (
            round(self._machine.period_s / remote.period_s),
            CycleTimer(remote.period_s),
            0,
            find_full_angles_rad(self._machine.levers),
        )
        with wire.open(remote.frame_ids) as bus:
            while not stop() and not any(task.done() for task in tasks):
                # The time until the next message belongs to the event loop.
                await asyncio.sleep(max(0.0, pace.next_s - time.monotonic()))
                while (frame := bus.recv(0.0)) is not None:
                    remote.hear(frame, time.monotonic())
                pace.begin()
                # Levers are moved once a control period, the remote sends more often.
                if cycle % every == 0:
                    angles_rad, remote.button_right = self._own.levers(self._given())
                    remote.levers = (angles_rad / full_rad).clip(-1.0, 1.0).tolist()
                cycle += 1
                bus.send(remote.build_frame())

    def _given(self) -> np.ndarray:
        """Return the hands' command of the coming period, `(J,)`; zero outside a trial."""
        shown, study, num = self._shown, self._study, self._machine.num_joints
        if study.get("phase") != "running" or shown.get("q") is None or not shown.get("targets"):
            # A new trial begins with fresh eyes and hands.
            self._model = None
            return np.zeros(num)
        if self._model is None:
            operator = (
                self._bench.guided if study["condition"] == "guided" else self._bench.unguided
            )
            self._model = operator.build(
                self._machine, np.array([self._number - 1]), self._person.seed
            )
        rim = np.array(shown["targets"][0]["center_in_base_m"])
        view = OperatorView(
            q=np.array(shown["q"])[None], rim_in_base_m=rim[None], advice=self._advice(shown)[None]
        )
        return self._model.step(view)[0]

    def _advice(self, shown: dict[str, Any]) -> np.ndarray:
        advice = shown.get("advice")
        if advice is None:
            # Without advice a person sees nothing; NaN says so to the models.
            return np.full(self._machine.num_joints, np.nan)
        parts = np.array([advice["levers"][f"{side}_{axis}"] for side, axis in AXES])
        return self._shown_map.command(
            parts * self._shown_full_rad, advice["levers"]["button_right"]
        )

    def _end(self) -> None:
        if not self._finished:
            log.info("all sittings are done")
            os.kill(os.getppid(), signal.SIGINT)  # as the experimenter would
        self._finished = True
