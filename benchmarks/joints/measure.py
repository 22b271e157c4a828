"""Measure what the project reads off public logs of other joints: servos (SO-101) and a linear drive (EMPS).

    python benchmarks/joints/measure.py emps <folder with emps.mat and emps_p.mat> benchmarks/joints/emps.json
    python benchmarks/joints/measure.py so101 <folder with the parquet files> benchmarks/joints/so101.json

The logs are public and none is copied here; `exam/conf/real_machine` says where they are from.
"""

from __future__ import annotations

import json
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from brokk_rl import extensions
from brokk_rl.session import write_json
from diagnosis import api

PUBLISHED = {"mass_kg": 95.11, "viscous_n_s_m": 203.5, "coulomb_n": 20.39, "offset_n": -3.16}
"""Janot, Gautier and Brunot (2019), from the same experiment."""
EMPS_FILES = {"emps": ["emps.mat"], "emps_p": ["emps_p.mat"], "both": ["emps.mat", "emps_p.mat"]}


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
    return {"published": PUBLISHED, "logs": found}


def measure_so101(folder: Path) -> dict[str, Any]:
    """Return the answer of the diagnosis against an ideal servo, and the errors on recordings apart."""
    case = extensions.load_option("real_machine", "so101")
    field, apart = (read_set("so101", folder, list(one)) for one in (case.field, case.apart))
    with tempfile.TemporaryDirectory() as out:
        outcome = api.diagnose(field, out, simulator="servo", unseen=apart)
        api.report(outcome, field, out)
        answer = json.loads((Path(out) / "diagnosis.json").read_text())
    kept = ("verdict", "reason", "selected", "gap", "rivals", "unseen", "gates")
    return {key: answer.get(key) for key in kept}


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
