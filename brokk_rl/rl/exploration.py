"""Exploration noise whose bound falls while a policy learns."""

from __future__ import annotations

import math

import torch
from rsl_rl.modules.distribution import GaussianDistribution
from torch.distributions import Normal


class CappedGaussian(GaussianDistribution):
    """Gaussian whose largest standard deviation can be moved while CUDA graphs use it.

    rsl-rl holds the bounds of the spread as numbers, which a captured graph keeps for ever. Here
    the cap is a tensor. It belongs to the weights, so that a resumed training goes on with it.

    Args:
        output_dim: Number of actions.
        init_std: Standard deviation at the beginning.
        std_range: Smallest standard deviation, and the cap at the beginning.
    """

    def __init__(self, output_dim: int, init_std: float, std_range: tuple[float, float]) -> None:
        super().__init__(output_dim, init_std, std_range, std_type="log")
        self.log_cap: torch.Tensor
        self.register_buffer("log_cap", torch.tensor(self.log_std_range[1]))

    def set_cap(self, std: float) -> None:
        """Move the cap; it stays above the smallest standard deviation."""
        self.log_cap.fill_(max(math.log(std), self.log_std_range[0]))

    def update(self, mlp_output: torch.Tensor) -> None:
        """Update the distribution; see `rsl_rl.modules.distribution.GaussianDistribution`."""
        log_std = self.log_std_param.minimum(self.log_cap).clamp(min=self.log_std_range[0])
        self._distribution = Normal(mlp_output, log_std.exp())
