"""The diagnosis of a simulator held against recordings: search, sizes and proof by its own free runs.

Axes: `C` trials, `W` windows, `K` steps, `J` joints, `B` draws of the bootstrap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from actuators.models.linear import Hold
from brokk_rl.contracts.actuator import Actuator
from diagnosis import sensors
from diagnosis.answer import Answer, Outcome, Ranked
from diagnosis.case import GapCase
from diagnosis.closure import Estimate, Gate
from diagnosis.engine.decide import EffectFinding
from diagnosis.engine.sizes import SIGMAS
from diagnosis.free_runs import WindowedRuns, combine_joints
from diagnosis.gates import MAX_RIVAL_RATIO
from diagnosis.grown_effects import GrownEffect
from diagnosis.reference_diagnosis import (
    ACCEPTED_FINDINGS,
    Diagnosis,
    ProgressCallback,
    SearchResult,
    SizesByName,
)
from diagnosis.repair_proof import NOISE_FACTOR, RepairProof
from diagnosis.simulator_runs import EffectSimulator, cut_simulator_runs
from diagnosis.simulator_search import SimulatorSearch

FORM_ERROR = 0.1
"""Relative error of a size that its form makes, 1 sigma. Chosen by hand: no comparison is recorded."""
LEAST_NEED = 0.05
"""Least share of the error without an effect that the effect takes away, on the half of the field that its
size was not fitted to. Chosen by hand."""


class SimulatorProof(RepairProof):
    """The proof of what a search found: free runs of the simulator with effects around it.

    The floor is the error of an ARX fitted to the field, or that of the repaired simulator where it
    is the smaller one; with a reference it is the simulator's own error there.

    Args:
        case: The recordings.
        search: The search.
        effects: Named effects.
        reference: The simulator held against the reference; `None` without any.
        generator: Draws the bootstraps.
    """

    def __init__(
        self,
        case: GapCase,
        search: SimulatorSearch,
        effects: Sequence[GrownEffect],
        reference: EffectSimulator | None,
        generator: np.random.Generator,
    ) -> None:
        self._search = search
        findings = [one.summarise() for one in effects]
        super().__init__(case, findings, len(search.runs.row), generator)
        self.effects, self._reference = effects, reference
        if reference is None:
            self.floor_of = "field"
        self._fitted = [search.fit(effects, self.half != half) for half in (0, 1)]

    @property
    def measured(self) -> np.ndarray:
        """Measured positions, `(W, K, J)`, rad or m."""
        return self._search.runs.cut.measured

    def _simulate(self, effects: frozenset[str], half: int) -> np.ndarray:
        some = [one for one in self._fitted[half] if one.kind.name in effects]
        return self._search.whole.simulate(some)[0]

    @cached_property
    def sizes(self) -> dict[str, SizesByName]:
        """Sizes of each effect with their 95 % intervals."""
        deviations = self._search.whole.linearise(self.effects).estimate_deviations()
        names, found = self.machine.joint_names, {}
        for place, one in enumerate(self.effects):
            sizes = found[one.kind.name] = {}
            for name, value in one.values.items():
                least, most = one.kind.limits(name)
                off = value - (one.kind.numbers[name].none or 0.0)
                width = SIGMAS * np.hypot(deviations[place, name], FORM_ERROR * off)
                low, high = np.clip([value - width, value + width], least, most)
                at_bound = np.isclose(value, least) | np.isclose(value, most)
                where = {"machine": 0}
                if one.kind.numbers[name].per_joint:
                    where = {names[j]: j for j in np.flatnonzero(one.joints)}
                sizes[name] = {}
                for joint, j in where.items():
                    interval = (float(low[j]), float(high[j]))
                    sizes[name][joint] = Estimate(float(value[j]), interval, bool(at_bound[j]))
        return found

    @cached_property
    def floor_squares(self) -> np.ndarray:
        """Mean squares at the floor in each draw, `(1 + B, J)`."""
        after = self.measure_squares(self.after)
        reference = self._reference
        if reference is not None:
            squares = np.square(reference.plain_runs - reference.cut.measured).mean((0, 1))
        else:
            joints = self.rivals["arx"].joints
            squares = np.square([joints.get(name, np.inf) for name in self.machine.joint_names])
        return np.minimum(after, squares)

    def judge(self) -> list[Gate]:
        """Return the gates of all repairs, and whether the simulator keeps up with a linear ARX of the field.

        Nothing else tells here what no effect explains. The engine of two recordings has its own signs of
        that: an ARX contradicted 6 of 414 practice answers, and each of these had a true name first.
        """
        least = self.rivals["arx"].rmse
        if least is None:
            return super().judge()
        after = float(self.measure_errors(self.after)[0])
        noise = np.square(sensors.estimate_sensor_noise(self._case.reference or self._case.field))
        ratio = after / max(least, 1e-12)
        # What errs by its sensors only cannot be improved.
        is_noise = after <= NOISE_FACTOR * float(combine_joints(noise, self.machine))
        passed = is_noise or ratio <= MAX_RIVAL_RATIO
        text = f"the error with the effects is {ratio:.2f} times that of an ARX fitted to the field"
        return [*super().judge(), Gate("near_arx", passed, ratio, MAX_RIVAL_RATIO, text)]

    def view(self, paths: np.ndarray) -> WindowedRuns:
        """Return free runs beside the recordings of the field."""
        return self._search.runs.view(paths)


@dataclass(frozen=True)
class SimulatorDiagnosis(Diagnosis):
    """A diagnosis of what a simulator lacks; a reference is one that the simulator was fitted to.

    Attributes:
        base: The simulator.
        seed: Of the effects that draw.
    """

    base: Actuator
    seed: int

    def search(self, told: Sequence[Gate], tell: ProgressCallback) -> SearchResult:
        """Return what the simulator lacks."""
        case = self.case
        runs = self._cut(case.field)
        reference = self._cut(case.reference) if case.reference else None
        search = SimulatorSearch(runs, reference, self.kinds)
        effects: list[GrownEffect] = []
        # A search takes minutes, and most findings end in "cannot tell" whatever it names.
        if all(gate.passed or gate.name in ACCEPTED_FINDINGS for gate in told):
            effects = search.run(lambda done: tell("simulating every effect", 0.05 + 0.75 * done))

        def prove(effects: Sequence[GrownEffect] = ()) -> SimulatorProof:
            return SimulatorProof(case, search, effects, reference, self.generator)

        proof = prove(effects)
        while (weak := _find_weakest(proof)) is not None:
            proof = prove(search.fit([one for one in proof.effects if one is not weak]))
        return SearchResult(
            verdict="effects" if proof.effects else "none",
            proof=proof,
            prove_nothing=prove,
            rivals=[one.summarise() for one in search.rivals],
            otherwise="no effect makes the errors of the simulator likelier and surely reduces those of its free runs",
            evidence={},
        )

    def size(self, one: EffectFinding, proof: RepairProof) -> tuple[str, SizesByName]:
        """Return the name of an effect in the registry, and its sizes."""
        assert isinstance(proof, SimulatorProof), "the search made it"
        return one.name, proof.sizes[one.effect]

    def _cut(self, recordings: Sequence[Any]) -> EffectSimulator:
        return cut_simulator_runs(self.base, recordings, self.case.machine, self.seed)


def _find_weakest(proof: SimulatorProof) -> GrownEffect | None:
    """Return the effect whose removal raises the error on the other half least, of those that do not for sure."""
    weak = []
    for place, one in enumerate(proof.effects):
        need = proof.parts[one.kind.name]["needed"]
        if need.mean < LEAST_NEED or need.ci95[0] <= 0.0:
            weak.append((need.mean, place))
    return proof.effects[min(weak)[1]] if weak else None


def describe_doubts(case: GapCase, why: str) -> Outcome:
    """Return the answer of recordings that cannot tell anything, beside joints that stand still.

    Raises:
        RecordingError: no recording is long enough for a free run.
    """
    runs = cut_simulator_runs(Hold(), case.field, case.machine, 0)
    answer = Answer(
        verdict="unknown",
        selected=(),
        ranking=(Ranked("unknown", (), 1.0),),
        gap=None,
        gates=(Gate("enough_data", False, None, None, why),),
        reason=f"cannot tell, because {why}",
    )
    return Outcome(answer, runs.view(runs.plain_runs), None)
