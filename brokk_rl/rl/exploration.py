"""Exploration noise whose floor falls while a policy learns."""

from __future__ import annotations

import math

import torch
from rsl_rl.modules.distribution import GaussianDistribution
from torch.distributions import Normal


class FlooredGaussian(GaussianDistribution):
    """Gaussian whose smallest standard deviation can be moved while CUDA graphs use it.

    rsl-rl holds the bounds of the spread as numbers, which a captured graph keeps for ever. Here
    the floor is a tensor. It belongs to the weights, so that a resumed training goes on with it.

    Args:
        output_dim: Number of actions.
        init_std: Standard deviation at the beginning.
        std_range: Floor at the beginning, and the largest standard deviation.
    """

    def __init__(self, output_dim: int, init_std: float, std_range: tuple[float, float]) -> None:
        super().__init__(output_dim, init_std, std_range, std_type="log")
        self.log_floor: torch.Tensor
        self.register_buffer("log_floor", torch.tensor(self.log_std_range[0]))

    def set_floor(self, std: float) -> None:
        """Move the floor; it stays below the largest standard deviation."""
        self.log_floor.fill_(min(math.log(std), self.log_std_range[1]))

    def update(self, mlp_output: torch.Tensor) -> None:
        """Update the distribution; see `rsl_rl.modules.distribution.GaussianDistribution`."""
        log_std = self.log_std_param.clamp(max=self.log_std_range[1]).maximum(self.log_floor)
        self._distribution = Normal(mlp_output, log_std.exp())
