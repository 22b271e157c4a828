"""Recordings: the log of one run of a machine, its twin or the simulator, as one Parquet file.

Axes: `T` time, `J` joints in machine order. Row `k` holds the measured position at `t_s[k]` and the command in force from then on.
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

from brokk_rl.errors import RecordingError, StorageError, choices
from brokk_rl.machine import Machine

SCHEMA = "1"
RATE_TOLERANCE = 0.2
"""Largest relative deviation of a period from the stated rate."""
COMMAND_TOLERANCE = 1e-6
"""Rounding of float32 that is still no command outside [-1, 1]."""


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
        metadata: Further `brokk.*` metadata without the prefix: `source`, `fingerprint`, `created`, `seed`, `run`.
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
    columns.update({name: np.asarray(values, dtype=np.float32) for name, values in recording.extra.items()})
    metadata = {"schema": SCHEMA, "machine": recording.machine, "rate_hz": f"{recording.rate_hz:g}", **recording.metadata}
    table = pa.table(columns).replace_schema_metadata({f"brokk.{key}": value for key, value in metadata.items()})
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, temporary, compression="zstd")
        os.replace(temporary, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise StorageError(f"cannot write recording {path}: {error.strerror or error}; nothing was left behind") from error


def read(path: Path, machine: Machine) -> Recording:
    """Reads the recording at `path`, made on `machine`.

    Raises:
        RecordingError: the file is missing or truncated, was made on another machine, lacks a column, or breaks a rule of the
            format; the message names file, row and column.
    """
    try:
        table = pq.read_table(path)
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: no such recording") from error
    except (pa.ArrowException, OSError) as error:
        raise RecordingError(f"{path}: truncated or not a Parquet file ({error})") from error
    metadata = {key.decode(): value.decode() for key, value in (table.schema.metadata or {}).items()}
    metadata = {key.removeprefix("brokk."): value for key, value in metadata.items() if key.startswith("brokk.")}
    rate_hz = _checked_metadata(metadata, machine, path)
    units = tuple(joint.unit for joint in machine.joints)
    commands = [command_column(name) for name in machine.joint_names]
    positions = [position_column(name, unit) for name, unit in zip(machine.joint_names, units, strict=True)]
    required = ["t_s", *commands, *positions]
    for name in required:
        if name not in table.column_names:
            raise RecordingError(f"{path}: column '{name}' is missing; {choices(name, table.column_names)}")
    columns = {name: _numbers(table.column(name), name, path) for name in table.column_names}
    recording = Recording(
        machine=metadata["machine"],
        joints=machine.joint_names,
        units=units,
        rate_hz=rate_hz,
        t_s=columns["t_s"].astype(np.float64),
        u=np.stack([columns[name] for name in commands], 1).astype(np.float32),
        q=np.stack([columns[name] for name in positions], 1).astype(np.float32),
        extra={name: values.astype(np.float32) for name, values in columns.items() if name not in required},
        metadata={key: value for key, value in metadata.items() if key not in ("schema", "machine", "rate_hz")},
        path=Path(path),
    )
    check(recording, str(path))
    return recording


def read_all(patterns: str | Sequence[str], machine: Machine) -> list[Recording]:
    """Reads all recordings that match a glob or any of several, in order of their names.

    Raises:
        RecordingError: nothing matches, or one of them cannot be used.
    """
    patterns = [patterns] if isinstance(patterns, str) else list(patterns)
    paths = sorted({name for pattern in patterns for name in glob(pattern, recursive=True)})
    if not paths:
        raise RecordingError(f"no recording matches {', '.join(patterns)} (seen from {Path.cwd()})")
    return [read(Path(name), machine) for name in paths]


def check(recording: Recording, where: str) -> None:
    """Raises a `RecordingError` that names file (`where`), row (from 0) and column when `recording` breaks a rule of the format.

    In an optional column NaN means "not measured"; everywhere else it is refused.
    """
    shape = (recording.num_samples, len(recording.joints))
    for name, values in (("u", recording.u), ("q", recording.q)):
        if values.shape != shape:
            raise RecordingError(f"{where}: {name} has shape {values.shape}, expected {shape} (samples, joints)")
    if recording.num_samples < 2:
        raise RecordingError(f"{where}: {recording.num_samples} rows; a recording has at least 2")
    columns = {"t_s": recording.t_s}
    for j, (joint, unit) in enumerate(zip(recording.joints, recording.units, strict=True)):
        columns[command_column(joint)] = recording.u[:, j]
        columns[position_column(joint, unit)] = recording.q[:, j]
    for name, values in (columns | dict(recording.extra)).items():
        if len(values) != recording.num_samples:
            raise RecordingError(f"{where}: column '{name}' has {len(values)} rows, t_s has {recording.num_samples}")
        if name in columns and (row := _first(~np.isfinite(values))) is not None:
            raise RecordingError(f"{where}: row {row}, column '{name}': {values[row]} is not a number")
    for name in map(command_column, recording.joints):
        if (row := _first(np.abs(columns[name]) > 1.0 + COMMAND_TOLERANCE)) is not None:
            raise RecordingError(f"{where}: row {row}, column '{name}': command {columns[name][row]:g} lies outside [-1, 1]")
    period_s = np.diff(recording.t_s)
    if (row := _first(period_s <= 0)) is not None:
        raise RecordingError(
            f"{where}: row {row + 1}, column 't_s': time does not increase ({recording.t_s[row]:g} s, then "
            f"{recording.t_s[row + 1]:g} s)"
        )
    if (row := _first(np.abs(period_s * recording.rate_hz - 1.0) > RATE_TOLERANCE)) is not None:
        raise RecordingError(
            f"{where}: row {row + 1}, column 't_s': {period_s[row]:g} s after the row before, but brokk.rate_hz = "
            f"{recording.rate_hz:g} means {1.0 / recording.rate_hz:g} s (20 % are allowed); split the recording at the gap or "
            "state its rate"
        )


def now() -> str:
    """Returns the present time as `brokk.created` wants it."""
    return datetime.now().astimezone().isoformat(timespec="milliseconds")


def later(created: str, elapsed_s: float) -> str:
    """Returns the time `elapsed_s` after `created`, both as `brokk.created` wants them."""
    return (datetime.fromisoformat(created) + timedelta(seconds=elapsed_s)).isoformat(timespec="milliseconds")


def stamp(machine: Machine) -> str:
    """Returns the machine's fingerprint as `brokk.fingerprint` holds it: JSON."""
    return json.dumps(machine.fingerprint())


def _checked_metadata(metadata: Mapping[str, str], machine: Machine, path: Path) -> float:
    """Returns the rate in Hz, after schema, machine and rate have been checked."""
    for key in ("schema", "machine", "rate_hz"):
        if key not in metadata:
            raise RecordingError(f"{path}: metadata 'brokk.{key}' is missing; not a recording, or one made by another program")
    if metadata["schema"] != SCHEMA:
        raise RecordingError(f"{path}: brokk.schema is '{metadata['schema']}', this version reads '{SCHEMA}'")
    if metadata["machine"] != machine.name:
        raise RecordingError(
            f"{path}: unknown machine '{metadata['machine']}', expected '{machine.name}'; choose it with machine=…"
        )
    try:
        rate_hz = float(metadata["rate_hz"])
    except ValueError:
        rate_hz = 0.0
    if not 0.0 < rate_hz < float("inf"):
        raise RecordingError(f"{path}: brokk.rate_hz is '{metadata['rate_hz']}', expected a positive number")
    return rate_hz


def _numbers(column: pa.ChunkedArray, name: str, path: Path) -> np.ndarray:
    """Returns a column as an array; an empty cell becomes NaN."""
    if not (pa.types.is_floating(column.type) or pa.types.is_integer(column.type)):
        raise RecordingError(f"{path}: column '{name}' holds {column.type}, expected numbers")
    return column.cast(pa.float64()).to_numpy()


def _first(condition: np.ndarray) -> int | None:
    """Returns the first row where `condition` holds, or `None`."""
    rows = np.flatnonzero(condition)
    return int(rows[0]) if len(rows) else None
