"""Alarms of the operator's page, as rules over what it shows.

An alarm asks for an action now: something is lost, or nothing is sent. A caution warns before that.
The names are English words that the page looks up in both languages.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from deploy.kernel.guard import GuardState, GuardTrip
from deploy.page.protocol import PageState

AlarmLevel = Literal["alarm", "caution"]
EARLY = 0.5
"""Share of the limit from which a delay is a caution. Chosen by hand."""
FAULTS = (
    GuardTrip.TIME_GAP,
    GuardTrip.CHANNEL_INVALID,
    GuardTrip.JOINTS_INVALID,
    GuardTrip.SECOND_SENDER,
    GuardTrip.JOINT_STILL,
    GuardTrip.JOINT_TURNED,
    GuardTrip.JOINT_WEAK,
    GuardTrip.JOINT_DRIFTS,
    GuardTrip.FLOW_UNASKED,
    GuardTrip.FLOW_TURNED,
    GuardTrip.FLOW_SCALED,
    GuardTrip.DESCRIPTION,
    GuardTrip.PULSES,
)
"""Faults that no age shows: alarms also where nothing is sent."""
EXPECTED = ("camera", "borehole")
"""Sources without which the loop goes on: a borehole that never came is a caution."""


@dataclass(frozen=True)
class Alarm:
    """A line of the alarm list.

    Attributes:
        level: `alarm` asks for an action now, `caution` warns before that.
        name: Fault in English words.
        detail: Source, joint or number that it is about; '' for none.
    """

    level: AlarmLevel
    name: str
    detail: str = ""


def list_alarms(shown: PageState) -> tuple[Alarm, ...]:
    """Return the alarms of a state, alarms before cautions."""
    if not shown.alive:
        found = [Alarm("alarm", "control computer silent")]
    else:
        found = [*_check_guard(shown), *_check_sources(shown), *_check_delay(shown)]
    found += _check_recorder(shown)
    return tuple(sorted(found, key=lambda one: one.level != "alarm"))


def _check_guard(shown: PageState) -> Iterator[Alarm]:
    state = shown.state
    if state is None:
        return
    if not state.bus_up:
        yield Alarm("alarm", GuardTrip.BUS_DOWN.value)
    if state.estop:
        yield Alarm("alarm", GuardTrip.ESTOP.value)
    if state.guard is GuardState.LATCHED and state.cause is not GuardTrip.ESTOP:
        yield Alarm("alarm", state.cause.value, _name_joint(state.observed_joint))
    if state.target is not GuardTrip.NONE and state.target is not state.cause:
        yield Alarm("alarm", state.target.value)
    is_told = state.guard is GuardState.LATCHED and state.trip is state.cause
    if state.trip in FAULTS and not is_told:
        yield Alarm("alarm", state.trip.value, _name_joint(state.observed_joint))
    if state.prompt:
        yield Alarm("alarm", "are you there")


def _check_sources(shown: PageState) -> Iterator[Alarm]:
    for one in shown.streams:
        if not one.stale:
            continue
        if one.age_s is None:
            level: AlarmLevel = "caution" if one.name in EXPECTED else "alarm"
            yield Alarm(level, "nothing has come", one.name)
        else:
            yield Alarm("caution" if one.name == "borehole" else "alarm", "too old", one.name)


def _check_delay(shown: PageState) -> Iterator[Alarm]:
    delay_s, limit_s = shown.health.delay_s, shown.health.delay_limit_s
    if delay_s > EARLY * limit_s:
        level: AlarmLevel = "alarm" if delay_s > limit_s else "caution"
        yield Alarm(level, "messages arrive late", f"{1e3 * delay_s:.0f} ms")


def _check_recorder(shown: PageState) -> Iterator[Alarm]:
    recording = shown.recording
    if shown.health.supervisor_silent:
        yield Alarm("alarm", "supervisor silent")
    if recording.failed and not recording.on:
        yield Alarm("alarm", "recording failed")
    if recording.on and shown.health.log_behind:
        yield Alarm("alarm", "recorder does not write")
    if recording.on and recording.dropped:
        yield Alarm("alarm", "recording has gaps", str(recording.dropped))


def _name_joint(number: int) -> str:
    """Return the joint's place in the machine as the page resolves it; '' for none."""
    return f"joint {number}" if number else ""
