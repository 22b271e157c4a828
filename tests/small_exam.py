"""The smallest exam that can be made, and runs of an actuator, for tests of the exam."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from motion import roll

from brokk_rl.machine import Machine

SMALL = (
    "mode=exam", "exam.mix.num_cases=2", "exam.mix.shares={none: 0.5, faint: 0, one: 0.5, several: 0, outside: 0}",
    "exam.reference.programs=[[levels]]", "exam.reference.file_s=12", "exam.field.programs=[[levels],[levels]]",
    "exam.field.file_s=8", "exam.withheld.programs=[[levels]]", "exam.withheld.file_s=10",
)  # fmt: skip
"""Overrides of the command: two cases of some seconds, one of them without a gap."""


def run_model(model: Any, machine: Machine, u: np.ndarray) -> np.ndarray:
    """Returns positions before each command `(T, J)`, from home on."""
    commands = torch.as_tensor(u, dtype=torch.float32)[:, None]
    return roll(model, machine, commands)[:-1, 0].numpy()
