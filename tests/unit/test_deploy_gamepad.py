"""A gamepad is the remote of the twin: what it sends, and what happens when it is unplugged."""

from __future__ import annotations

import contextlib
import os
import re
import struct
import time
import tty
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from composed import MACHINE, names, option
from desk import DBC, build_twin

from brokk_rl.errors import ConfigError
from deploy.bus.can_bus import CanFrame
from deploy.bus.description import BusDescription
from deploy.twin.bench import GamepadBench
from deploy.twin.remote import GamepadRemote, run_remote

REMOTE = GamepadRemote(device="", axes=(-1, 0, -4, 3), deadman=4, button_right=5)
AXIS, BUTTON = 0x02, 0x01


class Wire:
    """A bus on which the gateway says its time, and a person acts after each message."""

    def __init__(self, acts: list[Any]) -> None:
        self._bus, self._acts, self._counter = BusDescription(DBC, MACHINE), acts, 0
        self.sent: list[dict[str, float]] = []

    @contextlib.contextmanager
    def open(self, frame_ids: list[int]) -> Iterator[Wire]:
        yield self

    def recv(self, timeout_s: float) -> CanFrame | None:
        time.sleep(min(timeout_s, 0.005))
        self._counter += 1
        status = self._bus.layouts["MachineStatus"]
        values = {"Stamp": 0.1 + 0.005 * self._counter}
        return CanFrame(status.frame_id, self._bus.encode(status.name, values, self._counter))

    def send(self, frame: CanFrame) -> None:
        values = self._bus.decode(self._bus.by_id[frame.frame_id], frame.data)
        self.sent.append(values)
        if self._acts:
            self._acts.pop(0)()


def test_sticks_are_levers_shoulders_are_dead_man_and_button_and_unplugged_is_silent() -> None:
    pad, device = os.openpty()
    tty.setraw(device)

    def act(*events: tuple[int, int, int]) -> Any:
        data = b"".join(struct.pack("IhBB", 0, value, kind, n) for kind, n, value in events)
        return lambda: os.write(pad, data)

    acts = [
        act((BUTTON, 4, 1)),
        act((AXIS, 1, -32767), (AXIS, 3, 32767), (AXIS, 0, 2000)),
        act((BUTTON, 5, 1), (AXIS, 4, 16384)),
        act((BUTTON, 4, 0)),
        lambda: os.close(pad),
    ]
    wire = Wire(acts)
    end_s = time.monotonic() + 10.0
    settings = replace(REMOTE, device=os.ttyname(device))
    run_remote(lambda: time.monotonic() > end_s, wire, DBC, MACHINE, settings, None)  # type: ignore[arg-type]
    os.close(device)
    assert time.monotonic() < end_s, "an unplugged gamepad ends the remote"
    names = [f"Lever_{side}" for side in ("left_theta", "left_psi", "right_theta", "right_psi")]
    at_rest, held, moved, pressed, released = wire.sent[:5]
    assert not at_rest["DeadMan"] and not any(at_rest[name] for name in names)
    assert held["DeadMan"] and not held["ButtonRight"] and held["RemoteOn"]
    # forward is positive, to the right too; a stick that is hardly touched is centred
    assert [moved[name] for name in names] == pytest.approx([1.0, 0.0, 0.0, 1.0], abs=0.01)
    assert pressed["ButtonRight"] and pressed["DeadMan"]
    assert pressed["Lever_right_theta"] == pytest.approx(-(0.5 - 0.12) / 0.88, abs=0.01)
    assert not released["DeadMan"] and released["Lever_left_theta"] == pytest.approx(1.0, abs=0.01)
    assert len(wire.sent) == 5


def test_a_gamepad_that_is_not_there_is_refused_before_anything_starts(tmp_path: Path) -> None:
    twin = build_twin(option("bus", "udp"), remote=False)
    pad = replace(REMOTE, device=str(tmp_path / "js9"))
    bench = GamepadBench(twin=twin, plant=option("link", "nominal"), gamepad=pad)
    with pytest.raises(
        ConfigError, match=r"bench.gamepad.device=.*js9: No such file.*ls /dev/inp"
    ) as told:
        bench.companions(MACHINE, None)  # type: ignore[arg-type]
    # Without its device there is no such bench: the way out is another one, and each is shipped.
    others = re.findall(r"bench=(\w+)", str(told.value))
    assert others and set(others) <= set(names("bench")) and "leave" not in str(told.value)
    with pytest.raises(ConfigError, match=r"twin\.remote=false"):
        replace(bench, twin=replace(twin, remote=True))
    with pytest.raises(ConfigError, match="two buttons"):
        replace(REMOTE, deadman=5)
    with pytest.raises(ConfigError, match="4 lever axes"):
        replace(REMOTE, axes=(0, 1))
