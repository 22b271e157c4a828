"""The oracle: it knows the effects and joints of a case, fits only their sizes, and closes the gap.

Its share of the gap is an upper bound for candidates.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from actuators.contracts import ActuatorFit
from brokk_rl.machine import Machine
from diagnosis import baseline, case, effect_library
from diagnosis.baseline import Baseline
from diagnosis.gap import GapClosure
from diagnosis.refine import fit_set
from diagnosis.residuals import ParameterRay, Residuals, build_rays
from diagnosis.responses import Response, fit_sizes

MIN_RESPONSE = 1e-3
"""Response over noise below which an effect does not reach a joint; chosen by hand."""


@dataclass(frozen=True, eq=False)
class JointErrors:
    """Errors of the simulator on one joint, and the response to each effect.

    Attributes:
        z: Errors over their noise, `(E,)`.
        shapes: Response to each effect, one shape a ray; effects without a response
            to the joint are absent.
    """

    z: np.ndarray
    shapes: dict[str, list[Response]]

    def rays(self, names: frozenset[str]) -> list[Response]:
        """Return the shapes of several effects, in the order of their names."""
        found: list[Response] = []
        for name in sorted(names):
            found.extend(self.shapes[name])
        return found


@dataclass(frozen=True)
class CaseEvidence:
    """Inputs of the choice of effects.

    Attributes:
        base: The simulator, against field and reference.
        rays: Ways in which each effect grows.
        errors: Of each joint.
    """

    base: Baseline
    rays: dict[str, Sequence[ParameterRay]]
    errors: list[JointErrors]


def load_case_evidence(
    folder: Path, fit: ActuatorFit, machine: Machine, names: Sequence[str]
) -> CaseEvidence:
    """Return the residuals of a case, for the effects `names` that a free run can show.

    Args:
        folder: The case.
        fit: How the simulator is made from the reference.
        machine: The machine.
        names: The effects.

    Raises:
        RecordingError: the simulator cannot be fitted.
    """
    with tempfile.TemporaryDirectory(prefix="brokk") as scratch:
        base = baseline.fit_baseline(
            case.load_case(folder, machine), fit, Path(scratch), 0, torch.device("cpu")
        )
    grown: dict[str, Sequence[ParameterRay]] = {}
    for kind in effect_library.load_effects(machine, tuple(names)):
        if not kind.target.stochastic and kind.target.side != "kinematics":
            grown[kind.name] = build_rays(kind)
    return CaseEvidence(base, grown, collect_errors(base.field.residuals, grown))


def collect_errors(
    residuals: Residuals, rays: Mapping[str, Sequence[ParameterRay]]
) -> list[JointErrors]:
    """Return errors and responses of each joint; effects without a response there are left out."""
    shapes: list[dict[str, list[Response]]] = [{} for _ in residuals.z]
    for name, ways in rays.items():
        responses = [residuals.response(ray) for ray in ways]
        for j, mine in enumerate(shapes):
            own, largest = [], 0.0
            for ray, response in zip(ways, responses, strict=True):
                own.append(Response(ray.sizes, response[j]))
                largest = max(largest, np.abs(response[j]).max())
            if largest > MIN_RESPONSE:
                mine[name] = own
    errors = []
    for z, mine in zip(residuals.z, shapes, strict=True):
        errors.append(JointErrors(z, mine))
    return errors


def close_gap(
    folder: Path, effects: Mapping[str, Sequence[str]], fit: ActuatorFit, machine: Machine
) -> float | None:
    """Return the share of the gap of a case that its true effects close, on held-out windows.

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
    found = load_case_evidence(folder, fit, machine, tuple(effects))
    residuals = found.base.field.residuals
    subsets = []
    for joint, errors in zip(machine.joint_names, found.errors, strict=True):
        visible = set()
        for name, joints in effects.items():
            if joint in joints and name in errors.shapes:
                visible.add(name)
        subsets.append(frozenset(visible))
    if not any(subsets):
        return None
    start = list(map(_fit_start, found.errors, subsets))
    after = fit_set(residuals, subsets, found.rays, start).after
    closed = GapClosure(found.base, machine, after, None, np.random.default_rng(0)).gap().closed
    return None if closed is None else closed.mean


def close_labelled_gap(
    cases: Path, fit: ActuatorFit, machine: Machine, label: Mapping[str, Any]
) -> float | None:
    """Return the same for the case of a label, in the folder `cases`."""
    return close_gap(
        cases / label["case"],
        {one["effect"]: one["joints"] for one in label["effects"]},
        fit,
        machine,
    )


def _fit_start(errors: JointErrors, names: frozenset[str]) -> dict[str, np.ndarray]:
    """Return the additive least-squares sizes along the rays of each effect."""
    if not names:
        return {}
    ends = np.cumsum([len(errors.shapes[name]) for name in sorted(names)])[:-1]
    return dict(
        zip(sorted(names), np.split(fit_sizes(errors.z, errors.rays(names)), ends), strict=True)
    )
