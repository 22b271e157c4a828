"""Residual probes: regressions of the residual that point to families of effects.

The target is the excess of the simulated speed, over `SPAN_S`. Each probe is the regressor that one
effect would leave behind: acceleration (later motion), speed (gain), size of the speed (asymmetry),
speed at small or large commands, with other joints moving, under load, later in time. Each probe is
fitted together with gain and timing, in which every simulator errs a little, and compared with the
reference. Two further probes come from single events: the spread of the lateness of starts, and the
ringing after stops. Probes are evidence for people; the search decides by fitting.
Axes: `W` windows, `K` steps, `J` joints, `S` samples.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch

from actuators.recordings.split import COMMANDED
from actuators.scales import scale_time
from brokk_rl.gravity import Gravity
from brokk_rl.machine import Machine
from diagnosis.free_runs import WindowedRuns
from diagnosis.permutation_test import number_parts
from diagnosis.regimes import CREEP_COMMAND, REGIMES, TRANSIENT_S, label_regimes, shift_by_dead_time

MIN_SPEED = 0.1
"""Least speed of a start, of full speed; chosen by hand: slower ones amplify the noise of time."""
MIN_EVENTS = 8
"""Least number of starts or stops; chosen by hand."""
MIN_STOP_SAMPLES = 5
"""Least number of samples after a stop; chosen by hand."""
MAD = 1.4826
"""Median absolute deviation to standard deviation of a normal distribution."""


def measure_onsets(
    runs: WindowedRuns, machine: Machine, dead_time_s: np.ndarray
) -> dict[tuple[str, str], tuple[float, float]]:
    """Return the spread of the lateness of starts (s) and the ringing (rad or m), by joint.

    Each with its standard error; joints with fewer than `MIN_EVENTS` starts or stops are left out.
    """
    _, label = _label_recordings(runs, machine, dead_time_s)
    found = {}
    for j, name in enumerate(machine.joint_names):
        late_s = np.array(list(_measure_lateness(runs, runs.cut(label)[..., j], j, machine)))
        if len(late_s) >= MIN_EVENTS:
            # The median: a few starts fail for other reasons, such as a joint at its end stop.
            off = MAD * np.abs(late_s - np.median(late_s))
            error = float(off.std() / np.sqrt(len(off)))
            found["delay_jitter", name] = (float(np.median(off)), error)
        shaken = np.array(list(_measure_ringing(runs, [part[:, j] for part in label], j)))
        if len(shaken) >= MIN_EVENTS:
            error = float(MAD * shaken.std() / np.sqrt(len(shaken)))
            found["compliance", name] = (float(np.median(shaken)), error)
    return found


def _label_recordings(
    runs: WindowedRuns, machine: Machine, dead_time_s: np.ndarray
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return the commands when they act, and the regime of each sample, by recording."""
    acting, label = [], []
    for one in runs.recordings:
        u = shift_by_dead_time(one.u, dead_time_s, 1.0 / one.rate_hz)
        acting.append(u)
        label.append(label_regimes(u, one.q, machine, one.rate_hz))
    return acting, label


def _measure_lateness(
    runs: WindowedRuns, label: np.ndarray, joint: int, machine: Machine
) -> Iterator[float]:
    """Yield for each start within a window how much later the machine moves, s."""
    ahead = max(3, round(scale_time(machine, TRANSIENT_S) / machine.period_s))
    is_start = label == REGIMES.index("start")
    error, path = runs.error[..., joint], runs.simulated[..., joint]
    for window, begin in zip(*np.nonzero(is_start[:, 1:] & ~is_start[:, :-1]), strict=True):
        end = begin + ahead
        # A start that is cut short never reaches its speed.
        if end >= error.shape[1] or not is_start[window, begin + 1 : end].all():
            continue
        # By the last third of the start the simulated speed is nearly steady.
        third = ahead // 3
        moved = path[window, end] - path[window, end - third]
        speed = moved / (third * machine.period_s)
        if not abs(speed) > MIN_SPEED * machine.max_speed[joint]:
            continue
        late_s = (error[window, end] - error[window, begin]) / speed
        if np.isfinite(late_s):
            yield float(late_s)


def _measure_ringing(runs: WindowedRuns, label: list[np.ndarray], joint: int) -> Iterator[float]:
    """Yield the scatter about a straight line in the second half of the time after each stop."""
    for recording, regime in zip(runs.recordings, label, strict=True):
        is_stop = regime == REGIMES.index("stop")
        edges = np.flatnonzero(np.diff(is_stop.astype(np.int8)))
        for begin, end in zip(edges[::2], edges[1::2], strict=False) if not is_stop[0] else []:
            # The braking itself is no ringing: only the second half of the time counts.
            after = recording.q[begin + 1 + (end - begin) // 2 : end + 1, joint].astype(float)
            # A line through fewer samples leaves nothing to scatter.
            if len(after) >= MIN_STOP_SAMPLES:
                line = np.polyfit(np.arange(len(after)), after, 1)
                yield float(np.std(after - np.polyval(line, np.arange(len(after)))))


SPAN_S = 0.25
"""Time over which speeds are taken on the reference of `actuators.scales`, s; chosen by hand: shorter
ones are noise, longer ones blur."""
LARGE_COMMAND = 0.7
"""Smallest of the large commands, of full; chosen by hand."""
CLEAR_Z = 4.0
"""Standard errors from the reference at which a probe is reported; chosen by hand for some sixty
probes a report."""
MIN_SAMPLES = 40
"""Least number of samples with the condition of a probe; chosen by hand."""


@dataclass(frozen=True)
class Probe:
    """One figure.

    Attributes:
        effect: Family of effects that would leave it behind.
        joint: The joint.
        value: The figure on the field recordings, in the unit that `text` says.
        reference: The same on reference recordings; 0 without any.
        z: Difference over its standard error, from leaving out parts of recordings.
        text: The figure as a sentence.
    """

    effect: str
    joint: str
    value: float
    reference: float
    z: float
    text: str

    @property
    def is_clear(self) -> bool:
        """Return whether it stands out."""
        return abs(self.z) > CLEAR_Z

    def plain(self) -> dict[str, Any]:
        """Return it as plain JSON data."""
        return asdict(self)


PERCENT, MILLI = 1e2, 1e3
"""Factors of the sentences: shares to per cent, m, rad and s to thousandths."""
TEXTS = {
    "dead_time": (
        "moves {:.0f} ms later than simulated",
        "moves {:.0f} ms earlier than simulated",
        MILLI,
    ),
    "flow_gain": (
        "moves {:.0f} % slower than simulated",
        "moves {:.0f} % faster than simulated",
        PERCENT,
    ),
    "asymmetry": (
        "is {:.0f} % slower extending, faster retracting",
        "is {:.0f} % faster extending, slower retracting",
        PERCENT,
    ),
    "dead_band": (
        "is {:.0f} % slower at small commands",
        "is {:.0f} % faster at small commands",
        PERCENT,
    ),
    "saturation": (
        "is {:.0f} % slower at large commands",
        "is {:.0f} % faster at large commands",
        PERCENT,
    ),
    "flow_sharing": (
        "is {:.0f} % slower while others move",
        "is {:.0f} % faster while others move",
        PERCENT,
    ),
    "load_dependence": (
        "is {:.0f} % slower against its full load",
        "is {:.0f} % faster against its full load",
        PERCENT,
    ),
    "thermal_drift": (
        "loses {:.0f} % of its speed in time",
        "gains {:.0f} % of speed in time",
        PERCENT,
    ),
    "backlash": (
        "falls {:.1f} m{unit} short after reversals",
        "goes {:.1f} m{unit} further after reversals",
        MILLI,
    ),
    "delay_jitter": ("starts after times that vary by {:.0f} ms", "", MILLI),
    "compliance": ("shakes by {:.2f} m{unit} after stops", "", MILLI),
    "creep": (
        "sinks by {:.2f} m{unit}/s without command",
        "rises by {:.2f} m{unit}/s without command",
        MILLI,
    ),
}
"""Sentences for a coefficient above and below 0, and the factor to their unit."""


def probe_residuals(
    runs: WindowedRuns, reference: WindowedRuns | None, machine: Machine, dead_time_s: np.ndarray
) -> list[Probe]:
    """Return all figures, those that stand out most first.

    Args:
        runs: Free runs through field recordings.
        reference: The same simulator's through reference recordings; `None`: figures are compared
            with 0.
        machine: Gives joints and masses.
        dead_time_s: Time from command to motion of each joint, `(J,)`.
    """
    mine = _measure_probes(runs, machine, dead_time_s)
    other = _measure_probes(reference, machine, dead_time_s) if reference else {}
    found = []
    for (effect, joint), (value, error) in mine.items():
        base, base_error = other.get((effect, joint), (0.0, 0.0))
        unit = machine.joints[machine.joint_names.index(joint)].unit
        text = f"{joint} {_describe_coefficient(effect, value, unit)}"
        text += (
            f"; on the reference it {_describe_coefficient(effect, base, unit)}" if other else ""
        )
        z = (value - base) / max(float(np.hypot(error, base_error)), np.finfo(float).tiny)
        found.append(Probe(effect, joint, value, base, z, text))
    return sorted(found, key=lambda probe: -abs(probe.z))


def _measure_probes(
    runs: WindowedRuns, machine: Machine, dead_time_s: np.ndarray
) -> dict[tuple[str, str], tuple[float, float]]:
    """Return all figures with their standard errors, by effect and joint."""
    return _fit_coefficients(runs, machine, dead_time_s) | measure_onsets(
        runs, machine, dead_time_s
    )


def _describe_coefficient(effect: str, value: float, unit: str) -> str:
    above, below, factor = TEXTS[effect]
    return (below if value < 0 else above).format(abs(factor * value), unit=unit)


def _fit_coefficients(
    runs: WindowedRuns, machine: Machine, dead_time_s: np.ndarray
) -> dict[tuple[str, str], tuple[float, float]]:
    """Return the coefficient of each probe and its standard error, by effect and joint."""
    span = max(1, round(scale_time(machine, SPAN_S) / machine.period_s))
    span_s = span * machine.period_s
    lacks = _subtract_earlier(runs.error, span) / span_s
    speed = _subtract_earlier(runs.simulated, span) / span_s
    acceleration = _subtract_earlier(speed, span) / span_s
    clues = _ProbeColumns(runs, machine, dead_time_s)
    block = np.broadcast_to(number_parts(runs)[:, None], lacks.shape[:2])
    found = {}
    for j, name in enumerate(machine.joint_names):
        given = np.isfinite(lacks[..., j]) & np.isfinite(acceleration[..., j])
        # Every simulator errs a little in gain and timing, which would pass for other effects.
        always = np.stack([acceleration[..., j][given], speed[..., j][given]], 1)
        for effect, values in clues.of(j, speed[..., j]):
            column = np.nan_to_num(values[given])
            if (np.abs(column) > 0).sum() < MIN_SAMPLES:
                continue
            place = {"dead_time": 0, "flow_gain": 1}.get(effect, 2)
            rows = always if place < 2 else np.concatenate([always, column[:, None]], 1)
            found[effect, name] = _estimate_coefficient(
                rows, lacks[..., j][given], block[given], place
            )
    return found


class _ProbeColumns:
    """Regressors of the excess speed, one an effect, `(W, K)` for each joint."""

    def __init__(self, runs: WindowedRuns, machine: Machine, dead_time_s: np.ndarray) -> None:
        acting, label = _label_recordings(runs, machine, dead_time_s)
        self._u, self._regime = runs.cut(acting), runs.cut(label)
        self._load = None
        if machine.has_bodies:
            gravity, loads = Gravity(machine, torch.device("cpu")), []
            for one in runs.recordings:
                load = gravity.load(torch.as_tensor(one.q, dtype=torch.float32)).numpy()
                # Over the largest of the recording; the floor of 1 is for joints without any load.
                loads.append(load / np.maximum(np.abs(load).max(0), 1.0))
            self._load = runs.cut(loads)
        late_s = runs.elapsed_s - runs.elapsed_s.mean()
        self._late = (late_s / max(float(np.ptp(late_s)), 1e-9))[:, None]

    def of(self, joint: int, speed: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
        """Yield effect and clue of one joint, whose simulated speed is `speed`, `(W, K)`."""
        u, regime = self._u[..., joint], self._regime[..., joint]
        moving, size = np.abs(u) > COMMANDED, np.abs(u)
        others = (np.abs(self._u) > COMMANDED).sum(2) - moving > 0
        if self._load is not None and np.nanmax(np.abs(self._load[..., joint])) > 0.05:
            yield "creep", -np.sign(self._load[..., joint]) * (regime == REGIMES.index("hold"))
        if moving.sum() < MIN_SAMPLES:
            return
        yield "dead_time", speed
        yield "flow_gain", speed
        yield "asymmetry", np.abs(speed)
        yield "dead_band", speed * (moving & (size < CREEP_COMMAND))
        yield "saturation", speed * (size > LARGE_COMMAND)
        yield "flow_sharing", speed * others
        yield "thermal_drift", speed * self._late
        yield (
            "backlash",
            np.sign(u) * (regime == REGIMES.index("after a reversal")) / 0.6,
        )  # rad lacking, over the time it takes
        if self._load is not None and np.nanmax(np.abs(self._load[..., joint])) > 0.05:
            load = self._load[..., joint]
            yield "load_dependence", -np.sign(u) * load * np.abs(speed)


def _subtract_earlier(values: np.ndarray, span: int) -> np.ndarray:
    """Return the change over the last `span` steps, `(W, K, J)`, NaN before there are so many."""
    found = np.full(values.shape, np.nan)
    found[:, span:] = values[:, span:] - values[:, :-span]
    return found


def _estimate_coefficient(
    rows: np.ndarray, target: np.ndarray, block: np.ndarray, place: int
) -> tuple[float, float]:
    """Return a least-squares coefficient and its jackknife standard error over blocks."""
    names = np.unique(block)
    grams = np.stack([rows[block == b].T @ rows[block == b] for b in names])
    crosses = np.stack([rows[block == b].T @ target[block == b] for b in names])

    def solved(gram: np.ndarray, cross: np.ndarray) -> float:
        # Keeps the matrix regular where a column is a multiple of another.
        ridge = 1e-9 * np.trace(gram) / len(gram) + 1e-15
        return float(np.linalg.solve(gram + ridge * np.eye(len(gram)), cross)[place])

    value = solved(grams.sum(0), crosses.sum(0))
    count = len(names)
    if count < 2:
        return value, float("inf")
    # Samples of a block depend on each other, so blocks are left out as a whole.
    pairs = zip(grams.sum(0) - grams, crosses.sum(0) - crosses, strict=True)
    left = np.array([solved(gram, cross) for gram, cross in pairs])
    return value, float(np.sqrt((count - 1) / count * ((left - left.mean()) ** 2).sum()))
