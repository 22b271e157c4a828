"""Measure what the project reads off public logs of other joints: servos (SO-101) and a linear drive (EMPS).

    python benchmarks/joints/measure.py emps <folder with emps.mat and emps_p.mat> benchmarks/joints/emps.json
    python benchmarks/joints/measure.py so101 <folder with the parquet files> benchmarks/joints/so101.json

The logs are public and none is copied here; `exam/conf/real_machine` says where they are from.
"""

from __future__ import annotations

import dataclasses
import json
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import torch
from scipy.optimize import least_squares
from scipy.signal import hilbert

from brokk_rl import extensions
from brokk_rl.session import write_json
from diagnosis import api

PUBLISHED = {"mass_kg": 95.11, "viscous_n_s_m": 203.5, "coulomb_n": 20.39, "offset_n": -3.16}
"""Janot, Gautier and Brunot (2019), from the same experiment."""
DIAGNOSED = {
    "mass_kg": ("inertia", "factor"),
    "viscous_n_s_m": ("viscous_friction", "viscous_n_s_m"),
    "coulomb_n": ("coulomb_friction", "coulomb_n"),
    "offset_n": ("force_offset", "offset_n"),
}
"""Effect and number that tell each of the published numbers."""
BASE_MASSES_KG = (100.0, 60.0)
"""Masses without friction against which the diagnosis is asked: near the truth, and far off."""
PARTS = 4
"""Recordings that the log is cut into: a diagnosis needs some that nothing is fitted to."""
EMPS_FILES = {"emps": ["emps.mat"], "emps_p": ["emps_p.mat"], "both": ["emps.mat", "emps_p.mat"]}

JOINTS = ("rotation", "pitch", "elbow", "wrist_pitch", "wrist_roll")
"""Joints of the SO-101 by the names of its columns."""
SWEEP_ROWS = 300
"""Rows of the frequency sweep that are taken at one frequency: 6 s, within which it rises by a fifth."""
SWEEP_HZ = (0.3, 3.0)
"""Frequencies of the sweep that are used; below them a part holds fewer than two cycles."""
LOOP_ORDERS = {"dead_time": 0, "dead_time_and_lag": 1, "dead_time_and_two_lags": 2}
"""Models of the sweep, by the number of equal lags behind the dead time."""


def read_set(name: str, folder: Path, patterns: list[str]) -> api.RecordingSet:
    """Return the recordings of the logs that match."""
    machine = extensions.load_option("machine", name)
    reader, found = extensions.load_option("import", name), []
    for pattern in patterns:
        for path in sorted(folder.glob(pattern)):
            found += reader.read(path, machine)
    return api.RecordingSet(tuple(found), machine)


def measure_emps(folder: Path) -> dict[str, Any]:
    """Return mass, friction and offset of each log, and how far they are from the published ones."""
    fit, found = extensions.load_option("fit", "force"), {}
    for name, files in EMPS_FILES.items():
        logs = read_set("emps", folder, files)
        with tempfile.TemporaryDirectory() as out:
            cpu = torch.device("cpu")
            fit.fit(logs.machine, logs.recordings, [], Path(out), 0, cpu)
            told = json.loads((Path(out) / "force.json").read_text())["parameters"]
        numbers = {}
        for key, published in PUBLISHED.items():
            one = told[key]["carriage"]
            numbers[key] = {**one, "error": one["value"] / published - 1.0}
        worst = max(abs(one["error"]) for one in numbers.values())
        found[name] = {"numbers": numbers, "worst_error": worst}
    field, apart = (read_set("emps", folder, [f"{name}.mat"]) for name in ("emps", "emps_p"))
    diagnoses = {f"{mass:g} kg": diagnose_emps(mass, field, apart) for mass in BASE_MASSES_KG}
    return {"published": PUBLISHED, "logs": found, "diagnosis": diagnoses}


def diagnose_emps(
    mass_kg: float, field: api.RecordingSet, apart: api.RecordingSet
) -> dict[str, Any]:
    """Return the answer against a mass without friction, and its errors against the published numbers."""
    parts = []
    for recording in field.recordings:
        rows = recording.num_samples // PARTS
        for part in range(PARTS):
            mine = slice(part * rows, (part + 1) * rows)
            t_s = recording.t_s[mine] - recording.t_s[mine][0]
            named = {**recording.metadata, "run": str(part)}
            u, q = recording.u[mine], recording.q[mine]
            parts.append(dataclasses.replace(recording, t_s=t_s, u=u, q=q, metadata=named))
    simulator = dataclasses.replace(extensions.load_option("actuator", "force"), mass_kg=mass_kg)
    split = api.RecordingSet(tuple(parts), field.machine)
    with tempfile.TemporaryDirectory() as out:
        answer = api.diagnose(split, out, simulator=simulator, unseen=apart).answer
    told = {one.effect: one for one in answer.selected}
    numbers = {}
    for key, (effect, name) in DIAGNOSED.items():
        if effect not in told:
            continue
        value = told[effect].parameters[name]["carriage"].mean
        value = value * mass_kg if name == "factor" else value
        numbers[key] = {"value": value, "error": value / PUBLISHED[key] - 1.0}
    return {
        "verdict": answer.verdict,
        "effects": sorted(told),
        "phantoms": sorted(set(told) - {effect for effect, _ in DIAGNOSED.values()}),
        "numbers": numbers,
        "worst_error": max((abs(one["error"]) for one in numbers.values()), default=None),
        "apart": answer.more["unseen"]["joints"]["carriage"],
    }


def measure_so101(folder: Path) -> dict[str, Any]:
    """Return the answer of the diagnosis against an ideal servo, and the errors on recordings apart."""
    case = extensions.load_option("real_machine", "so101")
    field, apart = (read_set("so101", folder, list(one)) for one in (case.field, case.apart))
    with tempfile.TemporaryDirectory() as out:
        outcome = api.diagnose(field, out, simulator="servo", unseen=apart)
        api.report(outcome, field, out)
        answer = json.loads((Path(out) / "diagnosis.json").read_text())
    kept = ("verdict", "reason", "selected", "gap", "rivals", "unseen", "gates", "motion_delay_s")
    found = {key: answer.get(key) for key in kept}
    return found | {"row_shift_s": measure_row_shifts(folder), "sweep": measure_sweep(folder)}


def measure_row_shifts(folder: Path) -> dict[str, float]:
    """Return the shift of each joint, s, at which speeds of targets and positions in the rows of the logs agree most.

    The logs are compared as they are, without any part of this project: the delay as SAGE counts it.
    """
    shifts = np.arange(20)
    total: dict[str, np.ndarray] = {}
    for path in sorted(folder.glob("*.parquet")):
        log = pq.read_table(path)
        period_s = float(np.median(np.diff(log["t_state_s"].to_numpy())))
        for joint in JOINTS:
            target, q = (np.diff(log[f"{name}_{joint}_rad"].to_numpy()) for name in ("target", "q"))
            last = len(q) - len(shifts)
            sums = [float(target[:last] @ q[shift : shift + last]) for shift in shifts]
            total[joint] = total.get(joint, 0.0) + np.array(sums)
    found = {}
    for joint, sums in total.items():
        best = int(np.argmax(sums))
        low, top, high = sums[best - 1 : best + 2]
        found[joint] = (best + 0.5 * (low - high) / (low - 2.0 * top + high)) * period_s
    return found


def measure_sweep(folder: Path) -> dict[str, dict[str, Any]]:
    """Return what the frequency sweep alone says of the delay of each joint.

    A line through the phase lag over the frequency has the delay as its slope, s; its value at 0 Hz is
    the lag that does not depend on the frequency, rad, as play has it. `amplitude_falls_by` is the
    part that the gain loses from the lowest to the highest frequency.

    `models` split the delay; see `fit_loop`. `misfit_without_lag` is the misfit of a dead time over that
    of a dead time and a lag. Their dead times hold a control period, after which even an ideal servo
    answers, or half of one beside a lag.
    """
    log = pq.read_table(folder / "frequency_sweep.parquet")
    period_s = float(np.median(np.diff(log["t_state_s"].to_numpy())))
    found = {}
    for joint in JOINTS:
        target, q = (
            log[f"{name}_{joint}_rad"].to_numpy().astype(float) for name in ("target", "q")
        )
        hz, response = measure_response(target, q, period_s)
        slope, at_rest = np.polyfit(2.0 * np.pi * hz, -np.angle(response), 1)
        models = {name: fit_loop(hz, response, order) for name, order in LOOP_ORDERS.items()}
        found[joint] = {"delay_s": float(slope), "lag_at_0_hz_rad": float(at_rest)}
        gain = np.abs(response[[np.argmin(hz), np.argmax(hz)]])
        found[joint]["amplitude_falls_by"] = float(1.0 - gain[1] / gain[0])
        best = models["dead_time_and_lag"]["misfit"]
        found[joint]["misfit_without_lag"] = models["dead_time"]["misfit"] / best
        found[joint]["models"] = models
    return found


def measure_response(
    target: np.ndarray, q: np.ndarray, period_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the frequencies of the parts of a sweep within `SWEEP_HZ`, and the complex response at each."""
    target = target - np.median(target)
    angle = np.unwrap(np.angle(np.asarray(hilbert(target))))
    frequency_hz = np.gradient(angle) / (2.0 * np.pi * period_s)
    rows = []
    for first in range(0, len(q) - SWEEP_ROWS, SWEEP_ROWS):
        part = slice(first, first + SWEEP_ROWS)
        wave = np.exp(-1j * angle[part])
        response = np.mean((q[part] - q[part].mean()) * wave) / np.mean(target[part] * wave)
        rows.append((np.median(frequency_hz[part]), response))
    hz, response = np.array([one for one, _ in rows]), np.array([one for _, one in rows])
    used = (hz > SWEEP_HZ[0]) & (hz < SWEEP_HZ[1])
    return hz[used], response[used]


def fit_loop(hz: np.ndarray, response: np.ndarray, order: int) -> dict[str, float]:
    """Return dead time and lag, s, that explain gain and phase of a joint best, and the misfit of the response.

    The response is `gain exp(-i (play + w dead_time)) / (1 + i w lag)^order`. Play takes a part of the
    amplitude and of the phase that is the same at all frequencies, since the sweep keeps its
    amplitude. A dead time leaves the amplitude as it is; a lag makes it smaller as well.
    """
    w = 2.0 * np.pi * hz

    def predict(x: np.ndarray) -> np.ndarray:
        gain, play_rad, dead_time_s, lag_s = x
        return gain * np.exp(-1j * (play_rad + w * dead_time_s)) / (1.0 + 1j * w * lag_s) ** order

    def compute_error(x: np.ndarray) -> np.ndarray:
        off = predict(x) - response
        return np.concatenate([np.real(off), np.imag(off)])

    found = least_squares(compute_error, [0.9, 0.1, 0.03, 0.03])
    dead_time_s, lag_s = found.x[2:].tolist()
    misfit = float(np.sqrt(2.0 * found.cost / len(hz)))
    told = {"dead_time_s": dead_time_s, "misfit": misfit}
    return told | ({"lag_s": lag_s} if order else {})


def main() -> None:
    """Measure one machine and write the file."""
    name, folder, out = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])
    begun = time.process_time()
    found = {"emps": measure_emps, "so101": measure_so101}[name](folder)
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
    ).stdout.strip()
    write_json(
        out,
        {
            "command": f"python benchmarks/joints/measure.py {name} <logs> {out.name}",
            "commit": commit,
            "device": f"{platform.machine()}, one CPU thread",
            "cpu_seconds": time.process_time() - begun,
            **found,
        },
    )


if __name__ == "__main__":
    main()
