"""Logs of arrays: Parquet, lines of JSON, LeRobotDataset v2 and v3, NumPy archives and MATLAB files.

A column of lists becomes one column for each item, named `action[elbow]` where the dataset names
the items and `action[2]` where it does not.
"""

from __future__ import annotations

import json
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.dataset as ds
from scipy import io as matlab

from actuators.recordings.cells import Labels, convert_frame
from actuators.recordings.log_tables import LogFile, LogRun, Table, name_log
from brokk_rl.errors import RecordingError

EPISODE = "episode_index"
"""Column of a LeRobotDataset that says which episode a row belongs to."""
MOST_COLUMNS = 256
"""Widest matrix that is taken for joints; wider ones are pictures."""
INDEX = "__index_level_"
"""Begin of the names under which pandas writes an index without a name."""
FORMATS = {".parquet": "parquet", ".jsonl": "json", ".ndjson": "json"}
"""Formats of pyarrow by the ending of their files."""
TABLE_ERRORS = (OSError, pa.ArrowException, ValueError)
"""Errors of pyarrow on a damaged file; a name that is no text is a `ValueError`."""
NPZ_ERRORS = (OSError, EOFError, ValueError, NotImplementedError, zipfile.BadZipFile, zlib.error)
"""Errors of NumPy on a damaged archive."""


class TableLog(LogFile):
    """A Parquet file, or one of lines of JSON, as a log with one table.

    Args:
        path: The file.
        labels: Names of the items of its lists; items without are numbered.
    """

    def __init__(self, path: Path, labels: Labels | None = None) -> None:
        super().__init__(path)
        self._labels = labels or {}

    def read_tables(self, max_rows: int | None) -> dict[str, Table]:
        """Return the columns of numbers, times, flags and lists; NaN stands for an empty cell."""
        kind = FORMATS[self.path.suffix.lower()]
        try:
            source = ds.dataset(self.path, format=kind)
            table = source.to_table() if max_rows is None else source.head(max_rows)
            while any(pa.types.is_struct(one) for one in table.schema.types):
                table = table.flatten()  # fields within others become `pose.x`
            frame = table.to_pandas(ignore_metadata=True)
            dates = frame.select_dtypes(["datetime", "datetimetz"]).columns
            index = {name: "timestamp" for name in dates if name.startswith(INDEX)}
            columns = convert_frame(frame.rename(columns=index), ".", self._labels)
        except TABLE_ERRORS as error:
            self.refuse(f"cannot be read as {kind} ({error})", error)
        return {"": Table(columns)}


class LeRobotLog(LogFile):
    """A LeRobotDataset, version 2 (a file an episode) or 3 (several episodes a file).

    Each episode is a run of its own. Pictures and videos are not read.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        try:
            info = json.loads((path / "meta" / "info.json").read_text())
            labels = _read_labels(info["features"])
            version = str(info["codebase_version"])
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise RecordingError(
                f"{path}/meta/info.json: expected the description of a LeRobotDataset ({error!r})"
            ) from error
        if not version.startswith(("v2", "v3")):
            raise RecordingError(
                f"{path}/meta/info.json: codebase_version is '{version}', expected v2.x or v3.x; "
                "LeRobot's own converter brings an older dataset to v3.0"
            )
        self._files = [TableLog(file, labels) for file in sorted(path.glob("data/**/*.parquet"))]
        if not self._files:
            self.refuse("no data/**/*.parquet; a LeRobotDataset keeps its rows there")

    def read_runs(self, max_rows: int | None) -> Iterator[LogRun]:
        """Yield each episode as a run."""
        for file in self._files if max_rows is None else self._files[:1]:
            columns = file.read_tables(max_rows)[""].columns
            numbers = columns.get(EPISODE, np.empty(0))
            if not len(numbers):
                file.refuse(f"column '{EPISODE}' is missing or has no rows")
            edges = [0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist(), len(numbers)]
            for begin, end in pairwise(edges):
                number = int(numbers[begin])
                part = {name: values[begin:end] for name, values in columns.items()}
                name = f"{name_log(self.path)}_{number:06d}"
                yield LogRun(name, f"{file.path}, episode {number}", {"": Table(part)})


class ArrayLog(LogFile):
    """Named arrays as a log: those of one length are a table, each structure with a time another one."""

    def read_tables(self, max_rows: int | None) -> dict[str, Table]:
        """Return the real vectors of the most frequent length, and columns of such matrices."""
        is_matlab = self.path.suffix.lower() == ".mat"
        found = self._read_matlab() if is_matlab else self._read_npz()
        tables = {}
        for table, arrays in found.items():
            sizes = Counter(size for values in arrays.values() for size in {*values.shape})
            length = max(sizes, key=lambda size: (sizes[size], size), default=0)
            columns: dict[str, np.ndarray] = {}
            for name, values in arrays.items():
                is_turned = len(values) != length and values.shape[-1] == length
                plain = values.T if is_turned else values
                if len(plain) != length or (plain.ndim > 1 and plain.shape[1] > MOST_COLUMNS):
                    continue
                rows = plain[:max_rows].astype(float)
                if rows.ndim == 1:
                    columns[name] = rows
                else:
                    for item, column in enumerate(rows.T):
                        columns[f"{name}[{item}]"] = column
            tables[table] = Table(columns)
        return tables

    def _read_npz(self) -> dict[str, dict[str, np.ndarray]]:
        """Return the real vectors and matrices of a NumPy archive; pickled objects are never loaded."""
        found, name = {}, ""
        try:
            with self.path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
                for name in archive.files:
                    try:
                        values = archive[name]
                    except ValueError as error:
                        if "allow_pickle" not in str(error):
                            raise
                        continue
                    if values.dtype.kind in "mM":  # times
                        values = values.astype(f"{values.dtype.kind}8[ns]").astype(float) * 1e-9
                    if _is_real(values) and values.ndim in (1, 2) and len(values) > 1:
                        found[name] = values
        except NPZ_ERRORS as error:
            place = f"array '{name}' is damaged" if name else "cannot be read as a NumPy archive"
            self.refuse(f"{place} ({error})", error)
        return {"": found}

    def _read_matlab(self) -> dict[str, dict[str, np.ndarray]]:
        """Return the arrays of a MATLAB file up to version 7, those of Simulink structures by their labels."""
        tables: dict[str, dict[str, np.ndarray]] = {"": {}}
        name = ""
        try:
            for name, *_ in matlab.whosmat(self.path):
                content = matlab.loadmat(self.path, variable_names=[name], simplify_cells=True)
                _add_array(tables, name, content.get(name))
        except NotImplementedError as error:
            self.refuse("a MATLAB file of version 7.3; save it again with save(…, '-v7')", error)
        except Exception as error:  # SciPy raises what its parser stumbles over
            place = f"array '{name}' " if name else ""
            self.refuse(f"{place}cannot be read as a MATLAB file up to version 7 ({error})", error)
        if not any(tables.values()):
            mend = "save arrays or structures with time, for objects (timeseries, Dataset) Simulink's format"
            self.refuse(f"holds no array of numbers that can be read; {mend} 'Structure With Time'")
        return {name: arrays for name, arrays in tables.items() if arrays}


def _add_array(tables: dict[str, dict[str, np.ndarray]], name: str, value: Any) -> None:
    """Add a variable to the tables: an array, the fields of a structure, or a structure of Simulink."""
    if isinstance(value, Mapping) and "signals" in value:
        time = np.atleast_1d(value.get("time", np.empty(0)))
        arrays = tables.setdefault(name, {"time": time}) if time.size > 1 else tables[""]
        signals = value["signals"]
        several = signals if isinstance(signals, (list, np.ndarray)) else [signals]
        for number, signal in enumerate(several):
            own = name if len(several) == 1 else f"{name}[{number}]"
            given = (signal.get("label"), signal.get("blockName"))
            # an empty text is an empty array
            label = next((one for one in given if isinstance(one, str) and one), own)
            unique = label if label not in arrays else f"{label}[{number}]"
            _add_array({"": arrays}, unique, signal["values"])
    elif isinstance(value, Mapping):
        for field, inner in value.items():
            _add_array(tables, f"{name}.{field}", inner)
    elif isinstance(value, np.ndarray) and _is_real(value) and value.size > 1:
        plain = value.squeeze()
        if plain.ndim == 3:  # Simulink keeps matrices over time as (rows, columns, T)
            plain = plain.reshape(-1, plain.shape[-1]).T
        if plain.ndim <= 2:
            tables[""][name] = plain


def _read_labels(features: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return the names of the items of each feature that names them."""
    labels = {}
    for feature, described in features.items():
        names = described.get("names")
        if isinstance(names, Mapping):  # version 2: {"motors": [...]}
            names = next(iter(names.values()), None)
        if isinstance(names, list):
            labels[feature] = [str(name) for name in names]
    return labels


def _is_real(values: np.ndarray) -> bool:
    return values.dtype.kind in "fiub"
