"""Recordings as training data: all of them end to end, and where in them a window may begin."""

from collections.abc import Sequence

import torch

from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording

COMMANDED = 0.02
"""A joint whose command stays below this is at rest, whatever its dead band."""


class Windows:
    """Windows of `H + K` samples from a set of recordings, joint by joint.

    Args:
        recordings: Where from; no window crosses from one into the next.
        machine: Gives joints and history.
        horizon: Steps to predict, `K`.
        device: Where the tensors live.
        purpose: What they are for, in error messages.

    Attributes:
        u: Commands of all recordings, `(J, T)`.
        q: Positions of all recordings, `(J, T)`.

    Raises:
        RecordingError: no recording is long enough for a single window, or a joint is never commanded.
    """

    def __init__(
        self, recordings: Sequence[Recording], machine: Machine, horizon: int, device: torch.device, purpose: str = "to fit to"
    ) -> None:
        self.u = torch.cat([torch.as_tensor(recording.u) for recording in recordings]).T.contiguous().to(device)
        self.q = torch.cat([torch.as_tensor(recording.q) for recording in recordings]).T.contiguous().to(device)
        self.num_history, self.horizon = machine.num_history, horizon
        self._length = machine.num_history + horizon
        starts, begin = [], 0
        for recording in recordings:
            starts.append(torch.arange(begin, begin + max(0, recording.num_samples - self._length + 1)))
            begin += recording.num_samples
        self.starts = torch.cat(starts).to(device)
        if not len(self.starts):
            longest = max((recording.num_samples for recording in recordings), default=0)
            raise RecordingError(
                f"too little data: the longest of {len(recordings)} recordings has {longest} samples, one window needs "
                f"{self._length} ({machine.num_history} of history and {horizon} to predict)"
            )
        self._moving = [self._active(u) for u in self.u]
        for joint, moving in zip(machine.joint_names, self._moving, strict=True):
            if not len(moving):
                raise RecordingError(
                    f"too little data: joint {joint} is never commanded in the {len(recordings)} recordings to fit to"
                )

    def _active(self, u: torch.Tensor) -> torch.Tensor:
        """Returns the starts of windows in which a joint with the commands `u` `(T,)` is commanded at some time."""
        count = torch.cat([torch.zeros(1, dtype=torch.int64, device=u.device), (u.abs() > COMMANDED).cumsum(0)])
        within = count[self.starts + self._length] - count[self.starts]
        return self.starts[within > 0]

    def draw(self, batch: int, still_share: float, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
        """Draws windows for each joint, mostly of times at which it is commanded.

        Args:
            batch: Number of windows a joint, `B`.
            still_share: Part drawn from all times instead.
            generator: On the CPU.

        Returns:
            Commands and positions, each `(J, B, H + K)`.
        """
        still = round(batch * still_share)
        rows = []
        for moving in self._moving:
            picks = [
                source[torch.randint(len(source), (count,), generator=generator).to(source.device)]
                for source, count in ((self.starts, still), (moving, batch - still))
            ]
            rows.append(torch.cat(picks))
        index = torch.stack(rows)  # (J, B)
        joint = torch.arange(len(rows), device=index.device)[:, None]
        return self.u.unfold(1, self._length, 1)[joint, index], self.q.unfold(1, self._length, 1)[joint, index]
