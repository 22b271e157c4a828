"""Recordings: the log of one run of a machine, its twin or the simulator, as one Parquet file.

Axes: `T` time, `J` joints in machine order. Row `k` holds the measured position at `t_s[k]` and the
command in force from then on.
"""

import contextlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from glob import glob
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from brokk_rl import recording_validation
from brokk_rl.errors import RecordingError, StorageError
from brokk_rl.machine import Machine
from brokk_rl.recording_validation import SCHEMA, Breach


@dataclass(frozen=True, kw_only=True)
class Recording:
    """One run of a machine at its control rate.

    Attributes:
        machine: Config name of the machine.
        joints: Joint names in machine order.
        units: `rad` or `m` for each joint.
        rate_hz: Nominal rate.
        t_s: Time since the start of the recording, shape `(T,)`, strictly increasing.
        u: Commands in force, shape `(T, J)`, in [-1, 1].
        q: Measured joint positions, shape `(T, J)`, rad or m.
        extra: Optional columns by name, each `(T,)`.
        metadata: Further `brokk.*` metadata without the prefix: `source`, `fingerprint`, `created`,
            `seed`, `run`.
        path: Where it was read from.
    """

    machine: str
    joints: tuple[str, ...]
    units: tuple[str, ...]
    rate_hz: float
    t_s: np.ndarray
    u: np.ndarray
    q: np.ndarray
    extra: Mapping[str, np.ndarray] = field(default_factory=dict)
    metadata: Mapping[str, str] = field(default_factory=dict)
    path: Path | None = None

    @property
    def run(self) -> str:
        """The run of the machine that this is a part of: a long run is cut into files, and a log split where it has gaps."""
        return self.metadata.get("run") or (self.path.stem if self.path else "")

    @property
    def num_samples(self) -> int:
        """Number of rows, `T`."""
        return len(self.t_s)

    @property
    def duration_s(self) -> float:
        """Time from the first to the last sample, s."""
        return float(self.t_s[-1] - self.t_s[0]) if self.num_samples else 0.0


def command_column(joint: str) -> str:
    """Returns the name of the column with the command of `joint`."""
    return f"u_{joint}"


def position_column(joint: str, unit: str) -> str:
    """Returns the name of the column with the position of `joint`, in `unit` (`rad` or `m`)."""
    return f"q_{joint}_{unit}"


def write(recording: Recording, path: Path) -> None:
    """Writes `recording` to `path`: under a temporary name first, so that `path` is either whole or absent.

    Raises:
        RecordingError: the recording breaks a rule of the format.
        StorageError: the file could not be written.
    """
    check(recording, str(path))
    columns: dict[str, np.ndarray] = {"t_s": recording.t_s.astype(np.float64)}
    for j, joint in enumerate(recording.joints):
        columns[command_column(joint)] = recording.u[:, j].astype(np.float32)
    for j, (joint, unit) in enumerate(zip(recording.joints, recording.units, strict=True)):
        columns[position_column(joint, unit)] = recording.q[:, j].astype(np.float32)
    columns.update(
        {name: np.asarray(values, dtype=np.float32) for name, values in recording.extra.items()}
    )
    metadata = {
        "schema": SCHEMA,
        "machine": recording.machine,
        "rate_hz": f"{recording.rate_hz:g}",
        **recording.metadata,
    }
    table = pa.table(columns).replace_schema_metadata(
        {f"brokk.{key}": value for key, value in metadata.items()}
    )
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, temporary, compression="zstd")
        os.replace(temporary, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise StorageError(
            f"cannot write recording {path}: {error.strerror or error}; nothing was left behind"
        ) from error


def read(path: Path, machine: Machine) -> Recording:
    """Reads the recording at `path`, made on `machine`.

    Raises:
        RecordingError: the file is missing or truncated, was made on another machine, lacks a
            column, or breaks a rule of the format; the message names file, row and column.
    """
    recording, found = examine(path, machine)
    if recording is None or found:
        raise RecordingError(f"{path}: {found[0]}")
    return recording


def examine(path: Path, machine: Machine) -> tuple[Recording | None, list[Breach]]:
    """Reads what can be read of the recording at `path`.

    Returns:
        The recording, with NaN in place of what is missing and the machine's rate where none is
        stated, `None` where nothing can be read; and every place where it breaks a rule of the
        format.
    """
    try:
        table = pq.read_table(path)
    except FileNotFoundError:
        return None, [Breach("no such recording")]
    except (pa.ArrowException, OSError) as error:
        return None, [Breach(f"truncated or not a Parquet file ({error})")]
    metadata = {
        key.decode(): value.decode() for key, value in (table.schema.metadata or {}).items()
    }
    metadata = {
        key.removeprefix("brokk."): value
        for key, value in metadata.items()
        if key.startswith("brokk.")
    }
    units = tuple(joint.unit for joint in machine.joints)
    commands = [command_column(name) for name in machine.joint_names]
    positions = [
        position_column(name, unit) for name, unit in zip(machine.joint_names, units, strict=True)
    ]
    required = ["t_s", *commands, *positions]
    found = [
        *recording_validation.of_metadata(metadata, machine.name),
        *recording_validation.of_names(required, table.column_names),
    ]
    columns: dict[str, np.ndarray] = {}
    for name in [*required, *(name for name in table.column_names if name not in required)]:
        if name not in table.column_names:
            continue
        column = table.column(name)
        if pa.types.is_floating(column.type) or pa.types.is_integer(column.type):
            columns[name] = column.cast(pa.float64()).to_numpy()  # an empty cell becomes NaN
        else:
            found.append(Breach(f"column '{name}' holds {column.type}, expected numbers", name))
    rate_hz = recording_validation.rate_hz(metadata) or 1.0 / machine.period_s
    found += recording_validation.of_columns(columns, required, rate_hz)
    missing = np.full(table.num_rows, np.nan)
    recording = Recording(
        machine=metadata.get("machine", machine.name),
        joints=machine.joint_names,
        units=units,
        rate_hz=rate_hz,
        t_s=columns["t_s"] if "t_s" in columns else np.arange(table.num_rows) / rate_hz,
        u=np.stack([columns.get(name, missing) for name in commands], 1).astype(np.float32),
        q=np.stack([columns.get(name, missing) for name in positions], 1).astype(np.float32),
        extra={
            name: values.astype(np.float32)
            for name, values in columns.items()
            if name not in required
        },
        metadata={
            key: value
            for key, value in metadata.items()
            if key not in ("schema", "machine", "rate_hz")
        },
        path=Path(path),
    )
    return recording, found


def read_all(patterns: str | Sequence[str], machine: Machine) -> list[Recording]:
    """Reads all recordings that match a glob or any of several, in order of their names.

    Raises:
        RecordingError: nothing matches, or one of them cannot be used.
    """
    return [read(path, machine) for path in matching(patterns, "recording")]


def matching(patterns: str | Sequence[str], what: str) -> list[Path]:
    """Returns the files that match a glob or any of several, in order of their names; `what` they are goes into the message.

    Raises:
        RecordingError: nothing matches.
    """
    patterns = [patterns] if isinstance(patterns, str) else list(patterns)
    paths = sorted({name for pattern in patterns for name in glob(pattern, recursive=True)})
    if not paths:
        raise RecordingError(f"no {what} matches {', '.join(patterns)} (seen from {Path.cwd()})")
    return [Path(name) for name in paths]


def check(recording: Recording, where: str) -> None:
    """Raises a `RecordingError` that names file (`where`), row (from 0) and column when `recording` breaks a rule of the format.

    In an optional column NaN means "not measured"; everywhere else it is refused.
    """
    shape = (recording.num_samples, len(recording.joints))
    for name, values in (("u", recording.u), ("q", recording.q)):
        if values.shape != shape:
            raise RecordingError(
                f"{where}: {name} has shape {values.shape}, expected {shape} (samples, joints)"
            )
    columns = {"t_s": recording.t_s}
    for j, (joint, unit) in enumerate(zip(recording.joints, recording.units, strict=True)):
        columns[command_column(joint)] = recording.u[:, j]
        columns[position_column(joint, unit)] = recording.q[:, j]
    required = list(columns)
    for breach in recording_validation.of_columns(
        columns | dict(recording.extra), required, recording.rate_hz
    ):
        raise RecordingError(f"{where}: {breach}")


def now() -> str:
    """Returns the present time as `brokk.created` wants it."""
    return datetime.now().astimezone().isoformat(timespec="milliseconds")


def later(created: str, elapsed_s: float) -> str:
    """Returns the time `elapsed_s` after `created`, both as `brokk.created` wants them."""
    return (datetime.fromisoformat(created) + timedelta(seconds=elapsed_s)).isoformat(
        timespec="milliseconds"
    )


def stamp(machine: Machine) -> str:
    """Returns the machine's fingerprint as `brokk.fingerprint` holds it: JSON."""
    return json.dumps(machine.fingerprint())
