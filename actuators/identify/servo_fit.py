"""Fit of `actuators.models.servo`, joint by joint: delay, loop, play and sag by free runs, with standard errors.

A position loop forgets where it began, so a recording is one free run, less its first second. The search
for the dead time (`actuators.identify.dead_time`) gives the start; nonlinear least squares do the rest.
"""

from collections.abc import Sequence

import numpy as np
import torch
from scipy.optimize import least_squares
from scipy.signal import lfilter

from actuators.contracts import FitTask
from actuators.identify.dead_time import LONGEST_S, RESOLUTION_S, ServoLoops
from actuators.identify.option_file import estimate_standard_errors, write_numbers
from actuators.identify.signals import apply_play, discretise_loop
from actuators.models.servo import Servo
from actuators.open_loop import WARM_UP_S
from brokk_rl.commands import read_targets
from brokk_rl.errors import RecordingError
from brokk_rl.spec import spec

STEPS = np.array([5e-3, 2e-3, 5e-2, 2e-3, 1e-3, 1e-2])
"""Size of each number, in its own unit, by which steps of the search count; a tenth is a difference.
Chosen by hand: above the grain of samples and encoders, below what changes a loop."""
FIRST_PLAY = 0.02
"""Play of the start, of its upper bound. Chosen by hand: at 0 its derivative has one side only."""
NUM_STARTS = 3
"""Delays from which the search starts, each with its best loop: a longer delay and a faster loop look alike."""
FINE_S = 0.0025
"""Longest step of the simulated loop, s: at 0.01 s a response of 0.02 s comes out as 0.01 s."""
OUTLIER = 3.0
"""Root mean square errors of the start beyond which an error counts with its size, not its square."""


BOUNDS = {
    "dead_time_s": (0.0, 1.0),
    "response_s": (0.0, 0.5),
    "damping": (0.05, 5.0),
    "play_rad": (0.0, 0.2),
    "sag_rad": (-0.2, 0.2),
    "sag_slope": (-0.3, 0.3),
}
"""Lower and upper bound of each number of `actuator=servo` that is fitted. A response of 0.5 s is a loop of 0.3 Hz;
no drive keeps a resonance of a lower damping, and a loop of a higher one is a first-order lag."""


@spec
class ServoFit:
    """Fits `actuator=servo` by free runs.

    Attributes:
        name: Name of the model in tables and of its files: `<name>.yaml`, an option for
            `actuator=@…`, and `<name>.json` with standard errors.
        actuator: The model; top speed and limit keep the values they have here.
    """

    name: str
    actuator: Servo

    def fit(self, task: FitTask) -> Servo:
        """Fit to all recordings; validation chooses nothing.

        Raises:
            ConfigError: the machine is not commanded by position.
            RecordingError: too little data.
            StorageError: a file could not be written.
        """
        machine = task.machine
        self.actuator.build(machine, 1, torch.device("cpu"))  # refuses numbers that make no sense
        recordings = [one for one in task.recordings if one.duration_s > 2.0 * LONGEST_S]
        if not recordings:
            raise RecordingError(
                f"too little data: no recording is longer than {2.0 * LONGEST_S:g} s"
            )
        targets = [read_targets(one.u.astype(float), machine) for one in recordings]
        low, high = np.array(list(BOUNDS.values())).T
        # a joint answers no earlier than its history reaches back
        high[0] = min(high[0], (machine.num_history - 1) * machine.period_s)
        found, errors = [], []
        for j, joint in enumerate(machine.joint_names):
            pairs = []
            for target, one in zip(targets, recordings, strict=True):
                pairs.append((target[:, j], one.q[:, j].astype(float)))
            if max(float(np.ptp(target)) for target, _ in pairs) == 0.0:
                raise RecordingError(
                    f"too little data: joint {joint} is never commanded in the {len(recordings)} recordings to fit to"
                )
            middle = 0.5 * (machine.lower[j] + machine.upper[j])
            x, error = _JointRuns(pairs, machine.period_s, middle).fit(low, high)
            found.append(x)
            errors.append(error)
        numbers = dict(zip(BOUNDS, np.array(found).T, strict=True))
        told = dict(zip(BOUNDS, np.array(errors).T, strict=True))
        return write_numbers(task.folder, self.name, self.actuator, machine, numbers, told)


class _JointRuns:
    """Free runs of one joint.

    Args:
        pairs: Targets and positions of each recording, rad or m.
        period_s: Period of the recordings.
        middle: Middle of the travel, about which the sag changes.
    """

    def __init__(
        self, pairs: Sequence[tuple[np.ndarray, np.ndarray]], period_s: float, middle: float
    ) -> None:
        self._pairs, self._period_s, self._middle = pairs, period_s, middle
        self._num_steps = max(1, round(period_s / FINE_S))
        self._skip = round(WARM_UP_S / period_s)

    def fit(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the numbers of `BOUNDS` and their standard errors."""
        grid_s = np.arange(0.0, high[0] + 1e-9, RESOLUTION_S)
        best = None
        scale = 0.0
        loops = ServoLoops(self._pairs, self._period_s, grid_s).list_loops()
        for delay, w, damping in loops[:NUM_STARTS]:
            start = np.array([grid_s[delay], 1.0 / w, damping, FIRST_PLAY * high[3], 0.0, 0.0])
            x = np.clip(start, low + 1e-3 * STEPS, high - 1e-3 * STEPS)
            # one scale for all starts, so that their losses compare
            scale = scale or max(float(np.sqrt(np.square(self._compute_errors(x)).mean())), 1e-9)
            found = least_squares(
                self._compute_errors, x, bounds=(low, high), x_scale=STEPS, loss="soft_l1",
                f_scale=OUTLIER * scale, diff_step=0.1 * STEPS / np.maximum(np.abs(x), STEPS),
            )  # fmt: skip
            if best is None or found.cost < best.cost:
                best = found
        assert best is not None, "there is a delay to begin at"
        lengths = [len(q) - self._skip for _, q in self._pairs]
        return best.x, estimate_standard_errors(self._compute_errors, best.x, 0.1 * STEPS, lengths)

    def _compute_errors(self, x: np.ndarray) -> np.ndarray:
        """Return simulated less measured positions of all recordings, one after the other."""
        dead_time_s, response_s, damping, play, sag, slope = x
        step_s, late = self._period_s / self._num_steps, dead_time_s / self._period_s
        numerator, denominator = discretise_loop(1.0 / max(response_s, 1e-4), damping, step_s)
        errors = []
        for target, q in self._pairs:
            held = apply_play(target, play)
            reached = held - sag - slope * (held - self._middle)
            fine = np.repeat(reached - reached[0], self._num_steps)
            followed = lfilter(numerator, denominator, fine) + reached[0]
            places = np.arange(len(q)) - late
            seen = np.interp(places, np.arange(len(fine)) / self._num_steps, followed)
            errors.append((seen - q)[self._skip :])
        return np.concatenate(errors)
