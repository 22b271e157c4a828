"""Logs of arrays: Parquet, LeRobotDataset v2 and v3, NumPy archives and MATLAB files.

A column of lists becomes one column for each item, named `action[elbow]` where the dataset names
the items and `action[2]` where it does not.
"""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Collection, Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import IO, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.lib import format as npy
from scipy import io as matlab

from actuators.recordings.log_tables import BLOCK_ROWS, LogFile, LogRun, StoredColumns, Table
from brokk_rl.errors import RecordingError

EPISODE = "episode_index"
"""Column of a LeRobotDataset that says which episode a row belongs to."""

MATLAB_NUMBERS = (
    "double",
    "single",
    *(f"{u}int{bits}" for u in ("", "u") for bits in (8, 16, 32, 64)),
)
"""Classes of real arrays as MATLAB names them."""

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
            arrays = dict(columns)
            numbers = arrays[EPISODE]
            if not len(numbers):
                raise RecordingError(f"{file}: has no rows")
            edges = [0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist(), len(numbers)]
            for begin, end in pairwise(edges):
                run = f"{self.path.resolve().name}_{int(numbers[begin]):06d}"
                part = {name: values[begin:end] for name, values in arrays.items()}
                where = f"{file}, episode {int(numbers[begin])}"
                yield LogRun(run, where, {"": Table(part)})
            if max_rows is not None:
                return


class NumpyLog(LogFile):
    """A NumPy archive (`.npz`) as a log with one table; pickled objects are never loaded."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        shapes, member = {}, None
        try:
            with zipfile.ZipFile(path) as archive:
                for member in archive.namelist():
                    with archive.open(member) as file:
                        shape, _, kind = _read_npy_header(file)
                    if kind.kind in "fiu" and len(shape) in (1, 2) and shape[0] > 1:
                        shapes[member] = shape
        except NPZ_ERRORS as error:
            if member is None:
                raise RecordingError(
                    f"{path}: cannot be read as a NumPy archive ({error})"
                ) from error
            raise RecordingError(f"{path}: array '{member}' is damaged ({error})") from error
        self._members = _select_longest(shapes)

    def list_tables(self) -> dict[str, list[str]]:
        """Return the real vectors of the most frequent length, and columns of such matrices."""
        return {"": [name for member in self._members for name in self._name_columns(member)]}

    def read_runs(
        self, wanted: Mapping[str, Collection[str]], max_rows: int | None
    ) -> Iterator[LogRun]:
        """Yield the archive as one run."""
        names = wanted.get("", ())
        columns = StoredColumns(names)
        with zipfile.ZipFile(self.path) as archive:
            for member in self._members:
                several = self._name_columns(member)
                kept = {at: name for at, name in enumerate(several) if name in names}
                if not kept:
                    continue
                try:
                    with archive.open(member) as file:
                        for block in _read_npy_blocks(file, max_rows):
                            for at, name in kept.items():
                                columns.add(name, block[:, at])
                except NPZ_ERRORS as error:
                    raise RecordingError(
                        f"{self.path}: array '{member}' is damaged ({error})"
                    ) from error
        yield LogRun(self.path.stem, str(self.path), {"": Table(columns)})

    def _name_columns(self, member: str) -> list[str]:
        return _name_array_columns(member.removesuffix(".npy"), self._members[member])


class MatlabLog(LogFile):
    """A MATLAB file up to version 7 as a log with one table."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        shapes = {}
        for name, shape, kind in self._call(matlab.whosmat):
            if kind in MATLAB_NUMBERS and len(shape) == 2 and max(shape) > 1:
                shapes[name] = (max(shape),) if min(shape) == 1 else shape
        self._shapes = _select_longest(shapes)

    def list_tables(self) -> dict[str, list[str]]:
        """Return the real vectors of the most frequent length, and columns of such matrices."""
        found = []
        for name, shape in self._shapes.items():
            found += _name_array_columns(name, shape)
        return {"": found}

    def read_runs(
        self, wanted: Mapping[str, Collection[str]], max_rows: int | None
    ) -> Iterator[LogRun]:
        """Yield the file as one run; arrays are read one at a time."""
        names = wanted.get("", ())
        columns = StoredColumns(names)
        for array, shape in self._shapes.items():
            several = _name_array_columns(array, shape)
            if not any(name in names for name in several):
                continue
            at_array = f"array '{array}' "
            values = self._call(matlab.loadmat, at_array, variable_names=[array])[array]
            if values.dtype.kind not in "fiu":
                raise RecordingError(f"{self.path}: array '{array}' is not real")
            values = values.reshape(-1, 1) if len(shape) == 1 else values
            for at, name in enumerate(several):
                if name in names:
                    columns.add(name, values[:max_rows, at])
            # Two arrays of a long log would fill the memory.
            del values
        yield LogRun(self.path.stem, str(self.path), {"": Table(columns)})

    def _call(self, reader: Any, place: str = "", **options: Any) -> Any:
        try:
            return reader(self.path, **options)
        except NotImplementedError as error:
            raise RecordingError(
                f"{self.path}: a MATLAB file of version 7.3; save it again with save(…, '-v7')"
            ) from error
        except Exception as error:  # SciPy raises what its parser stumbles over
            raise RecordingError(
                f"{self.path}: {place}cannot be read as a MATLAB file up to version 7 ({error})"
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
    file = _open_parquet(path)
    try:
        return _name_fields(file, labels)
    except PARQUET_ERRORS as error:
        raise RecordingError(f"{path}: damaged in its first rows ({error})") from error


def _name_fields(file: pq.ParquetFile, labels: Mapping[str, list[str]]) -> dict[str, list[str]]:
    items, uncertain = {}, []
    for field in file.schema_arrow:
        if _is_number(field.type):
            items[field.name] = [field.name]
        elif pa.types.is_fixed_size_list(field.type) and _is_number(field.type.value_type):
            items[field.name] = _name_list(field.name, field.type.list_size, labels)
        elif _is_list(field.type) and _is_number(field.type.value_type):
            uncertain.append(field.name)
    if uncertain and file.metadata.num_rows:
        head = next(file.iter_batches(batch_size=1, columns=uncertain))
        for name in uncertain:
            items[name] = _name_list(name, len(head.column(name)[0]), labels)
    return items


def _name_list(column: str, length: int, labels: Mapping[str, list[str]]) -> list[str]:
    names = labels.get(column, [])
    if len(names) != length or len(set(names)) != length:
        names = [str(i) for i in range(length)]
    return [f"{column}[{name}]" for name in names]


def _is_number(kind: pa.DataType) -> bool:
    return pa.types.is_floating(kind) or pa.types.is_integer(kind)


def _is_list(kind: pa.DataType) -> bool:
    return pa.types.is_list(kind) or pa.types.is_large_list(kind)


def _open_parquet(path: Path) -> pq.ParquetFile:
    try:
        file = pq.ParquetFile(path)
        # Names of columns are decoded here.
        _ = file.schema_arrow
        return file
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: no such log") from error
    except PARQUET_ERRORS as error:
        raise RecordingError(f"{path}: cannot be read as parquet ({error})") from error


def _read_parquet(
    path: Path, items: Mapping[str, list[str]], names: Collection[str], max_rows: int | None
) -> StoredColumns:
    """Return the named columns, each `(T,)`; NaN for an empty cell."""
    wanted = [column for column, several in items.items() if any(n in names for n in several)]
    columns = StoredColumns(n for column in wanted for n in items[column] if n in names)
    row = 0
    try:
        for batch in _open_parquet(path).iter_batches(batch_size=BLOCK_ROWS, columns=wanted):
            for column in wanted:
                values = _convert_array(batch.column(column), len(items[column]))
                for at, name in enumerate(items[column]):
                    if name in names:
                        columns.add(name, values[:, at])
            row += batch.num_rows
            if max_rows is not None and row >= max_rows:
                break
    except PARQUET_ERRORS as error:
        raise RecordingError(
            f"{path}: damaged in the {BLOCK_ROWS} rows from row {row} on ({error})"
        ) from error
    return columns


def _convert_array(values: pa.Array, length: int) -> np.ndarray:
    """Return numbers or lists of numbers as `(T, K)`.

    Raises:
        ValueError: A list has another length.
    """
    if _is_number(values.type):
        return values.cast(pa.float64()).to_numpy(zero_copy_only=False).reshape(-1, 1)
    flat = values.flatten()
    if len(flat) != length * len(values) or values.null_count:
        raise ValueError(f"a list of another length than {length}")
    return flat.cast(pa.float64()).to_numpy(zero_copy_only=False).reshape(-1, length)


def _select_longest(shapes: Mapping[str, tuple[int, ...]]) -> dict[str, tuple[int, ...]]:
    """Return the arrays of the most frequent number of rows."""
    lengths = [shape[0] for shape in shapes.values()]
    length = max(lengths, key=lengths.count, default=0)
    return {name: shape for name, shape in shapes.items() if shape[0] == length}


def _name_array_columns(name: str, shape: tuple[int, ...]) -> list[str]:
    return [name] if len(shape) == 1 else [f"{name}[{i}]" for i in range(shape[1])]


def _read_npy_header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Return shape, whether columns lie together, and type of an array."""
    version = npy.read_magic(file)
    if version == (1, 0):
        return npy.read_array_header_1_0(file)
    if version == (2, 0):
        return npy.read_array_header_2_0(file)
    raise ValueError(f"array of format version {version}, expected 1.0 or 2.0")


def _read_npy_blocks(file: IO[bytes], max_rows: int | None) -> Iterator[np.ndarray]:
    """Yield blocks of rows, `(B, K)`, of an array of one or two axes."""
    shape, is_by_column, kind = _read_npy_header(file)
    num_rows, width = shape[0], shape[1] if len(shape) == 2 else 1
    if is_by_column and width > 1:  # the rows do not lie together: read it whole
        data = np.frombuffer(_read_exactly(file, num_rows * width * kind.itemsize), kind)
        yield data.reshape(width, num_rows).T[:max_rows]
        return
    for begin in range(0, min(num_rows, max_rows or num_rows), BLOCK_ROWS):
        count = min(BLOCK_ROWS, num_rows - begin)
        data = _read_exactly(file, count * width * kind.itemsize)
        yield np.frombuffer(data, kind).reshape(count, width)


def _read_exactly(file: IO[bytes], size: int) -> bytes:
    data = file.read(size)
    if len(data) < size:
        raise EOFError(f"{len(data)} of {size} bytes are there")
    return data
