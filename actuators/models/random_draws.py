"""Random numbers from a counter in the state instead of a generator.

No host is involved, a CUDA graph may hold the draws, and a run that is restored from its state goes
on exactly; a generator would be memory outside the state, which the contract of an actuator model
forbids.
"""

import math

import torch


def start_counter(num_envs: int, salt: int, device: torch.device) -> torch.Tensor:
    """Return the first counter of each environment, `(N,)` int64, from torch's seed.

    `salt` keeps effects apart.
    """
    seed = (torch.initial_seed() + salt * 2_654_435_761) % 2**31
    return torch.arange(num_envs, dtype=torch.int64, device=device) * 2_654_435_761 + seed


def draw_uniform(draw: torch.Tensor, column: int, width: int) -> torch.Tensor:
    """Return numbers in [0, 1), `(N, width)`, for the counter `(N,)`.

    Each `column` (below 256) gives independent ones.
    """
    place = torch.arange(width, dtype=torch.int64, device=draw.device) + 256 * column
    return hash_uniform(draw[:, None] * 65_536 + place)


def hash_uniform(key: torch.Tensor) -> torch.Tensor:
    """Return uniform numbers in [0, 1) for int64 keys.

    Mixing steps of splitmix64 (Steele et al. 2014), which wrap around.
    """
    key = key * -7_046_029_254_386_353_131
    key = (key ^ ((key >> 30) & 0x3FFFFFFFF)) * -4_658_895_280_553_007_687
    key = (key ^ ((key >> 27) & 0x1FFFFFFFFF)) * -7_723_592_293_110_705_685
    return ((key >> 40) & 0xFFFFFF).to(torch.float32) / float(1 << 24)


def draw_normal(draw: torch.Tensor, column: int, width: int) -> torch.Tensor:
    """Return standard normal numbers, `(N, width)` (Box and Muller).

    Uses `column` and `column + 1`.
    """
    radius = torch.sqrt(-2.0 * torch.log(1.0 - draw_uniform(draw, column, width)))
    return radius * torch.cos(2.0 * math.pi * draw_uniform(draw, column + 1, width))
