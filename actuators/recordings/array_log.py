"""Logs of arrays: Parquet, LeRobotDataset v2 and v3, NumPy archives and MATLAB files.

A column of lists becomes one column for each item, named `action[elbow]` where the dataset names
the items and `action[2]` where it does not.
"""

from __future__ import annotations

import json
import zipfile
import zlib
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy import io as matlab

from actuators.recordings.log_tables import LogFile, LogRun, Table
from brokk_rl.errors import RecordingError

EPISODE = "episode_index"
"""Column of a LeRobotDataset that says which episode a row belongs to."""
MOST_COLUMNS = 256
"""Widest matrix that is taken for joints; wider ones are pictures."""
BATCH_ROWS = 65536
PARQUET_ERRORS = (OSError, pa.ArrowException, ValueError)
"""Errors of pyarrow on a damaged file; a name that is no text is a `ValueError`."""
NPZ_ERRORS = (OSError, EOFError, ValueError, NotImplementedError, zipfile.BadZipFile, zlib.error)
"""Errors of the libraries on a damaged archive."""


class ParquetLog(LogFile):
    """A Parquet file as a log with one table."""

    def list_tables(self) -> dict[str, list[str]]:
        """Return the columns of numbers, and those of fixed lists item by item."""
        return {"": [name for names in _name_items(self.path, {}).values() for name in names]}

    def read_runs(
        self, wanted: Mapping[str, Collection[str]], max_rows: int | None
    ) -> Iterator[LogRun]:
        """Yield the file as one run."""
        columns = _read_parquet(self.path, _name_items(self.path, {}), wanted.get("", ()), max_rows)
        yield LogRun(self.path.stem, str(self.path), {"": Table(columns)})


class LeRobotLog(LogFile):
    """A LeRobotDataset, version 2 (a file an episode) or 3 (several episodes a file).

    Each episode is a run of its own. Pictures and videos are not read.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        try:
            info = json.loads((path / "meta" / "info.json").read_text())
            self._labels = _read_labels(info["features"])
            self._version = str(info["codebase_version"])
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise RecordingError(
                f"{path}/meta/info.json: expected the description of a LeRobotDataset ({error!r})"
            ) from error
        if not self._version.startswith(("v2", "v3")):
            raise RecordingError(
                f"{path}/meta/info.json: codebase_version is '{self._version}', expected v2.x or v3.x; "
                "LeRobot's own converter brings an older dataset to v3.0"
            )
        self._files = sorted(path.glob("data/**/*.parquet"))
        if not self._files:
            raise RecordingError(
                f"{path}: no data/**/*.parquet; a LeRobotDataset keeps its rows there"
            )

    def list_tables(self) -> dict[str, list[str]]:
        """Return the columns of numbers, items of lists by the names that the dataset gives them."""
        items = _name_items(self._files[0], self._labels)
        return {"": [name for names in items.values() for name in names]}

    def read_runs(
        self, wanted: Mapping[str, Collection[str]], max_rows: int | None
    ) -> Iterator[LogRun]:
        """Yield each episode as a run."""
        names = wanted.get("", ())
        for file in self._files:
            items = _name_items(file, self._labels)
            columns = _read_parquet(file, items, {*names, EPISODE}, max_rows)
            if EPISODE not in columns:
                raise RecordingError(f"{file}: column '{EPISODE}' is missing")
            numbers = columns[EPISODE]
            if not len(numbers):
                raise RecordingError(f"{file}: has no rows")
            edges = [0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist(), len(numbers)]
            for begin, end in pairwise(edges):
                run = f"{self.path.resolve().name}_{int(numbers[begin]):06d}"
                part = {name: values[begin:end] for name, values in columns.items()}
                where = f"{file}, episode {int(numbers[begin])}"
                yield LogRun(run, where, {"": Table(part)})
            if max_rows is not None:
                return


class ArrayLog(LogFile):
    """Named arrays as a log: those of one length are a table, each structure with a time another one."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        tables = _read_matlab(path) if path.suffix.lower() == ".mat" else _read_npz(path)
        self._tables: dict[str, dict[str, np.ndarray]] = {}
        for table, arrays in tables.items():
            sizes = Counter(size for values in arrays.values() for size in {*values.shape})
            length = max(sizes, key=lambda size: (sizes[size], size), default=0)
            columns: dict[str, np.ndarray] = {}
            for name, values in arrays.items():
                is_turned = len(values) != length and values.shape[-1] == length
                plain = values.T if is_turned else values
                if len(plain) == length and plain.ndim == 1:
                    columns[name] = plain.astype(float)
                elif len(plain) == length and plain.shape[1] <= MOST_COLUMNS:
                    for item, column in enumerate(plain.T.astype(float)):
                        columns[f"{name}[{item}]"] = column
            self._tables[table] = columns

    def list_tables(self) -> dict[str, list[str]]:
        """Return the real vectors of the most frequent length, and columns of such matrices."""
        return {table: [*columns] for table, columns in self._tables.items()}

    def read_runs(
        self, wanted: Mapping[str, Collection[str]], max_rows: int | None
    ) -> Iterator[LogRun]:
        """Yield the file as one run."""
        tables = {}
        for table, names in wanted.items():
            tables[table] = Table({name: self._tables[table][name][:max_rows] for name in names})
        yield LogRun(self.path.stem, str(self.path), tables)


def _read_npz(path: Path) -> dict[str, dict[str, np.ndarray]]:
    """Return the real vectors and matrices of a NumPy archive; pickled objects are never loaded."""
    found, member = {}, None
    try:
        with zipfile.ZipFile(path) as archive:
            for member in archive.namelist():
                values = _read_member(archive, member)
                if values.dtype.kind in "fiub" and values.ndim in (1, 2) and len(values) > 1:
                    found[member.removesuffix(".npy")] = values
    except NPZ_ERRORS as error:
        if member is None:
            raise RecordingError(f"{path}: cannot be read as a NumPy archive ({error})") from error
        raise RecordingError(f"{path}: array '{member}' is damaged ({error})") from error
    return {"": found}


def _read_member(archive: zipfile.ZipFile, member: str) -> np.ndarray:
    """Return an array of an archive, an empty one for objects."""
    with archive.open(member) as file:
        try:
            return np.lib.format.read_array(file, allow_pickle=False)
        except ValueError as error:
            if "allow_pickle" in str(error):
                return np.empty(0)
            raise


def _read_matlab(path: Path) -> dict[str, dict[str, np.ndarray]]:
    """Return the arrays of a MATLAB file up to version 7, those of Simulink structures by their labels."""
    tables: dict[str, dict[str, np.ndarray]] = {"": {}}
    for name in [name for name, *_ in _call_matlab(path, matlab.whosmat, "")]:
        options = {"variable_names": [name], "simplify_cells": True}
        content = _call_matlab(path, matlab.loadmat, f"array '{name}' ", **options)
        _add_array(tables, name, content.get(name))
    if not any(tables.values()):
        raise RecordingError(
            f"{path}: holds no array of numbers that can be read; save arrays or structures with time, "
            "for objects (timeseries, Dataset) Simulink's format 'Structure With Time'"
        )
    return {name: arrays for name, arrays in tables.items() if arrays}


def _add_array(tables: dict[str, dict[str, np.ndarray]], name: str, value: Any) -> None:
    """Add a variable to the tables: an array, the fields of a structure, or a structure of Simulink."""
    if isinstance(value, Mapping) and "signals" in value:
        time = np.atleast_1d(value.get("time", np.empty(0)))
        arrays = tables.setdefault(name, {"time": time}) if time.size > 1 else tables[""]
        signals = value["signals"]
        several = signals if isinstance(signals, (list, np.ndarray)) else [signals]
        for number, signal in enumerate(several):
            given = [
                signal.get("label"),
                signal.get("blockName"),
            ]  # an empty text is an empty array
            own = name if len(several) == 1 else f"{name}[{number}]"
            label = next((one for one in given if isinstance(one, str) and one), own)
            unique = label if label not in arrays else f"{label}[{number}]"
            _add_array({"": arrays}, unique, signal["values"])
    elif isinstance(value, Mapping):
        for field, inner in value.items():
            _add_array(tables, f"{name}.{field}", inner)
    elif isinstance(value, np.ndarray) and value.dtype.kind in "fiub" and value.size > 1:
        plain = value.squeeze()
        if plain.ndim == 3:  # Simulink keeps matrices over time as (rows, columns, T)
            plain = plain.reshape(-1, plain.shape[-1]).T
        if plain.ndim <= 2:
            tables[""][name] = plain


def _call_matlab(path: Path, read: Any, place: str, **options: Any) -> Any:
    try:
        return read(path, **options)
    except NotImplementedError as error:
        raise RecordingError(
            f"{path}: a MATLAB file of version 7.3; save it again with save(…, '-v7')"
        ) from error
    except Exception as error:  # SciPy raises what its parser stumbles over
        raise RecordingError(
            f"{path}: {place}cannot be read as a MATLAB file up to version 7 ({error})"
        ) from error


def _read_labels(features: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return the names of the items of each feature that names them."""
    labels = {}
    for feature, described in features.items():
        names = described.get("names")
        if isinstance(names, Mapping):  # version 2: {"motors": [...]}
            names = next(iter(names.values()), None)
        shape = described.get("shape") or [0]
        if isinstance(names, list) and len(shape) == 1 and len(names) == shape[0]:
            labels[feature] = [str(name) for name in names]
    return labels


def _name_items(path: Path, labels: Mapping[str, list[str]]) -> dict[str, list[str]]:
    """Return the names that each column of a Parquet file gives: itself, or those of its items."""
    try:
        with pq.ParquetFile(path) as file:
            schema = file.schema_arrow  # names of columns are decoded here
            head = next(file.iter_batches(batch_size=1), None)
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: no such log") from error
    except PARQUET_ERRORS as error:
        raise RecordingError(f"{path}: cannot be read as parquet ({error})") from error
    items = {}
    for field in schema:
        kind = field.type
        if _is_number(kind):
            items[field.name] = [field.name]
        elif _is_list(kind) and _is_number(kind.value_type) and head is not None and len(head):
            length = len(head.column(field.name)[0] or [])
            names = labels.get(field.name, [])
            if len(names) != length or len(set(names)) != length:
                names = [str(i) for i in range(length)]
            items[field.name] = [f"{field.name}[{name}]" for name in names]
    return items


def _is_number(kind: pa.DataType) -> bool:
    types = pa.types
    tests = (types.is_floating, types.is_integer, types.is_boolean, types.is_timestamp)
    return any(test(kind) for test in tests)


def _is_list(kind: pa.DataType) -> bool:
    types = pa.types
    tests = (types.is_list, types.is_large_list, types.is_fixed_size_list)
    return any(test(kind) for test in tests)


def _read_parquet(
    path: Path, items: Mapping[str, list[str]], names: Collection[str], max_rows: int | None
) -> dict[str, np.ndarray]:
    """Return the named columns, each `(T,)`; NaN for an empty cell."""
    wanted = [column for column, several in items.items() if any(n in names for n in several)]
    parts: dict[str, list[np.ndarray]] = {}
    row = 0
    try:
        with pq.ParquetFile(path) as file:
            for batch in file.iter_batches(batch_size=BATCH_ROWS, columns=wanted):
                for column in wanted:
                    values = _convert_array(batch.column(column), len(items[column]))
                    for at, name in enumerate(items[column]):
                        if name in names:
                            parts.setdefault(name, []).append(values[:, at])
                row += batch.num_rows
                if max_rows is not None and row >= max_rows:
                    break
    except PARQUET_ERRORS as error:
        raise RecordingError(
            f"{path}: damaged in the {BATCH_ROWS} rows from row {row} on ({error})"
        ) from error
    return {name: np.concatenate(several) for name, several in parts.items()}


def _convert_array(values: pa.Array, length: int) -> np.ndarray:
    """Return numbers or lists of numbers as `(T, K)`; times as s since 1970.

    Raises:
        ValueError: A list has another length.
    """
    if pa.types.is_timestamp(values.type):
        plain = values.cast(pa.timestamp("ns")).cast(pa.int64()).to_numpy(zero_copy_only=False)
        return np.asarray(plain, dtype=float).reshape(-1, 1) / 1e9
    if _is_number(values.type):
        kind = pa.uint8() if pa.types.is_boolean(values.type) else values.type
        return values.cast(kind).cast(pa.float64()).to_numpy(zero_copy_only=False).reshape(-1, 1)
    flat = values.flatten()
    if len(flat) != length * len(values) or values.null_count:
        raise ValueError(f"a list of another length than {length}")
    return flat.cast(pa.float64()).to_numpy(zero_copy_only=False).reshape(-1, length)
