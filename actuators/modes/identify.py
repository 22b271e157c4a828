"""`brokk mode=identify`: fits an actuator model and tests it on unseen recordings."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from rich.text import Text

from actuators import open_loop
from actuators.contracts import ActuatorFit
from actuators.identify import page
from actuators.identify.request import Identification
from actuators.identify.results import (
    HOLD,
    HORIZONS_S,
    LINEAR,
    FitStage,
    build_results,
    list_recordings,
)
from actuators.recordings.split import check_commanded, group_by_run, split_runs
from brokk_rl import record
from brokk_rl.console_table import TableCell, print_table, print_text
from brokk_rl.errors import ConfigError, RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.session import Session, read_record, write_json
from brokk_rl.spec import spec

log = logging.getLogger(__name__)

TONES = {"good": "green", "bad": "red", "warn": "yellow", "plain": "default"}

Runs = Mapping[str, Sequence[Recording]]


@spec
class Identify:
    """Fits an actuator model to recordings; compares free runs with baselines and rivals.

    Attributes:
        session: Folder, seed, device.
        machine: The machine that was recorded.
        fit: The model that is kept.
        baselines: Models to compare with, by name: `hold`, `arx`, and any more
            (`+fit@baselines.<name>=<fit>`).
        identify: Recordings to fit to and to judge by.
        resume: Run folder of an interrupted identification to go on with; the same as
            `session.out`.
    """

    session: Session
    machine: Machine
    fit: ActuatorFit
    baselines: dict[str, ActuatorFit]
    identify: Identification
    resume: str | None

    def check(self) -> None:
        if lacking := {HOLD, LINEAR} - self.baselines.keys():
            raise ConfigError(
                f"baselines: {' and '.join(sorted(lacking))} must be among them; no error means anything by itself"
            )
        if self.baselines.get(self.fit.name, self.fit) != self.fit:
            raise ConfigError(
                f"baselines.{self.fit.name} differs from fit, but has its name; give it another: +fit@baselines.<name>=…"
            )

    def run(self) -> float:
        """Write model, `identification.json`, picture and report; return the final error.

        Returns:
            Root mean square error at 10 s (or the longest horizon that fits), % of travel, mean
            over joints.

        Raises:
            RecordingError: a recording cannot be used, or there is too little data.
            CheckpointError: the fit left nothing that can be loaded.
            StorageError: something could not be written, or the folder holds other fits.
        """
        self._check_resume()
        self.session.seed_all()
        stages = self._stages()
        judged = [recording for stage in stages for recording in list_recordings(stage.test)]
        longest_s = open_loop.find_longest_horizon_s(judged, self.machine) + 1e-9
        horizons_s = [horizon_s for horizon_s in HORIZONS_S if horizon_s <= longest_s]
        for stage in stages:
            if stage.test or not self.identify.folds:
                stage.cut = self._cut(stage, horizons_s or HORIZONS_S[:1])
        models = {self.fit.name: self.fit, **self.baselines}
        device = self.session.torch_device()
        torch.set_num_threads(1)  # the networks are small: threads would only wait for each other
        for stage in stages:
            for name in models if stage.cut else (self.fit.name,):
                is_kept = name == self.fit.name
                folder = stage.folder if is_kept else stage.folder / "baselines" / name
                stage.fit(name, models[name], folder, self.machine, device)
        result, scores = build_results(
            self.machine, self.fit.name, stages, horizons_s, self.session.generator
        )
        result |= {"device": str(device), "seed": self.session.seed, "folds": self.identify.folds}
        folder = self.session.folder
        write_json(folder / "identification.json", result)
        page.write_page(folder, result, scores)
        _print_results(result, folder)
        return result["overall"][self.fit.name][f"{horizons_s[-1]:g}"]["percent"]

    def _check_resume(self) -> None:
        if self.resume is None:
            return
        if Path(self.resume).resolve() != self.session.folder.resolve():
            raise ConfigError(
                f"resume={self.resume}: an identification goes on in its own folder; add session.out={self.resume}"
            )
        if not (read_record(self.session.folder) or {}).get("resumed"):
            raise ConfigError(
                f"resume={self.resume}: there is no run to go on with; leave resume away to begin one"
            )

    def _stages(self) -> list[FitStage]:
        """Return the fits to do, each with whole runs to fit to, to stop by, and to judge by."""
        options, folder = self.identify, self.session.folder
        runs = group_by_run(record.read_recordings(options.recordings, self.machine))
        if options.folds:
            purpose = "for every fold to have one to fit to and one to stop by"
            check_commanded(runs, self.machine, 3, purpose)
            if len(runs) < options.folds:
                raise RecordingError(
                    f"too little data: identify.folds={options.folds}, but there are {len(runs)} runs"
                )
            shares = {str(number): 1.0 / options.folds for number in range(options.folds)}
            stages = []
            for number, tested in enumerate(split_runs(runs, shares).values(), 1):
                test = {key: runs[key] for key in tested}
                rest = {key: runs[key] for key in runs if key not in tested}
                name = f"fold {number} of {options.folds}"
                stages.append(self._stage(name, folder / "folds" / str(number), rest, test))
            return [*stages, self._stage("all runs", folder, runs, {})]
        if options.test is not None:
            test = group_by_run(record.read_recordings(options.test, self.machine))
            self._check_unseen(runs, test)
            return [self._stage("", folder, runs, test)]
        purpose = (
            "one to fit to, one to stop the fit by and one to judge by (identify.test, or folds)"
        )
        check_commanded(runs, self.machine, 3, purpose)
        return [self._stage("", folder, *self._split(runs))]

    def _stage(self, name: str, folder: Path, rest: Runs, test: Runs) -> FitStage:
        where = f"in {name} " if name else ""
        purpose = f"{where}one to fit to and one to stop the fit by"
        check_commanded(rest, self.machine, 2, purpose)
        seed = self.session.stream(f"fit {name}".strip())
        return FitStage(name, folder, seed, *self._split(rest), test)

    def _split(self, runs: Runs) -> tuple[Runs, Runs]:
        """Return the runs without those that are held out, and these."""
        share = 1.0 / self.identify.hold_out
        kept, held = split_runs(runs, {"kept": 1.0 - share, "held out": share}).values()
        return {name: runs[name] for name in kept}, {name: runs[name] for name in held}

    def _check_unseen(self, runs: Runs, test: Runs) -> None:
        files = []
        for part in (runs, test):
            files.append({r.path.resolve() for r in list_recordings(part) if r.path})
        if shared := {*map(str, files[0] & files[1]), *(runs.keys() & test.keys())}:
            raise RecordingError(
                f"identify.test: {min(shared)} is also among identify.recordings; judge by runs that were not fitted to"
            )

    def _cut(self, stage: FitStage, horizons_s: Sequence[float]) -> open_loop.FreeRunWindows:
        judged, stride_s = list_recordings(stage.test), self.identify.stride_s
        return open_loop.cut_windows(judged, self.machine, horizons_s[-1], stride_s, horizons_s[0])


def _print_results(result: Mapping, folder: Path) -> None:
    horizons = list(result["overall"][result["model"]])
    table: list[list[TableCell]] = []
    for joint, models in (*result["joints"].items(), ("all joints", result["overall"])):
        delay = result["delay_s"].get(joint)
        key, digits = ("rmse", 4) if joint in result["joints"] else ("percent", 2)
        for row, (name, rows) in enumerate(models.items()):
            cells: list[TableCell] = []
            for horizon in horizons:
                if not rows[horizon]:
                    cells.append(None)
                    continue
                is_least = rows[horizon]["percent"] <= page.find_least(models, horizon)
                cells.append(Text(f"{rows[horizon][key]:.{digits}f}", "bold" if is_least else ""))
            after = "" if row or delay is None else f"{delay['value']:.2f} s"
            table.append(["" if row else joint, name, *cells, after])
    print_table(
        ("joint", "model", *(f"{horizon} s" for horizon in horizons), "dead time"),
        table,
        "error at the end of free runs on unseen runs (RMSE, rad or m; last rows: % of travel)",
    )
    for number, sentence in enumerate(result["verdict"]):
        if number == 0 or sentence["tone"] in ("bad", "warn"):
            print_text(sentence["text"], TONES[sentence["tone"]])
    print_text(f"report: {folder / page.PAGE}")
