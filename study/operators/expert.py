"""An operator who knows the machine: several joints at once, by where the arm is going to be rather than where it is."""

from __future__ import annotations

from brokk_rl.spec import spec
from study.operators.crossover import Crossover


@spec
class Expert(Crossover):
    """Simulated, unguided: reckons with everything that is on its way, and so works faster than the delay lets others.

    The law is that of `Crossover` that anticipates all motion still on its way; fields are the same.
    """
