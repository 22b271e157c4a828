"""Networks that read the history of the paper's observation in another form."""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch import nn

INCREMENT_GAIN = 20.0
"""Factor on increments of normalised positions, which brings them to about 1. Chosen by hand: a
quarter of the travel takes a fast joint one second."""
FREQUENCIES = (1.0, 2.0)
"""Factors on normalised positions and targets, of which sine and cosine are given too (Fourier
features, Tancik et al. 2020). Chosen by hand."""


class HistoryEncoding(nn.Module):
    """Fixed transformation of an observation vector: nothing in it is learned or of a machine.

    Thirteen positions that hardly differ hide the motion of a joint in their last digits. Here the
    newest position stays, the others become increments, and sines and cosines of target and newest
    position come in addition.

    Args:
        num_samples: Samples of history, `H`.
        num_joints: Joints, `J`.
    """

    def __init__(self, num_samples: int, num_joints: int) -> None:
        super().__init__()
        self._shape = (num_samples, num_joints)
        self._num = num_samples * num_joints

    @property
    def num_added(self) -> int:
        """Numbers by which the vector grows."""
        return 2 * len(FREQUENCIES) * (3 + self._shape[1])

    def forward(self, vector: torch.Tensor) -> torch.Tensor:
        """Return the transformed vector, `(N, O + num_added)`."""
        head, q, rest = vector.split((3, self._num, vector.shape[-1] - 3 - self._num), dim=-1)
        q = q.reshape(-1, *self._shape)
        increments = (q[:, 1:] - q[:, :-1]).flatten(1) * INCREMENT_GAIN
        place = torch.cat((head, q[:, -1]), -1)
        waves = []
        for factor in FREQUENCIES:
            waves += [(factor * place).sin(), (factor * place).cos()]
        return torch.cat((place, increments, rest, *waves), -1)


class HistoryModel(MLPModel):
    """rsl-rl's network behind a `HistoryEncoding` of the group `policy`, which comes first.

    Args:
        obs: Observation groups.
        obs_groups: Groups of actor and critic.
        obs_set: Which of both it is.
        output_dim: Number of outputs.
        num_samples: As in `HistoryEncoding`, like the next one.
        num_joints: See there.
        **rest: As in `rsl_rl.models.MLPModel`, without normalisation by running statistics.
    """

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        *,
        num_samples: int,
        num_joints: int,
        **rest: Any,
    ) -> None:
        encoding = HistoryEncoding(num_samples, num_joints)
        self._num_added = encoding.num_added
        rest["obs_normalization"] = False
        super().__init__(obs, obs_groups, obs_set, output_dim, **rest)
        self.obs_normalizer = encoding

    def _get_latent_dim(self) -> int:
        """Return the number of inputs of the network behind the encoding."""
        return self.obs_dim + self._num_added
