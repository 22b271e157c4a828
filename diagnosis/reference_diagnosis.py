"""The diagnosis of a case with a reference: what the recordings show directly, the engine, sizes and proof.

Axes: `W` windows, `K` steps, `J` joints, `B` draws of the bootstrap.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from scipy.signal import savgol_filter

from actuators.models.linear import Hold
from actuators.recordings.recording_checks import examine_recordings
from brokk_rl.history import History
from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis import gates, geometry, sensors
from diagnosis.answer import Answer, NextExperiment, Outcome, Ranked, Selected, Verdict, Where
from diagnosis.case import GapCase
from diagnosis.closure import Estimate, Gate
from diagnosis.effect_library import DetectedEffect, EffectType
from diagnosis.engine.coverage import measure_uncovered
from diagnosis.engine.decide import LEAST_NATS, Decider, Decision, EffectFinding
from diagnosis.engine.side import measure_units, stack_side
from diagnosis.engine.sizes import SIGMAS, describe_numbers
from diagnosis.repair_proof import EngineProof, RepairProof
from diagnosis.where import locate_gap

SizesByName = Mapping[str, Mapping[str, Estimate]]
"""Sizes by number and joint, or `machine`."""
ProgressCallback = Callable[[str, float], None]
"""Receives the name of a step and the share of the whole that is done."""
CLOCK_SHIFT_S = 0.012
"""Least shift between encoders and tool tracker that is named: 73 practice cases without one show 0.0022 s at
most, two whose encoder repeats its readings 0.011 s."""
SLOPE_S = 0.4
"""Time over which the velocity of a tool point is taken."""
CLOCK_ERROR_S, CLOCK_ERROR = 0.001, 0.05
"""Standard error of that shift, s and over it; five cases with one show 1.00 to 1.07 of it."""
SCATTERING = frozenset({"clock_offset", "quantisation", "sensor_noise"})
"""Effects by which tool points scatter about any law of the encoders."""
UNNAMED_PROBABILITY = 0.8
"""Probability of a verdict that names no effect; chosen by hand."""
NATS_OF_SURE = 15.0
"""Gain that makes the odds of an effect e times as large; chosen by hand."""
MAX_RIVALS = 4
"""Most rivals of a ranking."""


@dataclass(frozen=True)
class SearchResult:
    """Result of a search for effects in the motion.

    Attributes:
        verdict: Its verdict, before the gates.
        proof: Free runs with and without the named effects.
        prove_nothing: Makes the proof without any effect.
        rivals: All effects with what they earn, the best first.
        otherwise: The reason where nothing is named.
        evidence: Further evidence, plain JSON data.
        gates: Conditions of any verdict that the search itself found.
    """

    verdict: Verdict
    proof: RepairProof
    prove_nothing: Callable[[], RepairProof]
    rivals: Sequence[EffectFinding]
    otherwise: str
    evidence: Mapping[str, Any]
    gates: Sequence[Gate] = ()


@dataclass(frozen=True)
class Diagnosis(ABC):
    """A diagnosis: what tool points and samples show directly, the search in the motion, its proof, the gates.

    Attributes:
        case: The recordings.
        kinds: The library.
        generator: Draws bootstraps.
    """

    case: GapCase
    kinds: Sequence[EffectType]
    generator: np.random.Generator

    @abstractmethod
    def search(self, told: Sequence[Gate], tell: ProgressCallback) -> SearchResult:
        """Return what explains the motion; `told` are the gates of the recordings."""

    @abstractmethod
    def size(self, one: EffectFinding, proof: RepairProof) -> tuple[str, SizesByName]:
        """Return the name of an effect in the registry, and its sizes."""

    def name(self, one: EffectFinding) -> str:
        """Return the name of an effect in the registry."""
        return one.name

    def run(self, tell: ProgressCallback) -> Outcome:
        """Return the outcome; `tell` receives the name and the progress of each step."""
        machine = self.case.machine
        tell("recordings", 0.02)
        remarks = examine_recordings(self.case.field, machine)
        known = examine_recordings(self.case.reference, machine)
        told = gates.judge_recordings(remarks, known, self.case.field, self.case.reference, machine)
        found = self.search(told, tell)
        told += found.gates
        tell("sizes and proof", 0.9)
        proof, verdict, detected = found.proof, found.verdict, self.detected
        named = {one.effect: name_joints(one.joints, machine) for one in proof.findings}
        told = accept_named_joints(told, named)
        names = {one.kind.name for one in detected} | {self.name(one) for one in proof.findings}
        if geometry.is_tracked(self.case.field, machine) and not names & SCATTERING:
            told.append(gates.judge_scatter(geometry.measure_scatter_growth(self.case, self.kinds)))
        if failed := gates.list_failures(told):
            proof, detected = found.prove_nothing(), []
        elif proof.findings or verdict == "none":
            judged = proof.judge()
            told += judged
            if failed := gates.list_failures(judged):
                proof = found.prove_nothing()
        ranked = [(one.gain, describe_detected(one, machine)) for one in detected]
        ranked += [(one.nats, self._describe(one, proof)) for one in proof.findings]
        selected = [one for _, one in sorted(ranked, key=lambda pair: -pair[0])]
        reason = f"cannot tell, because {failed}" if failed else found.otherwise
        if selected:
            verdict = "effects"
            if not failed:
                reason = "; ".join(f"{one.effect} on {', '.join(one.joints)}" for one in selected)
        elif failed or verdict != "none":
            verdict = "unknown"
        after = proof.view(proof.after) if selected else None
        answer = Answer(
            verdict=verdict,
            selected=tuple(selected),
            ranking=rank_effects(selected, found.rivals, verdict, machine),
            gap=proof.measure_gap(bool(selected)),
            where=self._locate(proof, selected),
            rivals=proof.rivals,
            gates=tuple(told),
            next_experiment=propose_measurement(selected),
            reason=reason,
            more={
                "sanity": [remark.plain() for remark in remarks],
                "evidence": {"rivals": describe_rivals(found.rivals, machine), **found.evidence},
            },
        )
        return Outcome(answer, proof.view(proof.before), after)

    def _locate(self, proof: RepairProof, selected: Sequence[Selected]) -> Where:
        """Return where the gap lies."""
        after = np.sqrt(proof.measure_squares(proof.after)[0])
        floor = np.sqrt(proof.floor_squares[0])
        where = locate_gap(proof.view(proof.before), after, floor, self.case.machine)
        stages = {kind.name: kind.stage for kind in self.kinds}
        return replace(where, stage=stages[selected[0].effect] if selected else None)

    @cached_property
    def detected(self) -> list[DetectedEffect]:
        """Effects that tool points and the scatter of samples show."""
        found = geometry.find_geometry_errors(self.case, self.kinds)
        for kind in self.kinds:
            # Steps of a coarse sensor are found by the engine itself.
            if kind.name == "sensor_noise":
                noise = sensors.find_sensor_noise(self.case, kind)
                found += [] if noise is None else [noise]
        return found

    def _describe(self, one: EffectFinding, proof: RepairProof) -> Selected:
        """Return the answer about an effect in the motion."""
        name, numbers = self.size(one, proof)
        part = proof.parts[one.effect]
        like, decided_by = list_alike(name, one.joints, self.case, self.kinds)
        return Selected(
            effect=name,
            joints=name_joints(one.joints, self.case.machine),
            probability=estimate_probability(one.nats),
            parameters=numbers,
            gap_closed=part["closed"],
            same_as=like,
            decided_by=decided_by,
            identified=part["identified"],
            edit=part["edit"],
        )


class ReferenceDiagnosis(Diagnosis):
    """A diagnosis of a machine of which earlier recordings are known."""

    def search(self, told: Sequence[Gate], tell: ProgressCallback) -> SearchResult:
        """Return what the engine decides."""
        case, machine, detected = self.case, self.case.machine, self.detected
        tell("fitting the reference", 0.2)
        reference = stack_side(case.reference, machine)
        field = stack_side(correct_positions(case.field, detected, machine), machine)
        decider = Decider(reference, field, self._measure_noise(), self.clock_late_s)
        decider.recorded = stack_side(case.field, machine)
        tell("simulating every effect", 0.45)
        decision = decider.decide()
        tell("sizes and proof", 0.8)
        known = {kind.name for kind in self.kinds} - {one.kind.name for one in detected}
        findings = [one for one in decision.named if self.name(one) in known]
        prove = partial(EngineProof, case, decider, generator=self.generator)
        proof = prove(findings=findings)
        # A false further effect may spoil the free runs with the true first one.
        while len(proof.findings) > 1 and gates.list_failures(proof.judge()):
            proof = prove(findings=proof.findings[:-1])
        return SearchResult(
            verdict=decision.verdict,
            proof=proof,
            prove_nothing=partial(prove, findings=()),
            rivals=decision.table.list_found(),
            otherwise=_explain(decision, self.case.machine),
            evidence=_describe_evidence(decision),
            gates=[
                gates.judge_coverage(measure_uncovered(field, decider.evidence.covered), machine)
            ],
        )

    def size(self, one: EffectFinding, proof: RepairProof) -> tuple[str, SizesByName]:
        """Return the name of an effect in the registry, and its sizes."""
        assert isinstance(proof, EngineProof), "the search made it"
        name, machine = self.name(one), self.case.machine
        if name == "clock_offset":
            return name, {"offset_s": dict.fromkeys(machine.joint_names, self._clock)}
        if name == "quantisation":
            joints = name_joints(one.joints, machine)
            return name, {"step_rad": {joint: proof.steps[joint] for joint in joints}}
        (kind,) = [kind for kind in self.kinds if kind.name == name]
        return name, describe_numbers(kind, proof.sizes[one.effect], one.hold, machine)

    def name(self, one: EffectFinding) -> str:
        """Return the name of an effect in the registry: a late clock is simulated as a dead time of all joints."""
        is_clock = self.clock_late_s != 0.0 and one.name == "dead_time"
        return "clock_offset" if is_clock else one.name

    def _measure_noise(self) -> np.ndarray:
        """Return the noise that noisy sensors add, units, `(J,)`."""
        machine = self.case.machine
        found = np.zeros(machine.num_joints)
        for one in self.detected:
            if one.kind.name == "sensor_noise":
                for name, sigma in one.parameters["sigma_rad"].items():
                    found[machine.joint_names.index(name)] = sigma.mean
        return found / measure_units(machine)

    @cached_property
    def clock_late_s(self) -> float:
        """By how much the encoders lag behind the tool tracker more than on the reference, s; 0 within its own wandering."""
        now = measure_clock_shift(self.case.field, self.case.machine)
        then = measure_clock_shift(self.case.reference, self.case.machine)
        if now is None:
            return 0.0
        late_s = now - (then or 0.0)
        return late_s if abs(late_s) > CLOCK_SHIFT_S else 0.0

    @property
    def _clock(self) -> Estimate:
        late_s = self.clock_late_s
        half = SIGMAS * float(np.hypot(CLOCK_ERROR_S, CLOCK_ERROR * late_s))
        return Estimate(late_s, (late_s - half, late_s + half))


def describe_detected(one: DetectedEffect, machine: Machine) -> Selected:
    """Return the answer about an effect that sensors or tool points show.

    Its share of their error is no share of the gap.
    """
    names = [name for name, has in zip(machine.joint_names, one.joints, strict=True) if has]
    return Selected(
        effect=one.kind.name,
        joints=tuple(names),
        probability=estimate_probability(one.net_gain),
        parameters=one.parameters,
        gap_closed=None,
    )


def list_alike(
    name: str, joints: Sequence[int], case: GapCase, kinds: Sequence[EffectType]
) -> tuple[tuple[str, ...], str | None]:
    """Return what commands and joint positions cannot tell from an effect, and the measurement that would."""
    if geometry.is_tracked(case.field, case.machine):
        return (), None
    known = {kind.name for kind in kinds}
    if name == "flow_gain" and "encoder_scale" in known:
        how = "an outside measurement of the angle (inclinometer, laser) at two positions"
        return ("encoder_scale",), how
    if name == "dead_time" and len(joints) == case.machine.num_joints and "clock_offset" in known:
        how = "one clock for commands and positions, or a pulse that both record"
        return ("clock_offset",), how
    return (), None


ACCEPTED_FINDINGS = ("does_not_obey", "unlogged_input", "interlock")
"""Findings about a joint that a named effect may be the cause of: a pump that is too small starves a joint while
others move, as an interlock does. Of opened cases two with such effects are told so since; two with a stop that
moved, whose joints stand still for half of the time, stay unknown."""

COARSE_FINDINGS = ("frozen_sensor", "jumps")
"""Findings about a joint whose coarse sensor repeats its readings, and then changes by a step."""


def accept_named_joints(told: Sequence[Gate], named: Mapping[str, Sequence[str]]) -> list[Gate]:
    """Return the gates of the recordings; what they find on a joint may have a named effect as its cause.

    Whether the effect explains it is told by the proof: the repaired simulator has to beat standing
    still on that joint.

    Args:
        told: The gates.
        named: Joints of each named effect.
    """
    found = []
    for gate in told:
        causes = named if gate.name in ACCEPTED_FINDINGS else ()
        if gate.name in COARSE_FINDINGS:
            causes = {"quantisation"} & named.keys()
        is_named = any(f", on {name};" in gate.text for cause in causes for name in named[cause])
        found.append(replace(gate, passed=gate.passed or is_named))
    return found


def estimate_probability(nats: float) -> float:
    """Return the probability that a named effect is there: half for one that just earns enough."""
    odds = np.exp((min(nats, 300.0) - LEAST_NATS) / NATS_OF_SURE)
    return float(np.clip(odds / (1.0 + odds), 0.5, 0.99))


def correct_positions(
    recordings: Sequence[Recording], detected: Sequence[DetectedEffect], machine: Machine
) -> list[Recording]:
    """Return the recordings without errors of the encoders that tool points showed."""
    found = list(recordings)
    for one in detected:
        if one.kind.target.side != "measurement" or one.kind.target.stochastic:
            continue
        model = one.kind.wrap(Hold(), machine, 2, torch.device("cpu"))
        for name, value in one.values().items():
            model.parameters[name].copy_(torch.as_tensor(value, dtype=torch.float32))
        ends = torch.tensor(np.stack([machine.lower, machine.upper]), dtype=torch.float32)
        with torch.inference_mode():
            model.step(History(q=ends[:, None], u=torch.zeros_like(ends[:, None])))
            shown = model.measure(ends).numpy().astype(float)
        slope = (shown[1] - shown[0]) / (machine.upper - machine.lower)
        found = [replace(r, q=machine.lower + (r.q - shown[0]) / slope) for r in found]
    return found


def measure_clock_shift(recordings: Sequence[Recording], machine: Machine) -> float | None:
    """Return by how much encoders lag behind measured tool points, s; `None` where none are measured.

    Errors of geometry depend on the positions. Any law of second order of these is left out of the
    tool points and of their velocity.
    """
    if not geometry.is_tracked(recordings, machine):
        return None
    kinematics = Kinematics(machine)
    positions, errors, velocities = [], [], []
    for recording in recordings:
        if not geometry.is_measured(recording):
            continue
        seen = geometry.stack_tool_points(recording)
        pose, _ = kinematics.pose_and_jacobian(torch.as_tensor(recording.q, dtype=torch.float32))
        tip = pose.tip_in_base_m.numpy().astype(float)
        given = np.flatnonzero(np.isfinite(seen).all(1))
        positions.append(recording.q[given].astype(float))
        errors.append((seen - tip)[given])
        # Noise of the encoders would shorten the shift: the slope is that of some tenths of a second.
        width = 2 * max(2, round(SLOPE_S / machine.period_s / 2.0)) + 1
        slope = savgol_filter(tip, width, 2, deriv=1, delta=machine.period_s, axis=0)
        velocities.append(np.asarray(slope)[given])
    q = np.concatenate(positions)
    first, second = np.triu_indices(q.shape[1])
    known = np.concatenate([np.ones((len(q), 1)), q, q[:, first] * q[:, second]], 1)
    both = np.concatenate([np.concatenate(errors), np.concatenate(velocities)], 1)
    left = both - known @ np.linalg.lstsq(known, both)[0]
    error, velocity = left[:, :3], left[:, 3:]
    return float((error * velocity).sum() / max(np.square(velocity).sum(), 1e-12))


def name_joints(joints: Sequence[int], machine: Machine) -> tuple[str, ...]:
    """Return the names of joints by their places."""
    return tuple(machine.joint_names[j] for j in joints)


def rank_effects(
    selected: Sequence[Selected],
    rivals: Sequence[EffectFinding],
    verdict: Verdict,
    machine: Machine,
) -> tuple[Ranked, ...]:
    """Return what is named, `none` or `unknown`, and the rivals, which share what the first leaves; most probable first."""
    found = [Ranked(one.effect, one.joints, one.probability) for one in selected]
    if verdict != "effects":
        found.append(Ranked(verdict, (), UNNAMED_PROBABILITY))
    names = {one.effect for one in found}
    others = []
    for one in rivals:
        if one.name not in names and one.nats > 0.0:
            others.append(one)
            names.add(one.name)
    others = others[:MAX_RIVALS]
    left = 1.0 - max(one.probability for one in found)
    odds = np.exp([(one.nats - others[0].nats) / NATS_OF_SURE for one in others])
    for one, chance in zip(others, left * odds / odds.sum(), strict=True):
        found.append(Ranked(one.name, name_joints(one.joints, machine), float(chance)))
    return tuple(sorted(found, key=lambda one: -one.probability))


def propose_measurement(selected: Sequence[Selected]) -> NextExperiment | None:
    """Return the measurement that would tell apart what these recordings cannot."""
    for one in selected:
        if one.same_as and one.decided_by:
            return NextExperiment(one.decided_by, (one.effect, *one.same_as))
    return None


def describe_rivals(rivals: Sequence[EffectFinding], machine: Machine) -> list[dict[str, Any]]:
    """Return what each effect earns, plain JSON data."""
    rows = []
    for one in rivals:
        joints = list(name_joints(one.joints, machine))
        rows.append({"effect": one.name, "joints": joints, "score": one.nats})
    return rows


def _explain(decision: Decision, machine: Machine) -> str:
    """Return why nothing is named."""
    if decision.verdict == "none":
        return "no effect earns more on the field recordings than it would by chance"
    group, nats = decision.generic
    shown = f"the field follows a law of: {group} ({nats:.0f} nats)"
    outside = next(iter(decision.table.list_found(is_outside=True)), None)
    if outside is not None and outside.nats > nats:
        cause = outside.effect.replace("_", " ")
        joints = ", ".join(name_joints(outside.joints, machine))
        shown = f"the field moves as by {cause} on {joints} ({outside.nats:.0f} nats)"
    return f"the gap is real, and no effect of the library explains it; {shown}"


def _describe_evidence(decision: Decision) -> dict[str, Any]:
    """Return what each effect earns beside the first, and each cause outside the library, plain JSON data."""
    outside = next(iter(decision.table.list_found(is_outside=True)), None)
    return {
        "outside": None if outside is None else {"cause": outside.effect, "score": outside.nats},
        "generic": {"group": decision.generic[0], "score": decision.generic[1]},
    }
