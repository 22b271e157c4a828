"""Acting, storing and returns of PPO, each one replay of a CUDA graph.

rsl-rl launches some seventy small kernels for each control step, and 301 for the returns of a
rollout. On a GPU that takes longer than their arithmetic.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from rsl_rl.algorithms import PPO
from torch import nn
from torch.nn import functional

from brokk_rl.rl.execution import capture_graph

ALIGNMENT = 8
"""Columns of network inputs are padded to a multiple: tensor cores want rows of whole 16 bytes, in
bfloat16 too."""


def pad_columns(inputs: torch.Tensor) -> torch.Tensor:
    """Return `(…, I)` with columns of zeros, so that I is a multiple of `ALIGNMENT`."""
    return functional.pad(inputs, (0, -inputs.shape[-1] % ALIGNMENT))


def run_network(
    network: nn.Sequential, inputs: torch.Tensor, mixed_precision: bool = False
) -> torch.Tensor:
    """Return the output of a network of linear layers for `inputs` that may be padded.

    Args:
        network: The network.
        inputs: `(N, I)`, or more columns.
        mixed_precision: Whether the hidden layers use bfloat16. The last one does not: seven bits
            of an action's mean would be as wide as its noise.
    """
    first, *hidden, last = network
    assert isinstance(first, nn.Linear)
    with torch.autocast(inputs.device.type, torch.bfloat16, enabled=mixed_precision):
        weight = functional.pad(first.weight, (0, inputs.shape[1] - first.in_features))
        values = functional.linear(inputs, weight, first.bias)
        for layer in hidden:
            values = layer(values)
    return last(values.float())


class CapturedRollout:
    """Acting, storing and returns as `rsl_rl.algorithms.PPO` does them, in its own storage.

    Each is one replay of a CUDA graph.

    For feed-forward networks with a Gaussian policy; all tensors keep their addresses. On a CPU the
    same runs without graphs.

    Args:
        algorithm: Gives networks, storage and discount.
        fuse: Have `torch.compile` fuse the networks with what is around them.
    """

    def __init__(self, algorithm: PPO, fuse: bool = False) -> None:
        self._algorithm, storage = algorithm, algorithm.storage
        self._observations = {
            name: torch.zeros_like(value[0])  # type: ignore[arg-type]
            for name, value in storage.observations.items()
        }
        self._reward, self._done, self._timed_out = (
            torch.zeros_like(storage.rewards[0]) for _ in range(3)
        )
        self._slot = torch.zeros(1, dtype=torch.int64, device=storage.rewards.device)
        self._actions = torch.zeros_like(storage.actions[0])
        self._values, self._log_prob = (
            torch.zeros_like(storage.values[0]),
            torch.zeros_like(storage.actions_log_prob[0]),
        )
        self._parameters = tuple(torch.zeros_like(self._actions) for _ in range(2))
        if storage.distribution_params is None:
            storage.distribution_params = tuple(torch.zeros_like(storage.actions) for _ in range(2))
        compiled = torch.compile(self._evaluate, fullgraph=True, dynamic=False)
        self._networks = compiled if fuse else self._evaluate
        self._act, self._store = self._run(self._decide), self._run(self._keep)
        self._look_back = self._run(self._estimate)

    def act(self, observations: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Return drawn actions, `(N, A)`; the tensor is overwritten by the next call."""
        for name, value in self._observations.items():
            value.copy_(observations[name])
        self._act()
        return self._actions

    def store(self, reward: torch.Tensor, done: torch.Tensor, timed_out: torch.Tensor) -> None:
        """Store the step that followed the last `act`; each `(N,)`.

        Raises:
            OverflowError: The storage is full.
        """
        storage = self._algorithm.storage
        if storage.step >= storage.num_transitions_per_env:
            raise OverflowError("the storage is full: update before going on")
        for target, value in (
            (self._reward, reward),
            (self._done, done),
            (self._timed_out, timed_out),
        ):
            target[:, 0].copy_(value)
        self._slot.fill_(storage.step)
        self._store()
        storage.step += 1

    def compute_returns(self, observations: Mapping[str, torch.Tensor]) -> None:
        """Compute returns and advantages of the stored steps.

        Args:
            observations: Groups after the last of them.
        """
        for name, value in self._observations.items():
            value.copy_(observations[name])
        self._look_back()

    def _run(self, step: Callable[[], None]) -> Callable[[], None]:
        device = self._slot.device
        return capture_graph(step, device).replay if device.type == "cuda" else step

    @torch.no_grad()
    def _decide(self) -> None:
        # as `Normal.sample`, which asks the host whether the spread is positive and cannot be
        # captured
        found = self._networks(self._observations, torch.randn_like(self._actions))
        kept = (self._actions, self._log_prob, self._values, *self._parameters)
        for target, value in zip(kept, found, strict=True):
            target.copy_(value)

    def _evaluate(
        self, seen: Mapping[str, torch.Tensor], noise: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Return actions, their log-probability, values and parameters of the distribution."""
        actor, critic = self._algorithm.actor, self._algorithm.critic
        mixed = self._algorithm.use_mixed_precision
        mean, values = (
            run_network(model.mlp, pad_columns(model.get_latent(seen)), mixed)  # type: ignore[arg-type]
            for model in (actor, critic)
        )
        actor.distribution.update(mean)  # type: ignore[union-attr]
        actions = actor.output_mean + actor.output_std * noise
        log_prob = actor.get_output_log_prob(actions)[:, None]
        return (actions, log_prob, values, *actor.output_distribution_params)

    @torch.no_grad()
    def _keep(self) -> None:
        storage = self._algorithm.storage
        # A time limit is no end of the task: the value of the next state counts on.
        reward = self._reward + self._algorithm.gamma * self._values * self._timed_out
        rows = [
            (storage.actions, self._actions),
            (storage.rewards, reward),
            (storage.dones, self._done.to(storage.dones.dtype)),
        ]
        rows += [(storage.values, self._values), (storage.actions_log_prob, self._log_prob)]
        rows += [(storage.observations[name], value) for name, value in self._observations.items()]
        rows += zip(storage.distribution_params or (), self._parameters, strict=True)
        for stored, value in rows:
            stored.index_copy_(0, self._slot, value[None])

    @torch.no_grad()
    def _estimate(self) -> None:
        """Estimate advantages (Schulman et al. 2016, equation 16); only their sum is sequential."""
        algorithm, storage = self._algorithm, self._algorithm.storage
        last = algorithm.critic(self._observations)[None]  # type: ignore[arg-type]
        going = 1.0 - storage.dones.float()
        following = torch.cat((storage.values[1:], last))
        errors = storage.rewards + going * algorithm.gamma * following - storage.values
        decay = going * (algorithm.gamma * algorithm.lam)
        advantage = torch.zeros_like(errors[0])
        for step in reversed(range(len(errors))):
            advantage = torch.addcmul(errors[step], decay[step], advantage, out=errors[step])
        storage.returns.copy_(errors + storage.values)
        if not algorithm.normalize_advantage_per_mini_batch:
            errors = (errors - errors.mean()) / (errors.std() + 1e-8)
        storage.advantages.copy_(errors)
