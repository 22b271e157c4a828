"""From finished fits to `identification.json`, the verdict and the pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from actuators.identify import dead_time, pictures
from actuators.identify.regimes import by_regime
from actuators.identify.scores import Scores, interval, overall
from actuators.identify.stages import Fitted, Stage, members
from actuators.identify.verdict import Finding, verdict
from brokk_rl import open_loop
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.split import commanded_s

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Identified:
    """All that was fitted.

    Attributes:
        machine: The machine.
        model: Name of the model that is kept; the others are what it is compared with.
        stages: Fits in their order; the last one made the model that is kept.
        cuts: Windows of each stage, `None` where it judges nothing.
        done: What each stage's fits left, by model.
        horizons_s: Horizons that fit into the recordings judged by.
        wanted_s: Horizons that were wanted.
    """

    machine: Machine
    model: str
    stages: Sequence[Stage]
    cuts: Sequence[open_loop.Windows | None]
    done: Sequence[dict[str, Fitted]]
    horizons_s: tuple[float, ...]
    wanted_s: tuple[float, ...]


def gather(
    identified: Identified, resampling: np.random.Generator, delaying: np.random.Generator
) -> tuple[dict[str, Any], list[Finding], dict[str, Figure]]:
    """Returns the fields of `identification.json`, the verdict, and the pictures by file stem.

    Args:
        identified: What was fitted.
        resampling: Draws the resamples of the errors.
        delaying: Draws those of the dead times.

    Raises:
        RecordingError: no recording is long enough to search for a dead time in.
    """
    machine, model = identified.machine, identified.model
    judging = [
        (cut, done)
        for cut, done in zip(identified.cuts, identified.done, strict=True)
        if cut is not None
    ]
    cut = open_loop.joined([cut for cut, _ in judging])
    predicted = {
        name: np.concatenate([done[name].predicted for _, done in judging])
        for name in judging[0][1]
    }
    scores = Scores(predicted, cut, machine, resampling)
    kept = identified.done[-1][model]
    last = identified.stages[-1]
    fitted_to = members(last.train) + members(last.validation)
    delays = dead_time.delays(fitted_to, machine, delaying)
    acting_s = np.array(
        [
            delay.value_s if delay and delay.is_found else machine.dead_time_s
            for delay in delays.values()
        ]
    )
    result: dict[str, Any] = {
        "schema": 1, "machine": machine.name, "model": model, "fit_seconds": round(kept.seconds, 2), "use": kept.use,
        "fold_seconds": [round(done[model].seconds, 2) for done in identified.done[:-1]],
    }  # fmt: skip
    result |= _errors(scores, identified)
    result["delay_s"] = {
        joint: delay
        and {
            "value": delay.value_s,
            "ci95": list(delay.ci95_s),
            "explained": delay.explained,
            "found": delay.is_found,
        }
        for joint, delay in delays.items()
    }
    result["regimes"] = by_regime(scores, acting_s)
    result["data"] = _data(identified, fitted_to, scores)
    findings = verdict(result, machine)
    result["verdict"] = [{"tone": finding.tone, "text": finding.text} for finding in findings]
    drawings = {
        "prediction": pictures.prediction(scores, model),
        "error_over_horizon": pictures.error_over_horizon(scores, model),
        "regimes": pictures.regimes(result["regimes"], machine, model, list(predicted)),
        "dead_time": pictures.dead_times(delays, machine),
    }
    return result, findings, drawings


def _errors(scores: Scores, identified: Identified) -> dict[str, Any]:
    """Returns `joints`, `overall`, `one_step`, `against` and `missing`."""
    machine, model = identified.machine, identified.model
    names, units = machine.joint_names, [joint.unit for joint in machine.joints]
    found: dict[str, Any] = {
        "joints": {joint: {} for joint in names},
        "overall": {},
        "one_step": {joint: {} for joint in names},
    }
    keys = {horizon_s: f"{horizon_s:g}" for horizon_s in identified.wanted_s}
    for name in scores.predicted:
        rows = {key: scores.at(name, h) for h, key in keys.items() if h in identified.horizons_s}
        for j, joint in enumerate(names):
            found["joints"][joint][name] = {
                key: rows[key][j] if key in rows else None for key in keys.values()
            }
        found["overall"][name] = {
            key: overall(rows[key], units) if key in rows else None for key in keys.values()
        }
        rmse, again = scores.rmse(name)
        for j, joint in enumerate(names):
            first = float(rmse[0, j])
            found["one_step"][joint][name] = {
                "rmse": first, "ci95": interval(again[:, 0, j]), "percent": float(100 * first / scores.travel[j])
            }  # fmt: skip
    found["against"] = {
        rival: {joint: {} for joint in (*names, "overall")}
        for rival in scores.predicted
        if rival != model
    }
    for rival, table in found["against"].items():
        for h, key in keys.items():
            rows = (
                scores.against(model, rival, h)
                if h in identified.horizons_s
                else [None] * (len(names) + 1)
            )
            for joint, row in zip(table, rows, strict=True):
                table[joint][key] = row
    judged = [recording for stage in identified.stages for recording in members(stage.test)]
    longest_s, before_s = (
        open_loop.longest_s(judged, machine),
        open_loop.num_before(machine) * machine.period_s,
    )
    reason = f"the longest recording judged by leaves {longest_s:.1f} s after the {before_s:.2f} s before a free run"
    found["missing"] = {key: reason for h, key in keys.items() if h not in identified.horizons_s}
    return found


def _data(identified: Identified, fitted_to: Sequence[Recording], scores: Scores) -> dict[str, Any]:
    """Returns what was fitted to and judged by: how much, which runs, and how far each joint was excited."""
    machine, last = identified.machine, identified.stages[-1]
    judged = [recording for stage in identified.stages for recording in members(stage.test)]
    u, q = (
        np.concatenate([getattr(recording, name) for recording in fitted_to]) for name in ("u", "q")
    )
    moved_s, judged_s = commanded_s(fitted_to), commanded_s(judged)
    tested = {name for stage in identified.stages for name in stage.test}
    return {
        "train": _facts(members(last.train), len(last.train)),
        "validation": _facts(members(last.validation), len(last.validation)),
        "test": _facts(judged, len(tested)),
        "windows": len(scores.cut.q),
        "runs": [
            {"stage": stage.name or "fit"}
            | {part: list(getattr(stage, part)) for part in ("train", "validation", "test")}
            for stage in identified.stages
        ],
        "excitation": {
            joint: {
                "commanded_s": float(moved_s[j]),
                "judged_s": float(judged_s[j]),
                "travel": float(np.ptp(q[:, j]) / scores.travel[j]),
                "largest_command": [float(min(0.0, u[:, j].min())), float(max(0.0, u[:, j].max()))],
            }
            for j, joint in enumerate(machine.joint_names)
        },
    }


def _facts(recordings: Sequence[Recording], num_runs: int) -> dict[str, Any]:
    return {
        "runs": num_runs,
        "recordings": len(recordings),
        "minutes": round(sum(recording.duration_s for recording in recordings) / 60.0, 1),
        "sources": sorted(
            {recording.metadata.get("source", "unknown") for recording in recordings}
        ),
    }
