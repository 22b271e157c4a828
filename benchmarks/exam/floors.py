"""Floors of an exam's plants: a base is fitted to the reference of cases without a gap, and runs free through their field.

    brokk mode=exam exam.mix.num_cases=6 'exam.mix.shares={none: 1, faint: 0, one: 0, several: 0,
    outside: 0}' session.out=<exam> python benchmarks/exam/floors.py <exam> hydraulic 0000 0001 …

Prints the root mean square error over 5 s free runs and at their end, all joints together, mrad.
"""

import sys
import tempfile
import time
from pathlib import Path

import hydra
import numpy as np
import torch
from hydra.utils import instantiate

from actuators import open_loop
from actuators.recordings.split import group_by_run
from brokk_rl import record


def main(exam: Path, fit_name: str, cases: list[str], *overrides: str) -> None:
    torch.set_num_threads(1)
    with hydra.initialize_config_module("conf", version_base="1.3"):
        cfg = hydra.compose(
            "config", ["mode=identify", f"fit={fit_name}", "identify.recordings=x", *overrides]
        )
    machine, fit = (instantiate(cfg[name], _convert_="all") for name in ("machine", "fit"))
    for case in cases:
        begun = time.monotonic()
        reference, field = (
            record.read_recordings(str(exam / "cases" / case / half / "*.parquet"), machine)
            for half in ("reference", "field")
        )
        runs = list(group_by_run(reference).values())
        train, validation = [recording for run in runs[:-1] for recording in run], runs[-1]
        with tempfile.TemporaryDirectory() as folder:
            actuator = fit.fit(machine, train, validation, Path(folder), 0, torch.device("cpu"))
            cut = open_loop.cut_windows(field, machine, 5.0, 1.0)
            error = open_loop.roll_out(actuator, machine, cut, torch.device("cpu")) - cut.measured
        over, end = (
            1000.0 * np.sqrt((part**2).mean((0, 1) if part.ndim == 3 else 0))
            for part in (error, error[:, -1])
        )
        print(
            f"{exam.name} {case} {fit_name}: over 5 s {np.sqrt((over**2).mean()):.1f} ({np.round(over, 1)}), "
            f"at the end {np.sqrt((end**2).mean()):.1f} mrad, {time.monotonic() - begun:.0f} s",
            flush=True,
        )


if __name__ == "__main__":
    main(
        Path(sys.argv[1]),
        sys.argv[2],
        [name for name in sys.argv[3:] if "=" not in name],
        *[x for x in sys.argv[3:] if "=" in x],
    )
