"""Wrong frames of the target: turned, shifted, or with other axes."""

from __future__ import annotations

import itertools

import numpy as np

from diagnosis.deployment.contract import LoadedPolicy
from diagnosis.deployment.distortions import Distortion, make_fixed
from diagnosis.deployment.replay import Change
from diagnosis.deployment.transforms import rotate_frame, shift_column

ANGLES_RAD = tuple(np.deg2rad([*range(-165, 0, 15), -4, 4, *range(15, 181, 15)]))
"""Angles at which a search for a turned frame begins."""
SHIFTS_M = (
    -1.5,
    -1.0,
    -0.7,
    -0.5,
    -0.3,
    -0.2,
    -0.1,
    -0.05,
    0.05,
    0.1,
    0.2,
    0.3,
    0.5,
    0.7,
    1.0,
    1.5,
)
"""Shifts at which a search for another origin begins, m."""


def list_frame_distortions(policy: LoadedPolicy) -> list[Distortion]:
    """Return turned, swapped and shifted frames of a point."""
    terms = {term.name: term for term in policy.contract.terms}
    found, name = list[Distortion](), "target"
    if name not in terms or len(terms[name].columns) != 3:
        return found
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            turn[range(3), order] = signs
            if order == (0, 1, 2) and sum(sign < 0 for sign in signs) < 2:
                continue  # no change, or the wrong sign of one axis
            axes = " ".join(
                ("-" if sign < 0 else "+") + "xyz"[axis]
                for sign, axis in zip(signs, order, strict=True)
            )
            change = Change(signals={name: lambda x, turn=turn: x @ turn.T})
            is_order = min(signs) > 0
            kind, text = (
                ("order", f"{name} has its axes in the order {axes}")
                if is_order
                else ("frame", f"{name} is in a frame with the axes {axes}")
            )
            found.append(Distortion(kind, name, text, make_fixed(change)))
    for axis in range(3):
        letter = "xyz"[axis]

        def turn_about(angle: float, axis: int = axis) -> Change:
            return Change(signals={name: lambda x: x @ rotate_frame(axis, angle).T})

        found.append(
            Distortion(
                "frame",
                name,
                f"{name} is in a frame turned by {{value}} rad about {letter}",
                turn_about,
                ANGLES_RAD,
                True,
                "angle_rad",
            )
        )
        found.append(
            Distortion(
                "frame",
                f"{name}.{letter}",
                f"{name} is in a frame shifted by {{value}} m along {letter}",
                lambda value, axis=axis: Change(signals={name: shift_column(axis, value)}),
                SHIFTS_M,
                True,
                "shift_m",
            )
        )
    return found
