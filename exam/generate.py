"""Recordings of cases: a plan for each run, machines of one make side by side, the files."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from annotated_types import MinLen

from actuators.excite.plan_report import PlanTrack
from actuators.excite.player import CommandGuards, PlanPlayer, drive
from actuators.excite.schedule import ExcitationPlan, plan_runs
from brokk_rl import record
from brokk_rl.contracts.actuator import Excitation
from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.machine import Machine
from brokk_rl.parallel import map_parallel, use_workers
from brokk_rl.progress import ItemProgress
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
CASES_FOLDER, WITHHELD_FOLDER = "cases", "withheld"
UNCHANGED_FOLDER = "unchanged"
"""Folder, beside withheld recordings, of the same machine without what the case is about."""
BLOCK_CASES = 12
"""Cases recorded side by side: 48 runs of a step in one array. More are hardly faster a case, and
an interruption loses more."""


Programs = Annotated[tuple[str, ...], MinLen(1)]
"""Names of the excitations of a file."""


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

    programs: Annotated[tuple[Programs, ...], MinLen(1)]
    other_hand: tuple[Programs, ...]
    file_s: float
    elapsed_s: tuple[float, float]

    def check(self) -> None:
        if self.other_hand and len(self.other_hand) != len(self.programs):
            raise ConfigError(
                f"other_hand: expected as many files as programs, {len(self.programs)}, got {len(self.other_hand)}"
            )

    def has_other_hand(self, question: CaseDesign) -> bool:
        """Return whether another hand drives this half of a case: by its chance, in half of the cases."""
        return bool(self.other_hand) and question.chance % 2 == 1


@dataclass(frozen=True)
class RecordingJob:
    """One file of one case.

    Attributes:
        question: The case.
        half: Which half the file is of.
        number: Number of the file in its half.
        plan: How that half is recorded.
        path: Where the file goes.
    """

    question: CaseDesign
    half: Half
    number: int
    plan: HalfPlan
    path: Path

    @property
    def is_field(self) -> bool:
        """True if the machine is recorded as it is."""
        return self.half != "reference"

    @property
    def unchanged_path(self) -> Path:
        """Where the same motion of the machine without what the case is about goes."""
        return self.path.parent / UNCHANGED_FOLDER / self.path.name

    @property
    def is_finished(self) -> bool:
        """True if its files are there; each is written in one step."""
        is_there = self.path.is_file()
        return is_there and (self.half != "withheld" or self.unchanged_path.is_file())

    @property
    def elapsed_s(self) -> float:
        """Time that the machine has run before, s; files follow one another through the day."""
        low_s, high_s = self.plan.elapsed_s
        share = (self.number + float(self.stream("elapsed").random())) / len(self.plan.programs)
        return low_s + share * (high_s - low_s)

    @property
    def programs(self) -> tuple[str, ...]:
        """Names of the excitations."""
        other = self.plan.has_other_hand(self.question)
        return (self.plan.other_hand if other else self.plan.programs)[self.number]

    def stream(self, name: str) -> np.random.Generator:
        """Return a stream of chance that is this file's alone."""
        return np.random.default_rng(
            [self.question.chance, self.number, STREAMS[self.half], *name.encode()]
        )

    def describe_run(self, roughness: str) -> PlantRun:
        """Return the run of the case's machine that the file holds."""
        question = self.question
        faults = question.faults if self.is_field else ()
        return PlantRun(
            seed=question.machine_seed,
            roughness=roughness,
            chance=int(self.stream("chance").integers(2**62)),
            elapsed_s=self.elapsed_s,
            day=int(self.is_field),
            faults={fault.effect: fault.parameters for fault in faults},
            tracked=question.tracked,
        )


@dataclass(frozen=True)
class CaseRecorder:
    """Record cases.

    Attributes:
        machine: The machine.
        plants: Its doubles.
        roughness: Which of the family's.
        excitations: By name.
        halves: Plan of each half, and of the withheld part.
        folder: Of the exam.
    """

    machine: Machine
    plants: DrawnPlants
    roughness: str
    excitations: Mapping[str, Excitation]
    halves: Mapping[Half, HalfPlan]
    folder: Path

    def write_all(self, questions: Sequence[CaseDesign], workers: int) -> None:
        """Record all cases that are not yet, in blocks of machines of one make; `workers`: processes."""
        todo = []
        for number, one in enumerate(questions):
            jobs = chain.from_iterable(self.list_jobs(number, one, half) for half in self.halves)
            if not all(job.is_finished for job in jobs):
                todo.append(number)
        todo.sort(key=lambda number: self._find_make(questions[number]))
        # a block for each process at least, so that none is idle
        size = max(1, min(BLOCK_CASES, -(-len(todo) // workers)))
        blocks = [todo[begin : begin + size] for begin in range(0, len(todo), size)]
        num_finished = len(questions) - len(todo)
        with ItemProgress("cases made", len(questions)) as progress, use_workers(workers):
            progress.skip(num_finished)
            map_parallel(
                lambda block: self.write({number: questions[number] for number in block}),
                blocks,
                lambda _, share: progress.reach(num_finished + int(share * len(todo))),
            )

    def write(self, questions: Mapping[int, CaseDesign]) -> None:
        """Record cases by number, side by side; the files do not depend on their neighbours.

        Raises:
            ConfigError: an excitation is unknown, or finds no room in a file.
        """
        # all halves are planned before anything is recorded: a plan without room fails at once
        planned = []
        for half in self.halves:
            jobs = []
            for number, question in questions.items():
                jobs += self.list_jobs(number, question, half)
            planned.append([(job, self.plan_run(job)) for job in jobs])
        for files in planned:
            jobs = [job for job, _ in files]
            runs = [job.describe_run(self.roughness) for job in jobs]
            for places, link in self.plants.build(self.machine, runs, jobs[0].plan.file_s):
                self._record([files[place] for place in places], link)

    def list_jobs(self, number: int, question: CaseDesign, half: Half) -> list[RecordingJob]:
        """Return the files of one half of a case."""
        place, plan = self.folder / CASES_FOLDER / f"{number:04d}" / half, self.halves[half]
        if half == "withheld":
            # the withheld part has a folder of its own, beside those of the cases
            place = self.folder / WITHHELD_FOLDER / f"{number:04d}"
        jobs = []
        for file in range(len(plan.programs)):
            jobs.append(RecordingJob(question, half, file, plan, place / f"{file:02d}.parquet"))
        return jobs

    def plan_run(self, job: RecordingJob) -> ExcitationPlan:
        """Return the excitation of a file; raises as `write`."""
        for name in job.programs:
            if name not in self.excitations:
                raise ConfigError(
                    f"exam: programs: no excitation '{name}'; {list_choices(name, self.excitations)}"
                )
        chosen = {name: self.excitations[name] for name in job.programs}
        about = (chosen, self.machine, 1, job.plan.file_s, job.stream("plan"))
        for _ in range(NUM_PLANS - 1):
            with suppress(ConfigError):
                return plan_runs(*about)
        return plan_runs(*about)

    def _find_make(self, question: CaseDesign) -> str:
        """Return the make of a case's machine."""
        run = PlantRun(question.machine_seed, self.roughness, chance=0, elapsed_s=0.0)
        return self.plants.draw(self.machine, run)[0]

    def _record(
        self, files: Sequence[tuple[RecordingJob, ExcitationPlan]], link: PlantLink
    ) -> None:
        """Record files of one half, of machines of one make."""
        jobs = [job for job, _ in files]
        machine, file_s = self.machine, jobs[0].plan.file_s
        runs = tuple(plan.runs[0] for _, plan in files)
        plan = ExcitationPlan(runs=runs, run_s=file_s, names=tuple(self.excitations))
        guards = CommandGuards(max_command=1.0, max_tool_speed_m_s=None)
        player = PlanPlayer(plan, machine, guards)
        player.level = logging.DEBUG  # a faulty machine may be slow on its ways to start poses
        with link as opened:
            track = PlanTrack(drive(opened, player, machine, len(jobs), file_s))
        u, q = track.u.astype(np.float32), track.q.astype(np.float32)
        t_s = track.t_s - track.t_s[0]
        is_withheld = jobs[0].half == "withheld"
        unchanged = self._repeat_without_faults(jobs, u) if is_withheld else None
        for n, job in enumerate(jobs):
            motion = record.make_motion(machine, "", t_s, u[:, n], q[:, n])
            if unchanged is not None:
                self._write_file(job, job.unchanged_path, replace(motion, q=unchanged[:, n]))
            extra = track.extra if job.question.tracked else {}
            columns = {name: values[n] for name, values in extra.items()}
            self._write_file(job, job.path, replace(motion, extra=columns))

    def _write_file(self, job: RecordingJob, path: Path, motion: record.Recording) -> None:
        """Write a motion of a job as it was recorded on its day."""
        elapsed_s = job.elapsed_s + 86400.0 * job.is_field
        begin = FIRST_DAY.isoformat(timespec="milliseconds")
        metadata = {
            "created": record.add_seconds(begin, elapsed_s),
            "fingerprint": record.format_fingerprint(self.machine),
        }
        record.write_recording(replace(motion, metadata=metadata), path)
        # the same time for all cases: the time of a file tells nothing about its case
        os.utime(path, (EPOCH_S, EPOCH_S))

    def _repeat_without_faults(self, jobs: Sequence[RecordingJob], u: np.ndarray) -> np.ndarray:
        """Return the positions of the same machines without faults, `(T, N, J)`."""
        healthy = []
        for job in jobs:
            run = job.describe_run(self.roughness)
            healthy.append(replace(run, faults={}, tracked=False))
        ((_, link),) = self.plants.build(self.machine, healthy, jobs[0].plan.file_s)
        path = []
        with link as opened:
            for command in u:
                path.append(opened.read().q)
                opened.send(Command(command.astype(float)))
        return np.stack(path).astype(np.float32)
