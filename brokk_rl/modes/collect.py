"""`brokk mode=collect`: drives the simulated machine with an excitation and writes recordings."""

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from rich.progress import Progress

from brokk_rl import record
from brokk_rl.contracts import Actuator, Excitation, ExcitationProcess
from brokk_rl.errors import ConfigError
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.spec import spec

log = logging.getLogger(__name__)

FOLDER = "recordings"


@spec
class Collection:
    """How much to record.

    Attributes:
        num_runs: Runs side by side, each on a machine of its own.
        run_minutes: Length of each run; its oil warms up over this time.
        file_minutes: A run is cut into files of this length.
        noise: Standard deviation of the measured position, rad or m.
    """

    num_runs: int
    run_minutes: float
    file_minutes: float
    noise: float

    def check(self) -> None:
        if self.num_runs < 1:
            raise ConfigError(f"collect.num_runs: expected 1 or more, got {self.num_runs}")
        if not 0 < self.file_minutes <= self.run_minutes:
            raise ConfigError(f"collect: expected 0 < file_minutes <= run_minutes, got {self.file_minutes} and {self.run_minutes}")
        if self.noise < 0:
            raise ConfigError(f"collect.noise: expected 0 or more, got {self.noise}")


@spec
class Collect:
    """Drives a machine with an excitation and writes what was commanded and measured, as Parquet recordings."""

    session: Session
    machine: Machine
    actuator: Actuator
    excitation: Excitation
    collect: Collection

    def run(self) -> None:
        """Writes `recordings/<run>_<part>.parquet` into the run folder.

        Raises:
            StorageError: a file could not be written.
        """
        self.session.seed_all()
        generator = self.session.generator("collect")
        process = self.excitation.build(self.machine, self.collect.num_runs, generator)
        # a few dozen runs are faster on a CPU
        device = torch.device("cpu") if self.session.device == "auto" else self.session.torch_device()
        files = self._drive(process, generator, device)
        minutes = self.collect.num_runs * self.collect.run_minutes
        log.info("%d recordings of %.0f minutes in all in %s", files, minutes, self.session.folder / FOLDER)

    def _drive(self, process: ExcitationProcess, generator: np.random.Generator, device: torch.device) -> int:
        """Runs the machine through all periods and returns the number of files written."""
        machine, num_runs = self.machine, self.collect.num_runs
        total = round(self.collect.run_minutes * 60.0 / machine.period_s)
        per_file = round(self.collect.file_minutes * 60.0 / machine.period_s)
        model = self.actuator.build(machine, num_runs, device)
        shape = (num_runs, machine.num_history, machine.num_joints)
        history = History(q=torch.zeros(shape, device=device), u=torch.zeros(shape, device=device))
        q = torch.as_tensor(process.start, dtype=torch.float32, device=device)
        history.reset(torch.ones(num_runs, dtype=torch.bool, device=device), q)
        oil_c = model.state.get("oil_c")
        writer = _Writer(self, process, record.now())
        with Progress(transient=True) as progress, torch.inference_mode():
            task = progress.add_task(f"{num_runs} runs", total=total)
            try:
                for _ in range(total):
                    measured = q.cpu().numpy() + self.collect.noise * generator.standard_normal((num_runs, machine.num_joints))
                    u = process.command(measured)
                    writer.add(u, measured, None if oil_c is None else oil_c.cpu().numpy().copy())
                    history.push_u(torch.as_tensor(u, dtype=torch.float32, device=device))
                    q = model.step(history)
                    history.push_q(q)
                    if writer.pending == per_file:
                        writer.flush()
                    progress.advance(task)
            finally:
                writer.flush()  # what was recorded before an interruption is kept
        return writer.files


class _Writer:
    """Gathers the samples of all runs and writes them file by file."""

    def __init__(self, mode: Collect, process: ExcitationProcess, created: str) -> None:
        self._mode, self._names = mode, process.names
        self._part, self._samples = 0, []
        machine = mode.machine
        self._template = record.Recording(
            machine=machine.name,
            joints=machine.joint_names,
            units=tuple(joint.unit for joint in machine.joints),
            rate_hz=1.0 / machine.period_s,
            t_s=np.empty(0),
            u=np.empty(0),
            q=np.empty(0),
            metadata={
                "source": f"simulator: {type(mode.actuator).__name__}, excitation: {type(mode.excitation).__name__}",
                "fingerprint": record.stamp(machine),
                "seed": str(mode.session.seed),
            },
        )
        self._created, self._elapsed_s = created, 0.0
        self.files = 0

    @property
    def pending(self) -> int:
        """Number of samples not yet written."""
        return len(self._samples)

    def add(self, u: np.ndarray, q: np.ndarray, oil_c: np.ndarray | None) -> None:
        """Appends one sample of all runs."""
        self._samples.append((u, q, oil_c))

    def flush(self) -> None:
        """Writes one file a run with the pending samples; fewer than two are no recording and stay pending."""
        if len(self._samples) < 2:
            return
        u, q = (np.stack([sample[i] for sample in self._samples], 1) for i in (0, 1))
        oil_c = None if self._samples[0][2] is None else np.stack([sample[2] for sample in self._samples], 1)
        period_s = self._mode.machine.period_s
        created = record.later(self._created, self._elapsed_s)
        for n, name in enumerate(self._names):
            recording = replace(
                self._template,
                t_s=np.arange(len(self._samples)) * period_s,
                u=u[n],
                q=q[n],
                extra={} if oil_c is None else {"oil_c": oil_c[n]},
                metadata={**self._template.metadata, "created": created},
            )
            record.write(recording, self._path(name))
        self.files += len(self._names)
        self._elapsed_s += len(self._samples) * period_s
        self._part += 1
        self._samples.clear()

    def _path(self, name: str) -> Path:
        return self._mode.session.folder / FOLDER / f"{name}_{self._part:02d}.parquet"
