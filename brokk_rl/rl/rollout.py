"""Acting and storing during a rollout, each as one replay of a CUDA graph instead of some seventy launches."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from rsl_rl.algorithms import PPO

from brokk_rl.rl.graph import capture


class Rollout:
    """Does what `act` and `process_env_step` of `rsl_rl.algorithms.PPO` do, into the algorithm's own storage.

    For feed-forward networks with a Gaussian policy; all tensors keep their addresses. On a CPU the
    same runs without graphs.

    Args:
        algorithm: Gives networks, storage and discount.
    """

    def __init__(self, algorithm: PPO) -> None:
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
        self._act, self._store = self._run(self._decide), self._run(self._keep)

    def act(self, observations: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Returns drawn actions, `(N, A)`; the tensor is overwritten by the next call."""
        for name, value in self._observations.items():
            value.copy_(observations[name])
        self._act()
        return self._actions

    def store(self, reward: torch.Tensor, done: torch.Tensor, timed_out: torch.Tensor) -> None:
        """Stores the step that followed the last `act`; each `(N,)`.

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

    def _run(self, step: Callable[[], None]) -> Callable[[], None]:
        device = self._slot.device
        return capture(step, device).replay if device.type == "cuda" else step

    @torch.no_grad()
    def _decide(self) -> None:
        actor, seen = self._algorithm.actor, self._observations
        actor.distribution.update(actor.mlp(actor.get_latent(seen)))  # type: ignore[union-attr, arg-type]
        mean, std = actor.output_mean, actor.output_std
        # as `Normal.sample`, which asks the host whether the spread is positive and cannot be
        # captured
        self._actions.copy_(mean + std * torch.randn_like(mean))
        self._log_prob[:, 0].copy_(actor.get_output_log_prob(self._actions))
        self._values.copy_(self._algorithm.critic(seen))  # type: ignore[arg-type]
        for kept, value in zip(self._parameters, actor.output_distribution_params, strict=True):
            kept.copy_(value)

    @torch.no_grad()
    def _keep(self) -> None:
        storage = self._algorithm.storage
        reward = (
            self._reward + self._algorithm.gamma * self._values * self._timed_out
        )  # the end of time is not the end
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
