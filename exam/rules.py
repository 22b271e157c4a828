"""Baselines that fit the same effects to the same simulator, and stop by a textbook rule: greedy forward selection, and BIC.

Both see the diagnosis' own errors, noise and simulated effects; what they lack is a price taken
from the reference, sets that do not grow from their best member, and a way to say unknown.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np

from brokk_rl.contracts.actuator import ActuatorFit
from brokk_rl.machine import Machine
from brokk_rl.spec import spec
from diagnosis import responses
from diagnosis.answer import FILE, Answer, Ranked, Selected, Where
from diagnosis.residuals import compute_loss
from exam import ground
from exam.ground import Errors

Worth = Callable[[Errors, frozenset[str]], float]
MOST = 4
"""Effects that a joint gets at most."""


@spec
class Forward:
    """Adds the best effect to each joint as long as it pays.

    Attributes:
        fit: How the simulator is made from the reference.
        rule: `held_out`: log likelihood on the half of the recordings that was not fitted to,
            `bic`: on all of them, less half the logarithm of their number for each parameter.
    """

    fit: ActuatorFit
    rule: Literal["held_out", "bic"]

    def answer(self, case: Path, out: Path, machine: Machine) -> None:
        """Writes the answer.

        Raises:
            RecordingError: the simulator cannot be fitted.
        """
        gains: dict[str, dict[str, float]] = {}
        for joint, errors in zip(
            machine.joint_names, ground.of_case(case, self.fit, machine).errors, strict=True
        ):
            for name, gain in grown(errors, held_out if self.rule == "held_out" else bic).items():
                gains.setdefault(name, {})[joint] = gain
        out.mkdir(parents=True, exist_ok=True)
        _said(gains).write(out / FILE)


def grown(errors: Errors, worth: Worth) -> dict[str, float]:
    """Returns the effects that a joint gets, and how much each was worth when it came."""
    chosen: frozenset[str] = frozenset()
    found: dict[str, float] = {}
    before = 0.0
    while len(chosen) < MOST:
        worths = {
            name: worth(errors, chosen | {name}) for name in errors.shapes if name not in chosen
        }
        best = max(worths, key=worths.__getitem__, default=None)
        if best is None or worths[best] <= before:
            break
        chosen, found[best], before = chosen | {best}, worths[best] - before, worths[best]
    return found


def held_out(errors: Errors, names: frozenset[str]) -> float:
    """Returns the gain in log likelihood on the half that was not fitted to."""
    return float(
        compute_loss(errors.z)
        - compute_loss(
            errors.z - responses.cross_validate_change(errors.z, errors.rays(names), errors.fold)
        )
    )


def bic(errors: Errors, names: frozenset[str]) -> float:
    """Returns the gain in log likelihood on all entries, less the price of the parameters."""
    rays = errors.rays(names)
    left = errors.z - responses.sum_responses(rays, responses.fit_sizes(errors.z, rays))
    return float(compute_loss(errors.z) - compute_loss(left)) - 0.5 * len(rays) * float(
        np.log(len(errors.z))
    )


def _said(gains: dict[str, dict[str, float]]) -> Answer:
    """Returns the answer: an effect is as probable as its worth in log likelihood makes it."""
    chances = {
        name: 1.0 / (1.0 + float(np.exp(-min(sum(by_joint.values()), 50.0))))
        for name, by_joint in gains.items()
    }
    order = sorted(gains, key=lambda name: -sum(gains[name].values()))
    selected = [
        Selected(
            effect=name,
            joints=tuple(gains[name]),
            probability=chances[name],
            parameters={},
            gap_closed=None,
        )
        for name in order
    ]
    return Answer(
        verdict="effects" if selected else "none",
        selected=tuple(selected),
        ranking=tuple(Ranked(one.effect, one.joints, one.probability) for one in selected)
        or (Ranked("none", (), 0.5),),
        where=Where({}, (), None),
        gap=None,
        next_experiment=None,
    )
