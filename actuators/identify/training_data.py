"""Recordings as training data: all of them end to end, and where in them a window may begin."""

import logging
from collections.abc import Sequence

import numpy as np
import torch
from torch import nn

from actuators.recordings.inspection import estimate_step
from actuators.recordings.split import COMMANDED
from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording


class TrainingWindows:
    """Windows of `H + K` samples from a set of recordings, joint by joint.

    Args:
        recordings: Where from; no window crosses from one into the next.
        machine: Gives joints and history.
        horizon: Steps to predict, `K`.
        device: Where the tensors live.
        purpose: Their purpose, in error messages.

    Attributes:
        u: Commands of all recordings, `(J, T)`.
        q: Positions of all recordings, `(J, T)`.
        starts: Samples at which a window may begin, `(S,)`.

    Raises:
        RecordingError: no recording is long enough for a single window, or a joint is never
            commanded.
    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        machine: Machine,
        horizon: int,
        device: torch.device,
        purpose: str = "to fit to",
    ) -> None:
        def join(parts: Sequence[np.ndarray]) -> torch.Tensor:
            return torch.cat([torch.as_tensor(part) for part in parts]).T.contiguous().to(device)

        self.u = join([recording.u for recording in recordings])
        self.q = join([recording.q for recording in recordings])
        self.num_history, self.horizon = machine.num_history, horizon
        self._length = machine.num_history + horizon
        starts, begin = [], 0
        for recording in recordings:
            count = max(0, recording.num_samples - self._length + 1)
            starts.append(torch.arange(begin, begin + count))
            begin += recording.num_samples
        self.starts = torch.cat(starts).to(device)
        if not len(self.starts):
            longest = max((recording.num_samples for recording in recordings), default=0)
            raise RecordingError(
                f"too little data: the longest of {len(recordings)} recordings {purpose} has {longest} samples, one window needs "
                f"{self._length} ({machine.num_history} of history and {horizon} to predict)"
            )
        self._moving = [self._within(u.abs() > COMMANDED) for u in self.u]
        for joint, found in zip(machine.joint_names, self._moving, strict=True):
            if not len(found):
                raise RecordingError(
                    f"too little data: joint {joint} is never commanded in the {len(recordings)} recordings {purpose}"
                )

    def draw(
        self, batch: int, still_share: float, generator: torch.Generator
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Draw windows for each joint, mostly of times at which it is commanded.

        Args:
            batch: Number of windows drawn a joint.
            still_share: Part drawn from all times instead.
            generator: Draws them.

        Returns:
            Commands and positions, each `(J, B, H + K)`.
        """
        still = round(batch * still_share)
        u, q = [], []
        for joint, moving in enumerate(self._moving):
            index = []
            for places, count in ((self.starts, still), (moving, batch - still)):
                drawn = torch.randint(len(places), (count,), generator=generator)
                index.append(places[drawn.to(places.device)])
            rows = torch.cat(index)
            u.append(self.u[joint].unfold(0, self._length, 1)[rows])
            q.append(self.q[joint].unfold(0, self._length, 1)[rows])
        return torch.stack(u), torch.stack(q)

    def _within(self, condition: torch.Tensor) -> torch.Tensor:
        """Return the starts of windows in which `condition`, `(T,)` bool, holds at some time."""
        count = nn.functional.pad(condition.cumsum(0), (1, 0))
        return self.starts[count[self.starts + self._length] > count[self.starts]]


log = logging.getLogger(__name__)

NEEDED_S = 15.0
"""Commanded time each way below which a fit is refused. Measured with `fit=mlp` on random levels of
the hydraulic plant: with 10 s each way the error of a free run of 5 s is three times that of an
ample fit, no better than a linear model; with 30 s 1.7 times."""
SETTLED = 3
"""Histories without a command after which a joint is at rest: its dead time is over and what swung
has died away."""


def list_sources(recordings: Sequence[Recording]) -> list[str]:
    """Return where recordings come from, each source once."""
    return sorted({recording.metadata.get("source", "unknown") for recording in recordings})


def measure_commanded_each_way_s(recordings: Sequence[Recording]) -> np.ndarray:
    """Return for how long each joint is commanded forth and back, s, shape `(2, J)`."""
    both = []
    for r in recordings:
        both.append(np.stack([(r.u > COMMANDED).sum(0), (r.u < -COMMANDED).sum(0)]) / r.rate_hz)
    return np.sum(both, 0)


def check_enough(recordings: Sequence[Recording], machine: Machine) -> None:
    """Check that each joint is commanded long enough each way.

    Raises:
        RecordingError: a joint is hardly commanded, in figures.
    """
    lacking = []
    found = measure_commanded_each_way_s(recordings)
    for name, (forth_s, back_s) in zip(machine.joint_names, found.T.tolist(), strict=True):
        if min(forth_s, back_s) < NEEDED_S:
            lacking.append(f"{name} {forth_s / 60:.1f} min forth and {back_s / 60:.1f} min back")
    if lacking:
        raise RecordingError(
            f"too little data: {'; '.join(lacking)} commanded (|u| > {COMMANDED:g}) in the {len(recordings)} recordings to fit to, "
            f"needed are {NEEDED_S / 60:.2g} min each way. Record more of these joints: small and large commands both ways over "
            "their whole travel (mode=collect)."
        )


def estimate_resting_noise(recordings: Sequence[Recording], machine: Machine) -> np.ndarray:
    """Return the size of increments at rest, rad or m, shape `(J,)`.

    The larger of two: the spread of the increments where the joint has long been without a command
    (68 of 100 are smaller; one standard deviation of normal noise), and the error of an increment
    from the sensor's own step, where it has a visible one: a difference of two values, each off by
    a step over the root of 12, is off by a step over the root of 6.
    """
    wait = SETTLED * machine.num_history
    noise = np.zeros(machine.num_joints)
    for joint, name in enumerate(machine.joint_names):
        still, moving = [], []
        for recording in recordings:
            commanded = np.abs(recording.u[:, joint]) > COMMANDED
            count = np.concatenate([np.zeros(wait), np.cumsum(commanded)])
            quiet = np.cumsum(commanded) == count[: len(commanded)]
            quiet[:wait] = False  # what came before the recording is not known
            q = recording.q[:, joint].astype(np.float64)
            still.append(np.diff(q)[quiet[:-1]])
            moving.append(q[~quiet])
        still, step = np.concatenate(still), estimate_step(np.concatenate(moving))
        noise[joint] = np.nan_to_num(step) / np.sqrt(6.0)
        if len(still):
            noise[joint] = max(noise[joint], float(np.quantile(np.abs(still), 0.68)))
        else:
            text = "%s is never at rest in the recordings to fit to: its drift at rest will not be learned"
            log.warning(text, name)
    return noise
