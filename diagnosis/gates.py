"""Gates between the search and the verdict: what must hold before a verdict is given.

A verdict that fails its gates is `unknown`. Gates of the recordings and of the kind of model come
before the search; where one fails, there is no telling.
Axes: `B` draws of the bootstrap, `W` windows, `J` joints.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from actuators.recordings.recording_checks import REMARKS, RecordingRemark, name_recording
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis.closure import Gate

# Limits here were chosen by hand on practice cases from a plant of other making; not searched. Those of
# `does not obey` and `jumps` were chosen on simulated servos: 60 sound logs and seven of a real SO-101
# have 0, logs whose drive is off for 5 % of the time 0.045, one jump a minute 0.067 (medians).
MAX_REMARK_SHARES = {
    "unlogged input": 0.1,
    "interlock": 0.02,
    "frozen sensor": 0.05,
    "exclusive joint": 0.01,
    "does not obey": 0.02,
    "jumps": 0.02,
}
"""Largest share of the field's time with a finding about one joint. Beyond it the recordings do not
tell what the machine was told: radio frames lost by nuisances freeze a sensor for 0.3 % of the time,
and no other finding of these occurs on sound recordings."""
MAX_EXCESS_TRAVEL = 0.05
"""Farthest position beyond the limits of the machine's file, over the travel. The reference counts
where there is one: a field that alone leaves the limits may have a biased encoder."""
EXCESS_QUANTILE = 0.99
"""Part of the positions that must lie within: single spikes are no wrong limit."""
MAX_RIVAL_RATIO = 1.5
"""Error over that of a rival fitted to the field, above which something is left to find: on 15
unchanged practice machines the ratio is 1.46 at most, and 1.12 on all but one."""
MAX_UNCOVERED = 0.5
"""Part of the field's motion with commands that the reference lacks, above which there is no telling. Chosen by hand."""
MAX_SCATTER_GROWTH = 3.0
"""Scatter of tool points about any law of geometry, over that of the reference, above which encoders slip. In 168
practice cases it is 0.9 to 1.17, with a clock that is late or a sensor that is noisy or coarse up to 12, and with a
belt that slips 22 and 82."""


def judge_recordings(
    remarks: Sequence[RecordingRemark],
    known: Sequence[RecordingRemark],
    field: Sequence[Recording],
    reference: Sequence[Recording],
    machine: Machine,
) -> list[Gate]:
    """Return the gates of the recordings: findings that make any cause untellable.

    What the reference shows as often is how the machine moves: the overshoot of a controller after each
    stop is no unlogged input.

    Args:
        remarks: About the field.
        known: About the reference.
        field: The machine as it is.
        reference: The machine as it was; empty without any.
        machine: The machine.
    """
    gates = []
    for name, limit in MAX_REMARK_SHARES.items():
        shares = measure_shares(name, remarks, field)
        usual = measure_shares(name, known, reference)
        beyond = {joint: share - usual.get(joint, 0.0) for joint, share in shares.items()}
        joint = max(beyond, key=beyond.__getitem__, default="")
        share = max(beyond.get(joint, 0.0), 0.0)
        text = f"'{name}' in {100 * shares.get(joint, 0.0):.1f} % of the time"
        if reference:
            text += f", {100 * usual.get(joint, 0.0):.1f} % on the reference"
        if share > limit:
            text = f"{text}, on {joint}; {REMARKS[name].advice}"
        gates.append(Gate(name.replace(" ", "_"), share <= limit, share, limit, text))
    return [*gates, _judge_limits(reference or field, machine)]


def measure_shares(
    name: str, remarks: Sequence[RecordingRemark], recordings: Sequence[Recording]
) -> dict[str, float]:
    """Return the share of the time with remarks of a kind, by joint."""
    total_s = sum(recording.duration_s for recording in recordings)
    duration_s = {name_recording(recording): recording.duration_s for recording in recordings}
    found: dict[str, float] = {}
    for remark in remarks:
        if remark.name != name:
            continue
        joint = remark.joint or "all joints"
        seconds = remark.share * duration_s.get(remark.recording, 0.0)
        found[joint] = found.get(joint, 0.0) + seconds / max(total_s, 1e-9)
    return found


def _judge_limits(recordings: Sequence[Recording], machine: Machine) -> Gate:
    q = np.concatenate([recording.q for recording in recordings])
    over = np.maximum(q - machine.upper, machine.lower - q) / (machine.upper - machine.lower)
    excess = np.quantile(over, EXCESS_QUANTILE, axis=0)
    worst = int(excess.argmax())
    value = max(0.0, float(excess[worst]))
    text = f"positions lie up to {100 * value:.1f} % of the travel beyond the limits"
    if value > MAX_EXCESS_TRAVEL:
        name = machine.joint_names[worst]
        text = f"{name}: {text}; measure the end stops and correct the machine's file"
    return Gate("limits", value <= MAX_EXCESS_TRAVEL, value, MAX_EXCESS_TRAVEL, text)


def judge_coverage(parts: np.ndarray, machine: Machine) -> Gate:
    """Return whether the reference was commanded as the field was.

    Args:
        parts: Part of the field's motion that was not, by joint, `(J,)`.
        machine: The machine.
    """
    total = float(parts.sum())
    passed = total <= MAX_UNCOVERED
    text = f"{100 * total:.0f} % of the motion has commands farther or faster than any of the reference"
    if not passed:
        name = machine.joint_names[int(parts.argmax())]
        text += f", most of it on {name}; record a reference that moves so"
    return Gate("covered", passed, total, MAX_UNCOVERED, text)


def judge_scatter(growth: float) -> Gate:
    """Return whether tool points follow the encoders by some law of geometry, as on the reference."""
    passed = growth <= MAX_SCATTER_GROWTH
    advice = "" if passed else "; look for an encoder that slips or shows coarse steps"
    text = f"tool points scatter {growth:.1f} times as much about any law of the encoders as on the reference{advice}"
    return Gate("encoders_slip", passed, growth, MAX_SCATTER_GROWTH, text)


def list_failures(gates: Sequence[Gate]) -> str:
    """Return the texts of the gates that failed; empty where all were passed."""
    return "; ".join(gate.text for gate in gates if not gate.passed)
