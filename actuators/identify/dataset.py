"""Recordings as training data: all of them end to end, and where in them a window may begin."""

from collections.abc import Sequence

import torch
from torch.nn.utils.rnn import pad_sequence

from actuators.models.draw import hashed
from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.split import COMMANDED


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
        self.u = (
            torch.cat([torch.as_tensor(recording.u) for recording in recordings])
            .T.contiguous()
            .to(device)
        )
        self.q = (
            torch.cat([torch.as_tensor(recording.q) for recording in recordings])
            .T.contiguous()
            .to(device)
        )
        self.num_history, self.horizon = machine.num_history, horizon
        self._length = machine.num_history + horizon
        starts, begin = [], 0
        for recording in recordings:
            starts.append(
                torch.arange(begin, begin + max(0, recording.num_samples - self._length + 1))
            )
            begin += recording.num_samples
        self.starts = torch.cat(starts).to(device)
        if not len(self.starts):
            longest = max((recording.num_samples for recording in recordings), default=0)
            raise RecordingError(
                f"too little data: the longest of {len(recordings)} recordings {purpose} has {longest} samples, one window needs "
                f"{self._length} ({machine.num_history} of history and {horizon} to predict)"
            )
        moving = [self._within(u.abs() > COMMANDED) for u in self.u]
        for joint, found in zip(machine.joint_names, moving, strict=True):
            if not len(found):
                raise RecordingError(
                    f"too little data: joint {joint} is never commanded in the {len(recordings)} recordings {purpose}"
                )
        self._moving = pad_sequence(moving, batch_first=True)  # (J, most)
        self._num_moving = torch.tensor([[len(found)] for found in moving], device=device)
        self._busy = self._busiest()
        self._joint = torch.arange(len(self.u), device=device)[:, None]

    def draw(
        self,
        batch: int,
        still_share: float,
        busy_share: float,
        key: torch.Tensor,
        together: bool = False,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Draws windows for each joint, mostly of times at which it is commanded. Fixed shapes, no host: a CUDA graph may hold it.

        Args:
            batch: Number of windows drawn a joint.
            still_share: Part drawn from all times instead.
            busy_share: Part drawn from the tenth of all times in which most is commanded at once.
            key: Names the draw, int64 of shape `()`: the same key gives the same windows.
            together: Each joint gets the windows of all, so that `B` is `J` times `batch`; else its
                own ones.

        Returns:
            Commands and positions, each `(J, B, H + K)`.
        """
        index = self._index(batch, still_share, busy_share, key)
        index = index.flatten()[None] if together else index
        return (
            self.u.unfold(1, self._length, 1)[self._joint, index],
            self.q.unfold(1, self._length, 1)[self._joint, index],
        )

    def _index(
        self, batch: int, still_share: float, busy_share: float, key: torch.Tensor
    ) -> torch.Tensor:
        still, busy = round(batch * still_share), round(batch * busy_share)
        place = torch.arange(len(self.u) * batch, device=key.device)
        chance = hashed(key * 1_048_576 + place).view(-1, batch)

        def pick(chance: torch.Tensor, count: torch.Tensor | int) -> torch.Tensor:
            return (chance.double() * count).long()

        rows = (
            self.starts[pick(chance[:, :still], len(self.starts))],
            self._busy[pick(chance[:, still : still + busy], len(self._busy))],
            self._moving.gather(1, pick(chance[:, still + busy :], self._num_moving)),
        )
        return torch.cat(rows, 1)

    def _within(self, condition: torch.Tensor) -> torch.Tensor:
        """Returns the starts of windows in which `condition`, `(T,)` bool, holds at some time."""
        count = torch.cat(
            [torch.zeros(1, dtype=torch.int64, device=condition.device), condition.cumsum(0)]
        )
        return self.starts[count[self.starts + self._length] > count[self.starts]]

    def _busiest(self) -> torch.Tensor:
        """Returns the tenth of the starts in whose windows the sum of all commands rises highest."""
        total = self.u.abs().sum(0).unfold(0, self._length, 1).amax(1)[self.starts]
        return self.starts[total.argsort(descending=True, stable=True)[: max(1, len(total) // 10)]]
