"""Converts a capture into recordings for identification and diagnosis.

`mode=convert import=capture`, at the machine's control rate. Positions are interpolated linearly
between messages. Commands are the valves' feedback, averaged over the period that begins at each
row, as in the policy's history. A gap in either splits the log; pieces of one log share the
metadata `run`.
"""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from brokk_rl import record
from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import DAMAGE, Recording
from brokk_rl.spec import NonNegative, Positive, spec
from deploy.recorder import capture_reader
from deploy.recorder.capture_reader import CaptureContents, TopicMessages

TARGET_COLUMNS = ("target_x_m", "target_y_m", "target_z_m")
LATE_SHARE = 0.25
"""Part of a period by which a decision may come after its row; chosen by hand, four times the jitter
of a loaded computer."""
Series = tuple[np.ndarray, np.ndarray]
"""Times, s, and values."""


@spec
class CaptureLogReader:
    """Reads captures of the loop, whole or cut off.

    Attributes:
        longest_gap_s: A longer time between two messages splits the log.
        shortest_s: Shorter pieces are left out.
    """

    longest_gap_s: Positive
    shortest_s: NonNegative

    def read(self, path: Path, machine: Machine) -> list[Recording]:
        """Return the pieces of the capture at `path`; see `actuators.modes.convert.LogReader`.

        Raises:
            RecordingError: it cannot be read, was made on another machine, or holds no piece that
                is long enough.
        """
        signals, found = _Signals(path, machine), []
        for begin_s, end_s in signals.split(self.longest_gap_s):
            if end_s - begin_s >= max(self.shortest_s, 2 * machine.period_s):
                found.append(signals.cut(begin_s, end_s))
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
        signals = _Signals(path, machine)
        for first_s, last_s in signals.split(self.longest_gap_s):
            # The ends may be off by less than a gap, since messages do not fall on them.
            if first_s <= begin_s + self.longest_gap_s and last_s >= end_s - self.longest_gap_s:
                return signals.cut(max(first_s, begin_s), min(last_s, end_s))
        raise RecordingError(
            f"{path}: a gap of more than {self.longest_gap_s:g} s in the {end_s - begin_s:.1f} s that are asked for"
        )


class _Signals:
    """Positions and valve feedback of a capture, by joint."""

    def __init__(self, path: Path, machine: Machine) -> None:
        self.contents = contents = capture_reader.read_capture(path)
        contents.check_machine(machine, path)
        self.path, self.machine = path, machine
        names = machine.joint_names
        self.q = {name: _find_series(contents, f"Position_{name}", path) for name in names}
        self.flow = {name: _find_series(contents, f"Flow_{name}", path) for name in names}

    def split(self, longest_gap_s: float) -> list[tuple[float, float]]:
        """Return begin and end of the pieces; a gap in one joint ends the piece for all."""
        times = [t_s for t_s, _ in (*self.q.values(), *self.flow.values())]
        return list(record.split_at_gaps(times, longest_gap_s))

    def cut(self, begin_s: float, end_s: float) -> Recording:
        """Return the recording of a piece."""
        contents, machine = self.contents, self.machine
        begin_s = _align_with_advice(contents, begin_s, machine.period_s)
        # The small addition keeps a period that rounding would drop.
        grid_s = (
            begin_s + np.arange(int((end_s - begin_s) / machine.period_s + 1e-6)) * machine.period_s
        )
        first_s = next(iter(contents.messages.values()))[0][0]
        # The monotonic clock is tied to the wall clock at the first message.
        created = datetime.fromtimestamp((contents.wall_ns / 1e9) + (begin_s - first_s), UTC)
        columns_u, columns_q = [], []
        for name in machine.joint_names:
            columns_u.append(_average_over_periods(self.flow[name], grid_s, machine.period_s))
            columns_q.append(np.interp(grid_s, *self.q[name]))
        metadata = {
            "source": f"capture: {contents.facts.get('source', self.path.name)}",
            "fingerprint": record.format_fingerprint(machine),
            "run": f"{self.path.resolve().parent.name}/{self.path.stem}",
            "created": created.isoformat(timespec="milliseconds"),
        }
        if contents.num_damaged:
            metadata[DAMAGE] = (
                f"{contents.num_lost} messages or more are lost in {contents.num_damaged} places"
            )
        return Recording(
            machine=machine.name,
            joints=machine.joint_names,
            units=tuple(joint.unit for joint in machine.joints),
            rate_hz=1.0 / machine.period_s,
            t_s=grid_s - begin_s,
            u=np.stack(columns_u, 1).astype(np.float32),
            q=np.stack(columns_q, 1).astype(np.float32),
            extra=_build_extra_columns(contents, grid_s, machine),
            metadata=metadata,
            path=None,
        )


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
        extra |= _read_advice(advised, grid_s, machine)
    return extra


def _align_with_advice(contents: CaptureContents, begin_s: float, period_s: float) -> float:
    """Return the begin of a piece, moved by less than a period onto a decision of the policy.

    Rows then hold what the policy saw when it decided.
    """
    advised = contents.messages.get("advice")
    later = advised.series("t_s") if advised else np.empty(0)
    later = later[(later >= begin_s) & (later < begin_s + period_s)]
    return float(later[0]) if len(later) else begin_s


def _read_advice(
    advised: TopicMessages, grid_s: np.ndarray, machine: Machine
) -> dict[str, np.ndarray]:
    """Return the policy's commands, its target and its observation; NaN where there was no advice."""
    t_s, names = advised.series("t_s"), machine.joint_names
    widths = {"u": len(names), "target_in_base_m": len(TARGET_COLUMNS), "observation": 0}
    rows = [values for _, values in advised]
    widths["observation"] = max((len(one.get("observation", ())) for one in rows), default=0)
    columns = {
        "u": [f"advice_{name}" for name in names],
        "target_in_base_m": list(TARGET_COLUMNS),
        "observation": [f"obs_{number}" for number in range(widths["observation"])],
    }
    # The advice in force at each row is the last one before it. A decision may come a little late.
    latest_s = grid_s + LATE_SHARE * machine.period_s
    last = np.searchsorted(t_s, latest_s, side="right") - 1
    # An observation belongs to its decision alone: a loop that has ended, or rests, sees nothing.
    decided = (last >= 0) & (latest_s - t_s[last.clip(0)] < machine.period_s)
    extra = {}
    for field, width in widths.items():
        given = np.full((len(rows), width), np.nan)
        for row, values in enumerate(rows):
            # Advice that was not valid was not shown.
            if values["reason"] == "valid" and len(values.get(field, ())) == width:
                given[row] = values[field]
        holds = decided if field == "observation" else last >= 0
        held = np.where(holds[:, None], given[last.clip(0)], np.nan).astype(np.float32)
        if np.isfinite(held).any() or field == "u":
            extra |= dict(zip(columns[field], held.T, strict=True))
    return extra
