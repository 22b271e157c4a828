"""One update of a fit, with everything it changes: on a GPU captured in a CUDA graph, on the CPU the same code called step by step.

A free run of 60 steps is some thousand tiny kernels forth and back; launched one by one they take
far longer than they run.
"""

from __future__ import annotations

import copy
from collections.abc import Callable

import torch

from actuators.identify.dataset import Windows
from actuators.models.network import JointNetworks
from brokk_rl.machine import Machine
from brokk_rl.rl.execution import capture_graph


class Descent:
    """Adam on free runs, with a running average of the weights.

    The windows of an update are named by a counter (`Windows.draw`), so that there is no generator
    with a state to keep. Rates are tensors that the host fills before an update, so that a captured
    update can be steered.

    Args:
        networks: What is fitted, on its device.
        machine: Gives the ends of travel.
        seed: Of the draws.

    Attributes:
        networks: The networks at work.
        averaged: The running average of their weights, which is what is validated and kept.
    """

    def __init__(self, networks: JointNetworks, machine: Machine, seed: int) -> None:
        self.networks, self.averaged = networks, copy.deepcopy(networks).requires_grad_(False)
        self._device = networks.quiet.device
        self._lower = torch.as_tensor(machine.lower, dtype=torch.float32, device=self._device)
        self._upper = torch.as_tensor(machine.upper, dtype=torch.float32, device=self._device)
        self._seed = seed % 2**31
        self._key = torch.zeros((), dtype=torch.int64, device=self._device)
        self._rate = torch.zeros((), device=self._device)
        self._share_of_new = torch.zeros((), device=self._device)
        self._parameters = list(networks.parameters())
        on_gpu = self._device.type == "cuda"
        self._adam = torch.optim.Adam(
            self._parameters, lr=self._rate, fused=True, capturable=on_gpu
        )
        self._begin_adam()

    def state(self) -> dict[str, torch.Tensor]:
        """Returns all that an update changes, by name; the tensors themselves, to be copied from and into."""
        found = {
            f"networks.{name}": value.detach() for name, value in self.networks.named_parameters()
        }
        found |= {f"averaged.{name}": value for name, value in self.averaged.named_parameters()}
        for number, parameter in enumerate(self._parameters):
            found |= {
                f"adam.{number}.{name}": value
                for name, value in self._adam.state[parameter].items()
            }
        return found

    def updater(
        self, windows: Windows, batch: int, still_share: float, busy_share: float
    ) -> Callable[[], None]:
        """Returns one update on `batch` windows a joint as a function; capturing it, on a GPU, leaves the state as it was."""

        def update() -> None:
            self._update(
                *windows.draw(
                    batch, still_share, busy_share, self._key, together=self.networks.coupled
                )
            )

        if self._device.type != "cuda":
            return update
        before = {name: value.clone() for name, value in self.state().items()}
        graph = capture_graph(update, self._device, gradients=True)
        for name, value in self.state().items():
            value.copy_(before[name])
        return graph.replay

    def steer(self, number: int, rate: float, average: float) -> None:
        """Sets number, learning rate and decay of the average of the update to come, without waiting for the device."""
        self._key.fill_(self._seed * 2**20 + number)
        self._rate.fill_(rate)
        self._share_of_new.fill_(1.0 - average)

    @torch.no_grad()
    def run(self, u: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
        """Returns the free runs of the averaged networks through windows `(J, B, H + K)`, shape `(J, B, K)`."""
        return self.averaged.roll_out(
            u[..., :-1], q[..., : self.averaged.num_history], self._lower, self._upper
        )

    def _update(self, u: torch.Tensor, q: torch.Tensor) -> None:
        networks, size = self.networks, self.networks.num_history
        scale = networks.increment_scale[:, None, None]
        horizon = q.shape[2] - size
        if horizon == 1:
            # before the dead zone, whose gradient is zero where it acts
            output = networks(networks.inputs(u[..., :size], q[..., :size]))
            loss = (
                (output - (q[..., size] - q[..., size - 1]) / scale[..., 0]).square().mean(1).sum()
            )
        else:
            path = networks.roll_out(u[..., :-1], q[..., :size], self._lower, self._upper)
            ahead = torch.arange(1, horizon + 1, device=q.device)
            # an error that grows with the square root of time counts the same early and late
            loss = (((path - q[..., size:]) / scale).square() / ahead).mean((1, 2)).sum()
        gradients = torch.autograd.grad(loss, self._parameters)
        for parameter, gradient in zip(self._parameters, gradients, strict=True):
            # joints are fitted independently: each has its own bound
            norm = gradient.flatten(1).norm(dim=1).clamp(min=1.0)
            parameter.grad = gradient / norm.view(-1, 1, 1)
        self._adam.step()
        with torch.no_grad():
            for mean, value in zip(self.averaged.parameters(), self._parameters, strict=True):
                mean.lerp_(value, self._share_of_new)

    def _begin_adam(self) -> None:
        """Makes Adam's state exist, with fixed addresses, before anything is captured: a step of rate and gradient zero."""
        for parameter in self._parameters:
            parameter.grad = torch.zeros_like(parameter)
        self._adam.step()
        for parameter in self._parameters:
            for value in self._adam.state[parameter].values():
                value.zero_()
