"""An effect that was found by other means than free runs: by the statistics of sensors or frames, or by a measured tool point."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from diagnosis.answer import Estimate
from diagnosis.library import Kind


@dataclass(frozen=True)
class Found:
    """An effect with its numbers.

    Attributes:
        kind: The effect.
        joints: Which joints have it, `(J,)` bool.
        parameters: By name and joint, or `machine`.
        worth: What it earns in log likelihood less its price.
        gain: What it earns.
        closed: Share of what the statistic shows that the effect explains.
        rivals: What other effects would earn in its place, by name.
    """

    kind: Kind
    joints: np.ndarray
    parameters: Mapping[str, Mapping[str, Estimate]]
    worth: float
    gain: float
    closed: float
    rivals: Mapping[str, float]

    def values(self, count: int = 1) -> dict[str, np.ndarray]:
        """Returns the numbers of `count` candidates that all have the effect, each `(C, J)` or `(C, 1)`."""
        found = {}
        for name, estimates in self.parameters.items():
            if "machine" in estimates:
                row = np.array([estimates["machine"].mean])
            else:
                row = np.full(len(self.joints), float(self.kind.numbers[name].none))
                row[self.joints] = [one.mean for one in estimates.values()]
            found[name] = np.repeat(row[None], count, 0)
        return found


def interval(sizes: np.ndarray, likelihood: np.ndarray) -> tuple[float, float, float]:
    """Returns the most likely size and the ends of its 95 % interval from log likelihoods at rising `sizes`."""
    fine = np.interp(np.linspace(0, len(sizes) - 1, 401), np.arange(len(sizes)), np.log(sizes))
    curve = np.interp(fine, np.log(sizes), likelihood)
    best = int(np.argmax(likelihood))
    if 0 < best < len(sizes) - 1:  # a parabola through the best three
        part = slice(best - 1, best + 2)
        a, b, c = np.polyfit(np.log(sizes[part]), likelihood[part], 2)
        near = (fine >= np.log(sizes[best - 1])) & (fine <= np.log(sizes[best + 1]))
        if a < 0:
            curve = np.where(near, np.maximum(curve, a * fine**2 + b * fine + c), curve)
    inside = np.exp(fine[curve > curve.max() - 1.92])
    return float(np.exp(fine[int(np.argmax(curve))])), float(inside.min()), float(inside.max())
