"""What the diagnosis works on: a case's simulator, its errors, and what each effect would change about them."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from brokk_rl.contracts.actuator import ActuatorFit
from brokk_rl.machine import Machine
from diagnosis import baseline, case, effect_library
from diagnosis.baseline import Baseline
from diagnosis.residuals import ParameterRay, build_rays
from diagnosis.responses import Response

TOUCHES = 1e-3
"""Change of an error, over its noise, below which an effect does nothing to a joint."""


@dataclass(frozen=True, eq=False)
class Errors:
    """What the simulator errs by on one joint.

    Attributes:
        z: Errors over their noise, `(E,)`.
        shapes: What each effect would change about them, one shape a ray; effects that do nothing
            to the joint are absent.
        fold: Half of the recordings of each entry.
    """

    z: np.ndarray
    shapes: dict[str, list[Response]]
    fold: np.ndarray

    def rays(self, names: frozenset[str]) -> list[Response]:
        """Returns the shapes of several effects, in the order of their names."""
        return [shape for name in sorted(names) for shape in self.shapes[name]]


@dataclass(frozen=True)
class Ground:
    """All that is known before anything is chosen.

    Attributes:
        base: The simulator, against field and reference.
        rays: Ways in which each effect grows.
        errors: Of each joint.
    """

    base: Baseline
    rays: dict[str, Sequence[ParameterRay]]
    errors: list[Errors]


def of_case(
    folder: Path, fit: ActuatorFit, machine: Machine, names: Sequence[str] | None = None
) -> Ground:
    """Returns the ground of a case, for the effects `names`, or for all that a free run can show.

    Raises:
        RecordingError: the simulator cannot be fitted.
    """
    with tempfile.TemporaryDirectory(prefix="brokk") as scratch:
        base = baseline.fit_baseline(
            case.load_case(folder, machine), fit, Path(scratch), 0, torch.device("cpu")
        )
    residuals, grown = base.field.residuals, {}
    shapes: list[dict[str, list[Response]]] = [{} for _ in range(machine.num_joints)]
    for kind in effect_library.load_effects(machine, None if names is None else tuple(names)):
        if kind.target.stochastic or kind.target.side == "kinematics":
            continue
        ways = grown[kind.name] = build_rays(kind)
        responses = [residuals.response(ray) for ray in ways]
        for j, mine in enumerate(shapes):
            if max((np.abs(response[j]).max() for response in responses), default=0.0) > TOUCHES:
                mine[kind.name] = [
                    Response(ray.sizes, response[j])
                    for ray, response in zip(ways, responses, strict=True)
                ]
    return Ground(
        base,
        grown,
        [Errors(z, mine, residuals.fold) for z, mine in zip(residuals.z, shapes, strict=True)],
    )
