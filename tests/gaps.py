"""Gaps of known size and recordings of known motion, for the tests of the diagnosis."""

from __future__ import annotations

import numpy as np
from motion import make_recording

from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis import effect_library
from diagnosis.answer import Answer
from diagnosis.case import GapCase
from diagnosis.reference_diagnosis import ReferenceDiagnosis

PERIOD_S = 0.05
DELAY = 11
NOISE = 0.0003


def recording(
    machine: Machine, ignored: np.ndarray | None = None, seconds: float = 240.0
) -> Recording:
    """Returns a recording in which all joints but q2 go to and fro; `ignored`, `(T,)`: where q3 does not obey."""
    steps = round(seconds / PERIOD_S)
    u = np.zeros((steps, 5))
    for j, (length, level) in enumerate(((90, 0.5), (70, 0.4), (80, 0.5), (60, 0.4), (100, 0.3))):
        u[:, j] = level * np.array([0.0, 1.0, 0.0, -1.0])[(np.arange(steps) // length) % 4]
    u[:, 1] = 0.0
    obeyed = u.copy()
    if ignored is not None:
        obeyed[ignored, 2] = 0.0
    moved = np.zeros((steps, 5))
    moved[DELAY:] = obeyed[:-DELAY] * machine.max_speed * PERIOD_S
    noise = NOISE * np.random.default_rng(0).standard_normal((steps, 5))
    q = machine.home + np.cumsum(moved, 0) + noise
    return make_recording(machine, u, q, "planted")


def diagnose(case: GapCase) -> Answer:
    """Returns the answer of the engine."""
    kinds = effect_library.load_effects(case.machine)
    generator = np.random.default_rng(0)
    work = ReferenceDiagnosis(case, kinds, generator)
    return work.run(lambda *_: None).answer
