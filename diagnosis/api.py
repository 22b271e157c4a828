"""Diagnosis in six functions for a Python program or a notebook, without the command line.

    from diagnosis import api

    field = api.load("read/recordings/*", "draft/machine.yaml")
    outcome = api.diagnose(field, "runs/diagnosis", simulator="servo")
    print(outcome.answer.verdict, [one.effect for one in outcome.answer.selected])
    api.report(outcome, field, "runs/diagnosis")

`from_arrays` takes arrays in the place of recordings. Options are named as on the command line
(`servo`, or the path of a YAML file), or given as specs. The extra `diagnose` is enough: neither
simulator nor training is imported.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FunctionType
from typing import Any

import numpy as np
import torch

from actuators import open_loop
from actuators.contracts import ActuatorFit, FitTask
from actuators.recordings import log_draft
from actuators.recordings.guess import CommandKind, GivenColumns
from actuators.recordings.name_evidence import UNITS, read_unit
from brokk_rl import extensions, record
from brokk_rl.contracts.actuator import Actuator
from brokk_rl.errors import ConfigError, RecordingError, list_choices
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis import own_simulator
from diagnosis import report as diagnosis_report
from diagnosis.answer import Outcome
from diagnosis.case import GapCase
from diagnosis.modes.diagnose import Diagnose
from diagnosis.request import FITS

HELD_OUT = 4
"""One recording in so many stops a fit."""


@dataclass(frozen=True)
class RecordingSet:
    """Recordings of one machine.

    Attributes:
        recordings: The recordings.
        machine: The machine.
    """

    recordings: tuple[Recording, ...]
    machine: Machine


def load(pattern: str | Sequence[str], machine: str | Path | Machine) -> RecordingSet:
    """Return the recordings (Parquet files) that match a glob or several.

    Args:
        pattern: Glob or globs.
        machine: Option of `machine`: a name, the path of a YAML file, or the spec.

    Raises:
        ConfigError: There is no such machine, or its file is not valid.
        RecordingError: There are no recordings, or one cannot be used.
    """
    chosen: Machine = _load_option("machine", machine)
    patterns = pattern if isinstance(pattern, str) else tuple(pattern)
    return RecordingSet(tuple(record.read_recordings(patterns, chosen)), chosen)


def from_arrays(
    t_s: np.ndarray,
    u: np.ndarray,
    q: np.ndarray,
    command: CommandKind,
    joints: Sequence[str] | None = None,
    unit: str = "rad",
    max_force: float | None = None,
) -> RecordingSet:
    """Return recordings of arrays, with a machine that is drafted from them.

    Args:
        t_s: Times, `(T,)` s; a gap splits the recording.
        u: Commands, `(T,)` or `(T, J)`: targets in `unit`, speeds or forces.
        q: Positions in `unit`, of the same shape.
        command: `position`, `velocity` or `torque`, the quantity that commands set.
        joints: Names of the joints; `None`: `joint_1`, `joint_2`, …
        unit: Unit of the positions, as `log.position_unit`.
        max_force: Force or torque at the largest command, N or Nm; needed for `torque`.

    Raises:
        RecordingError: The shapes differ, or the times cannot be used.
        ConfigError: A force is commanded without `max_force`, or the unit is unknown.
    """
    commands, positions = (np.asarray(one, dtype=float).reshape(len(t_s), -1) for one in (u, q))
    names = list(joints or [f"joint_{number + 1}" for number in range(positions.shape[1])])
    if commands.shape != positions.shape or len(names) != positions.shape[1]:
        raise RecordingError(
            f"from_arrays: expected commands, positions and names of as many joints, got {commands.shape}, "
            f"{positions.shape} and {len(names)}"
        )
    if command == "torque" and max_force is None:
        raise ConfigError(
            "from_arrays: command 'torque' needs max_force, the force at the largest command"
        )
    if read_unit(unit) is None:
        raise ConfigError(f"from_arrays: unknown unit '{unit}'; {list_choices(unit, UNITS)}")
    columns = {"t_s": np.asarray(t_s, dtype=float)}
    pairs = {}
    for number, name in enumerate(names):
        pairs[name] = (f"command {name}", f"measured {name}")
        columns |= {pairs[name][0]: commands[:, number], pairs[name][1]: positions[:, number]}
    given = GivenColumns(pairs, command, unit, time=("t_s",))
    with TemporaryDirectory() as folder:
        log = Path(folder) / "arrays.npz"
        np.savez(log, **columns)  # pyright: ignore[reportArgumentType]
        draft = log_draft.make_draft([log], "arrays", given)
        texts = {
            "machine": draft.format(log_draft.MACHINE_TEMPLATE),
            "import": draft.format(log_draft.MAP_TEMPLATE),
        }
        texts["machine"] = texts["machine"].replace(f'"{log_draft.MISSING}"', str(max_force))
        for name, text in texts.items():
            (Path(folder) / f"{name}.yaml").write_text(text)
        machine, reader = (_load_option(name, Path(folder) / f"{name}.yaml") for name in texts)
        return RecordingSet(tuple(reader.read(log, machine)), machine)


def identify(
    recordings: RecordingSet,
    folder: str | Path,
    fit: str | Path | ActuatorFit | None = None,
    seed: int = 0,
) -> Actuator:
    """Return an actuator fitted to recordings; its file is left in `folder`.

    Args:
        recordings: Two or more.
        folder: Where `<name>.yaml` or the weights go.
        fit: Option of `fit`; `None`: `valve`; `servo` or `force` for joints commanded
            by position or torque.
        seed: Of all random numbers.

    Raises:
        RecordingError: There is too little data.
        StorageError: The file could not be written.
    """
    given = recordings.recordings
    if len(given) < 2:
        raise RecordingError(f"identify: expected two recordings or more, got {len(given)}")
    train = [one for number, one in enumerate(given) if number % HELD_OUT]
    task = FitTask(recordings.machine, train, given[::HELD_OUT], Path(folder), seed)
    return _choose_fit(fit, recordings.machine).fit(task)


def diagnose(
    field: RecordingSet,
    folder: str | Path,
    simulator: str | Path | Actuator | Callable[..., Any] | None = None,
    reference: RecordingSet | None = None,
    fit: str | Path | ActuatorFit | None = None,
    effects: Sequence[str] | None = None,
    repeatability: float | None = None,
    seed: int = 0,
    workers: int = 1,
) -> Outcome:
    """Return where a simulator departs from the machine, and which effects cause it.

    Args:
        field: Recordings of the machine as it is.
        folder: For the files of the fit.
        simulator: Option of `actuator`, or a simulator of your own: a function `step(state, command)` or
            its name `module:function`, or the path of an MJCF file; not needed with a reference.
        reference: Recordings that the simulator was built from; it is fitted to them.
        fit: Option of `fit` that makes the simulator of joints commanded by torque from a reference;
            `None`: `force`.
        effects: Names to choose among; `None`: all that the machine may have.
        repeatability: How much the machine repeats from day to day, standard deviation over the value;
            `None`: as on the command line.
        seed: Of all random numbers.
        workers: Processes that share the work, on Linux.

    Raises:
        RecordingError: There are no recordings, or too few to fit to.
        ConfigError: There is neither simulator nor reference, or an effect is unknown.
    """
    if not field.recordings:
        raise RecordingError("diagnose: expected a recording or more of the machine, got none")
    asked = _build_mode(field.machine, folder, seed)
    names = None if effects is None else tuple(effects)
    subject = replace(asked.diagnosis, effects=names, workers=workers)
    if repeatability is not None:
        subject = replace(subject, repeatability=repeatability)
    chosen = _choose_fit(fit, field.machine)
    asked = replace(asked, fit=chosen, actuator=_load_simulator(simulator), diagnosis=subject)
    asked.session.seed_all()
    before = () if reference is None else reference.recordings
    return asked.find_causes(GapCase(field.machine, before, field.recordings))


def simulate(
    actuator: str | Path | Actuator | Callable[..., Any], recordings: RecordingSet
) -> list[np.ndarray]:
    """Return the positions that a model predicts for the commands of each recording, `(T, J)`.

    The model sees the measured positions of its history and of one second of warm-up, which are
    returned as they are; from then on it sees its own predictions.

    Raises:
        RecordingError: A recording is shorter than history and warm-up.
    """
    model: Actuator = _load_simulator(actuator)
    machine, found = recordings.machine, []
    before = open_loop.count_samples_before(machine)
    for one in recordings.recordings:
        horizon_s = max(1, one.num_samples - before) * machine.period_s
        cut = open_loop.cut_windows([one], machine, horizon_s, horizon_s)
        ahead = open_loop.roll_out(model, machine, cut, torch.device("cpu"))[0]
        found.append(np.concatenate([cut.q[0, :before], ahead]))
    return found


def report(outcome: Outcome, field: RecordingSet, folder: str | Path) -> Path:
    """Write `report.html`, `diagnosis.json` and `effects.yaml`; return the path of the report.

    Raises:
        StorageError: A file could not be written.
    """
    asked = _build_mode(field.machine, folder, 0)
    asked.session.folder.mkdir(parents=True, exist_ok=True)
    asked.write(outcome)
    return asked.session.folder / diagnosis_report.REPORT_FILE


def _load_option(group: str, option: Any) -> Any:
    """Return an option of a config group by its name or by a path that ends in `.yaml`; a spec as it is."""
    if not isinstance(option, str | Path):
        return option
    name = str(option)
    return extensions.load_option(group, f"@{name}" if name.endswith((".yaml", ".yml")) else name)


def _load_simulator(simulator: str | Path | Actuator | Callable[..., Any] | None) -> Any:
    """Return the spec of an option, of a function or of an MJCF file."""
    if callable(simulator) and not hasattr(simulator, "build"):
        name = getattr(simulator, "__qualname__", "")
        if not isinstance(simulator, FunctionType) or "<" in name:
            raise ConfigError(
                f"simulator: expected a function at the top of a module, got {simulator!r}; write 'def step(state, command):' "
                "there, and call yours in it"
            )
        simulator = f"{simulator.__module__}:{simulator.__qualname__}"
    if isinstance(simulator, str | Path) and own_simulator.is_named_in(str(simulator)):
        return own_simulator.OwnSimulator(source=str(simulator))
    return _load_option("actuator", simulator)


def _choose_fit(fit: str | Path | ActuatorFit | None, machine: Machine) -> ActuatorFit:
    if fit is None:
        fit = FITS[machine.interface]
    return _load_option("fit", fit)


def _build_mode(machine: Machine, folder: str | Path, seed: int) -> Diagnose:
    """Return the mode as the command line would build it; recordings are given, none is read."""
    mode = extensions.load_mode("mode=diagnose", "diagnosis.field=given", "session.device=cpu")
    session = replace(mode.session, out=str(folder), seed=seed)
    return replace(mode, machine=machine, session=session)
