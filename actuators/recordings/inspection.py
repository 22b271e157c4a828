"""Inspection of a recording: rates, ranges, noise, and stretches that no model could explain.

Axes: `T` time, `J` joints. Recordings may be broken: missing values are NaN and take no part.
"""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import minimum_filter1d

from actuators.recordings.signal_checks import LONGEST_LAG_S, find_jumps, find_spikes, find_wrap
from actuators.recordings.split import COMMANDED
from brokk_rl.commands import read_targets, view_recordings
from brokk_rl.machine import Machine
from brokk_rl.record import Recording, find_stretches

FAST_SHARE = 0.2
"""Speed, of full speed, from which motion without command is no sinking load but an input that is
not logged. The effect `creep` sinks at a few percent; chosen by hand."""
CODE_REPEATS = 5
"""A value measured so often is a step of the sensor and no coincidence."""
STEP_QUANTILE = 0.05
"""Neighbouring values of a coarse sensor lie one step apart or, where those between were not
visited often, several."""
LATTICE_SHARE, LATTICE_ERROR = 0.9, 0.05
"""So many gaps between neighbouring values of a coarse sensor are whole steps, but for such a part of one: of
random gaps every tenth is."""
HELD_TARGET = 1e-4
"""Speed of a target, as a part of full speed, below which it is held: above the rounding of float32. A
servo follows a slow target, where a valve stays closed under a small command."""
JUMP = 1.5
"""A sensor that has missed a sample jumps by two periods' worth of motion."""

FAR_SHARE, STAND_SHARE = 0.25, 0.2
"""Parts of the travel from which on a joint stays away from its target, and by which a target moves that it
does not follow. The elbow of a sound SO-101 sags by 0.11 and sticks over 0.1 of its travel."""
STILL_TRAVEL, STILL_TARGET = 0.01, 0.05
"""A joint stands below so many parts of the travel per s, whatever the machine's top speed is said to be, and
below such a part of the mean speed of its target: a slow machine moves by less."""
JUMP_TRAVEL = 0.01
"""Part of the travel from which on a step is told; smaller ones hide in noise and coarse sensors."""
LEAST_ROWS = 5
"""Least number of rows of a stretch: a slow log has one in seconds."""
MAX_IRREGULAR_SHARE = 0.05
"""Share of periods further than 10 % from the median from which a clock is irregular; chosen by hand."""
MIN_SATURATED_ROWS = 10
"""Least number of rows at the extreme of a sensor, away from the stops, that count as saturation; chosen by
hand: half a second at 20 Hz."""


DRIVING = 0.3
"""Command that should move any joint: above the widest dead band expected, 0.22 of stroke."""
STILL = 0.05
"""Speed, of full speed, below which a joint rests; chosen by hand, well above the noise of the encoders."""
SETTLE_S = 0.3
"""Time beyond the dead time that a joint takes to start or to stop: spool, oil and structure."""
UNANSWERED_S = 0.5
"""Command without motion is told from this duration on; chosen by hand: shorter ones are mostly late starts."""
DRIFT = 0.01
"""Part of the travel from which motion within one stretch without command is told; chosen by hand."""
EQUAL_ROWS = 10
"""Equal samples in a row that a sensor with noise does not show, half a second at 20 Hz; chosen by hand."""
STEPS = 4.0
"""A change of so many steps of a sensor, or of its noise, cannot hide in it; chosen by hand, few false alarms."""
AT_LIMIT = 0.01
"""A joint so close to its limit, as a part of its travel, may stand at its stop; chosen by hand."""


@dataclass(frozen=True)
class RecordingFinding:
    """A stretch of a recording that needs an explanation.

    Attributes:
        kind: A key of `recording_checks.REMARKS`.
        joint: Joint concerned, `None` where it is all of them.
        row: First row.
        num_rows: Rows on end.
        t_s: Time of the first row.
        duration_s: From the first row to the last.
        text: Description with its size.
    """

    kind: str
    joint: str | None
    row: int
    num_rows: int
    t_s: float
    duration_s: float
    text: str


@dataclass(frozen=True)
class Inspection:
    """Contents of one recording.

    Attributes:
        recording: The recording.
        viewed: The same with speeds as commands, whatever the interface of the machine.
        timing: Rate and jitter of the file.
        joints: Ranges, shares of time, noise and sensor step of each joint, by name.
        findings: In order of time.
    """

    recording: Recording
    viewed: Recording
    timing: dict[str, float | None]
    joints: dict[str, dict[str, float | None]]
    findings: list[RecordingFinding]


def inspect_recording(recording: Recording, machine: Machine) -> Inspection:
    """Return the contents of a recording of `machine`."""
    with warnings.catch_warnings(), np.errstate(invalid="ignore", divide="ignore"):
        warnings.simplefilter("ignore", RuntimeWarning)  # of columns that are all NaN
        scan = _RecordingScan(recording, machine)
        findings = sorted(scan.find_all(), key=lambda finding: finding.row)
        return Inspection(recording, scan.viewed, scan.timing(), scan.joints(), findings)


class _RecordingScan:
    """Scan of one recording: the quantities that all findings use."""

    def __init__(self, recording: Recording, machine: Machine) -> None:
        self._machine = machine
        (self.viewed,) = view_recordings([recording], machine)
        self._t_s, self._u = self.viewed.t_s, self.viewed.u.astype(np.float64)
        self._q = self.viewed.q.astype(np.float64)
        # of joints that are commanded by position, `(T, J)`, rad or m
        self._targets: np.ndarray | None = None
        if machine.interface == "position":
            self._targets = read_targets(recording.u.astype(float), machine)
        self._period_s = 1.0 / recording.rate_hz
        self._travel = machine.upper - machine.lower
        self._reach = max(1, round(0.15 / self._period_s))
        self._after, self._before = self._speed(self._reach, 0), self._speed(0, self._reach)
        self._v = np.nanmean([self._after, self._before], 0)
        self._is_moving = np.abs(self._v) > STILL * machine.max_speed
        self._lead = round((machine.dead_time_s + SETTLE_S) / self._period_s)
        least = HELD_TARGET if machine.interface == "position" else COMMANDED
        self._idle = find_held(np.abs(self._u) < least, self._lead)
        self._noise = np.array([self._noise_of(j) for j in range(machine.num_joints)])
        self._step = np.array([estimate_step(q) for q in self._q.T])
        grain = np.fmax(np.nan_to_num(self._step), np.nan_to_num(self._noise))
        self._visible = STEPS * grain

    def timing(self) -> dict[str, float | None]:
        """Return duration, rate and jitter."""
        periods_s = np.diff(self._t_s)
        median_s = np.nanmedian(periods_s)
        figures = {
            "duration_s": np.nanmax(self._t_s) - np.nanmin(self._t_s),
            "rate_hz": 1.0 / median_s if median_s > 0 else np.nan,
            "stated_rate_hz": 1.0 / self._period_s,
            "jitter_s": np.nanpercentile(np.abs(periods_s - median_s), 95),
            "longest_s": np.nanmax(periods_s),
        }
        return {name: to_json_number(value) for name, value in figures.items()}

    def joints(self) -> dict[str, dict[str, float | None]]:
        """Return the figures of each joint."""
        size, found = np.abs(self._u), {}
        margin = AT_LIMIT * self._travel
        low, high = self._machine.lower + margin, self._machine.upper - margin
        at_limit = (self._q < low) | (self._q > high)
        for j, name in enumerate(self._machine.joint_names):
            figures = {
                "lowest": np.nanmin(self._q[:, j]),
                "highest": np.nanmax(self._q[:, j]),
                "commanded": np.mean(size[:, j] > COMMANDED),
                "full_command": np.mean(size[:, j] > 0.99),
                "moving": np.mean(self._is_moving[:, j]),
                "at_limit": np.mean(at_limit[:, j]),
                "fastest": np.nanquantile(np.abs(self._v[:, j]), 0.99),
                "noise": self._noise[j],
                "step": self._step[j],
            }
            found[name] = {key: to_json_number(value) for key, value in figures.items()}
        return found

    def find_all(self) -> Iterator[RecordingFinding]:
        """Yield all findings, kind by kind."""
        yield from self._find_clock_faults()
        for j, joint in enumerate(self._machine.joints):
            yield from self._find_ignored_commands(j, joint.name)
            yield from self._find_jumps(j, joint.name, joint.unit)
            yield from self._find_uncommanded_motion(j, joint.name, joint.unit)
            yield from self._find_frozen(j, joint.name, joint.unit)
            yield from self._find_saturation(j, joint.name, joint.unit)
            over = np.fmax(self._q[:, j] - joint.upper.value, joint.lower.value - self._q[:, j])
            for row, count in find_stretches(over > self._visible[j]):
                most = np.nanmax(over[row : row + count])
                text = f"up to {most:.2g} {joint.unit} beyond its limit"
                yield self._finding("beyond limit", joint.name, row, count, text)
            if self._targets is not None:
                yield from self._find_disobedience(j, self._targets[:, j], joint.name, joint.unit)
        same = np.append(False, (np.diff(self._q, axis=0) == 0).all(1))
        is_seen = (np.abs(self._v) * self._period_s > self._visible).any(1)
        for row, count in find_stretches(same & is_seen):
            text = f"{count} rows repeat the one before"
            yield self._finding("lost frames", None, row, count, text)
        commanded = np.abs(self._u) > COMMANDED
        for j in np.flatnonzero(self._machine.is_exclusive):
            others = np.delete(commanded, j, axis=1).any(1)
            for row, count in find_stretches(commanded[:, j] & others):
                name, text = self._machine.joint_names[j], "commanded together with another joint"
                yield self._finding("exclusive joint", name, row, count, text)

    def _find_ignored_commands(self, j: int, name: str) -> Iterator[RecordingFinding]:
        """Yield commands that should move a joint away from a stop and do not."""
        joint, margin = self._machine.joints[j], AT_LIMIT * self._travel[j]
        for sign in (1, -1):
            driven = find_held(sign * self._u[:, j] > DRIVING, self._lead)
            low, high = joint.lower.value + margin, joint.upper.value - margin
            stop = self._q[:, j] > high if sign > 0 else self._q[:, j] < low
            is_ignored = driven & ~self._is_moving[:, j] & ~stop & np.isfinite(self._v[:, j])
            for row, count in self._find_long(is_ignored):
                text = f"commanded {self._u[row : row + count, j].mean():+.2f}, does not move"
                yield self._finding("command without motion", name, row, count, text)

    def _find_disobedience(
        self, j: int, target: np.ndarray, name: str, unit: str
    ) -> Iterator[RecordingFinding]:
        """Yield stretches over which a joint stays away from where its target has been, or stands while it moves."""
        window = max(1, round(LONGEST_LAG_S / self._period_s))
        # the range of the targets that the joint may still be on its way to
        past = np.concatenate([np.repeat(target[:1], window), target])
        recent = np.lib.stride_tricks.sliding_window_view(past, window + 1)
        above, below = self._q[:, j] - recent.max(1), recent.min(1) - self._q[:, j]
        away = np.fmax(np.fmax(above, below), 0.0)
        is_coming = np.where(above > below, self._v[:, j] < 0, self._v[:, j] > 0)
        far = (away > FAR_SHARE * self._travel[j]) & ~(is_coming & self._is_moving[:, j])
        for row, count in self._find_long(far):
            text = f"stays up to {away[row : row + count].max():.2g} {unit} away from its target"
            yield self._finding("does not obey", name, row, count, text)
        target_speed = np.abs(np.diff(target)).mean() / self._period_s
        still = min(STILL_TRAVEL * self._travel[j], STILL_TARGET * target_speed)
        is_still = np.abs(self._v[:, j]) < still
        for row, count in self._find_long(is_still & ~far):
            moved = np.ptp(target[row : row + max(1, count - self._lead)])
            if moved > STAND_SHARE * self._travel[j]:
                text = f"stands while its target moves by {moved:.2g} {unit}"
                yield self._finding("does not obey", name, row, count, text)

    def _find_jumps(self, j: int, name: str, unit: str) -> Iterator[RecordingFinding]:
        """Yield steps of a position that no command causes."""
        q = self._q[:, j]
        if not np.isfinite(q).all():
            return
        wrap = find_wrap(q)
        if wrap is None:
            cause = np.zeros(len(q)) if self._targets is None else self._targets[:, j]
            jumps = find_jumps(self._t_s, q, cause)
            rows = np.union1d(jumps, find_spikes(q) - 1).astype(int)
        else:
            rows = wrap.rows
        for row in rows.tolist():
            size = q[row + 1] - q[row]
            if abs(size) > max(self._visible[j], JUMP_TRAVEL * self._travel[j]):
                text = f"steps by {size:+.4g} {unit}" if wrap is None else wrap.explain()
                yield self._finding("jumps", name, row, 2, text)

    def _find_uncommanded_motion(self, j: int, name: str, unit: str) -> Iterator[RecordingFinding]:
        """Yield stretches without command over which a joint goes elsewhere."""
        for row, count in find_stretches(self._idle[:, j]):
            q, ends = self._q[row : row + count, j], min(5, count)
            moved = np.nanmedian(q[-ends:]) - np.nanmedian(q[:ends])
            if abs(moved) > max(DRIFT * self._travel[j], self._visible[j]):
                speed = np.nanquantile(np.abs(self._v[row : row + count, j]), 0.9)
                is_fast = speed > FAST_SHARE * self._machine.max_speed[j]
                mean = moved / (count * self._period_s)
                text = f"moves {moved:+.3g} {unit} without command ({mean:+.2g} {unit}/s)"
                kind = "unlogged input" if is_fast else "motion without command"
                yield self._finding(kind, name, row, count, text)

    def _find_frozen(self, j: int, name: str, unit: str) -> Iterator[RecordingFinding]:
        """Yield equal samples amid motion, and at rest where the sensor is otherwise never still."""
        q = self._q[:, j]
        equal = np.append(False, np.diff(q) == 0)
        is_noisy = equal.mean() < 0.05
        for row, count in find_stretches(equal):
            end = row + count  # first row with another value
            jump = abs(q[end] - q[end - 1]) if end < len(equal) else 0.0
            before = abs(self._before[row - 1, j])
            after = abs(self._after[min(end, len(equal) - 1), j])
            was_moving = before > STILL * self._machine.max_speed[j]
            least = max(self._visible[j], JUMP * np.fmax(before, after) * self._period_s)
            if was_moving and jump > least:
                text = f"{count + 1} equal samples, then a jump of {jump:.2g} {unit}"
                yield self._finding("frozen sensor", name, row - 1, count + 1, text)
            elif is_noisy and count + 1 >= EQUAL_ROWS:
                text = f"{count + 1} equal samples of a sensor with noise"
                yield self._finding("frozen sensor", name, row - 1, count + 1, text)

    def _find_saturation(self, j: int, name: str, unit: str) -> Iterator[RecordingFinding]:
        """Yield rows at the extreme of a sensor while the joint is driven further, away from its stops."""
        q, margin = self._q[:, j], AT_LIMIT * self._travel[j]
        acting = np.roll(self._u[:, j], round(self._machine.dead_time_s / self._period_s))
        if not np.ptp(q) > margin:
            return
        for extreme, outward in ((q.max(), 1.0), (q.min(), -1.0)):
            stop = self._machine.upper[j] if outward > 0 else self._machine.lower[j]
            if abs(stop - extreme) < margin:
                continue
            is_driven = outward * acting > DRIVING
            for row, count in find_stretches((q == extreme) & is_driven):
                if count >= MIN_SATURATED_ROWS:
                    text = f"{count} samples at {extreme:.4g} {unit} while driven further"
                    yield self._finding("saturated sensor", name, row, count, text)

    def _find_clock_faults(self) -> Iterator[RecordingFinding]:
        """Yield a clock whose rows are not equally spaced; single periods are breaches of the format."""
        periods_s = np.diff(self._t_s)
        if not np.isfinite(periods_s).all():
            return
        median_s = float(np.median(periods_s))
        if np.mean(np.abs(periods_s / median_s - 1.0) > 0.1) > MAX_IRREGULAR_SHARE:
            low, high = 1e3 * np.percentile(periods_s, (5, 95))
            text = f"periods of {low:.1f} to {high:.1f} ms (5 to 95 %)"
            text += f", median {1e3 * median_s:.1f} ms"
            yield self._finding("irregular clock", None, 0, len(self._t_s), text)

    def _find_long(self, condition: np.ndarray) -> list[tuple[int, int]]:
        """Return the stretches of a condition that last long enough to be told."""
        least = max(LEAST_ROWS, UNANSWERED_S / self._period_s)
        return [(row, count) for row, count in find_stretches(condition) if count >= least]

    def _finding(
        self, kind: str, joint: str | None, row: int, count: int, text: str
    ) -> RecordingFinding:
        begin_s, end_s = float(self._t_s[row]), float(self._t_s[row + count - 1])
        return RecordingFinding(kind, joint, row, count, begin_s, end_s - begin_s, text)

    def _speed(self, ahead: int, behind: int) -> np.ndarray:
        """Return mean speeds from `behind` rows before to `ahead` after, `(T, J)`.

        NaN near the ends.
        """
        speed, span = np.full(self._q.shape, np.nan), ahead + behind
        if len(self._q) > span:
            elapsed_s = self._t_s[span:] - self._t_s[:-span]
            change = self._q[span:] - self._q[:-span]
            speed[behind : len(self._q) - ahead] = change / elapsed_s[:, None]
        return speed

    def _noise_of(self, joint: int) -> float:
        """Return the standard deviation of the sensor at rest.

        A difference of two samples holds the noise twice.
        """
        change = np.diff(self._q[:, joint])[self._idle[1:, joint] & ~self._is_moving[1:, joint]]
        return float(np.nanstd(change) / np.sqrt(2.0)) if len(change) > 20 else np.nan


def find_held(condition: np.ndarray, num_rows: int) -> np.ndarray:
    """Return where `condition`, `(T, …)`, has held for more than `num_rows` rows on end."""
    # the filter lies on the rows before
    size, origin = num_rows + 1, num_rows // 2
    return minimum_filter1d(condition, size, axis=0, mode="constant", origin=origin)


def estimate_step(q: np.ndarray) -> float:
    """Return the step of a coarse sensor, NaN for a fine one.

    Repeated values are its steps, also in a log that was brought to another rate. A joint that hardly rests
    has few of these; then all values must lie whole steps apart.
    """
    values, counts = np.unique(q[np.isfinite(q)], return_counts=True)
    codes = values[counts >= CODE_REPEATS]
    if len(codes) >= 10 and counts[counts >= CODE_REPEATS].sum() >= 0.3 * len(q):
        return float(np.quantile(np.diff(codes), STEP_QUANTILE))
    if len(values) < 10:
        return np.nan
    gaps = np.diff(values)
    step = float(np.quantile(gaps, STEP_QUANTILE))
    off = np.abs(gaps / step - np.round(gaps / step))
    return step if np.quantile(off, LATTICE_SHARE) < LATTICE_ERROR else np.nan


def to_json_number(value: Any) -> float | None:
    """Return a number, `None` for NaN, which JSON cannot hold."""
    return float(value) if np.isfinite(value) else None
