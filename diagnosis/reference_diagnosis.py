"""The diagnosis of a case with a reference: what the recordings show directly, the engine, sizes and proof.

Axes: `W` windows, `K` steps, `J` joints, `B` draws of the bootstrap.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from scipy.signal import savgol_filter

from actuators.models.linear import Hold
from actuators.recordings.inspection import InspectionThresholds
from actuators.recordings.recording_checks import RecordingRemark, examine_recordings
from brokk_rl.history import History
from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis import gates, geometry, sensors
from diagnosis.answer import Answer, NextExperiment, Outcome, Ranked, Selected, Verdict
from diagnosis.case import GapCase
from diagnosis.closure import Estimate, Gate
from diagnosis.effect_library import DetectedEffect, EffectType
from diagnosis.engine.decide import Decider, Decision, EffectFinding
from diagnosis.engine.side import measure_units, stack_side
from diagnosis.engine.sizes import SIGMAS, describe_numbers
from diagnosis.repair_proof import EngineProof, RepairProof
from diagnosis.where import find_stage, locate_gap

SizesByName = Mapping[str, Mapping[str, Estimate]]
"""Sizes by number and joint, or `machine`."""
ProgressCallback = Callable[[str, float], None]
"""Receives the name of a step and the share of the whole that is done."""
DIRECT_NATS = 4.0
NAME_NATS = 12.0
"""Cost of a joint and of a name where tool points or the scatter of samples show an effect."""
CLOCK_SHIFT_S = 0.012
"""Least shift between encoders and tool tracker that is named: 73 practice cases without one show 0.0022 s at
most, two whose encoder repeats its readings 0.011 s."""
SLOPE_S = 0.4
"""Time over which the velocity of a tool point is taken."""
CLOCK_ERROR_S, CLOCK_ERROR = 0.001, 0.05
"""Standard error of that shift, s and over it; five cases with one show 1.00 to 1.07 of it."""
MAX_RIVALS = 4
"""Most rivals of the named effects in a ranking."""
NATS_OF_HALF = 20.0
NATS_OF_SURE = 15.0
"""An effect of so many nats is there in half of the cases, and how fast that grows."""


@dataclass(frozen=True)
class NamedEffect:
    """A named effect, however it was found.

    Attributes:
        kind: The effect of the registry.
        finding: What the engine found; `None` where it was found directly.
        detected: What tool points or samples showed; `None` otherwise.
    """

    kind: EffectType
    finding: EffectFinding | None
    detected: DetectedEffect | None


@dataclass(frozen=True)
class Diagnosis:
    """Steps of a diagnosis that do not depend on how effects are found.

    Attributes:
        case: The recordings.
        kinds: The library.
        thresholds: When a stretch of a recording is worth telling.
        generator: Draws bootstraps.
    """

    case: GapCase
    kinds: Sequence[EffectType]
    thresholds: InspectionThresholds
    generator: np.random.Generator

    @cached_property
    def remarks(self) -> list[RecordingRemark]:
        """Findings about the field's recordings."""
        return examine_recordings(self.case.field, self.case.machine, self.thresholds)

    def judge_recordings(self) -> list[Gate]:
        """Return the gates of the recordings."""
        case = self.case
        known = examine_recordings(case.reference, case.machine, self.thresholds)
        return gates.judge_recordings(self.remarks, known, case.field, case.reference, case.machine)

    def describe_simulated(
        self, kind: str, one: EffectFinding, numbers: SizesByName, proof: RepairProof
    ) -> Selected:
        """Return the answer about an effect `kind` of the registry that was simulated."""
        part = proof.parts.get(one.effect)
        like, decided_by = list_alike(kind, one.joints, self.case, self.kinds)
        return Selected(
            effect=kind,
            joints=name_joints(one.joints, self.case.machine),
            probability=estimate_probability(one.nats),
            parameters=numbers,
            gap_closed=None if part is None else part["closed"],
            same_as=like,
            decided_by=decided_by,
            identified=None if part is None else part["identified"],
            edit=None if part is None else part["edit"],
        )

    def build_outcome(
        self,
        verdict: Verdict,
        selected: Sequence[Selected],
        rivals: Sequence[EffectFinding],
        proof: RepairProof,
        told: Sequence[Gate],
        reason: str,
        evidence: Mapping[str, Any],
    ) -> Outcome:
        """Return the outcome of effects that are `selected`, with what else was weighed."""
        machine = self.case.machine
        before, floor = proof.view(proof.before), proof.view_floor()
        weighed = {"rivals": describe_rivals(rivals, machine), "unit": "log likelihood"}
        answer = Answer(
            verdict=verdict,
            selected=tuple(selected),
            ranking=rank_effects(selected, rivals, verdict, machine),
            where=locate_gap(before, floor, machine, find_stage(selected, self.kinds)),
            gap=proof.measure_gap(bool(selected)),
            rivals=proof.rivals,
            gates=tuple(told),
            next_experiment=propose_measurement(selected),
            reason=reason,
            more={
                "sanity": [remark.plain() for remark in self.remarks],
                "evidence": {**weighed, **evidence},
            },
        )
        return Outcome(answer, before, proof.view(proof.after) if selected else None, floor)


class ReferenceDiagnosis(Diagnosis):
    """A diagnosis of a machine of which earlier recordings are known."""

    def run(self, tell: ProgressCallback) -> Outcome:
        """Return the outcome; `tell` receives the name and the progress of each step."""
        case, machine = self.case, self.case.machine
        tell("recordings", 0.05)
        told = self.judge_recordings()
        tell("sensors and tool points", 0.1)
        detected = self._detect()
        tell("fitting the reference", 0.2)
        reference = stack_side(case.reference, machine)
        field = stack_side(correct_positions(case.field, detected, machine), machine)
        decider = Decider(reference, field, self._measure_noise(detected), self.clock_late_s)
        tell("simulating every effect", 0.45)
        decision = decider.decide()
        named_joints = {machine.joint_names[j] for one in decision.named for j in one.joints}
        told = accept_named_joints(told, sorted(named_joints))
        if failed := gates.list_failures(told):
            decision = replace(decision, verdict="unknown", named=())
        tell("sizes and proof", 0.8)
        named = [] if failed else self._list_named(decision, detected)
        findings = [one.finding for one in named if one.finding is not None]
        proof = EngineProof(case, decider, findings, self.generator)
        judged = proof.judge() if findings or decision.verdict == "none" else []
        if not failed and (failed := gates.list_failures(judged)):
            decision = replace(decision, verdict="unknown", named=())
            named = [one for one in named if one.finding is None]
            proof = EngineProof(case, decider, [], self.generator)
        selected = [self._describe(one, proof) for one in sorted(named, key=_get_nats)]
        verdict = "effects" if selected else decision.verdict
        reason = _explain(verdict, selected, decision, failed)
        told = (*told, *judged)
        evidence = _describe_evidence(decision)
        return self.build_outcome(verdict, selected, decision.rivals, proof, told, reason, evidence)

    def _detect(self) -> list[DetectedEffect]:
        """Return the effects that tool points and the scatter of samples show."""
        found = geometry.find_geometry_errors(self.case, self.kinds, DIRECT_NATS, NAME_NATS)
        for kind in self.kinds:
            # Steps of a coarse sensor are found by the engine itself.
            if kind.name == "sensor_noise":
                noise = sensors.find_sensor_noise(self.case, kind, DIRECT_NATS, NAME_NATS)
                found += [] if noise is None else [noise]
        return found

    def _measure_noise(self, detected: Sequence[DetectedEffect]) -> np.ndarray:
        """Return the noise that noisy sensors add, units, `(J,)`."""
        machine = self.case.machine
        found = np.zeros(machine.num_joints)
        for one in detected:
            if one.kind.name == "sensor_noise":
                for name, sigma in one.parameters["sigma_rad"].items():
                    found[machine.joint_names.index(name)] = sigma.mean
        return found / measure_units(machine)

    def _list_named(
        self, decision: Decision, detected: Sequence[DetectedEffect]
    ) -> list[NamedEffect]:
        kinds = {kind.name: kind for kind in self.kinds}
        found = [NamedEffect(one.kind, None, one) for one in detected]
        for finding in decision.named if decision.verdict == "effects" else ():
            # The engine simulates a clock that is late as a dead time of all joints.
            is_clock = self.clock_late_s != 0.0 and finding.name == "dead_time"
            name = "clock_offset" if is_clock else finding.name
            if name in kinds and name not in [one.kind.name for one in found]:
                found.append(NamedEffect(kinds[name], finding, None))
        return found

    @cached_property
    def clock_late_s(self) -> float:
        """By how much the encoders lag behind the tool tracker more than on the reference, s; 0 within its own wandering."""
        now = measure_clock_shift(self.case.field, self.case.machine)
        then = measure_clock_shift(self.case.reference, self.case.machine)
        if now is None:
            return 0.0
        late_s = now - (then or 0.0)
        return late_s if abs(late_s) > CLOCK_SHIFT_S else 0.0

    def _describe(self, one: NamedEffect, proof: EngineProof) -> Selected:
        machine = self.case.machine
        if one.detected is not None:
            return describe_detected(one.detected, machine)
        finding = one.finding
        assert finding is not None, "an effect was found one way or the other"
        if one.kind.name == "clock_offset":
            offset = describe_clock(self.clock_late_s)
            parameters = {"offset_s": dict.fromkeys(machine.joint_names, offset)}
        elif one.kind.name == "quantisation":
            coarse = name_joints(finding.joints, machine)
            parameters = {"step_rad": {name: proof.steps[name] for name in coarse}}
        else:
            rows = proof.sizes[finding.effect]
            parameters = describe_numbers(one.kind, rows, finding.hold, machine)
        return self.describe_simulated(one.kind.name, finding, parameters, proof)


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
        edit={"own_statistic_explained": one.closed},
    )


def describe_clock(late_s: float) -> Estimate:
    """Return the time by which encoders lag behind the tool tracker with its 95 % interval."""
    half = SIGMAS * float(np.hypot(CLOCK_ERROR_S, CLOCK_ERROR * late_s))
    return Estimate(late_s, (late_s - half, late_s + half))


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
        return (
            "clock_offset",
        ), "one clock for commands and positions, or a pulse that both record"
    return (), None


ACCEPTED_FINDINGS = ("does_not_obey", "unlogged_input")
"""Findings about a joint that a named effect may be the cause of."""


def accept_named_joints(told: Sequence[Gate], named: Sequence[str]) -> list[Gate]:
    """Return the gates of the recordings; joints that do not move as commanded may have a named effect.

    Whether the effect explains it is told by the proof: the repaired simulator has to beat standing
    still on that joint.
    """
    found = []
    for gate in told:
        is_named = any(f", on {name};" in gate.text for name in named)
        passed = gate.passed or (gate.name in ACCEPTED_FINDINGS and is_named)
        found.append(replace(gate, passed=passed))
    return found


def _get_nats(one: NamedEffect) -> float:
    """Return the key that puts the effect that earns most first."""
    if one.finding is not None:
        return -one.finding.nats
    assert one.detected is not None, "an effect was found one way or the other"
    return -one.detected.gain


def estimate_probability(nats: float) -> float:
    """Return the probability that a named effect is there."""
    odds = np.exp((min(nats, 300.0) - NATS_OF_HALF) / NATS_OF_SURE)
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
        if not all(column in recording.extra for column in geometry.TOOL_COLUMNS):
            continue
        seen = np.stack([recording.extra[column] for column in geometry.TOOL_COLUMNS], 1)
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


def rank_effects(
    selected: Sequence[Selected], rivals: Sequence[EffectFinding], verdict: str, machine: Machine
) -> tuple[Ranked, ...]:
    """Return all that is worth naming, the most probable first.

    Args:
        selected: What is named.
        rivals: All effects with what they earn, the best first.
        verdict: `effects`, `none` or `unknown`.
        machine: Gives the joints' names.
    """
    found = [Ranked(one.effect, one.joints, one.probability) for one in selected]
    left = 1.0 - max([one.probability for one in selected], default=0.0)
    if verdict != "effects":
        found.append(Ranked(verdict, (), 0.8))
        left = 0.2
    names = {one.effect for one in selected}
    for one in rivals[:MAX_RIVALS]:
        if one.name not in names and one.nats > 0.0:
            chance = left * float(np.clip(one.nats / 100.0, 0.01, 0.5))
            found.append(Ranked(one.name, name_joints(one.joints, machine), chance))
            names.add(one.name)
    return tuple(sorted(found, key=lambda one: -one.probability))


def name_joints(joints: Sequence[int], machine: Machine) -> tuple[str, ...]:
    """Return the names of joints by their places."""
    return tuple(machine.joint_names[j] for j in joints)


def describe_rivals(rivals: Sequence[EffectFinding], machine: Machine) -> list[dict[str, Any]]:
    """Return what each effect earns, plain JSON data."""
    rows = []
    for one in rivals:
        told = {"name": one.name, "effect": one.name, "score": one.nats}
        rows.append(told | {"joints": list(name_joints(one.joints, machine))})
    return rows


def propose_measurement(selected: Sequence[Selected]) -> NextExperiment | None:
    """Return the measurement that would tell apart what these recordings cannot."""
    for one in selected:
        if one.same_as and one.decided_by:
            return NextExperiment(
                "", (one.effect, *one.same_as), f"no excitation does; {one.decided_by} would"
            )
    return None


def _explain(verdict: str, selected: Sequence[Selected], decision: Decision, failed: str) -> str:
    if failed:
        return f"cannot tell, because {failed}"
    if verdict == "effects":
        return "; ".join(f"{one.effect} on {', '.join(one.joints)}" for one in selected)
    if verdict == "none":
        return "no effect earns more on the field recordings than it would by chance"
    group, nats = decision.generic
    return (
        "the gap is real, and no effect of the library explains it; "
        f"the field follows a law of: {group} ({nats:.0f} nats)"
    )


def _describe_evidence(decision: Decision) -> dict[str, Any]:
    """Return what each effect earns beside the first, and each cause outside the library, plain JSON data."""
    outside = decision.outside
    return {
        "second": [{"effect": one.name, "score": one.nats} for one in decision.seconds[:5]],
        "outside": None if outside is None else {"cause": outside.effect, "score": outside.nats},
        "generic": {"group": decision.generic[0], "score": decision.generic[1]},
        "left": decision.left,
    }
