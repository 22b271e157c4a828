"""Changes between reference and field, joint by joint, named or not.

The numbers of each joint are fitted to the field as they were to the reference. Their differences
are told with intervals, in words that need no effect.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diagnosis.closure import Estimate, serialize_estimate
from diagnosis.engine.baseline import DEVIATION, FITTED, fit_numbers, linearise
from diagnosis.engine.evidence import FieldJoint, RowEvidence
from diagnosis.engine.joint_model import NAMES, PLACE
from diagnosis.engine.side import measure_units

ROUNDS = 5
"""Rounds of the fit, as for the reference."""
RELATIVE = ("speed_out", "speed_in")
ABSOLUTE = ("delay_s", "band_out", "band_in")
IN_UNITS = {"play": "", "creep": "_s"}
"""Numbers that are told: over their value, as they are, and in the unit of the joint."""


@dataclass(frozen=True)
class JointChange:
    """Change of one number of a joint.

    Attributes:
        joint: Name of the joint.
        number: Name of the number, with its unit; a speed is told as a share of itself.
        change: Field less reference.
    """

    joint: str
    number: str
    change: Estimate

    def to_json(self) -> dict[str, object]:
        """Return plain JSON data."""
        change = serialize_estimate(self.change)
        return {"joint": self.joint, "number": self.number, "change": change}


def measure_changes(evidence: RowEvidence, joints: list[FieldJoint]) -> list[JointChange]:
    """Return the changes of the numbers of each joint of the field."""
    machine = evidence.field.machine
    units = measure_units(machine)
    found = []
    for joint in joints:
        base = evidence.bases[joint.joint]
        numbers = fit_numbers(joint.side, joint.joint, base.numbers, joint.measure, ROUNDS)
        _, slopes = linearise(joint.side, joint.joint, numbers, joint.measure)
        normal = slopes @ slopes.T / max(joint.scatter, 1.0) + np.diag(1.0 / DEVIATION**2)
        covariance = np.linalg.inv(normal) + base.covariance
        deviation = dict(
            zip(np.array(NAMES)[FITTED].tolist(), np.sqrt(np.diag(covariance)), strict=True)
        )
        name, unit = machine.joint_names[joint.joint], machine.joints[joint.joint].unit
        for number in (*RELATIVE, *ABSOLUTE, *IN_UNITS):
            scale, label = 1.0, number
            if number in RELATIVE:
                scale, label = 1.0 / base.numbers[PLACE[number]], f"{number}_share"
            elif number in IN_UNITS:
                scale, label = float(units[joint.joint]), f"{number}_{unit}{IN_UNITS[number]}"
            change = scale * (numbers[PLACE[number]] - base.numbers[PLACE[number]])
            half = 1.96 * scale * deviation[number]
            estimate = Estimate(float(change), (float(change - half), float(change + half)))
            found.append(JointChange(name, label, estimate))
    return found
