"""Converts a capture into recordings for identification and diagnosis.

`mode=convert import=capture`, at the machine's control rate. Positions are interpolated linearly
between messages. Commands are the valves' feedback, averaged over the period that begins at each
row, as in the policy's history. A gap in either splits the log; pieces of one log share the
metadata `run`.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from brokk_rl import record
from brokk_rl.errors import CheckpointError, RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.spec import spec
from deploy.recorder import capture_reader
from deploy.recorder.capture_reader import CaptureContents

Series = tuple[np.ndarray, np.ndarray]
"""Times, s, and values."""


@spec
class CaptureLogReader:
    """Reads captures of the loop, whole or cut off.

    Attributes:
        longest_gap_s: A longer time between two messages splits the log.
        shortest_s: Shorter pieces are left out.
    """

    longest_gap_s: float
    shortest_s: float

    def read(self, path: Path, machine: Machine) -> list[Recording]:
        """Return the pieces of the capture at `path`; see `actuators.recordings.log_reader.LogReader`.

        Raises:
            RecordingError: it cannot be read, was made on another machine, or holds no piece that
                is long enough.
        """
        (contents, q, flow), found = self._series(path, machine), []
        # All joints share the pieces: a gap in one of them ends the piece for all.
        for begin_s, end_s in record.split_at_gaps(
            [t_s for t_s, _ in (*q.values(), *flow.values())], self.longest_gap_s
        ):
            if end_s - begin_s >= max(self.shortest_s, 2 * machine.period_s):
                found.append(self._piece(contents, q, flow, begin_s, end_s, path, machine))
        if not found:
            raise RecordingError(
                f"{path}: no piece of {self.shortest_s:g} s or more without a gap of {self.longest_gap_s:g} s in positions or "
                "valve feedback"
            )
        return found

    def between(self, path: Path, machine: Machine, begin_s: float, end_s: float) -> Recording:
        """Return the recording between two times of the monotonic clock.

        Raises:
            RecordingError: it cannot be read, was made on another machine, or has a gap there.
        """
        contents, q, flow = self._series(path, machine)
        for first_s, last_s in record.split_at_gaps(
            [t_s for t_s, _ in (*q.values(), *flow.values())], self.longest_gap_s
        ):
            # The ends may be off by less than a gap, since messages do not fall on them.
            if first_s <= begin_s + self.longest_gap_s and last_s >= end_s - self.longest_gap_s:
                return self._piece(
                    contents, q, flow, max(first_s, begin_s), min(last_s, end_s), path, machine
                )
        raise RecordingError(
            f"{path}: a gap of more than {self.longest_gap_s:g} s in the {end_s - begin_s:.1f} s that are asked for"
        )

    def _series(
        self, path: Path, machine: Machine
    ) -> tuple[CaptureContents, dict[str, Series], dict[str, Series]]:
        """Return the capture, and positions and valve feedback by joint."""
        contents = capture_reader.read_capture(path)
        try:
            machine.check_fingerprint(json.loads(contents.facts["fingerprint"]), str(path))
        except (CheckpointError, KeyError, ValueError) as error:
            raise RecordingError(f"{path}: {error}") from error
        names = machine.joint_names
        q = {name: _find_series(contents, f"Position_{name}", path) for name in names}
        return contents, q, {name: _find_series(contents, f"Flow_{name}", path) for name in names}

    def _piece(
        self,
        contents: CaptureContents,
        q: dict[str, Series],
        flow: dict[str, Series],
        begin_s: float,
        end_s: float,
        path: Path,
        machine: Machine,
    ) -> Recording:
        # The small addition keeps a period that rounding would drop.
        grid_s = (
            begin_s + np.arange(int((end_s - begin_s) / machine.period_s + 1e-6)) * machine.period_s
        )
        first_s = next(iter(contents.messages.values()))[0][0]
        # The monotonic clock is tied to the wall clock at the first message.
        created = datetime.fromtimestamp((contents.wall_ns / 1e9) + (begin_s - first_s), UTC)
        columns_u, columns_q = [], []
        for name in machine.joint_names:
            columns_u.append(_average_over_periods(flow[name], grid_s, machine.period_s))
            columns_q.append(np.interp(grid_s, *q[name]))
        return Recording(
            machine=machine.name,
            joints=machine.joint_names,
            units=tuple(joint.unit for joint in machine.joints),
            rate_hz=1.0 / machine.period_s,
            t_s=grid_s - begin_s,
            u=np.stack(columns_u, 1).astype(np.float32),
            q=np.stack(columns_q, 1).astype(np.float32),
            extra=_build_extra_columns(contents, grid_s, machine),
            metadata={
                "source": f"capture: {contents.facts.get('source', path.name)}", "fingerprint": record.format_fingerprint(machine),
                "run": f"{path.resolve().parent.name}/{path.stem}", "created": created.isoformat(timespec="milliseconds"),
            },
            path=None,
        )  # fmt: skip


def _find_series(contents: CaptureContents, signal: str, path: Path) -> Series:
    """Return times and values of a signal, whatever message it came in, without invalid ones."""
    joint, positions = signal.partition("_")[2], signal.startswith("Position_")
    for messages in contents.messages.values():
        if signal in messages.names:
            t_s, values, valid = messages.series("t_s"), messages.series(signal), f"Valid_{joint}"
            if positions and valid in messages.names:
                # Values that the sensor itself calls invalid are left out.
                kept = messages.series(valid) == 1.0
                t_s, values = t_s[kept], values[kept]
            if len(t_s) > 1:
                # Times must increase: a repeated message has the time of the first.
                forward = np.concatenate([[True], np.diff(t_s) > 0])
                return t_s[forward], values[forward]
    raise RecordingError(
        f"{path}: signal '{signal}' was never heard (topics: {', '.join(sorted(contents.messages)) or 'none'})"
    )


def _average_over_periods(series: Series, grid_s: np.ndarray, period_s: float) -> np.ndarray:
    """Return the mean of a value, held from message to message, over the period after each time."""
    t_s, values = series
    # integral of the staircase up to any time, linear in between
    integral = np.concatenate([[0.0], np.cumsum(values[:-1] * np.diff(t_s))])
    return np.diff(np.interp(np.append(grid_s, grid_s[-1] + period_s), t_s, integral)) / period_s


def _build_extra_columns(
    contents: CaptureContents, grid_s: np.ndarray, machine: Machine
) -> dict[str, np.ndarray]:
    """Return the oil's temperature and the advice shown, where there was any; NaN where not."""
    extra: dict[str, np.ndarray] = {}
    for messages in contents.messages.values():
        if "OilTemperature" in messages.names:
            oil_c = np.interp(grid_s, messages.series("t_s"), messages.series("OilTemperature"))
            extra["oil_c"] = oil_c.astype(np.float32)
    if advised := contents.messages.get("advice"):
        t_s = advised.series("t_s")
        shown = np.full((len(t_s), machine.num_joints), np.nan)
        for row, (_, values) in enumerate(advised):
            # Advice that was not valid was not shown.
            if values["reason"] == "valid":
                shown[row] = values["u"]
        # The advice in force at each row is the last one before it.
        rows = np.searchsorted(t_s, grid_s, side="right") - 1
        for j, name in enumerate(machine.joint_names):
            extra[f"advice_{name}"] = np.where(rows >= 0, shown[rows.clip(0), j], np.nan).astype(
                np.float32
            )
    return extra
