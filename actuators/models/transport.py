"""Dead time and dead band: the commands that act during the coming control period."""

import torch

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine


def check_dead_time(longest_s: float, machine: Machine, where: str) -> None:
    """Raise a `ConfigError` when the machine's history does not reach back `longest_s`."""
    reach_s = (machine.num_history - 1) * machine.period_s
    if not 0.0 <= longest_s <= reach_s + 1e-6:
        raise ConfigError(
            f"{where}: a dead time of {longest_s:.3f} s (spread included) does not fit the {reach_s:.3f} s that the history of "
            f"machine '{machine.name}' reaches back; shorten it or raise machine.num_history"
        )


def select_commands_in_force(
    u: torch.Tensor, delay_periods: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Split the coming control period at the moment when the delayed command changes.

    A command is held for one period, so with a dead time of `n + f` periods the valve sees the
    command of `n + 1` periods ago for the first part `f` of the period and that of `n` periods ago
    for the rest. Nothing is interpolated: this is exact.

    Args:
        u: Command history, shape `(N, H, J)`, newest last.
        delay_periods: Dead time in control periods, shape `(N, J)`, in [0, H - 1].

    Returns:
        The earlier command, the later command, and the part of the period in which the earlier one
        acts, each `(N, J)`.
    """
    last = u.shape[1] - 1
    # half a millionth of a period forgives 0.55 / 0.05 = 11.000000000000002
    whole = torch.floor(delay_periods + 5e-7)
    part = (delay_periods - whole).clamp(0.0, 1.0)
    newest = last - whole.to(torch.int64)
    later = u.gather(1, newest.clamp(0, last)[:, None]).squeeze(1)
    earlier = u.gather(1, (newest - 1).clamp(0, last)[:, None]).squeeze(1)
    return earlier, later, part


def split_run_commands(
    u: torch.Tensor, delay_periods: torch.Tensor, first: int
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return `select_commands_in_force` of each step of a run, the two commands `(T - first + 1, N, J)`.

    Args:
        u: Commands of the run, `(T, N, J)`; step `k` follows command `first + k - 1`.
        delay_periods: Dead time in control periods, `(N, J)`.
        first: Length of the history at the first step.
    """
    whole = torch.floor(delay_periods + 5e-7)  # see `select_commands_in_force`
    part = (delay_periods - whole).clamp(0.0, 1.0)
    steps = torch.arange(first - 2, len(u), device=u.device)[:, None, None]
    found = u.gather(0, (steps - whole.to(torch.int64)).clamp(0, len(u) - 1))
    return found[:-1], found[1:], part


def open_valve(
    u: torch.Tensor, dead_band_extend: torch.Tensor, dead_band_retract: torch.Tensor
) -> torch.Tensor:
    """Return the valve opening in [-1, 1], shape of `u`.

    Zero inside the dead band, one at full command each way.
    """
    extend = torch.relu(u - dead_band_extend) / (1.0 - dead_band_extend)
    retract = torch.relu(-u - dead_band_retract) / (1.0 - dead_band_retract)
    return extend - retract
