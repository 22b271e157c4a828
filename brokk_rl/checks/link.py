"""Checker of links to a machine."""

from __future__ import annotations

import math

import numpy as np

from brokk_rl.contracts.link import Link
from brokk_rl.errors import BrokkError
from brokk_rl.machine import Machine
from brokk_rl.signals import Command


def check_link(link: Link, machine: Machine, num_runs: int = 1) -> None:
    """Check a closed link to a machine, or to `num_runs` simulated ones, against `Link`.

    It sends only a standstill, and a command that is no number: the link must refuse that by a
    `BrokkError` or send a standstill.
    """
    with link as open_link:
        first = open_link.read()
        shape = (num_runs, machine.num_joints) if num_runs > 1 else (machine.num_joints,)
        found = np.shape(first.q)
        assert found == shape, f"read: expected positions of shape {shape}, got {found}"
        is_finite = np.isfinite(np.asarray(first.q)).all() and math.isfinite(first.t_s)
        assert is_finite, "read: positions or time are not finite"
        sent = open_link.send(Command(np.zeros(shape))).u
        text = f"send: a standstill was sent as {sent}"
        assert np.array_equal(np.asarray(sent), np.zeros(shape)), text
        assert open_link.read().t_s >= first.t_s, "read: time runs backwards"
        for name, value in getattr(open_link, "extra", dict)().items():
            text = f"extra: '{name}' has shape {np.shape(value)}, expected one number a machine"
            assert np.shape(value) in ((), (num_runs,)), text
        try:
            sent = open_link.send(Command(np.full(shape, np.nan))).u
        except BrokkError:
            return
        text = f"send: a command that is no number was sent as {sent}"
        assert not np.asarray(sent).any(), text
