"""`brokk mode=identify`: fits an actuator model to recordings and says how good it is on recordings it has not seen."""

import logging
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from brokk_rl import dead_time, open_loop, record
from brokk_rl.contracts import Actuator, ActuatorFit
from brokk_rl.errors import ConfigError, RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.session import Session, write_json
from brokk_rl.spec import spec

log = logging.getLogger(__name__)

HORIZONS_S = (1.0, 2.0, 5.0, 10.0)
"""Horizons of `identification.json`."""


@spec
class Identification:
    """What to fit to and what to judge by.

    Attributes:
        recordings: Glob, or list of globs, of recordings to fit to.
        test: Glob or globs of unseen recordings to judge by, best of another excitation; `null` sets one in `hold_out` of
            `recordings` aside.
        hold_out: One recording in so many, in order of their names, is kept from the fit to stop it by.
        stride_s: Distance between the beginnings of two free runs.
        threads: CPU threads for the fit; the networks are so small that one is fastest, above all beside other work.
    """

    recordings: str | tuple[str, ...]
    test: str | tuple[str, ...] | None
    hold_out: int
    stride_s: float
    threads: int

    def check(self) -> None:
        if self.hold_out < 2:
            raise ConfigError(f"identify.hold_out: expected 2 or more, got {self.hold_out}")
        if self.threads < 1:
            raise ConfigError(f"identify.threads: expected 1 or more, got {self.threads}")


@spec
class Identify:
    """Fits an actuator model to recordings; compares free runs on unseen ones with the baselines."""

    session: Session
    machine: Machine
    fit: ActuatorFit
    baselines: dict[str, ActuatorFit]
    identify: Identification

    def run(self) -> float:
        """Writes checkpoint, `identification.json` and `prediction.png`; returns the 10 s error, % of travel, mean over joints.

        Raises:
            RecordingError: a recording cannot be used, or there is too little data.
            CheckpointError: the fit left nothing that can be loaded.
        """
        self.session.seed_all()
        train, validation, test = self._split()
        device = self.session.torch_device()
        folder, seed = self.session.folder, self.session.stream("fit")
        result: dict[str, Any] = {"schema": 1, "machine": self.machine.name, "device": str(device), "joints": {}, "overall": {}}
        with _threads(self.identify.threads):
            began = time.monotonic()
            fitted = {self.fit.name: self.fit.fit(self.machine, train, validation, folder, seed, device)}
            result["fit_seconds"] = round(time.monotonic() - began, 2)
            for name, baseline in self.baselines.items():
                fitted[name] = baseline.fit(self.machine, train, validation, folder, seed, device)
        cut = open_loop.windows(test, self.machine, HORIZONS_S[-1], self.identify.stride_s)
        predicted = {name: open_loop.free_run(actuator, self.machine, cut, device) for name, actuator in fitted.items()}
        for name, path in predicted.items():
            table = open_loop.errors(path, cut, self.machine, HORIZONS_S, self.session.generator("resample"))
            for joint, rows in table.items():
                result["joints"].setdefault(joint, {})[name] = rows
            result["overall"][name] = _overall(table)
        result["delay_s"] = self._delays(train)
        result["data"] = {
            "train": _facts(train), "validation": _facts(validation), "test": _facts(test), "windows": len(cut.q)
        }  # fmt: skip
        result["model"] = self.fit.name
        write_json(folder / "identification.json", result)
        _picture(folder / "prediction.png", cut, predicted, self.machine, self.fit.name)
        _show(result, fitted)
        return result["overall"][self.fit.name]["10"]["percent"]

    def _split(self) -> tuple[list[Recording], list[Recording], list[Recording]]:
        """Returns recordings to fit to, to stop by, and to judge by; whole recordings, never parts of one."""
        options = self.identify
        found = record.read_all(options.recordings, self.machine)
        if options.test is not None:
            test = record.read_all(options.test, self.machine)
            if shared := {r.path.resolve() for r in found if r.path} & {r.path.resolve() for r in test if r.path}:
                raise RecordingError(
                    f"identify.test: {min(shared)} is also among identify.recordings; judge by recordings not fitted to"
                )
        else:
            test, found = found[1 :: options.hold_out], [r for i, r in enumerate(found) if i % options.hold_out != 1]
        validation, train = found[:: options.hold_out], [r for i, r in enumerate(found) if i % options.hold_out]
        if not (train and validation and test):
            count = len(found) + (len(test) if options.test is None else 0)
            raise RecordingError(
                f"too little data: {count} recordings do not make a set to fit to, one "
                "to stop by and one to judge by; record more, or shorter files (collect.file_minutes)"
            )
        return train, validation, test

    def _delays(self, train: Sequence[Recording]) -> dict[str, Any]:
        found = dead_time.delays(train, self.machine, self.session.generator("delay"))
        return {
            joint: None if delay is None else {"value": delay.value_s, "ci95": list(delay.ci95_s), "explained": delay.explained}
            for joint, delay in found.items()
        }


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """Limits torch to `count` CPU threads within the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(min(count, before))
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _overall(table: dict[str, Any]) -> dict[str, dict[str, float]]:
    """Returns means over joints, by horizon."""
    keys = ("rmse", "percent", "path_mean", "end_mean")
    horizons = next(iter(table.values()))
    return {horizon: {key: float(np.mean([rows[horizon][key] for rows in table.values()])) for key in keys} for horizon in horizons}


def _facts(recordings: Sequence[Recording]) -> dict[str, Any]:
    return {
        "recordings": len(recordings),
        "minutes": round(sum(recording.duration_s for recording in recordings) / 60.0, 1),
        "sources": sorted({recording.metadata.get("source", "unknown") for recording in recordings}),
    }


def _show(result: dict[str, Any], fitted: dict[str, Actuator]) -> None:
    table = Table(title="free-running error at the end of the horizon (RMSE, rad or m)", box=None)
    for column in ("joint", "model", *(f"{horizon_s:g} s" for horizon_s in HORIZONS_S), "dead time"):
        table.add_column(column, justify="left" if column in ("joint", "model") else "right")
    for joint, models in result["joints"].items():
        delay = result["delay_s"][joint]
        for row, name in enumerate(fitted):
            cells = [f"{models[name][f'{horizon_s:g}']['rmse']:.4f}" for horizon_s in HORIZONS_S]
            last = "" if row or delay is None else f"{delay['value']:.2f} s"
            table.add_row("" if row else joint, name, *cells, last)
    Console().print(table)


def _picture(path: Path, cut: open_loop.Windows, predicted: dict[str, np.ndarray], machine: Machine, name: str) -> None:
    """Draws, for each joint, measured and predicted position in its liveliest windows (the paper's figure 2)."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    steps = cut.measured.shape[1]
    t_s = machine.period_s * np.arange(1, steps + 1)
    colours = dict(
        zip([other for other in predicted if other != name], ("tab:gray", "tab:orange", "tab:green", "tab:red"), strict=False)
    )
    figure, axes = pyplot.subplots(machine.num_joints, 3, figsize=(12, 2.2 * machine.num_joints), squeeze=False, sharex=True)
    for j, joint in enumerate(machine.joints):
        travel = np.abs(np.diff(cut.measured[:, :, j], axis=1)).sum(1)
        for axis, window in zip(axes[j], np.argsort(-travel)[:3], strict=False):
            axis.plot(t_s, cut.measured[window, :, j], color="black", label="measured")
            for other, value in predicted.items():
                if other == name:
                    axis.plot(t_s, value[window, :, j], label=other, color="tab:blue")
                else:
                    axis.plot(
                        t_s, value[window, :, j], label=other, color=colours.get(other, "tab:purple"), linewidth=0.8, linestyle="--"
                    )
        axes[j][0].set_ylabel(f"{joint.name} [{joint.unit}]")
    axes[0][0].legend(fontsize="small")
    for axis in axes[-1]:
        axis.set_xlabel("free-running time [s]")
    figure.tight_layout()
    figure.savefig(path, dpi=100)
    pyplot.close(figure)
