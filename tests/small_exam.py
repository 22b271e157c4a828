"""The smallest exam that can be made, and runs of an actuator, for tests of the exam."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from brokk_rl.history import History
from brokk_rl.machine import Machine

SMALL = (
    "mode=exam", "exam.mix.num_cases=2", "exam.mix.shares={none: 0.5, faint: 0, one: 0.5, several: 0, outside: 0}",
    "exam.reference.programs=[[levels]]", "exam.reference.file_s=12", "exam.field.programs=[[levels],[levels]]",
    "exam.field.file_s=8", "exam.withheld.programs=[[levels]]", "exam.withheld.file_s=10",
)  # fmt: skip
"""Overrides of the command: two cases of some seconds, one of them without a gap."""


def run_model(model: Any, machine: Machine, u: np.ndarray) -> np.ndarray:
    """Returns positions before each command `(T, J)`, from home on."""
    shape = (1, machine.num_history, machine.num_joints)
    history = History(torch.zeros(shape), torch.zeros(shape))
    home = torch.as_tensor(machine.home, dtype=torch.float32)[None]
    history.reset(torch.ones(1, dtype=torch.bool), home)
    q = []
    for command in torch.as_tensor(u, dtype=torch.float32):
        q.append(history.q[0, -1].numpy().copy())
        history.push_u(command[None])
        history.push_q(model.step(history))
    return np.array(q)
