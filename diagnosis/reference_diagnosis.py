"""The diagnosis of a case with a reference: what the recordings show directly, the engine, sizes and proof.

Axes: `W` windows, `K` steps, `J` joints, `B` draws of the bootstrap.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from actuators.recordings.inspection import InspectionThresholds
from actuators.recordings.recording_checks import examine_recordings
from brokk_rl.history import History
from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis import gates, geometry, sensors
from diagnosis.answer import Answer, NextExperiment, Outcome, Ranked, Selected
from diagnosis.case import GapCase
from diagnosis.closure import Gate
from diagnosis.effect_library import DetectedEffect, EffectType, StationaryModel
from diagnosis.engine.decide import Decider, Decision, EffectFinding
from diagnosis.engine.side import measure_units, stack_side
from diagnosis.engine.sizes import describe_numbers
from diagnosis.free_runs import WindowedRuns
from diagnosis.repair_proof import EngineProof
from diagnosis.survey import Survey, examine_gap

ProgressCallback = Callable[[str, float], None]
"""Receives the name of a step and the share of the whole that is done."""
DIRECT_NATS = 4.0
NAME_NATS = 12.0
"""Cost of a joint and of a name where tool points or the scatter of samples show an effect."""
CLOCK_SHIFT_S = 0.01
"""Least shift between encoders and tool tracker that is named; the trackers' own clock wanders less."""
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
class ReferenceDiagnosis:
    """A diagnosis of a machine of which earlier recordings are known.

    Attributes:
        case: The recordings.
        kinds: The library.
        thresholds: When a stretch of a recording is worth telling.
        generator: Draws bootstraps and permutations.
    """

    case: GapCase
    kinds: Sequence[EffectType]
    thresholds: InspectionThresholds
    generator: np.random.Generator

    def run(self, tell: ProgressCallback) -> Outcome:
        """Return the outcome; `tell` receives the name and the progress of each step."""
        case, machine = self.case, self.case.machine
        tell("recordings", 0.05)
        remarks = examine_recordings(case.field, machine, self.thresholds)
        told = gates.judge_recordings(remarks, case.field, case.reference, machine)
        tell("sensors and tool points", 0.1)
        detected = self._detect()
        tell("fitting the reference", 0.2)
        reference = stack_side(case.reference, machine)
        field = stack_side(correct_positions(case.field, detected, machine), machine)
        decider = Decider(reference, field, self._measure_noise(detected))
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
        return self._build_outcome(decision, named, proof, (*told, *judged), failed)

    def _detect(self) -> list[DetectedEffect]:
        """Return the effects that tool points and the scatter of samples show."""
        on_tool = geometry.find_geometry_errors(self.case, self.kinds, DIRECT_NATS, NAME_NATS)
        noisy = [kind for kind in self.kinds if kind.name in ("sensor_noise", "quantisation")]
        rough = sensors.find_sensor_effects(self.case, noisy, DIRECT_NATS, NAME_NATS)
        # Steps of a coarse sensor are found by the engine itself.
        return [*on_tool.found, *(one for one in rough if one.kind.name == "sensor_noise")]

    def _measure_noise(self, detected: Sequence[DetectedEffect]) -> np.ndarray:
        """Return the noise that noisy sensors add, units, `(J,)`."""
        machine = self.case.machine
        noisy = np.zeros(machine.num_joints, dtype=bool)
        for one in detected:
            if one.kind.name == "sensor_noise":
                noisy |= one.joints
        if not noisy.any():
            return np.zeros(machine.num_joints)
        excess = sensors.measure_excess_scatter(self.case.field, self.case.reference, machine)
        return excess * noisy / measure_units(machine)

    def _list_named(
        self, decision: Decision, detected: Sequence[DetectedEffect]
    ) -> list[NamedEffect]:
        kinds = {kind.name: kind for kind in self.kinds}
        # Frames that come late shake all joints, which looks like noise of all sensors.
        is_held = any(one.hold is not None for one in decision.named)
        found = []
        for one in detected:
            if not (is_held and one.kind.name == "sensor_noise" and one.joints.all()):
                found.append(NamedEffect(one.kind, None, one))
        for finding in decision.named if decision.verdict == "effects" else ():
            name = self._name_delay(finding)
            if name in kinds and name not in [one.kind.name for one in found]:
                found.append(NamedEffect(kinds[name], finding, None))
        return found

    def _name_delay(self, finding: EffectFinding) -> str:
        """Return the name of a finding; a delay of all joints that the tool tracker lacks is one of the clock."""
        if finding.name != "dead_time" or len(finding.joints) < self.case.machine.num_joints:
            return finding.name
        field = measure_clock_shift(self.case.field, self.case.machine)
        known = measure_clock_shift(self.case.reference, self.case.machine)
        if field is None:
            return finding.name
        return "clock_offset" if abs(field - (known or 0.0)) > CLOCK_SHIFT_S else finding.name

    def _build_outcome(
        self,
        decision: Decision,
        named: Sequence[NamedEffect],
        proof: EngineProof,
        told: Sequence[Gate],
        failed: str,
    ) -> Outcome:
        machine = self.case.machine
        before = proof.view(proof.before)
        after = proof.view(proof.after) if named else None
        floor = proof.view_floor()
        survey = self._examine(before, floor, after)
        selected = [self._describe(one, proof) for one in sorted(named, key=_get_nats)]
        verdict = "effects" if selected else decision.verdict
        answer = Answer(
            verdict=verdict,
            selected=tuple(selected),
            ranking=rank_effects(selected, decision.rivals, verdict, machine),
            where=survey.where(selected, self.kinds),
            gap=proof.measure_gap(bool(named)),
            rivals=proof.rivals,
            gates=tuple(told),
            next_experiment=propose_measurement(selected),
            reason=_explain(verdict, selected, decision, failed),
            more=survey.more() | {"evidence": _describe_evidence(decision, machine)},
        )
        return Outcome(answer, before, after, floor)

    def _examine(
        self, before: WindowedRuns, floor: WindowedRuns | None, after: WindowedRuns | None
    ) -> Survey:
        machine = self.case.machine
        dead_time_s = np.full(machine.num_joints, machine.dead_time_s)
        return examine_gap(
            before, floor, after, machine, self.thresholds, dead_time_s, self.generator
        )

    def _describe(self, one: NamedEffect, proof: EngineProof) -> Selected:
        machine = self.case.machine
        if one.detected is not None:
            return describe_detected(one.detected, machine)
        finding = one.finding
        assert finding is not None, "an effect was found one way or the other"
        # A clock that is late was simulated as a dead time.
        simulated = {kind.name: kind for kind in self.kinds}.get(finding.name, one.kind)
        parameters = describe_numbers(simulated, proof.sizes[finding.effect], finding.hold, machine)
        if one.kind.name == "clock_offset":
            parameters = {"offset_s": parameters["dead_time_s"]}
        part = proof.parts.get(finding.effect)
        like, decided_by = list_alike(one.kind.name, finding.joints, self.case, self.kinds)
        return Selected(
            effect=one.kind.name,
            joints=name_joints(finding.joints, machine),
            probability=estimate_probability(finding.nats),
            parameters=parameters,
            gap_closed=None if part is None else part["closed"],
            same_as=like,
            decided_by=decided_by,
            identified=None if part is None else part["identified"],
            edit=None if part is None else part["edit"],
        )


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
        is_named = any(f"on {name} " in gate.text for name in named)
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
        model = one.kind.wrap(StationaryModel(), machine, 2, torch.device("cpu"))
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
    """Return by how much encoders lag behind measured tool points, s; `None` where none are measured."""
    if not geometry.is_tracked(recordings, machine):
        return None
    kinematics = Kinematics(machine)
    products, squares = 0.0, 0.0
    for recording in recordings:
        if not all(column in recording.extra for column in geometry.TOOL_COLUMNS):
            continue
        seen = np.stack([recording.extra[column] for column in geometry.TOOL_COLUMNS], 1)
        pose, _ = kinematics.pose_and_jacobian(torch.as_tensor(recording.q, dtype=torch.float32))
        tip = pose.tip_in_base_m.numpy().astype(float)
        velocity = np.gradient(tip, machine.period_s, axis=0)
        off = seen - tip
        given = np.isfinite(off).all(1)
        off = off[given] - off[given].mean(0)
        products += float((off * velocity[given]).sum())
        squares += float(np.square(velocity[given]).sum())
    return products / max(squares, 1e-12)


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


def _describe_evidence(decision: Decision, machine: Machine) -> dict[str, Any]:
    """Return what each effect earns, plain JSON data."""
    outside = decision.outside
    return {
        "rivals": describe_rivals(decision.rivals, machine),
        "second": [{"effect": one.name, "score": one.nats} for one in decision.seconds[:5]],
        "outside": None if outside is None else {"cause": outside.effect, "score": outside.nats},
        "generic": {"group": decision.generic[0], "score": decision.generic[1]},
        "left": decision.left,
        "unit": "log likelihood",
    }
