"""Recordings of cases: a plan for each run, machines of one make side by side, the files."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import numpy as np

from actuators.excite.plan_report import PlanTrack
from actuators.excite.player import CommandGuards, PlanPlayer, drive
from actuators.excite.schedule import Approach, ExcitationPlan, plan_runs
from brokk_rl import record
from brokk_rl.contracts.actuator import Excitation
from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.machine import Machine
from brokk_rl.signals import Command
from brokk_rl.spec import spec
from exam.case_distribution import CaseDesign
from exam.plants.family import DrawnPlants, PlantLink, PlantRun

NUM_PLANS = 4
"""Plans drawn before a file is said to be too short: now and then the ways between distant poses
leave no room."""
FIRST_DAY = datetime(2026, 1, 5, 8, 0, tzinfo=UTC)
"""Recordings say when they were made, so that warm-up can be read across files; all cases say the
same."""
EPOCH_S = FIRST_DAY.timestamp()


Half = Literal["reference", "field", "withheld"]
"""Parts of a case. The withheld one is of the machine as it is, and no candidate gets it."""
STREAMS: dict[Half, int] = {"reference": 0, "field": 1, "withheld": 2}
"""Number of each in the streams of chance."""
UNCHANGED_FOLDER = "unchanged"
"""Folder, beside withheld recordings, of the same machine without what the case is about."""


@spec
class HalfPlan:
    """Plan of the recordings of one half of a case, `reference` or `field`, or of the withheld part.

    Attributes:
        programs: Names of the excitations of each file.
        other_hand: The same in the other half of the cases, as many files, where another hand drives;
            empty: all cases have `programs`.
        file_s: Length of a file.
        elapsed_s: Range of the time that the machine has run before a file begins.
    """

    programs: tuple[tuple[str, ...], ...]
    other_hand: tuple[tuple[str, ...], ...]
    file_s: float
    elapsed_s: tuple[float, float]

    def check(self) -> None:
        if not self.programs or not all(self.programs):
            raise ConfigError(
                "exam: each file needs one or more excitations, e.g. [[levels], [levels, holds]]"
            )
        if self.other_hand and len(self.other_hand) != len(self.programs):
            raise ConfigError(
                f"other_hand: expected as many files as programs, {len(self.programs)}, got {len(self.other_hand)}"
            )

    def has_other_hand(self, question: CaseDesign) -> bool:
        """Return whether another hand drives this half of a case: by its chance, in half of the cases."""
        return bool(self.other_hand) and question.chance % 2 == 1


class RecordingJob:
    """One file of one case.

    Attributes:
        question: The case.
        case: Its number.
        number: Number of the file in its half.
        half: How that is recorded.
        name: Which half.
        elapsed_s: How long the machine has run before.
        created: When, as recordings say it.
        plan: The excitation.
    """

    plan: ExcitationPlan
    name: Half

    def __init__(
        self, question: CaseDesign, case: int, number: int, half: HalfPlan, name: Half
    ) -> None:
        self.question, self.case, self.number = question, case, number
        self.half, self.name = half, name
        share = (number + float(self.stream("elapsed").random())) / len(half.programs)
        low_s, high_s = half.elapsed_s
        self.elapsed_s = low_s + share * (
            high_s - low_s
        )  # files follow one another through the day
        self.created = record.add_seconds(
            FIRST_DAY.isoformat(timespec="milliseconds"), self.elapsed_s + 86400.0 * self.is_field
        )

    @property
    def is_field(self) -> bool:
        """True if the machine is recorded as it is."""
        return self.name != "reference"

    def stream(self, name: str) -> np.random.Generator:
        """Return a stream of chance that is this file's alone."""
        return np.random.default_rng(
            [self.question.chance, self.number, STREAMS[self.name], *name.encode()]
        )


class CaseRecorder:
    """Record cases.

    Args:
        machine: The machine.
        plants: Its doubles.
        roughness: Which of the family's.
        excitations: By name.
        approach: How start poses are taken up.
    """

    def __init__(
        self,
        machine: Machine,
        plants: DrawnPlants,
        roughness: str,
        excitations: Mapping[str, Excitation],
        approach: Approach,
    ) -> None:
        self._machine, self._plants, self._roughness = machine, plants, roughness
        self._excitations, self._approach = excitations, approach
        self._guards = CommandGuards(max_command=1.0, max_tool_speed_m_s=None)

    def planned(
        self, questions: Sequence[CaseDesign], half: HalfPlan, name: Half
    ) -> list[RecordingJob]:
        """Return the files of one half of all cases with their plans, before anything is recorded.

        Raises:
            ConfigError: an excitation is unknown, or finds no room in a file.
        """
        jobs = []
        for n, question in enumerate(questions):
            for k in range(len(half.programs)):
                job = RecordingJob(question, n, k, half, name)
                job.plan = self._plan(job)
                jobs.append(job)
        return jobs

    def record(self, jobs: Sequence[RecordingJob], folders: Sequence[Path]) -> None:
        """Write the files of one half of each case into its folder.

        Args:
            jobs: The files. They are the same whatever is recorded beside them.
            folders: Where each case's files go.
        """
        # a faulty machine may be slow on its ways to start poses; this process only records
        logging.getLogger(PlanPlayer.__module__).setLevel(logging.ERROR)
        runs = list(map(self._specimen, jobs))
        for places, link in self._plants.build(self._machine, runs, jobs[0].half.file_s):
            mine = [jobs[i] for i in places]
            self._batch(mine, [runs[i] for i in places], link, folders)

    def find_make(self, question: CaseDesign) -> str:
        """Return the make of a case's machine."""
        run = PlantRun(question.machine_seed, self._roughness, chance=0, elapsed_s=0.0)
        return self._plants.draw(self._machine, run)[0]

    def _specimen(self, job: RecordingJob) -> PlantRun:
        question = job.question
        faults = (
            {fault.effect: fault.parameters for fault in question.faults} if job.is_field else {}
        )
        return PlantRun(
            seed=question.machine_seed,
            roughness=self._roughness,
            chance=int(job.stream("chance").integers(2**62)),
            elapsed_s=job.elapsed_s,
            day=int(job.is_field),
            faults=faults,
            outside_fault=question.outside_fault if job.is_field else None,
            tracked=question.tracked,
        )

    def _plan(self, job: RecordingJob) -> ExcitationPlan:
        other = job.half.has_other_hand(job.question)
        names = (job.half.other_hand if other else job.half.programs)[job.number]
        for name in names:
            if name not in self._excitations:
                raise ConfigError(
                    f"exam: programs: no excitation '{name}'; {list_choices(name, self._excitations)}"
                )
        chosen = {name: self._excitations[name] for name in names}
        stream = job.stream("plan")
        tried = 1
        while True:
            try:
                return plan_runs(chosen, self._machine, self._approach, 1, job.half.file_s, stream)
            except ConfigError:
                if tried == NUM_PLANS:
                    raise
                tried += 1

    def _batch(
        self,
        jobs: Sequence[RecordingJob],
        specimens: Sequence[PlantRun],
        link: PlantLink,
        folders: Sequence[Path],
    ) -> None:
        """Record files of one half, of machines of one make."""
        half = jobs[0].half
        machine = self._machine
        plan = ExcitationPlan(
            runs=tuple(job.plan.runs[0] for job in jobs),
            run_s=half.file_s,
            names=tuple(self._excitations),
        )
        runner = PlanPlayer(plan, machine, self._approach, self._guards)
        with link as opened:
            samples = list(drive(opened, runner, machine, len(jobs), half.file_s))
        track = PlanTrack(samples)
        extra = {}
        for name in samples[0].extra:
            extra[name] = np.stack([sample.extra[name] for sample in samples], 1)
        u, q = track.u.astype(np.float32), track.q.astype(np.float32)
        t_s = track.t_s - track.t_s[0]
        is_withheld = jobs[0].name == "withheld"
        if is_withheld:
            unchanged = self._without(specimens, u, half)
            for n, job in enumerate(jobs):
                place = folders[job.case] / UNCHANGED_FOLDER
                self._write(job, t_s, u[:, n], unchanged[:, n], {}, place)
        for n, job in enumerate(jobs):
            columns = {}
            if job.question.tracked:
                columns = {name: values[n] for name, values in extra.items()}
            # the withheld part has a folder of its own, beside those of the cases
            place = folders[job.case] if is_withheld else folders[job.case] / job.name
            self._write(job, t_s, u[:, n], q[:, n], columns, place)

    def _write(
        self,
        job: RecordingJob,
        t_s: np.ndarray,
        u: np.ndarray,
        q: np.ndarray,
        columns: dict[str, np.ndarray],
        folder: Path,
    ) -> None:
        """Write a file of a job."""
        machine = self._machine
        recording = record.Recording(
            machine=machine.name,
            joints=machine.joint_names,
            units=tuple(joint.unit for joint in machine.joints),
            rate_hz=1.0 / machine.period_s,
            t_s=t_s,
            u=u,
            q=q,
            extra=columns,
            metadata={"created": job.created, "fingerprint": record.format_fingerprint(machine)},
        )
        path = folder / f"{job.number:02d}.parquet"
        record.write_recording(recording, path)
        # the same time for all cases: the time of a file tells nothing about its case
        os.utime(path, (EPOCH_S, EPOCH_S))

    def _without(self, specimens: Sequence[PlantRun], u: np.ndarray, half: HalfPlan) -> np.ndarray:
        """Return the positions of the same machines without faults, `(T, N, J)`."""
        healthy = []
        for specimen in specimens:
            healthy.append(replace(specimen, faults={}, outside_fault=None, tracked=False))
        ((_, link),) = self._plants.build(self._machine, healthy, half.file_s)
        path = []
        with link as opened:
            for command in u:
                path.append(opened.read().q)
                opened.send(Command(command.astype(float)))
        return np.stack(path).astype(np.float32)
