"""`brokk mode=collect`: plans an excitation, drives a machine through it, writes recordings."""

from __future__ import annotations

import logging
import time
from dataclasses import replace
from pathlib import Path

from actuators.excite import plan_report
from actuators.excite.plan_report import PlanTrack
from actuators.excite.player import CommandGuards, NominalLink, PlanPlayer, Sample, drive
from actuators.excite.schedule import ExcitationPlan, check_order, plan_runs
from brokk_rl import record
from brokk_rl.contracts.actuator import Excitation
from brokk_rl.contracts.link import Connection
from brokk_rl.machine import Machine
from brokk_rl.progress import ItemProgress
from brokk_rl.record import RATE_TOLERANCE
from brokk_rl.session import Session
from brokk_rl.spec import Count, Positive, spec

log = logging.getLogger(__name__)

FOLDER = "recordings"


@spec
class Collection:
    """Amount to record, and its bounds.

    Attributes:
        num_runs: Runs side by side, each on a machine of its own; a real machine has one.
        run_minutes: Length of each run; its oil warms up over this time.
        file_minutes: A run is cut into files of this length.
        flush_s: The file that grows is written again after this time, so that even a power failure
            costs no more.
        only_plan: Stop after `plan.png`, before anything moves.
        guards: Bounds that no program can exceed.
    """

    num_runs: Count
    run_minutes: Positive
    file_minutes: Positive
    flush_s: Positive
    only_plan: bool
    guards: CommandGuards

    def check(self) -> None:
        check_order(self, "file_minutes", "run_minutes")


@spec
class Collect:
    """Drives a machine, simulated or real, through excitations and writes recordings."""

    session: Session
    machine: Machine
    link: Connection
    excitation: dict[str, Excitation]
    collect: Collection

    def run(self) -> None:
        """Write `plan.png` and `recordings/<run>_<part>.parquet` into the run folder.

        Raises:
            ConfigError: the plan finds no room in a run.
            LinkError: the link to the machine failed; the recording until then is kept.
            StorageError: a file could not be written.
        """
        self.session.seed_all()
        settings, run_s = self.collect, self.collect.run_minutes * 60.0
        # The link refuses what it cannot do before a plan is written.
        link = self.link.build(self.machine, settings.num_runs, self.session)
        count, generator = settings.num_runs, self.session.generator("collect")
        plan = plan_runs(self.excitation, self.machine, count, run_s, generator)
        self._show(plan)
        if settings.only_plan:
            return
        writer = Writer(self, plan)
        num_periods = round(run_s / self.machine.period_s)
        title = f"control periods of {settings.num_runs} runs"
        with link as opened, ItemProgress(title, num_periods) as progress:
            try:
                for sample in drive(opened, self._runner(plan), self.machine, count, run_s):
                    writer.add(sample)
                    progress.advance()
            finally:
                writer.finish()  # what was recorded before an interruption is kept
        minutes = writer.recorded_s / 60.0
        log.info("%d recordings of %.1f minutes in all in %s", writer.files, minutes, self.folder)

    @property
    def folder(self) -> Path:
        """Folder of the recordings."""
        return self.session.folder / FOLDER

    def _runner(self, plan: ExcitationPlan) -> PlanPlayer:
        return PlanPlayer(plan, self.machine, self.collect.guards)

    def _show(self, plan: ExcitationPlan) -> None:
        """Try the plan out on a nominal machine and draw it."""
        machine, count = self.machine, self.collect.num_runs
        link = NominalLink(machine, count)
        track = PlanTrack(drive(link, self._runner(plan), machine, count, plan.run_s))
        path = self.session.folder / "plan.png"
        plan_report.draw_plan(plan, track, machine, path)
        if unplayed := plan_report.list_cut_segments(plan, track):
            text = "plan: no time for %s in some of the runs; raise collect.run_minutes"
            log.warning(text, ", ".join(unplayed))
        text = "plan: %d segments in the first of %d runs; see %s"
        log.info(text, len(plan.runs[0]), count, path)


class Writer:
    """Writer of the recordings of all runs; a growing file is rewritten at intervals.

    Attributes:
        files: Number of files written.
        recorded_s: Time recorded, all runs together.
    """

    def __init__(self, mode: Collect, plan: ExcitationPlan) -> None:
        self._machine, self._settings, self._folder = mode.machine, mode.collect, mode.folder
        self._names = [f"{'-'.join(plan.names)}_{n:02d}" for n in range(len(plan.runs))]
        self._created, self._begin_s = record.format_now(), 0.0
        self._metadata = {
            "source": f"{mode.link.source}, excitation: {', '.join(plan.names)}",
            "fingerprint": record.format_fingerprint(mode.machine),
            "seed": str(mode.session.seed),
        }
        self._part, self._samples, self._written = 0, [], time.monotonic()
        self.files, self.recorded_s = 0, 0.0

    def add(self, sample: Sample) -> None:
        """Append one sample of all runs; begin new files at length limits and time gaps."""
        if not self.files and not self._samples:
            self._begin_s = sample.t_s
        if self._samples:
            most = max(2, round(self._settings.file_minutes * 60.0 / self._machine.period_s))
            periods = (sample.t_s - self._samples[-1].t_s) / self._machine.period_s
            if abs(periods - 1.0) > RATE_TOLERANCE or len(self._samples) >= most:
                self.finish()
        self._samples.append(sample)
        if time.monotonic() - self._written > self._settings.flush_s:
            self._write()

    def finish(self) -> None:
        """Write the present files for the last time; leave out a single sample."""
        if len(self._samples) > 1:
            self._write()
            self._part += 1
            self.files += len(self._names)
            self.recorded_s += len(self._names) * len(self._samples) * self._machine.period_s
        self._samples = []

    def _write(self) -> None:
        """Write one file a run."""
        self._written = time.monotonic()
        if len(self._samples) < 2:
            return
        track, begin_s = PlanTrack(self._samples), self._samples[0].t_s
        for n, name in enumerate(self._names):
            run, t_s = f"{name} {self._created}", track.t_s - begin_s
            motion = record.make_motion(self._machine, run, t_s, track.u[:, n], track.q[:, n])
            created = record.add_seconds(self._created, begin_s - self._begin_s)
            metadata = {**self._metadata, "created": created, **motion.metadata}
            extra = {key: values[n] for key, values in track.extra.items()}
            path = self._folder / f"{name}_{self._part:02d}.parquet"
            record.write_recording(replace(motion, extra=extra, metadata=metadata), path)
