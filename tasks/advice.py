"""Proposals for a person who moves the levers.

A person follows late and sluggishly, so the machine's history lacks the newest proposals. A policy
without them would propose the same motion again until the first of it arrives. With them the dead
times of machine and person are one.

"""

import torch

from brokk_rl.commands import select_levers
from brokk_rl.machine import Machine
from tasks.settings import AdviceConfig, take_middle

MIN_LAG_PERIODS = 1e-6
"""Floor of the hand's lag, in control periods: no lag would divide by zero."""
ROUNDING = 5e-7
"""Tolerance, in control periods, by which a delay of whole periods counts as whole."""


class LeverAdviser:
    """Proposals under `AdviceConfig`; stateless, so that it can stand inside a policy."""

    def __init__(self, advice: AdviceConfig, machine: Machine, device: torch.device) -> None:
        self._dead_zone = take_middle(advice.dead_zone)
        self._exclusive = torch.as_tensor(machine.is_exclusive, device=device)
        most = advice.joints_at_once
        self._most = (
            machine.num_joints if most is None else most[0] if isinstance(most, tuple) else most
        )
        self._hold = round(advice.hold_s / machine.period_s)
        self._future = _predict_levers(advice, machine).to(device)

    def coming(self, proposed: torch.Tensor, given: torch.Tensor) -> torch.Tensor:
        """Return the commands that hands will still give, `(N, F, J)`, without further proposals.

        Args:
            proposed: Proposals so far, oldest first, `(N, H, J)`.
            given: Commands given in the last period, `(N, J)`.
        """
        hand = self._shown(given)
        levers = torch.einsum("fh,nhj->nfj", self._future, torch.cat((proposed, hand[:, None]), 1))
        return (
            levers.sign()
            * (levers.abs() - self._dead_zone).clamp(min=0.0)
            / (1.0 - self._dead_zone)
        )

    def proposal(self, wanted: torch.Tensor, proposed: torch.Tensor) -> torch.Tensor:
        """Return the proposal, `(N, J)`, by which the commands `wanted`, `(N, J)`, are given.

        Args:
            wanted: Commands under the masks.
            proposed: Proposals so far, oldest first, `(N, H, J)`.
        """
        shown = self._shown(wanted)
        if self._most >= wanted.shape[1]:
            return shown
        # a lever that was taken lately: the newest proposals have it without a gap, but not yet for
        # `hold_s`
        lately = ((proposed == 0).float().flip(1).cumsum(1) < 0.5).sum(1)
        kept = (lately > 0) & (lately < self._hold) & (shown != 0)
        return torch.where(select_levers(shown.abs() + 2.0 * kept, self._most), shown, 0.0)

    def _shown(self, command: torch.Tensor) -> torch.Tensor:
        """Return the deflection that commands `command`."""
        return torch.where(
            command == 0,
            0.0,
            command.sign() * (self._dead_zone + (1.0 - self._dead_zone) * command.abs()),
        )


def _predict_levers(advice: AdviceConfig, machine: Machine) -> torch.Tensor:
    """Return the weights of coming levers, `(F, H + 1)`.

    Columns: `H` proposals, oldest first, and the present position of the hand.
    """
    num, period_s = machine.num_history, machine.period_s
    delay = take_middle(advice.delay_s) / period_s
    lag = max(take_middle(advice.lag_s) / period_s, MIN_LAG_PERIODS)
    steps = round((take_middle(advice.delay_s) + advice.settle_s) / period_s) + 1
    whole = int(delay + ROUNDING)
    part = max(0.0, delay - whole)
    stay = float(torch.exp(torch.tensor(-1.0 / lag)))
    rows, hand = [], torch.zeros(num + 1)
    hand[num] = 1.0
    for step in range(steps):
        target = torch.zeros(num + 1)
        # the hand follows the proposal of `delay` periods ago, between two samples
        for back, weight in ((whole, 1.0 - part), (whole + 1, part)):
            place = num + step - back
            if 0 <= place < num:
                target[place] += weight
        rows.append(target + (hand - target) * lag * (1.0 - stay))  # the mean over the period
        hand = target + (hand - target) * stay
    return torch.stack(rows)
