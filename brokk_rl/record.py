"""The rules of the recording format, and every place where a file breaks one.

Reading stops at the first breach; inspecting a recording lists them all. Rows count from 0; `T` is
time.
"""

import io
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from glob import glob
from pathlib import Path

import numpy as np

from brokk_rl.errors import RecordingError, list_choices
from brokk_rl.machine import Machine
from brokk_rl.session import write_bytes

SCHEMA = "1"
STATED = ("schema", "machine", "rate_hz")
"""Metadata that every recording has."""
DAMAGE = "damage"
"""Metadata that says in words what was lost of the log."""
RATE_TOLERANCE = 0.2
"""Largest relative deviation of a period from the stated rate."""
COMMAND_TOLERANCE = 1e-6
"""Rounding of float32 that is still no command outside [-1, 1]."""


@dataclass(frozen=True)
class Breach:
    """A place where a recording breaks a rule of the format.

    Attributes:
        text: The expected and the found content.
        column: Column concerned, `None` where it is the file as a whole.
        row: First row concerned, `None` where it is the column or the file as a whole.
        num_rows: Number of rows on end that break the same rule.
    """

    text: str
    column: str | None = None
    row: int | None = None
    num_rows: int = 1

    def __str__(self) -> str:
        where = "" if self.row is None else f"row {self.row}, column '{self.column}': "
        more = f" ({self.num_rows} such rows on end)" if self.num_rows > 1 else ""
        return f"{where}{self.text}{more}"


def check_metadata(metadata: Mapping[str, str], machine: str) -> Iterator[Breach]:
    """Yield the breaches in the metadata of a recording of machine `machine`."""
    for key in STATED:
        if key not in metadata:
            yield Breach(
                f"metadata 'brokk.{key}' is missing; not a recording, or one made by another program: mode=import reads such logs"
            )
    if metadata.get("schema", SCHEMA) != SCHEMA:
        yield Breach(f"brokk.schema is '{metadata['schema']}', this version reads '{SCHEMA}'")
    if metadata.get("machine", machine) != machine:
        yield Breach(
            f"unknown machine '{metadata['machine']}', expected '{machine}'; choose it with machine=…"
        )
    if "rate_hz" in metadata and parse_rate_hz(metadata) is None:
        yield Breach(f"brokk.rate_hz is '{metadata['rate_hz']}', expected a positive number")


def parse_rate_hz(metadata: Mapping[str, str]) -> float | None:
    """Return the stated rate, `None` where there is none or none that makes sense."""
    try:
        rate = float(metadata.get("rate_hz", ""))
    except ValueError:
        return None
    return rate if 0.0 < rate < float("inf") else None


def check_columns(
    columns: Mapping[str, np.ndarray], required: Sequence[str], stated_hz: float
) -> Iterator[Breach]:
    """Yield the breaches in the numbers.

    In an optional column NaN means "not measured"; everywhere else it is a breach.

    Args:
        columns: By name, each `(T,)`; missing ones are left out.
        required: Names of the columns that every recording has: time, commands, positions.
        stated_hz: Rate that the file states.
    """
    num_samples = max(map(len, columns.values()), default=0)
    if num_samples < 2:
        yield Breach(f"{num_samples} rows; a recording has at least 2")
    for name, values in columns.items():
        if len(values) != num_samples:
            yield Breach(f"column '{name}' has {len(values)} rows, others have {num_samples}", name)
        if name in required:
            for row, count in find_stretches(~np.isfinite(values)):
                yield Breach(f"{values[row]} is not a number", name, row, count)
    for name, values in columns.items():
        if name.startswith("u_") and name in required:
            for row, count in find_stretches(np.abs(values) > 1.0 + COMMAND_TOLERANCE):
                yield Breach(f"command {values[row]:g} lies outside [-1, 1]", name, row, count)
    if "t_s" in columns:
        yield from _check_time(columns["t_s"], stated_hz)


def _check_time(t_s: np.ndarray, stated_hz: float) -> Iterator[Breach]:
    period_s = np.diff(t_s)
    for row, count in find_stretches(period_s <= 0):
        yield Breach(
            f"time does not increase ({t_s[row]:g} s, then {t_s[row + 1]:g} s)",
            "t_s",
            row + 1,
            count,
        )
    for row, count in find_stretches(
        (np.abs(period_s * stated_hz - 1.0) > RATE_TOLERANCE) & (period_s > 0)
    ):
        text = (
            f"{period_s[row]:g} s after the row before, but brokk.rate_hz = {stated_hz:g} means {1.0 / stated_hz:g} s "
            f"({RATE_TOLERANCE:.0%} are allowed); split the recording at the gap or state its rate"
        )
        yield Breach(text, "t_s", row + 1, count)


def find_stretches(condition: np.ndarray) -> list[tuple[int, int]]:
    """Return first row and length of each stretch of rows where `condition`, `(T,)`, holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], condition, [False]]).astype(np.int8)))
    return [(int(begin), int(end - begin)) for begin, end in edges.reshape(-1, 2)]


def split_at_gaps(
    clocks: Iterable[np.ndarray], longest_gap_s: float
) -> Iterator[tuple[float, float]]:
    """Yield the spans, begin and end in s, in which none of several clocks has a gap."""
    begin_s, end_s = -np.inf, np.inf
    gaps: list[tuple[float, float]] = []
    for t_s in clocks:
        begin_s, end_s = max(begin_s, float(t_s[0])), min(end_s, float(t_s[-1]))
        rows = np.flatnonzero(np.diff(t_s) > longest_gap_s)
        gaps += zip(t_s[rows].tolist(), t_s[rows + 1].tolist(), strict=True)
    at_s = begin_s
    for before_s, after_s in sorted(gaps):
        if before_s >= end_s:
            break
        if before_s >= at_s:
            yield at_s, before_s
        at_s = max(at_s, after_s)
    if at_s <= end_s:
        yield at_s, end_s


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
        """The machine's run that this is a part of: runs are cut into files and at gaps."""
        return self.metadata.get("run") or (self.path.stem if self.path else "")

    @property
    def num_samples(self) -> int:
        """Number of rows, `T`."""
        return len(self.t_s)

    @property
    def duration_s(self) -> float:
        """Time from the first to the last sample, s."""
        return float(self.t_s[-1] - self.t_s[0]) if self.num_samples else 0.0


def make_motion(
    machine: Machine, run: str, t_s: np.ndarray, u: np.ndarray, q: np.ndarray
) -> Recording:
    """Return a planned motion, commands and positions `(T, J)`, in the form of a recording."""
    return Recording(
        machine=machine.name,
        joints=machine.joint_names,
        units=tuple(joint.unit for joint in machine.joints),
        rate_hz=1.0 / machine.period_s,
        t_s=t_s,
        u=u.astype(np.float32),
        q=q.astype(np.float32),
        metadata={"run": run},
    )


def name_command_column(joint: str) -> str:
    """Return the name of the column with the command of `joint`."""
    return f"u_{joint}"


def name_position_column(joint: str, unit: str) -> str:
    """Return the name of the column with the position of `joint`, in `unit` (`rad` or `m`)."""
    return f"q_{joint}_{unit}"


def write_recording(recording: Recording, path: Path) -> None:
    """Write `recording` to `path`, which is then either whole or absent.

    Raises:
        RecordingError: the recording breaks a rule of the format.
        StorageError: the file could not be written.
    """
    # Here, not above: the machine's computer captures and repairs without Parquet.
    import pyarrow as pa
    import pyarrow.parquet as pq

    check_recording(recording, str(path))
    columns: dict[str, np.ndarray] = {"t_s": recording.t_s.astype(np.float64)}
    for name, values in (list_columns(recording) | dict(recording.extra)).items():
        columns[name] = np.asarray(values, dtype=np.float32)
    metadata = {
        "schema": SCHEMA,
        "machine": recording.machine,
        "rate_hz": f"{recording.rate_hz:g}",
        **recording.metadata,
    }
    table = pa.table(columns).replace_schema_metadata(
        {f"brokk.{key}": value for key, value in metadata.items()}
    )
    buffer = io.BytesIO()
    pq.write_table(table, buffer, compression="zstd")
    write_bytes(path, buffer.getvalue())


def read_recording(path: Path, machine: Machine) -> Recording:
    """Read the recording at `path`, made on `machine`.

    Raises:
        RecordingError: the file is missing or truncated, was made on another machine, lacks a
            column, or breaks a rule of the format; the message names file, row and column.
    """
    recording, found = examine_recording(path, machine)
    if recording is None or found:
        raise RecordingError(f"{path}: {found[0]}")
    return recording


def examine_recording(path: Path, machine: Machine) -> tuple[Recording | None, list[Breach]]:
    """Read as much as possible of the recording at `path`.

    Returns:
        The recording, with NaN for missing values and the machine's rate where none is
        stated, `None` where nothing can be read; and every place where it breaks a rule of the
        format.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(path)
    except FileNotFoundError:
        return None, [Breach("no such recording")]
    except (pa.ArrowException, OSError) as error:
        return None, [
            Breach(f"truncated or not a Parquet file; mode=import reads other logs ({error})")
        ]
    metadata = {}
    for key, value in (table.schema.metadata or {}).items():
        if key.startswith(b"brokk."):
            metadata[key.removeprefix(b"brokk.").decode()] = value.decode()
    units = tuple(joint.unit for joint in machine.joints)
    commands = list(map(name_command_column, machine.joint_names))
    positions = list(map(name_position_column, machine.joint_names, units))
    required = ["t_s", *commands, *positions]
    found = list(check_metadata(metadata, machine.name))
    columns: dict[str, np.ndarray] = {}
    present = table.column_names
    for name in dict.fromkeys([*required, *present]):
        column = table.column(name) if name in present else None
        if column is None:
            text = f"column '{name}' is missing; {list_choices(name, present)}"
            found.append(Breach(text, name))
        elif pa.types.is_floating(column.type) or pa.types.is_integer(column.type):
            columns[name] = column.cast(pa.float64()).to_numpy()  # an empty cell becomes NaN
        else:
            found.append(Breach(f"column '{name}' holds {column.type}, expected numbers", name))
    rate_hz = parse_rate_hz(metadata) or 1.0 / machine.period_s
    found += check_columns(columns, required, rate_hz)
    missing = np.full(table.num_rows, np.nan)
    recording = Recording(
        machine=metadata.get("machine", machine.name),
        joints=machine.joint_names,
        units=units,
        rate_hz=rate_hz,
        t_s=columns["t_s"] if "t_s" in columns else np.arange(table.num_rows) / rate_hz,
        u=np.stack([columns.get(name, missing) for name in commands], 1).astype(np.float32),
        q=np.stack([columns.get(name, missing) for name in positions], 1).astype(np.float32),
        extra={name: columns[name].astype(np.float32) for name in columns if name not in required},
        metadata={key: metadata[key] for key in metadata if key not in STATED},
        path=Path(path),
    )
    return recording, found


def read_recordings(patterns: str | Sequence[str], machine: Machine) -> list[Recording]:
    """Read all recordings that match a glob or any of several, in order of their names.

    Raises:
        RecordingError: nothing matches, or one of them cannot be used.
    """
    return [read_recording(path, machine) for path in find_files(patterns, "recording")]


def find_files(patterns: str | Sequence[str], what: str) -> list[Path]:
    """Return the files that match one or several globs, sorted; `what` names them in messages.

    Raises:
        RecordingError: nothing matches.
    """
    patterns = [patterns] if isinstance(patterns, str) else list(patterns)
    paths = sorted({name for pattern in patterns for name in glob(pattern, recursive=True)})
    if not paths:
        given = ", ".join(patterns) or "an empty list"
        raise RecordingError(f"no {what} matches {given} (seen from {Path.cwd()})")
    return [Path(name) for name in paths]


def check_recording(recording: Recording, where: str) -> None:
    """Raise a `RecordingError` where `recording` breaks a rule of the format.

    The message names file (`where`), row (from 0) and column.

    In an optional column NaN means "not measured"; everywhere else it is refused.
    """
    shape = (recording.num_samples, len(recording.joints))
    for name, values in (("u", recording.u), ("q", recording.q)):
        if values.shape != shape:
            raise RecordingError(
                f"{where}: {name} has shape {values.shape}, expected {shape} (samples, joints)"
            )
    columns = {"t_s": recording.t_s} | list_columns(recording)
    required = list(columns)
    for breach in check_columns(columns | dict(recording.extra), required, recording.rate_hz):
        raise RecordingError(f"{where}: {breach}")


def list_columns(recording: Recording) -> dict[str, np.ndarray]:
    """Return commands, then positions, of all joints by the names of their columns."""
    joints, units = recording.joints, recording.units
    positions = map(name_position_column, joints, units)
    names = [*map(name_command_column, joints), *positions]
    return dict(zip(names, [*recording.u.T, *recording.q.T], strict=True))


def format_now() -> str:
    """Return the present time as `brokk.created` wants it."""
    return datetime.now().astimezone().isoformat(timespec="milliseconds")


def add_seconds(created: str, elapsed_s: float) -> str:
    """Return the time `elapsed_s` after `created`, both as `brokk.created` wants them."""
    return (datetime.fromisoformat(created) + timedelta(seconds=elapsed_s)).isoformat(
        timespec="milliseconds"
    )


def format_fingerprint(machine: Machine) -> str:
    """Return the machine's fingerprint as `brokk.fingerprint` holds it: JSON."""
    return json.dumps(machine.fingerprint())
