"""What adding up promised, held against simulation.

While sets are searched, what an effect does at a size is interpolated and effects are added up.
What begins at a threshold can pay between two sizes that were simulated and nowhere else; it is
dropped before it is named.
Axes: `J` joints.
"""

from __future__ import annotations

import numpy as np

from diagnosis.evidence import Evidence
from diagnosis.repair import Repair
from diagnosis.search import LEAST, Chosen, Price, Subset
from diagnosis.shapes import plain_joints


def kept(
    evidence: Evidence,
    chosen: Chosen,
    repaired: Repair,
    price: Price,
    scatter: np.ndarray,
    shared: Subset,
) -> tuple[Subset, ...]:
    """Returns the set without effects of no size worth naming, and without joints where it does not pay when it is simulated.

    Args:
        evidence: Errors of the simulator.
        chosen: The set.
        repaired: Its simulation, on halves of the recordings that sizes were not fitted to.
        price: What a subset costs on a joint.
        scatter: Mean square error over what the noise says, `(J,)`.
        shared: Effects with one cause for all joints: they stay on all of them.
    """
    found = []
    joints = zip(
        plain_joints(evidence, scatter), plain_joints(evidence, scatter, repaired.z), strict=True
    )
    for j, (subset, (before, after)) in enumerate(zip(chosen.subsets, joints, strict=True)):
        earned = float(before.loss.sum() - after.loss.sum()) + before.price - after.price
        pays = earned > price(j, subset)
        found.append(
            frozenset(
                name
                for name in subset
                if name in shared or (pays and repaired.size(name, j) >= LEAST)
            )
        )
    return tuple(found)
