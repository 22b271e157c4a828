"""Survey of a gap: location, error of the tool, touched holes, recordings.

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
from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis.answer import JointGap, RegimeGap, Selected, Stage, Where
from diagnosis.effect_library import EffectType
from diagnosis.free_runs import WindowedRuns
from diagnosis.geometry import TOOL_COLUMNS
from diagnosis.where import GapLocation, locate_gap

CONTACT_N = 200.0
"""Force at the tool that counts as contact, N; chosen by hand: above the noise of a force that is
computed from pressures."""
MAX_TARGET_DISTANCE_M = 0.5
"""Largest distance of the touched hole from the tip, m; chosen by hand."""
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
class BoreholeError:
    """Distance of touched points from the estimated borehole.

    Attributes:
        rms_m: Its size, m.
        text: Why, in a sentence.
    """

    rms_m: float
    text: str


def assess_perception(recordings: Sequence[Recording], machine: Machine) -> BoreholeError | None:
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
    return BoreholeError(rms_m, text)


@dataclass(frozen=True)
class Survey:
    """Location, errors of the tip, geometry and recordings of a gap.

    Attributes:
        remarks: About the recordings.
        location: Where the gap lies.
        touches: Error of estimated boreholes; `None` where none was touched.
        tip: Errors of the tip: `before`, `after` the effects, `floor`; empty without geometry.
        machine: The machine.
    """

    remarks: Sequence[RecordingRemark]
    location: GapLocation
    touches: BoreholeError | None
    tip: dict[str, TipError]
    machine: Machine

    def where(self, selected: Sequence[Selected], kinds: Sequence[EffectType]) -> Where:
        """Return the field `where` of `diagnosis.json`; shares are those of the gap.

        The stage is that of the first named effect, otherwise that of wrong boreholes.

        Args:
            selected: The named effects, the first first.
            kinds: All effects.
        """
        joints = {}
        for name, joint in self.location.joints.items():
            joints[name] = JointGap(joint.rmse, joint.floor, joint.gap)
        parts = [part for part in self.location.largest() if part.gap > 0.0]
        regimes = [RegimeGap(part.joint, part.category, part.gap) for part in parts]
        named = selected[0].effect if selected else ""
        stage: Stage | None = next((kind.stage for kind in kinds if kind.name == named), None)
        if stage is None and self.touches is not None:
            stage = "perception"
        units = {joint.name: joint.unit for joint in self.machine.joints}
        return Where(joints, tuple(regimes[:MAX_LISTED]), stage, units)

    def more(self) -> dict[str, Any]:
        """Return further fields of `diagnosis.json`, plain JSON data."""
        return {
            "sanity": [remark.plain() for remark in self.remarks],
            "location": self.location.plain(),
            "touches": self.touches and asdict(self.touches),
            "tip": {name: asdict(one) for name, one in self.tip.items()},
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
    """Survey a gap.

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
    tip: dict[str, TipError] = {}
    if machine.has_bodies:
        for name, runs in (("before", before), ("after", after), ("floor", floor)):
            if runs is not None:
                tip[name] = measure_tip_error(runs, machine)
    touches = assess_perception(before.recordings, machine)
    remarks = examine_recordings(before.recordings, machine, thresholds)
    return Survey(remarks, location, touches, tip, machine)
