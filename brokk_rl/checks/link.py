"""Checker of links to a machine."""

from __future__ import annotations

import math

import numpy as np

from brokk_rl.checks.exercise import require
from brokk_rl.contracts import Link
from brokk_rl.errors import BrokkError
from brokk_rl.machine import Machine
from brokk_rl.signals import Command


def check_link(link: Link, machine: Machine) -> None:
    """Checks a closed link to a machine, real or simulated, against `Link`.

    Sends nothing but a standstill, and a command that is no number: it must be refused by a `BrokkError` or sent as a standstill.
    """
    with link as open_link:
        first = open_link.read()
        require(
            np.shape(first.q) == (machine.num_joints,), f"read: expected {machine.num_joints} positions, got {np.shape(first.q)}"
        )
        require(bool(np.isfinite(np.asarray(first.q)).all()) and math.isfinite(first.t_s), "read: positions or time are not finite")
        sent = open_link.send(Command(np.zeros(machine.num_joints)))
        require(np.array_equal(np.asarray(sent.u), np.zeros(machine.num_joints)), f"send: a standstill was sent as {sent.u}")
        require(open_link.read().t_s >= first.t_s, "read: time runs backwards")
        try:
            sent = open_link.send(Command(np.full(machine.num_joints, np.nan)))
        except BrokkError:
            return
        require(bool((np.asarray(sent.u) == 0).all()), f"send: a command that is no number was sent as {sent.u}")
