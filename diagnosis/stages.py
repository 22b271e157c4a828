"""Survey of a gap before any effect is fitted: tip error, stages, recordings, location.

The stages are timing, actuation, sensing, kinematics, perception and contact. Timing, actuation and
sensing share the error of the joints. Kinematics and perception are errors of their own, in metres
at the tool.

The errors of the joints add up at the tip as vectors and may cancel. The part of joint `j` is its
contribution along the whole error, summed over all samples: `Σ (J_j e_j) · d / Σ d · d` with
`d = Σ_j J_j e_j`. The parts add up to 1.
Axes: `W` windows, `K` steps, `J` joints, `S` samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch

from actuators.recordings.inspection import InspectionThresholds
from actuators.scales import scale_time
from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis.answer import JointGap, RegimeGap, Stage, Where
from diagnosis.free_runs import WindowedRuns
from diagnosis.geometry import TOOL_COLUMNS, ToolPointErrors, compare_tool_points
from diagnosis.probes import SPAN_S, Probe, probe_residuals
from diagnosis.sanity import RecordingRemark, examine_recordings
from diagnosis.sensors import estimate_sensor_noise
from diagnosis.where import GapLocation, JointError, locate_gap


@dataclass(frozen=True)
class TipError:
    """Error of the tip over free runs of one simulator.

    Attributes:
        tip_rms_m: Root mean square distance between simulated and measured tip, m.
        joint_rms_m: Displacement of the tip by each joint's error alone, root mean square, m.
        joint_part: Part of the mean squared distance that each joint answers for; they add up to 1,
            one below 0 cancels others.
    """

    tip_rms_m: float
    joint_rms_m: dict[str, float]
    joint_part: dict[str, float]


@dataclass(frozen=True)
class TipErrorBudget:
    """Tip error before and after the effects, and the floor; `None` without such a simulator.

    Attributes:
        before: Of the simulator as it was.
        after: With the selected effects.
        floor: Of the simulator on reference recordings.
        stages_m: Root mean square of the contribution of other stages, by stage, m.
    """

    before: TipError
    after: TipError | None
    floor: TipError | None
    stages_m: dict[str, float]

    def plain(self) -> dict[str, Any]:
        """Return it as plain JSON data, in mm as its name says."""

        def account(one: TipError | None) -> dict[str, Any] | None:
            return one and {
                "tip_rms_mm": 1e3 * one.tip_rms_m,
                "joint_rms_mm": {name: 1e3 * value for name, value in one.joint_rms_m.items()},
                "joint_part": one.joint_part,
            }

        stages = {name: 1e3 * value for name, value in self.stages_m.items()}
        return {name: account(getattr(self, name)) for name in ("before", "after", "floor")} | {
            "stages_mm": stages
        }


def measure_tip_error(runs: WindowedRuns, machine: Machine) -> TipError:
    """Return the error of the tip over free runs.

    Raises:
        ConfigError: the machine's geometry is not known.
    """
    given = np.isfinite(runs.error).all(2)
    measured, error = runs.measured[given], runs.error[given]
    kinematics = Kinematics(machine)
    pose, jacobian = kinematics.pose_and_jacobian(torch.as_tensor(measured, dtype=torch.float32))
    simulated = kinematics.pose(torch.as_tensor(measured + error, dtype=torch.float32))
    distance = (simulated.tip_in_base_m - pose.tip_in_base_m).numpy().astype(float)
    moved = jacobian.tip.numpy().astype(float) * error[:, None, :]  # (S, 3, J)
    whole = moved.sum(2)
    along = np.einsum("sij,si->j", moved, whole)
    part = along / max(float((whole**2).sum()), np.finfo(float).tiny)
    alone = np.sqrt((moved**2).sum(1).mean(0))
    names = machine.joint_names
    return TipError(
        float(np.sqrt((distance**2).sum(1).mean())),
        dict(zip(names, alone.tolist(), strict=True)),
        dict(zip(names, part.tolist(), strict=True)),
    )


STAGE_OF: dict[str, Stage] = {
    "dead_time": "timing", "delay_jitter": "timing", "frame_loss": "timing", "clock_offset": "timing",
    "quantisation": "sensing", "sensor_noise": "sensing",
    "encoder_bias": "kinematics", "encoder_scale": "kinematics", "link_length": "kinematics", "base_tilt": "kinematics",
    "extrinsics": "perception",
}  # fmt: skip
"""Stage of each effect; all others are of the actuation."""
CONTACT_N = 200.0
"""Force at the tool that counts as contact, N; chosen by hand: above the noise of a force that is
computed from pressures."""
MIN_EXPLAINED, MIN_EXCESS_RATIO = 0.05, 1.5
"""Share explained by one error of geometry, and ratio to the reference's error, from which the
kinematics count as wrong; chosen by hand: the noise of tool points differs between poses."""
MAX_TARGET_DISTANCE_M = 0.5
"""Largest distance of the touched hole from the tip, m; chosen by hand."""
MIN_NOISE_PART, MIN_GAP_PART = 0.1, 0.01
"""Part of a joint's excess, and of the gap, from which its sensor noise is told. Chosen by hand; not
searched."""
TARGET_COLUMNS = ("target_x_m", "target_y_m", "target_z_m")


@dataclass(frozen=True)
class StageFinding:
    """Contribution of a stage to the gap.

    Attributes:
        stage: Its name.
        part: Part of the joints' gap; `None` for a stage that is no part of it.
        rms_m: Its contribution at the tool, m; `None` where it is unknown.
        text: Why, in a sentence.
    """

    stage: str
    part: float | None
    rms_m: float | None
    text: str

    def plain(self) -> dict[str, Any]:
        """Return it as plain JSON data."""
        return asdict(self)


@dataclass(frozen=True)
class StageEvidence:
    """Inputs of the attribution to stages."""

    location: GapLocation
    probes: Sequence[Probe]
    budget: TipErrorBudget | None
    field_geometry: ToolPointErrors | None
    reference_geometry: ToolPointErrors | None


def attribute_to_stages(
    known: StageEvidence, runs: WindowedRuns, reference: WindowedRuns | None, machine: Machine
) -> list[StageFinding]:
    """Return the contribution of each stage about which the recordings tell something."""
    whole_m = _compute_tip_excess(known.budget) if known.budget else None
    found = _split_joint_gap(known, runs, reference, machine, whole_m)
    others = (
        _assess_kinematics(known),
        assess_perception(runs.recordings, machine),
        _assess_contact(runs),
    )
    return [*found, *filter(None, others)]


def select_stage(findings: Sequence[StageFinding], has_gap: bool) -> Stage | None:
    """Return the stage with the largest contribution at the tool; `None` without a gap."""
    # Tool points and touches show errors of their own where the joints have no gap.
    usable = ["kinematics", "perception"]
    if has_gap:
        usable += ["timing", "actuation", "sensing"]
    weighed = []
    for one in findings:
        weight = one.rms_m if one.rms_m is not None else one.part or 0.0
        if one.stage in usable and weight > 0.0:
            weighed.append((weight, one.stage))
    return max(weighed)[1] if weighed else None  # type: ignore[return-value]


def _compute_tip_excess(budget: TipErrorBudget) -> float:
    """Return the tip error beyond the floor, root mean square, m."""
    floor_m = budget.floor.tip_rms_m if budget.floor else 0.0
    return float(np.sqrt(max(budget.before.tip_rms_m**2 - floor_m**2, 0.0)))


def _split_joint_gap(
    known: StageEvidence,
    runs: WindowedRuns,
    reference: WindowedRuns | None,
    machine: Machine,
    whole_m: float | None,
) -> list[StageFinding]:
    timing, late = _assess_timing(known, runs, machine)
    sensing, noisy = _assess_sensing(known, runs, reference, machine)
    timing = min(timing, 1.0)
    sensing = min(sensing, 1.0 - timing)
    rows = (
        (
            "timing",
            timing,
            "; ".join(late)
            or "no joint moves earlier or later than simulated, beyond what the reference shows",
        ),
        ("sensing", sensing, "; ".join(noisy) or "no sensor is noisier than on the reference"),
        ("actuation", 1.0 - timing - sensing, "what is left of the joints' gap"),
    )
    found = []
    for stage, part, text in rows:
        rms_m = None if whole_m is None else whole_m * float(np.sqrt(part))
        found.append(StageFinding(stage, part, rms_m, text))
    return found


def _assess_timing(
    known: StageEvidence, runs: WindowedRuns, machine: Machine
) -> tuple[float, list[str]]:
    """Return the part of timing in the joints' gap, and a sentence for each late joint."""
    part, texts = 0.0, []
    clear = [probe for probe in known.probes if probe.effect == "dead_time" and probe.is_clear]
    late = {probe.joint: probe for probe in clear}
    span = max(1, round(scale_time(machine, SPAN_S) / machine.period_s))
    speed = (runs.simulated[:, span:] - runs.simulated[:, :-span]) / (span * machine.period_s)
    for j, (name, joint) in enumerate(known.location.joints.items()):
        if name in late:
            probe = late[name]
            # A delay displaces by speed times time.
            moved = float(np.mean(speed[..., j] ** 2)) * (probe.value - probe.reference) ** 2
            part += joint.gap * min(1.0, moved / _compute_joint_excess(joint))
            texts.append(probe.text)
    return part, texts


def _assess_sensing(
    known: StageEvidence, runs: WindowedRuns, reference: WindowedRuns | None, machine: Machine
) -> tuple[float, list[str]]:
    """Return the part of sensor noise in the joints' gap, and a sentence for each noisy joint."""
    part, texts = 0.0, []
    noise = estimate_sensor_noise(runs.recordings)
    floor = estimate_sensor_noise(reference.recordings) if reference else np.zeros_like(noise)
    for j, (name, joint) in enumerate(known.location.joints.items()):
        excess = _compute_joint_excess(joint)
        # The start of a window is measured as well, so noise counts twice.
        more = 2.0 * max(noise[j] ** 2 - floor[j] ** 2, 0.0)
        if more > MIN_NOISE_PART * excess and joint.gap > MIN_GAP_PART:
            part += joint.gap * min(1.0, more / excess)
            unit = machine.joints[j].unit
            texts.append(
                f"{name} has {1e3 * noise[j]:.2f} m{unit} of noise, {1e3 * floor[j]:.2f} on the reference"
            )
    return part, texts


def _compute_joint_excess(joint: JointError) -> float:
    """Return the mean squared error beyond the floor, never 0."""
    return max(joint.rmse**2 - joint.floor**2, 1e-18)


def _assess_kinematics(known: StageEvidence) -> StageFinding | None:
    field, reference = known.field_geometry, known.reference_geometry
    if field is None:
        return None
    floor_m = reference.rms_m if reference else 0.0
    excess_m = float(np.sqrt(max(field.rms_m**2 - floor_m**2, 0.0)))
    by_cause_m = field.rms_m * float(np.sqrt(field.explained))
    text = f"measured tool points lie {1e3 * field.rms_m:.1f} mm from forward kinematics"
    text += f" ({1e3 * floor_m:.1f} mm on the reference)" if reference else ""
    is_explained = field.explained > max(
        MIN_EXPLAINED, 2.0 * reference.explained if reference else 0.0
    )
    if is_explained or field.rms_m > MIN_EXCESS_RATIO * floor_m:
        scale, unit = (1e3, f"m{field.unit}") if field.unit else (1e2, "%")
        text += f"; {100 * field.explained:.0f} % of it is explained by {field.cause} of {scale * field.size:+.1f} {unit}"
    else:
        excess_m = 0.0
    return StageFinding("kinematics", None, by_cause_m if is_explained else excess_m, text)


def assess_perception(recordings: Sequence[Recording], machine: Machine) -> StageFinding | None:
    """Return the distance of estimated boreholes from the touched points, `None` without both."""
    if not machine.has_bodies:
        return None
    off = []
    for recording in recordings:
        extra = recording.extra
        if not {*TARGET_COLUMNS, "force_n"} <= extra.keys():
            continue
        target = np.stack([extra[column] for column in TARGET_COLUMNS], 1).astype(float)
        if {*TOOL_COLUMNS} <= extra.keys():
            tip = np.stack([extra[column] for column in TOOL_COLUMNS], 1).astype(float)
        else:
            q = torch.as_tensor(recording.q, dtype=torch.float32)
            tip = Kinematics(machine).pose(q).tip_in_base_m.numpy()
        # Only the first sample of a touch: afterwards the tool may slide.
        touches = extra["force_n"] > CONTACT_N
        first = touches & ~np.append(False, touches[:-1])
        distance = np.linalg.norm(tip - target, axis=1)[first]
        off += distance[distance < MAX_TARGET_DISTANCE_M].tolist()
    if not off:
        return None
    rms_m = float(np.sqrt(np.mean(np.square(off))))
    text = (
        f"at {len(off)} touches the tip is {1e3 * rms_m:.0f} mm (RMS) from the estimated borehole"
    )
    return StageFinding("perception", None, rms_m, text)


def _assess_contact(runs: WindowedRuns) -> StageFinding | None:
    if not all("force_n" in recording.extra for recording in runs.recordings):
        return None
    force = runs.cut([recording.extra["force_n"] for recording in runs.recordings])
    square = np.nansum(runs.error**2, 2)
    touching = force > CONTACT_N
    if not touching.any():
        return None
    part = float(square[touching].sum() / max(square.sum(), np.finfo(float).tiny))
    time = float(touching.sum() / np.isfinite(force).sum())
    return StageFinding(
        "contact",
        None,
        None,
        f"{100 * part:.0f} % of the squared error lies in contact, {100 * time:.0f} % of the time",
    )


MAX_LISTED = 12
"""Most regimes and probes in `diagnosis.json`."""


@dataclass(frozen=True)
class Survey:
    """Location, probes, stages, tip error, geometry and recordings of a gap."""

    remarks: Sequence[RecordingRemark]
    location: GapLocation
    probes: Sequence[Probe]
    stages: Sequence[StageFinding]
    budget: TipErrorBudget | None
    geometry: ToolPointErrors | None
    machine: Machine

    def where(self) -> Where:
        """Return the field `where` of `diagnosis.json`; shares are those of the gap."""
        joints = {}
        for name, joint in self.location.joints.items():
            joints[name] = JointGap(joint.rmse, joint.floor, joint.gap)
        parts = [part for part in self.location.largest() if part.gap > 0.0]
        regimes = [RegimeGap(part.joint, part.category, part.gap) for part in parts]
        stage = select_stage(self.stages, self.location.has_gap)
        return Where(
            joints,
            tuple(regimes[:MAX_LISTED]),
            stage,
            {joint.name: joint.unit for joint in self.machine.joints},
        )

    def more(self) -> dict[str, Any]:
        """Return further fields of `diagnosis.json`, plain JSON data."""
        return {
            "sanity": [remark.plain() for remark in self.remarks],
            "location": self.location.plain(),
            "probes": [probe.plain() for probe in self.probes[:MAX_LISTED]],
            "stages": [stage.plain() for stage in self.stages],
            "budget": self.budget and self.budget.plain(),
            "geometry": self.geometry and self.geometry.plain(),
        }


def examine_gap(
    before: WindowedRuns,
    floor: WindowedRuns | None,
    after: WindowedRuns | None,
    machine: Machine,
    thresholds: InspectionThresholds,
    dead_time_s: np.ndarray,
    generator: np.random.Generator,
    whole: WindowedRuns | None = None,
) -> Survey:
    """Survey a gap before any effect is fitted.

    Args:
        before: Free runs of the simulator as it was through field recordings.
        floor: The same through reference recordings that it was not fitted to; `None`: there is no
            floor.
        after: Free runs with the selected effects, for the budget; `None` without.
        machine: The machine.
        thresholds: When a stretch of a recording is worth telling.
        dead_time_s: Time from command to motion of each joint, `(J,)`.
        generator: Draws the permutations.
        whole: Free runs through whole field recordings.
    """
    location = locate_gap(before, floor, machine, dead_time_s, generator, whole)
    clues = probe_residuals(before, floor, machine, dead_time_s)
    field_geometry = compare_tool_points(before.recordings, machine)
    reference_geometry = compare_tool_points(floor.recordings, machine) if floor else None
    budget = _measure_budget(before, after, floor, machine) if machine.has_bodies else None
    evidence = StageEvidence(location, clues, budget, field_geometry, reference_geometry)
    rows = attribute_to_stages(evidence, before, floor, machine)
    if budget:
        # A row without a part of the joints' gap is an error of its own, at the tool.
        for row in rows:
            if row.part is None and row.rms_m is not None:
                budget.stages_m[row.stage] = row.rms_m
    return Survey(
        examine_recordings(before.recordings, machine, thresholds),
        location,
        clues,
        rows,
        budget,
        field_geometry,
        machine,
    )


def _measure_budget(
    before: WindowedRuns, after: WindowedRuns | None, floor: WindowedRuns | None, machine: Machine
) -> TipErrorBudget:
    return TipErrorBudget(
        measure_tip_error(before, machine),
        measure_tip_error(after, machine) if after else None,
        measure_tip_error(floor, machine) if floor else None,
        {},
    )
