"""Checks of the guard that need a file: the envelope of the machine's shapes, and the observer."""

from __future__ import annotations

import json
import logging
from typing import Any

import numpy as np

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.registry import resolve_package_path
from deploy.checks.envelope import Envelope
from deploy.checks.observer import Observer
from deploy.checks.shapes import read_machine_shapes
from deploy.checks.valve_model import describe_sources, load_observer_file
from deploy.kernel.limits import GuardLimits

log = logging.getLogger(__name__)

DESKS = ("udp_multicast", "virtual")
"""Interfaces of buses without a machine: twins."""
MACHINES = ("machine: ", "capture: ", "log: ")
"""Beginnings of the sources of recordings that may be of a machine."""

LONGEST_S = 10.0
"""Longest window of an observer, and time in which it has to find a joint that stands still at full
flow. Chosen by hand: ten times the window of the shipped file."""


def check_command_rate(limits: GuardLimits, machine: Machine) -> None:
    """Check that a command is not yet too old when the next one comes.

    Raises:
        ConfigError: it is.
    """
    if limits.request_s <= machine.period_s:
        raise ConfigError(
            f"guard.request_s: expected more than the control period of {machine.name}, "
            f"{machine.period_s:g} s, got {limits.request_s:g}; give it the period and 0.03 s for lateness"
        )


def build_observer(
    limits: GuardLimits, machine: Machine, interface: str, commands: bool
) -> Observer | None:
    """Return the observer, and log its thresholds; see `read_observer_content`."""
    content = read_observer_content(limits, machine, interface, commands)
    if content is None or limits.observer is None:
        return None
    thresholds, path = content["thresholds"], limits.observer.path
    pairs = zip(machine.joint_names, thresholds["slack_s"], strict=True)
    slack = ", ".join(f"{name} {slack_s:g} s" for name, slack_s in pairs)
    text = "observer: thresholds of %s, %s, %.0f minutes: %s of full speed"
    log.info(text, path, describe_sources(content), thresholds["minutes"], slack)
    return Observer(content, machine)


def read_observer_content(
    limits: GuardLimits, machine: Machine, interface: str, commands: bool
) -> dict[str, Any] | None:
    """Return the observer's file; `None` where it is switched off, or not of this machine.

    Args:
        limits: Of the guard.
        machine: The machine.
        interface: Of the bus.
        commands: Whether commands may be sent.

    Raises:
        ConfigError: the file cannot be read, or is not of this machine where commands are sent.
    """
    if limits.observer is None:
        return None
    path = limits.observer.path
    content = load_observer_file(resolve_package_path(path))
    if content.get("fingerprint") != machine.fingerprint():
        fault = f"made for machine {content.get('machine')}, which differs from {machine.name}"
    elif not _is_complete(content, machine):
        raise ConfigError(
            f"guard.observer.path: expected thresholds and a model of {machine.num_joints} joints in {path} "
            "that find one that stands still, got others; make it again by brokk mode=observe"
        )
    elif interface not in DESKS and not all(map(is_from_machine, content["sources"])):
        fault = f"made {describe_sources(content)}, and this bus is that of a machine"
    else:
        return content
    if commands:
        raise ConfigError(
            f"guard.observer.path: {path} was {fault}; its thresholds would be wrong. Make a file from "
            "recordings of this machine by brokk mode=observe, or go without by guard.observer=null"
        )
    log.warning("%s was %s: there is no observer; brokk mode=observe makes a file", path, fault)
    return None


def _is_complete(content: dict[str, Any], machine: Machine) -> bool:
    """Return whether an observer of a file's content finds each joint that stands still at full flow."""
    middle, found = (machine.lower + machine.upper) / 2, []
    try:
        json.dumps(content, allow_nan=False)
        describe_sources(content)
        if min(content["thresholds"]["slack_s"]) <= 0:
            return False
        for flow in np.eye(machine.num_joints):
            observer = Observer(content, machine)
            if not machine.period_s <= observer.window_s <= LONGEST_S:
                return False
            for period in range(round(LONGEST_S / machine.period_s)):
                observer.update(period * machine.period_s, middle, flow, may_touch=False)
                if observer.observation.joint >= 0:
                    break
            found.append(observer.observation.joint)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError):
        return False
    return found == list(range(machine.num_joints))


def is_from_machine(source: str) -> bool:
    """Return whether a recording's source is a machine, as far as it says so: no simulator, no desk."""
    return source.startswith(MACHINES) and not any(name in source for name in DESKS)


def build_envelope(limits: GuardLimits, machine: Machine, commands: bool) -> Envelope | None:
    """Return the envelope of the arm; `None` where it is switched off or the shapes are not known.

    Args:
        limits: Of the guard.
        machine: The machine.
        commands: Whether commands may be sent.

    Raises:
        ConfigError: the shapes cannot be read, or are not of this machine where commands are sent.
    """
    if limits.envelope is None:
        return None
    path = limits.envelope.shapes
    shapes = read_machine_shapes(resolve_package_path(path), machine)
    if shapes is not None:
        return Envelope(limits.envelope, machine, shapes, limits.speed_margin, limits.reaction_s)
    fault = f"{path} holds no shapes of machine {machine.name}"
    if commands and machine.has_bodies:
        raise ConfigError(
            f"guard.envelope.shapes: {fault}; brokk mode=export writes such a file, and "
            "guard.envelope=null goes without"
        )
    log.warning("%s: there is no envelope of its arm", fault)
    return None
