"""Survey of a gap before any effect is fitted: location, stages, error of the tool, recordings.

The stages are timing, actuation, sensing, kinematics and perception. Timing, actuation and sensing
share the error of the joints. Kinematics and perception are errors of their own, in metres at the
tool.

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
from actuators.recordings.recording_checks import RecordingRemark, examine_recordings
from actuators.scales import scale_time
from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis.answer import JointGap, RegimeGap, Stage, Where
from diagnosis.free_runs import WindowedRuns
from diagnosis.geometry import TOOL_COLUMNS, ToolPointErrors, compare_tool_points
from diagnosis.sensors import estimate_sensor_noise
from diagnosis.where import GapLocation, locate_gap

SPAN_S = 0.25
"""Time over which speeds are taken on the reference of `actuators.scales`, s; chosen by hand: shorter
ones are noise, longer ones blur."""
CONTACT_N = 200.0
"""Force at the tool that counts as contact, N; chosen by hand: above the noise of a force that is
computed from pressures."""
MIN_EXPLAINED, MIN_EXCESS_RATIO = 0.05, 1.5
"""Share explained by one error of geometry, and ratio to the reference's error, from which the
kinematics count as wrong; chosen by hand: the noise of tool points differs between poses."""
MAX_TARGET_DISTANCE_M = 0.5
"""Largest distance of the touched hole from the tip, m; chosen by hand."""
MIN_PART = 0.1
"""Part of a joint's excess from which its lateness or its sensor noise is told. Chosen by hand; not
searched."""
TARGET_COLUMNS = ("target_x_m", "target_y_m", "target_z_m")
MAX_LISTED = 12
"""Most regimes in `diagnosis.json`."""


@dataclass(frozen=True)
class TipError:
    """Error of the tip over free runs of one simulator.

    Attributes:
        tip_rms_m: Root mean square distance between simulated and measured tip, m.
        joint_part: Part of the mean squared distance that each joint answers for; they add up to 1,
            one below 0 cancels others.
    """

    tip_rms_m: float
    joint_part: dict[str, float]


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
    tip_rms_m = float(np.sqrt((distance**2).sum(1).mean()))
    return TipError(tip_rms_m, dict(zip(machine.joint_names, part.tolist(), strict=True)))


@dataclass(frozen=True)
class StageFinding:
    """Contribution of a stage to the gap.

    Attributes:
        stage: Its name.
        part: Part of the joints' gap; `None` for a stage that is no part of it.
        rms_m: Its contribution at the tool, m; `None` where it is unknown.
        text: Why, in a sentence.
    """

    stage: Stage
    part: float | None
    rms_m: float | None
    text: str


def select_stage(findings: Sequence[StageFinding], has_gap: bool) -> Stage | None:
    """Return the stage with the largest contribution at the tool; `None` without a gap."""
    # Tool points and touches show errors of their own where the joints have no gap.
    weighed: list[tuple[float, Stage]] = []
    for one in findings:
        weight = one.rms_m if one.rms_m is not None else one.part or 0.0
        if weight > 0.0 and (has_gap or one.part is None):
            weighed.append((weight, one.stage))
    return max(weighed)[1] if weighed else None


def split_joint_gap(
    location: GapLocation,
    runs: WindowedRuns,
    reference: WindowedRuns | None,
    machine: Machine,
    tip_excess_m: float | None,
) -> list[StageFinding]:
    """Return the parts of timing, sensing and actuation in the joints' gap.

    Args:
        location: The gap of each joint.
        runs: Free runs through field recordings.
        reference: The same through reference recordings.
        machine: The machine.
        tip_excess_m: Error of the tip beyond the floor, m; `None` where it is not known.
    """
    late_s, floor_s = (_estimate_lateness(one, machine) for one in (runs, reference or runs))
    floor_s = floor_s if reference else np.zeros_like(late_s)
    noise = estimate_sensor_noise(runs.recordings)
    floor_noise = estimate_sensor_noise(reference.recordings) if reference else 0.0 * noise
    speed = _change_over_span(runs.simulated, machine)
    timing, sensing = 0.0, 0.0
    late, noisy = [], []
    for j, (name, joint) in enumerate(location.joints.items()):
        excess = max(joint.rmse**2 - joint.floor**2, 1e-18)
        # A delay displaces by speed times time.
        moved = float(np.nanmean(speed[..., j] ** 2)) * (late_s[j] - floor_s[j]) ** 2
        if moved > MIN_PART * excess:
            timing += joint.gap * min(1.0, moved / excess)
            late.append(
                f"{name} moves {1e3 * (late_s[j] - floor_s[j]):+.0f} ms later than simulated"
            )
        # The start of a window is measured as well, so noise counts twice.
        more = 2.0 * max(noise[j] ** 2 - floor_noise[j] ** 2, 0.0)
        if more > MIN_PART * excess:
            sensing += joint.gap * min(1.0, more / excess)
            unit = machine.joints[j].unit
            noisy.append(
                f"{name} has {1e3 * noise[j]:.2f} m{unit} of noise, {1e3 * floor_noise[j]:.2f} on the reference"
            )
    timing = min(timing, 1.0)
    sensing = min(sensing, 1.0 - timing)
    rows: list[tuple[Stage, float, str]] = [
        ("timing", timing, "; ".join(late) or "no joint moves later or earlier than simulated"),
        ("sensing", sensing, "; ".join(noisy) or "no sensor is noisier than on the reference"),
        ("actuation", 1.0 - timing - sensing, "what is left of the joints' gap"),
    ]
    found = []
    for stage, part, text in rows:
        rms_m = None if tip_excess_m is None else tip_excess_m * float(np.sqrt(part))
        found.append(StageFinding(stage, part, rms_m, text))
    return found


def _change_over_span(values: np.ndarray, machine: Machine) -> np.ndarray:
    """Return the rate of change over `SPAN_S`, `(W, K, J)`, NaN before there are so many steps."""
    span = max(1, round(scale_time(machine, SPAN_S) / machine.period_s))
    found = np.full(values.shape, np.nan)
    found[:, span:] = (values[:, span:] - values[:, :-span]) / (span * machine.period_s)
    return found


def _estimate_lateness(runs: WindowedRuns, machine: Machine) -> np.ndarray:
    """Return how much later each joint moves than simulated, s, `(J,)`.

    A delay leaves an error of speed in proportion to the acceleration; gain is fitted beside it, since
    every simulator errs a little there too.
    """
    excess = _change_over_span(runs.error, machine)
    speed = _change_over_span(runs.simulated, machine)
    acceleration = _change_over_span(speed, machine)
    late_s = np.zeros(machine.num_joints)
    for j in range(machine.num_joints):
        given = np.isfinite(excess[..., j]) & np.isfinite(acceleration[..., j])
        columns = np.stack([acceleration[..., j][given], speed[..., j][given]], 1)
        late_s[j] = np.linalg.lstsq(columns, excess[..., j][given])[0][0]
    return late_s


def assess_kinematics(
    field: ToolPointErrors | None, reference: ToolPointErrors | None
) -> StageFinding | None:
    """Return what measured tool points say about the geometry; `None` without any."""
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


@dataclass(frozen=True)
class Survey:
    """Location, stages, errors of the tip, geometry and recordings of a gap.

    Attributes:
        remarks: About the recordings.
        location: Where the gap lies.
        stages: Contributions of the stages.
        tip: Errors of the tip: `before`, `after` the effects, `floor`; empty without geometry.
        geometry: Errors of measured tool points.
        machine: The machine.
    """

    remarks: Sequence[RecordingRemark]
    location: GapLocation
    stages: Sequence[StageFinding]
    tip: dict[str, TipError]
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
        units = {joint.name: joint.unit for joint in self.machine.joints}
        return Where(joints, tuple(regimes[:MAX_LISTED]), stage, units)

    def more(self) -> dict[str, Any]:
        """Return further fields of `diagnosis.json`, plain JSON data."""
        return {
            "sanity": [remark.plain() for remark in self.remarks],
            "location": self.location.plain(),
            "stages": [asdict(stage) for stage in self.stages],
            "tip": {name: asdict(one) for name, one in self.tip.items()},
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
) -> Survey:
    """Survey a gap before any effect is fitted.

    Args:
        before: Free runs of the simulator as it was through field recordings.
        floor: The same through reference recordings that it was not fitted to; `None`: there is no
            floor.
        after: Free runs with the selected effects, for the error of the tip; `None` without.
        machine: The machine.
        thresholds: When a stretch of a recording is worth telling.
        dead_time_s: Time from command to motion of each joint, `(J,)`.
        generator: Draws the permutations.
    """
    location = locate_gap(before, floor, machine, dead_time_s, generator)
    geometry = compare_tool_points(before.recordings, machine)
    reference_geometry = compare_tool_points(floor.recordings, machine) if floor else None
    tip: dict[str, TipError] = {}
    tip_excess_m = None
    if machine.has_bodies:
        for name, runs in (("before", before), ("after", after), ("floor", floor)):
            if runs is not None:
                tip[name] = measure_tip_error(runs, machine)
        floor_m = tip["floor"].tip_rms_m if floor else 0.0
        tip_excess_m = float(np.sqrt(max(tip["before"].tip_rms_m ** 2 - floor_m**2, 0.0)))
    stages = split_joint_gap(location, before, floor, machine, tip_excess_m)
    others = (
        assess_kinematics(geometry, reference_geometry),
        assess_perception(before.recordings, machine),
    )
    stages += filter(None, others)
    remarks = examine_recordings(before.recordings, machine, thresholds)
    return Survey(remarks, location, stages, tip, geometry, machine)
