"""The oracle: it is told which effects a case has on which joints, fits only their sizes, and so closes what there is to close."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from brokk_rl.contracts.actuator import ActuatorFit
from brokk_rl.machine import Machine
from diagnosis import gap
from diagnosis.refine import fit_set
from diagnosis.responses import fit_sizes
from exam import ground
from exam.ground import Errors

NO_GAP = 1.1
"""Error over floor below which nobody can say what share of the gap is closed."""


def closed_by(
    folder: Path, effects: Mapping[str, Sequence[str]], fit: ActuatorFit, machine: Machine
) -> float | None:
    """Returns the share of the gap of a case that its true effects close, on windows that their sizes were not fitted to.

    Args:
        folder: The case.
        effects: Joints of each effect.
        fit: How the simulator is made from the reference.
        machine: The machine.

    Returns:
        `None` where there is no gap in the motion, or no free run shows any of the effects.

    Raises:
        RecordingError: the simulator cannot be fitted.
    """
    found = ground.of_case(folder, fit, machine, tuple(effects))
    residuals = found.base.field.residuals
    subsets = [
        frozenset(
            name for name, joints in effects.items() if joint in joints and name in errors.shapes
        )
        for joint, errors in zip(machine.joint_names, found.errors, strict=True)
    ]
    measured = residuals.simulator.cut.measured
    before = gap.compute_squares(residuals.base, measured, machine)
    floors = [
        gap.compute_squares(one.residuals.base, one.residuals.simulator.cut.measured, machine)
        for one in found.base.left_out
    ]
    floor = np.concatenate(floors)
    if not any(subsets) or gap.compute_rmse(before) < NO_GAP * gap.compute_rmse(floor):
        return None
    start = [_start(errors, subset) for errors, subset in zip(found.errors, subsets, strict=True)]
    after = gap.compute_squares(
        fit_set(residuals, subsets, found.rays, start).after, measured, machine
    )
    return float(
        gap.compute_shares(before, after, floor, [])[0]
    )  # as an answer says it: no repair is better than the floor


def of_label(
    cases: Path, fit: ActuatorFit, machine: Machine, label: Mapping[str, Any]
) -> float | None:
    """Returns the same for the case of a label, in the folder `cases`."""
    return closed_by(
        cases / label["case"],
        {one["effect"]: one["joints"] for one in label["effects"]},
        fit,
        machine,
    )


def _start(errors: Errors, names: frozenset[str]) -> dict[str, np.ndarray]:
    """Returns the sizes along the rays of each effect that explain the errors best, as far as effects add up."""
    if not names:
        return {}
    ends = np.cumsum([len(errors.shapes[name]) for name in sorted(names)])[:-1]
    return dict(
        zip(sorted(names), np.split(fit_sizes(errors.z, errors.rays(names)), ends), strict=True)
    )
