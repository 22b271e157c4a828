"""On which part of the way from command to estimate the gap lies: timing, actuation, sensing, kinematics, perception, contact.

Timing, actuation and sensing share the gap of the joints; kinematics and perception are errors of
their own, told in millimetres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch

from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis.answer import Stage
from diagnosis.budget import Budget
from diagnosis.free_runs import WindowedRuns
from diagnosis.geometry import COLUMNS, Geometry
from diagnosis.probes import SPAN_S, Probe
from diagnosis.where import Location

STAGE_OF: dict[str, Stage] = {
    "dead_time": "timing", "delay_jitter": "timing", "frame_loss": "timing", "clock_offset": "timing",
    "quantisation": "sensing", "sensor_noise": "sensing",
    "encoder_bias": "kinematics", "encoder_scale": "kinematics", "link_length": "kinematics", "base_tilt": "kinematics",
    "extrinsics": "perception",
}  # fmt: skip
"""Stage of each effect; all others are of the actuation."""
CONTACT_N = 200.0
"""More than this at the tool is contact, not the noise of a force that is computed from
pressures."""
EXPLAINED, FAR = 0.05, 1.5
"""Poses differ, and with them what a measured tool point has of noise: only what one error of
geometry explains so much of, or what is so many times the reference's, counts as an error of
kinematics."""
NEAR_M = 0.5
"""A hole further than this from the tip is not the one that is touched."""
TARGET = ("target_x_m", "target_y_m", "target_z_m")


@dataclass(frozen=True)
class StageFinding:
    """What a stage has to do with the gap.

    Attributes:
        stage: Its name.
        part: Part of the joints' gap; `None` for a stage that is no part of it.
        rms_m: What it adds at the tool, m; `None` where that cannot be told.
        text: Why, in a sentence.
    """

    stage: str
    part: float | None
    rms_m: float | None
    text: str

    def plain(self) -> dict[str, Any]:
        """Returns it as plain JSON data."""
        return asdict(self)


@dataclass(frozen=True)
class Known:
    """What is known about the stages before they are weighed; see the modules that the types come from."""

    location: Location
    probes: Sequence[Probe]
    budget: Budget | None
    field_geometry: Geometry | None
    reference_geometry: Geometry | None


def stages(
    known: Known, runs: WindowedRuns, reference: WindowedRuns | None, machine: Machine
) -> list[StageFinding]:
    """Returns what each stage has to do with the gap, those about which something can be said."""
    whole_m = _beyond(known.budget) if known.budget else None
    found = _of_joints(known, runs, reference, machine, whole_m)
    found += list(
        filter(None, (_kinematics(known), perception(runs.recordings, machine), _contact(runs)))
    )
    return found


def foremost(findings: Sequence[StageFinding], has_gap: bool) -> Stage | None:
    """Returns the stage that matters most at the tool (without geometry: by its part of the gap); `None` without a gap."""
    those = [
        f
        for f in findings
        if f.stage in ("timing", "actuation", "sensing", "kinematics", "perception")
    ]
    those = [f for f in those if has_gap or f.stage in ("kinematics", "perception")]
    weighed = [(f.rms_m if f.rms_m is not None else f.part or 0.0, f.stage) for f in those]
    weighed = [pair for pair in weighed if pair[0] > 0.0]
    return max(weighed)[1] if weighed else None  # type: ignore[return-value]


def _beyond(budget: Budget) -> float:
    """Returns what the tip's error exceeds the floor by, as root mean square, m."""
    floor_m = budget.floor.tip_rms_m if budget.floor else 0.0
    return float(np.sqrt(max(budget.before.tip_rms_m**2 - floor_m**2, 0.0)))


def _of_joints(
    known: Known,
    runs: WindowedRuns,
    reference: WindowedRuns | None,
    machine: Machine,
    whole_m: float | None,
) -> list[StageFinding]:
    noise, floor = (
        measurement_noise(runs.recordings),
        measurement_noise(reference.recordings) if reference else None,
    )
    parts, texts = {"timing": 0.0, "sensing": 0.0}, {"timing": [], "sensing": []}
    late = {
        probe.joint: probe
        for probe in known.probes
        if probe.effect == "dead_time" and probe.is_clear
    }
    span = max(1, round(SPAN_S / machine.period_s))
    speed = (runs.simulated[:, span:] - runs.simulated[:, :-span]) / SPAN_S
    for j, (name, joint) in enumerate(known.location.joints.items()):
        excess = max(joint.rmse**2 - joint.floor**2, 1e-18)
        if name in late:
            probe = late[name]
            moved = float(np.mean(speed[..., j] ** 2)) * (probe.value - probe.reference) ** 2
            parts["timing"] += joint.gap * min(1.0, moved / excess)
            texts["timing"].append(probe.text)
        # the start of a window is measured as well, so noise counts twice
        more = 2.0 * max(noise[j] ** 2 - (floor[j] ** 2 if floor is not None else 0.0), 0.0)
        if more > 0.1 * excess and joint.gap > 0.01:
            parts["sensing"] += joint.gap * min(1.0, more / excess)
            unit = machine.joints[j].unit
            before = 0.0 if floor is None else 1e3 * floor[j]
            texts["sensing"].append(
                f"{name} has {1e3 * noise[j]:.2f} m{unit} of noise, {before:.2f} on the reference"
            )
    timing, sensing = (
        min(parts["timing"], 1.0),
        min(parts["sensing"], 1.0 - min(parts["timing"], 1.0)),
    )
    rows = {"timing": timing, "sensing": sensing, "actuation": 1.0 - timing - sensing}
    sayings = {
        "timing": "; ".join(texts["timing"])
        or "no joint moves earlier or later than simulated, beyond what the reference shows",
        "sensing": "; ".join(texts["sensing"]) or "no sensor is noisier than on the reference",
        "actuation": "what is left of the joints' gap",
    }
    return [
        StageFinding(
            stage, part, None if whole_m is None else whole_m * float(np.sqrt(part)), sayings[stage]
        )
        for stage, part in rows.items()
    ]


def measurement_noise(recordings: Sequence[Recording]) -> np.ndarray:
    """Returns the noise of each sensor, standard deviation, `(J,)`: from third differences, which smooth motion hardly has.

    The median makes edges of motions, which are few, count little. White noise of 1 has third
    differences of sqrt(20).
    """
    third = np.concatenate(
        [np.diff(recording.q.astype(float), 3, axis=0) for recording in recordings]
    )
    return np.median(np.abs(third), 0) / 0.6745 / np.sqrt(20.0)


def _kinematics(known: Known) -> StageFinding | None:
    field, reference = known.field_geometry, known.reference_geometry
    if field is None:
        return None
    floor_m = reference.rms_m if reference else 0.0
    excess_m = float(np.sqrt(max(field.rms_m**2 - floor_m**2, 0.0)))
    by_cause_m = field.rms_m * float(np.sqrt(field.explained))
    text = f"measured tool points lie {1e3 * field.rms_m:.1f} mm from forward kinematics"
    text += f" ({1e3 * floor_m:.1f} mm on the reference)" if reference else ""
    is_explained = field.explained > max(EXPLAINED, 2.0 * reference.explained if reference else 0.0)
    if is_explained or field.rms_m > FAR * floor_m:
        scale, unit = (1e3, f"m{field.unit}") if field.unit else (1e2, "%")
        text += f"; {100 * field.explained:.0f} % of it is explained by {field.cause} of {scale * field.size:+.1f} {unit}"
    else:
        excess_m = 0.0
    return StageFinding("kinematics", None, by_cause_m if is_explained else excess_m, text)


def perception(recordings: Sequence[Recording], machine: Machine) -> StageFinding | None:
    """Returns how far estimated boreholes lie from where the tool touched, `None` where recordings do not carry both."""
    if not machine.has_bodies:
        return None
    off = []
    for recording in recordings:
        if not all(column in recording.extra for column in (*TARGET, "force_n")):
            continue
        target = np.stack([recording.extra[column] for column in TARGET], 1).astype(float)
        if all(column in recording.extra for column in COLUMNS):
            tip = np.stack([recording.extra[column] for column in COLUMNS], 1).astype(float)
        else:
            tip = (
                Kinematics(machine)
                .pose(torch.as_tensor(recording.q, dtype=torch.float32))
                .tip_in_base_m.numpy()
            )
        touches = recording.extra["force_n"] > CONTACT_N
        first = touches & ~np.append(False, touches[:-1])
        distance = np.linalg.norm(tip - target, axis=1)[first]
        off += distance[distance < NEAR_M].tolist()
    if not off:
        return None
    rms_m = float(np.sqrt(np.mean(np.square(off))))
    text = (
        f"at {len(off)} touches the tip is {1e3 * rms_m:.0f} mm (RMS) from the estimated borehole"
    )
    return StageFinding("perception", None, rms_m, text)


def _contact(runs: WindowedRuns) -> StageFinding | None:
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
