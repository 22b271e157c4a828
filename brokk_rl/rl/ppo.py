"""PPO of rsl-rl, without reading back to the host inside its loops.

rsl-rl reads the divergence and three losses back to the host after each mini-batch. A mini-batch
launches a few hundred small kernels, a control step about seventy. On a GPU that takes longer than
the arithmetic. Here the learning rate and the losses stay on the device. Acting, storing and a
mini-batch are one replay of a CUDA graph each.

Where several processes train together a mini-batch is two graphs. Between them one sum over all
processes takes a single buffer: every gradient and the divergence.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from typing import Any

import torch
import torch.distributed as dist
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution
from tensordict import TensorDict
from torch import nn

from brokk_rl.rl.execution import capture_graph, limit_to_one_thread
from brokk_rl.symmetry import Mirror


class CapturedRollout:
    """Acting and storing as `rsl_rl.algorithms.PPO` does them, into the algorithm's own storage.

    Each is one replay of a CUDA graph.

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

    def _run(self, step: Callable[[], None]) -> Callable[[], None]:
        device = self._slot.device
        return capture_graph(step, device).replay if device.type == "cuda" else step

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


LOWEST_RATE, HIGHEST_RATE, RATE_FACTOR = 1e-5, 1e-2, 1.5
"""Bounds and step of the adaptive learning rate, as in rsl-rl."""
FIGURES = ("value", "surrogate", "entropy")


class DevicePPO(PPO):
    """PPO for feed-forward networks.

    On a CPU, without teacher and mirror, it is rsl-rl's own, which acts on one thread.

    It may follow a teacher: the loss then holds the squared distance of the mean action from the
    teacher's, in the states that the student itself meets (Ross et al. 2011; Schmitt et al. 2018).
    """

    _rollout: CapturedRollout | None = None
    _mini_batch: Sequence[Callable[[], None]] | None = None
    """What one step of the optimiser consists of."""
    _gathered: torch.Tensor
    """Gradients of all parameters, of which `grad` of each is a view, and at the end the
    divergence."""
    _rows: torch.Tensor
    _advantages: torch.Tensor
    _rate: torch.Tensor
    _wanted: torch.Tensor
    """`desired_kl`, which may change from update to update."""
    _sums: torch.Tensor
    _teacher: MLPModel | None = None
    _mirror: Mirror | None = None
    _imitation: torch.Tensor
    """Weight of the distance from the teacher."""

    def follow(self, teacher: MLPModel) -> None:
        """Follow a teacher, with weight 0 until `set_imitation`; call it before the first step."""
        self._teacher = teacher.requires_grad_(False)
        self._imitation = torch.zeros((), device=self.device)

    def use_mirror(self, mirror: Mirror) -> None:
        """Learn from each step and its mirror image; call it before the first step.

        As rsl-rl's data augmentation (Mittal et al. 2024): advantage, return and old probability are
        those of the step itself; divergence and entropy count the steps alone.
        """
        self._mirror = mirror

    def set_imitation(self, weight: float) -> None:
        """Set the weight of the mean squared distance between the actions of both."""
        self._imitation.fill_(weight)

    def act(self, obs: TensorDict) -> torch.Tensor:
        """Draw actions; see `rsl_rl.algorithms.PPO.act`."""
        if not (self._on_device and isinstance(self.actor.distribution, GaussianDistribution)):
            with limit_to_one_thread(self.device):
                return super().act(obs)
        self._rollout = self._rollout or CapturedRollout(self)
        return self._rollout.act(obs)

    def process_env_step(
        self,
        obs: TensorDict,
        rewards: torch.Tensor,
        dones: torch.Tensor,
        extras: dict[str, torch.Tensor],
    ) -> None:
        """Store a step; see `rsl_rl.algorithms.PPO.process_env_step`."""
        if self._rollout is None:
            with limit_to_one_thread(self.device):
                super().process_env_step(obs, rewards, dones, extras)
        else:
            self._rollout.store(rewards, dones, extras.get("time_outs", torch.zeros_like(rewards)))

    def update(self) -> dict[str, float]:
        """Learn from the stored steps; return mean losses (`rsl_rl.algorithms.PPO.update`)."""
        return self.update_on_device() if self._on_device else super().update()

    def update_on_device(self) -> dict[str, float]:
        """Learn as `update` does, with one read-back; the same numbers up to rounding."""
        storage = self.storage
        used = self._batch_size() * self.num_mini_batches
        order = torch.randperm(used, device=self.device)
        fresh = self._mini_batch is None
        if fresh:
            self._prepare()
        self._advantages.copy_(storage.advantages)
        if fresh:
            self._rows.copy_(order[: len(self._rows)])
            self._mini_batch = self._parts()
        self._sums.zero_()
        self._wanted.fill_(self.desired_kl or 0.0)
        for _ in range(self.num_learning_epochs):
            for rows in order.split(len(self._rows)):
                self._rows.copy_(rows)
                for part in self._mini_batch or ():
                    part()
        for model in (self.actor, self.critic):
            self._normalise(model)
        storage.clear()
        *sums, self.learning_rate = torch.cat((self._sums, self._rate[None])).tolist()
        updates = self.num_learning_epochs * self.num_mini_batches
        return {name: value / updates for name, value in zip(FIGURES, sums, strict=True)}

    def save(self) -> dict[str, Any]:
        """Return the state without device-specific entries, so that any device can load it."""
        saved = super().save()
        optimizer = saved["optimizer_state_dict"]
        plain = {"lr": self.learning_rate, "capturable": False, "fused": None}
        return saved | {
            "optimizer_state_dict": optimizer
            | {"param_groups": [g | plain for g in optimizer["param_groups"]]}
        }

    def load(self, loaded_dict: dict, load_cfg: dict | None, strict: bool) -> bool:
        """Load a state; the next update captures new graphs for the optimiser's new tensors."""
        self._mini_batch = None
        return super().load(loaded_dict, load_cfg, strict)

    @property
    def _on_device(self) -> bool:
        plain = not (
            self.rnd or self.symmetry or self.actor.is_recurrent or self.critic.is_recurrent
        )
        # rsl-rl's own loss knows neither
        own = self._teacher is not None or self._mirror is not None
        return plain and (torch.device(self.device).type == "cuda" or own)

    def _batch_size(self) -> int:
        return self.storage.num_envs * self.storage.num_transitions_per_env // self.num_mini_batches

    def _prepare(self) -> None:
        """Make the tensors that graphs read and write.

        The optimiser reads its rate from one of them.
        """
        self._rows = torch.zeros(self._batch_size(), dtype=torch.int64, device=self.device)
        self._advantages = torch.zeros_like(self.storage.values)
        self._rate = torch.tensor(self.learning_rate, device=self.device)
        self._wanted = torch.zeros((), device=self.device)
        self._sums = torch.zeros(len(FIGURES), device=self.device)
        parameters = list(chain(self.actor.parameters(), self.critic.parameters()))
        self._gathered = torch.zeros(sum(p.numel() for p in parameters) + 1, device=self.device)
        for parameter, part in zip(
            parameters, self._gathered[:-1].split([p.numel() for p in parameters]), strict=True
        ):
            parameter.grad = part.view_as(parameter)
        on_gpu = torch.device(self.device).type == "cuda"
        for group in self.optimizer.param_groups:
            group.update(lr=self._rate, capturable=on_gpu, fused=on_gpu or None)
        for state in self.optimizer.state.values():  # loaded for a host that counts steps itself
            if on_gpu:
                state["step"] = state["step"].to(self.device, torch.float32)

    def _parts(self) -> Sequence[Callable[[], None]]:
        """Return the parts of a mini-batch, captured on a GPU.

        The calls before the capture leave no trace.
        """
        device = torch.device(self.device)
        if device.type != "cuda":
            return (
                (self._differentiate, self._sum_up, self._descend)
                if self.is_multi_gpu
                else (self._differentiate_and_descend,)
            )
        parameters = [*self.actor.parameters(), *self.critic.parameters()]
        kept = [(p, p.detach().clone()) for p in parameters] + [(self._rate, self._rate.clone())]
        moments = [
            (value, value.clone())
            for state in self.optimizer.state.values()
            for value in state.values()
        ]
        if (
            self.is_multi_gpu
        ):  # the sum stays outside: it is the one part whose length others decide
            graphs = []
            for part in (self._differentiate, self._descend):
                graphs.append(capture_graph(part, device, gradients=True))
            captured = (graphs[0].replay, self._sum_up, graphs[1].replay)
        else:
            captured = (
                capture_graph(self._differentiate_and_descend, device, gradients=True).replay,
            )
        with torch.no_grad():
            for value, before in kept + moments:
                value.copy_(before)
            if not moments:  # a fresh optimiser made them meanwhile
                for state in self.optimizer.state.values():
                    for value in state.values():
                        value.zero_()
        return captured

    def _normalise(self, model: nn.Module) -> None:
        """Update a model's normalisation in place.

        rsl-rl binds a new tensor, which the graph would not see.
        """
        held = [
            (module, name, value)
            for module in model.modules()
            for name, value in module._buffers.items()
        ]
        model.update_normalization(self.storage.observations.flatten(0, 1))  # type: ignore[operator]
        for module, name, value in held:
            if value is not None and module._buffers[name] is not value:
                module._buffers[name] = value.copy_(module._buffers[name])  # type: ignore[arg-type]

    def _differentiate_and_descend(self) -> None:
        self._differentiate()
        self._descend()

    def _differentiate(self) -> None:
        """Differentiate the loss of the stored steps `_rows`.

        Schulman et al. 2017, equations 7 and 9, with the weights of rsl-rl.
        """
        storage, rows = self.storage, self._rows
        observations = {}
        for name, value in storage.observations.items():
            observations[name] = value.flatten(0, 1)[rows]
        old_values, returns, advantages, old_log_prob, actions = (
            value.flatten(0, 1)[rows]
            for value in (
                storage.values,
                storage.returns,
                self._advantages,
                storage.actions_log_prob,
                storage.actions,
            )
        )
        parameters = []
        for value in storage.distribution_params or ():
            parameters.append(value.flatten(0, 1)[rows])
        old_parameters = tuple(parameters)
        if self.normalize_advantage_per_mini_batch:
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        own, mirror = len(rows), self._mirror
        if mirror is not None:
            for name, value in observations.items():
                observations[name] = torch.cat((value, mirror.apply(name, value)))
            actions = torch.cat((actions, actions * mirror.action))
            old_values, returns, advantages, old_log_prob = (
                torch.cat((value, value))
                for value in (old_values, returns, advantages, old_log_prob)
            )
        kind = torch.device(self.device).type
        with torch.autocast(
            device_type=kind, dtype=torch.bfloat16, enabled=self.use_mixed_precision
        ):
            # not by calling the actor: that would draw actions, and torch's check of their spread
            # asks the host
            self.actor.distribution.update(self.actor.mlp(self.actor.get_latent(observations)))  # type: ignore
            log_prob, entropy = (
                self.actor.get_output_log_prob(actions),
                self.actor.output_entropy[:own].mean(),
            )
            values = self.critic(observations)  # type: ignore[arg-type]
            if self._is_adaptive:
                with torch.no_grad():
                    new_parameters = tuple(
                        value[:own] for value in self.actor.output_distribution_params
                    )
                    divergence = self.actor.get_kl_divergence(old_parameters, new_parameters).mean()
            ratio = torch.exp(log_prob - old_log_prob.squeeze(1))
            gain = advantages.squeeze(1)
            clipped = ratio.clamp(1.0 - self.clip_param, 1.0 + self.clip_param)
            surrogate_loss = torch.max(-gain * ratio, -gain * clipped).mean()
            value_loss = (values - returns).square()
            if self.use_clipped_value_loss:
                near = old_values + (values - old_values).clamp(-self.clip_param, self.clip_param)
                value_loss = torch.max(value_loss, (near - returns).square())
            value_loss = value_loss.mean()
            loss = surrogate_loss + self.value_loss_coef * value_loss - self.entropy_coef * entropy
        if self._teacher is not None:
            loss = loss + self._imitation * self._measure_distance(self._teacher, observations)
        self._gathered.zero_()
        loss.backward()
        if self._is_adaptive:
            self._gathered[-1] = divergence
        self._sums.add_(torch.stack((value_loss, surrogate_loss, entropy)).detach())

    def _measure_distance(
        self, teacher: MLPModel, observations: dict[str, torch.Tensor]
    ) -> torch.Tensor:
        """Return the mean squared distance of the mean action from the teacher's command."""
        with torch.no_grad():
            wanted = teacher.mlp(teacher.get_latent(observations))  # type: ignore[arg-type]
        return (self.actor.output_mean - wanted.clamp(-1.0, 1.0)).square().mean()

    def _sum_up(self) -> None:
        """Add up gradients and divergence of all processes; the host does not wait for it."""
        dist.all_reduce(self._gathered)

    def _descend(self) -> None:
        """Take one step of the optimiser along the mean gradient of all processes."""
        if self.is_multi_gpu:
            self._gathered.div_(self.gpu_world_size)
        if self._is_adaptive:
            self._adapt_rate(self._gathered[-1])
        nn.utils.clip_grad_norm_(self.actor.parameters(), self.max_grad_norm)
        nn.utils.clip_grad_norm_(self.critic.parameters(), self.max_grad_norm)
        self.optimizer.step()

    @property
    def _is_adaptive(self) -> bool:
        return self.desired_kl is not None and self.schedule == "adaptive"

    def _adapt_rate(self, divergence: torch.Tensor) -> None:
        """Raise the learning rate where the policy moves too little, lower it where too much.

        `desired_kl` is the divergence of an update to aim at.
        """
        lower, higher = (
            (self._rate / RATE_FACTOR).clamp(min=LOWEST_RATE),
            (self._rate * RATE_FACTOR).clamp(max=HIGHEST_RATE),
        )
        too_near = (divergence < self._wanted / 2.0) & (divergence > 0.0)
        rate = torch.where(
            divergence > self._wanted * 2.0, lower, torch.where(too_near, higher, self._rate)
        )
        self._rate.copy_(rate)
