"""The effects that inverse dynamics shows on joints commanded by torque, from which a search begins.

`fit=force` reads mass, friction and offset off the field by linear least squares. Free runs of a drive
that lacks all of them err by so much that a search from nothing ends at a wrong mixture.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from brokk_rl.machine import Machine
from diagnosis.baseline import Baseline
from diagnosis.effect_library import EffectType
from diagnosis.shown_effects import EffectNumbers

LEAST_SIZE = 0.05
"""Smallest size, over the typical one, that is proposed; the search weighs what it adds."""


def propose_drive_effects(
    base: Baseline, kinds: Sequence[EffectType], machine: Machine
) -> list[EffectNumbers]:
    """Return the effects that lead from the simulator's numbers to the fitted ones, by joint and name.

    None without a flexible model of the field, or where either model has no such numbers.
    """
    found: list[dict[str, dict[str, float]]] = [{} for _ in machine.joint_names]
    if not base.is_flexible:
        return list(found)
    own, fitted = (
        _read_numbers(actuator, machine)
        for actuator in (base.actuator, base.left_out[0].residuals.simulator.base)
    )
    for kind in kinds:
        drives = getattr(kind.target, "drives", {})
        if not drives or not own.keys() & fitted.keys() >= set(drives.values()):
            continue
        values, large = {}, np.zeros(len(found), dtype=bool)
        for name, changed in drives.items():
            none = kind.numbers[name].none
            change = (
                fitted[changed] - own[changed] if none == 0.0 else fitted[changed] / own[changed]
            )
            values[name] = kind.clipped(name, change)
            large |= np.abs(values[name] - none) > LEAST_SIZE * np.abs(kind.size(name))
        for j in np.flatnonzero(large):
            found[j][kind.name] = {name: float(value[j]) for name, value in values.items()}
    return list(found)


def _read_numbers(actuator: Any, machine: Machine) -> dict[str, np.ndarray]:
    """Return the numbers of a model by name, each `(J,)`; empty for one without."""
    model = actuator.build(machine, 1, torch.device("cpu"))
    parameters = getattr(model, "parameters", {})
    found = {name: value[0].numpy().astype(float) for name, value in parameters.items()}
    motor = getattr(model, "motor", None)
    if motor is not None:  # inverse dynamics sees its back EMF as viscous friction
        found["viscous_n_s_m"] = found["viscous_n_s_m"] + motor.back_emf.numpy()
    return found
