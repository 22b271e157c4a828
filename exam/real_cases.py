"""Cases of the scorecard: logs of a real machine, its simulator, and the knowledge about it.

Each stage is the command that a person would type, in a process and a run folder of its own.
"""

from __future__ import annotations

import logging
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from actuators.recordings.log_reader import LogReader
from brokk_rl import record
from brokk_rl.errors import BrokkError, ConfigError, RecordingError, list_choices
from brokk_rl.machine import Machine
from brokk_rl.session import read_record
from brokk_rl.spec import spec

log = logging.getLogger(__name__)

PARTS = ("reference", "field", "apart")
"""Folders of the recordings of a case."""
SIMULATOR_FOLDER = "simulator"
DIAGNOSIS_FOLDER = "diagnosis"
ERRORS_FILE = "errors.txt"
"""Messages of a stage, beside its run folder."""
REFUSED = 2
"""Exit code of a mode that refuses its input; see `brokk_rl.cli.main`."""


class RefusalError(BrokkError):
    """The diagnosis refused the recordings."""


@spec
class KnownCauses:
    """Knowledge about a real machine, to score an answer by.

    Attributes:
        explainable: Whether effects of the library can explain the gap; if not, `unknown` is right.
        effects: Effects that the machine has and the simulator lacks, with their joints; no joints
            for an effect of the whole machine.
        plausible: Effects that the machine may have too; neither right nor phantoms.
        source: Source of this knowledge.
    """

    explainable: bool
    effects: dict[str, tuple[str, ...]]
    plausible: tuple[str, ...]
    source: str

    def check(self) -> None:
        if self.explainable and not self.effects:
            raise ConfigError("known.effects: expected one or more where the gap is explainable")
        if not self.explainable and self.effects:
            raise ConfigError("known.effects: expected none where the gap is not explainable")


@spec
class RealCase:
    """A case of the scorecard.

    Attributes:
        title: The machine and its simulator in words.
        folder: Folder of the logs below `scorecard.data`.
        machine: The recorded machine, an option of `machine` by its name.
        reader: Reads its logs.
        reference: Globs of logs that the simulator is built from; may be empty.
        field: Globs of logs that are diagnosed.
        apart: Globs of logs to which nothing is fitted; may be empty.
        fit: Arguments of `mode=identify` that make the simulator from the reference, or without one
            from the field; empty: `mode=diagnose` makes it, or `diagnose` names one.
        diagnose: Further arguments of `mode=diagnose`; `{simulator}` stands for the run folder of
            the fit.
        known: Knowledge about the machine.
    """

    title: str
    folder: str
    machine: Machine
    reader: LogReader
    reference: tuple[str, ...]
    field: tuple[str, ...]
    apart: tuple[str, ...]
    fit: tuple[str, ...]
    diagnose: tuple[str, ...]
    known: KnownCauses

    def check(self) -> None:
        if not self.field:
            raise ConfigError(f"{self.title}: expected one or more globs in field")
        has_actuator = any(word.startswith("actuator=") for word in self.diagnose)
        if has_actuator == self._is_fitted_to_reference():
            raise ConfigError(
                f"{self.title}: expected either an actuator=… among diagnose, or a reference and no fit"
            )
        names = self.machine.joint_names
        for effect, joints in self.known.effects.items():
            for joint in joints:
                if joint not in names:
                    raise ConfigError(
                        f"{self.title}: known.effects.{effect}: no joint '{joint}'; {list_choices(joint, names)}"
                    )

    def _is_fitted_to_reference(self) -> bool:
        return bool(self.reference) and not self.fit


@dataclass(frozen=True)
class CaseRun:
    """The files of one case.

    Attributes:
        case: The case.
        data: Folder of its logs.
        folder: Folder of its recordings and stages.
        limit_s: Longest time of a stage.
    """

    case: RealCase
    data: Path
    folder: Path
    limit_s: float

    def convert_logs(self) -> dict[str, int]:
        """Write `reference/`, `field/` and `apart/`; return the number of logs of each.

        Raises:
            RecordingError: a glob matches no log, a log cannot be used or is in two parts.
        """
        part_of: dict[Path, str] = {}
        for part in PARTS:
            for pattern in getattr(self.case, part):
                for path in record.find_files(str(self.data / pattern), "log"):
                    if part_of.setdefault(path, part) != part:
                        raise RecordingError(f"{path} is in {part_of[path]} and in {part}")
        counts: dict[str, int] = dict.fromkeys(PARTS, 0)
        for part in PARTS:
            shutil.rmtree(self.folder / part, ignore_errors=True)
        for path, part in part_of.items():
            (self.folder / part).mkdir(parents=True, exist_ok=True)
            for number, recording in enumerate(self.case.reader.read(path, self.case.machine)):
                name = f"{path.stem}_{number:02d}.parquet"
                record.write_recording(recording, self.folder / part / name)
            counts[part] += 1
        return counts

    def fit_simulator(self) -> None:
        """Run `mode=identify` where the case has a fit."""
        if not self.case.fit:
            return
        part = "reference" if self.case.reference else "field"
        self._run_stage(
            SIMULATOR_FOLDER,
            [
                "mode=identify",
                *self.case.fit,
                f"identify.recordings={self.folder / part}/*.parquet",
            ],
        )

    def diagnose_field(self) -> None:
        """Run `mode=diagnose`."""
        words = ["mode=diagnose"]
        for word in self.case.diagnose:
            words.append(word.replace("{simulator}", str(self.folder / SIMULATOR_FOLDER)))
        if any(word.startswith("actuator=") for word in self.case.diagnose):
            words.append(f"diagnosis.field={self.folder / 'field'}/*.parquet")
        else:
            words.append(f"diagnosis.case={self.folder}")
        if self.case.apart:
            words.append(f"diagnosis.unseen={self.folder / 'apart'}/*.parquet")
        self._run_stage(DIAGNOSIS_FOLDER, words)

    def _run_stage(self, name: str, words: Sequence[str]) -> None:
        """Run a mode in a process of its own, from its beginning; a finished fit is kept.

        Raises:
            RefusalError: the diagnosis refused the recordings.
            BrokkError: it failed or exceeded its time.
        """
        place = self.folder / name
        if name != DIAGNOSIS_FOLDER and (read_record(place) or {}).get("outcome") == "finished":
            return
        shutil.rmtree(place, ignore_errors=True)
        command = [sys.executable, "-P", "-m", "brokk_rl", *words]
        command += [
            f"machine={self.case.machine.name}",
            f"session.out={place}",
            "session.device=cpu",
        ]
        errors = self.folder / f"{name}_{ERRORS_FILE}"
        with errors.open("w") as file, subprocess.Popen(command, stderr=file) as process:
            try:
                code = process.wait(timeout=self.limit_s)
            except subprocess.TimeoutExpired as error:
                process.kill()
                raise BrokkError(f"{name}: no end within {self.limit_s:g} s") from error
            except BaseException:
                process.terminate()
                raise
        if code:
            text = errors.read_text().strip()
            last = text.splitlines()[-1].removeprefix("error: ") if text else f"exit status {code}"
            if name == DIAGNOSIS_FOLDER and code == REFUSED:
                raise RefusalError(last)
            raise BrokkError(f"{name}: {last}")
