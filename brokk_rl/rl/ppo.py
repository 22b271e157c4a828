"""PPO of rsl-rl, without reading back to the host inside its loops.

rsl-rl reads the divergence and three losses back to the host after each mini-batch. A mini-batch
launches a few hundred small kernels, a control step about seventy. On a GPU that takes longer than
the arithmetic. Here the learning rate and the losses stay on the device. Acting, storing, returns
and a pass over all mini-batches are one replay of a CUDA graph each.

The stored steps are put in the order of the mini-batches once an update, with the inputs of both
networks normalised and padded. rsl-rl does that in every mini-batch of every pass.

Where several processes train together a mini-batch is two graphs. Between them one sum over all
processes takes a single buffer: every gradient and the divergence.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import chain
from typing import Any

import torch
import torch.distributed as dist
from rsl_rl.algorithms import PPO
from rsl_rl.modules.distribution import GaussianDistribution
from tensordict import TensorDict
from torch import nn
from torch.distributions import Normal
from torch.nn.utils import get_total_norm

from brokk_rl.rl.execution import capture_graph, limit_to_one_thread, report_compile_errors
from brokk_rl.rl.rollout import CapturedRollout, pad_columns, run_network

LOWEST_RATE, HIGHEST_RATE, RATE_FACTOR = 1e-5, 1e-2, 1.5
"""Bounds and step of the adaptive learning rate, as in rsl-rl."""
FIGURES = ("value", "surrogate", "entropy")
PARAMETER = "parameter_"
"""Beginning of the names under which samples hold the parameters of the old distribution."""
CLIP_MARGIN = 1e-6
"""Added to a norm that is divided by, as `torch.nn.utils.clip_grad_norm_` does."""


ExampleAction = Callable[[Any], tuple[torch.Tensor, torch.Tensor]]
"""Returns actions for observation groups, and where they follow a path."""


class DevicePPO(PPO):
    """PPO for feed-forward networks with Gaussian actions.

    It learns as rsl-rl's own, up to rounding; a CPU acts on one thread.

    It may follow a teacher: the loss then holds the squared distance of the mean action from the
    teacher's, in the states that the student itself meets (Ross et al. 2011; Schmitt et al. 2018).
    """

    fuse: bool = False
    """True: `torch.compile` fuses acting and the loss. Set it before the first step."""
    _rollout: CapturedRollout | None = None
    _epoch: Sequence[Callable[[], None]] | None = None
    """Steps of one pass over all mini-batches, in their order."""
    _samples: dict[str, torch.Tensor] | None = None
    """Stored steps in the order of the mini-batches; see `shuffle`."""
    _gathered: torch.Tensor
    """Gradients of all parameters, of which `grad` of each is a view, and at the end the
    divergence."""
    _rate: torch.Tensor
    _wanted: torch.Tensor
    """`desired_kl`, which may change from update to update."""
    _sums: torch.Tensor
    _teacher: ExampleAction | None = None
    imitation: Sequence[float] = (0.0, 0.0)
    """Weights of the mean squared distance between the actions of teacher and student, (along a
    path, beside it)."""

    def follow(self, teacher: ExampleAction) -> None:
        """Follow a teacher as far as `imitation` says; call it before the first step.

        Args:
            teacher: See `brokk_rl.contracts.task.TaskProcess.example_action`.
        """
        self._teacher = teacher

    def act(self, obs: TensorDict) -> torch.Tensor:
        """Draw actions; see `rsl_rl.algorithms.PPO.act`."""
        if self._rollout is None:
            # tensors of rsl-rl's inference mode could not be used outside of it
            with torch.inference_mode(False), report_compile_errors():
                self._rollout = CapturedRollout(self, self.fuse)
        with limit_to_one_thread(self.device):
            return self._rollout.act(obs)

    def process_env_step(
        self,
        obs: TensorDict,
        rewards: torch.Tensor,
        dones: torch.Tensor,
        extras: dict[str, torch.Tensor],
    ) -> None:
        """Store a step; see `rsl_rl.algorithms.PPO.process_env_step`."""
        assert self._rollout is not None
        self._rollout.store(rewards, dones, extras.get("time_outs", torch.zeros_like(rewards)))

    def compute_returns(self, obs: TensorDict) -> None:
        """Compute returns and advantages; see `rsl_rl.algorithms.PPO.compute_returns`."""
        assert self._rollout is not None
        self._rollout.compute_returns(obs)

    def update(self) -> dict[str, float]:
        """Learn from the stored steps; return mean losses (`rsl_rl.algorithms.PPO.update`).

        Where a weight is not finite, `weights` stands among the losses.
        """
        order = torch.randperm(self._batch_size() * self.num_mini_batches, device=self.device)
        self.shuffle(order)
        if self._epoch is None:
            self._prepare()
            self._wanted.fill_(self.desired_kl or 0.0)
            with report_compile_errors():
                self._epoch = self._parts()
        self._sums.zero_()
        self._wanted.fill_(self.desired_kl or 0.0)
        for _ in range(self.num_learning_epochs):
            for part in self._epoch:
                part()
        for model in (self.actor, self.critic):
            self._normalise(model)
        self.storage.clear()
        found = torch.cat((self._sums, self._rate[None], self._measure_weights()[None])).tolist()
        self.learning_rate = found[len(FIGURES)]
        updates = self.num_learning_epochs * self.num_mini_batches
        losses = {name: value / updates for name, value in zip(FIGURES, found, strict=False)}
        return losses if math.isfinite(found[-1]) else losses | {"weights": found[-1]}

    @torch.no_grad()
    def _measure_weights(self) -> torch.Tensor:
        """Return the norm of all weights after an update; the host does not wait for it.

        Returns and gradients that are not finite have spoiled the weights.
        """
        weights = chain(self.actor.state_dict().values(), self.critic.state_dict().values())
        return get_total_norm([value for value in weights if value.is_floating_point()])

    def save(self) -> dict[str, Any]:
        """Return the state without device-specific entries, so that any device can load it."""
        saved = super().save()
        optimizer = saved["optimizer_state_dict"]
        plain = {"lr": self.learning_rate, "capturable": False, "fused": None}
        groups = [group | plain for group in optimizer["param_groups"]]
        return saved | {"optimizer_state_dict": optimizer | {"param_groups": groups}}

    def load(self, loaded_dict: dict, load_cfg: dict | None, strict: bool) -> bool:
        """Load a state; the next update captures new graphs for the optimiser's new tensors."""
        self._epoch = None
        return super().load(loaded_dict, load_cfg, strict)

    def _batch_size(self) -> int:
        return self.storage.num_envs * self.storage.num_transitions_per_env // self.num_mini_batches

    def _prepare(self) -> None:
        """Make the tensors that graphs read and write.

        The optimiser reads its rate from one of them.
        """
        self._loss = self._measure_loss
        if self.fuse:
            self._loss = torch.compile(self._measure_loss, fullgraph=True, dynamic=False)
        self._rate = torch.tensor(self.learning_rate, device=self.device)
        self._wanted = torch.zeros((), device=self.device)
        self._sums = torch.zeros(len(FIGURES), device=self.device)
        trained = [
            [p for p in m.parameters() if p.requires_grad] for m in (self.actor, self.critic)
        ]
        self._sizes = [sum(p.numel() for p in part) for part in trained]
        self._trained = [*trained[0], *trained[1]]
        self._gathered = torch.zeros(sum(self._sizes) + 1, device=self.device)
        parts = self._gathered[:-1].split([p.numel() for p in self._trained])
        for parameter, part in zip(self._trained, parts, strict=True):
            parameter.grad = part.view_as(parameter)
        on_gpu = torch.device(self.device).type == "cuda"
        for group in self.optimizer.param_groups:
            group.update(lr=self._rate, capturable=on_gpu, fused=on_gpu or None)
        for state in self.optimizer.state.values():  # loaded for a host that counts steps itself
            if on_gpu:
                state["step"] = state["step"].to(self.device, torch.float32)

    def _parts(self) -> Sequence[Callable[[], None]]:
        """Return the parts of a pass over all mini-batches, captured on a GPU.

        The calls before the capture leave no trace.
        """
        device = torch.device(self.device)
        starts = range(0, self._batch_size() * self.num_mini_batches, self._batch_size())
        if device.type != "cuda":
            parts: list[Callable[[], None]] = []
            for first in starts:
                parts += [partial(self._differentiate, first)]
                parts += [self._sum_up, self._descend] if self.is_multi_gpu else [self._descend]
            return parts
        kept = [(value, value.detach().clone()) for value in (*self._trained, self._rate)]
        moments = [(value, value.clone()) for value in self._list_moments()]
        captured: list[Callable[[], None]] = []
        if self.is_multi_gpu:
            # the sum stays outside: it is the one part whose length others decide
            for first in starts:
                part = partial(self._differentiate, first)
                captured += [capture_graph(part, device, gradients=True).replay, self._sum_up]
                captured += [lambda: descend.replay()]
            descend = capture_graph(self._descend, device, gradients=True)
        else:

            def learn() -> None:
                for first in starts:
                    self._differentiate(first)
                    self._descend()

            captured += [capture_graph(learn, device, gradients=True).replay]
        with torch.no_grad():
            for value, before in kept + moments:
                value.copy_(before)
            if not moments:  # a fresh optimiser made them meanwhile
                for value in self._list_moments():
                    value.zero_()
        return captured

    def _list_moments(self) -> list[torch.Tensor]:
        states = self.optimizer.state.values()
        return list(chain.from_iterable(state.values() for state in states))

    def _normalise(self, model: nn.Module) -> None:
        """Update a model's normalisation in place.

        rsl-rl binds a new tensor, which the graph would not see.
        """
        before = dict(model.named_buffers())
        model.update_normalization(self.storage.observations.flatten(0, 1))  # type: ignore[operator]
        for path, value in list(model.named_buffers()):
            owner, _, name = path.rpartition(".")
            module = model.get_submodule(owner)
            module._buffers[name] = before[path].copy_(value)

    @torch.no_grad()
    def shuffle(self, order: torch.Tensor) -> None:
        """Put the stored steps in `order`, the inputs of the networks ready for use.

        Normalisers and teacher do not change while a rollout is learned.
        """
        storage, num = self.storage, len(order)
        observations: Any = storage.observations.flatten(0, 1)[order]
        samples = {}
        if self._teacher is not None:
            samples["wanted"], samples["imitation"] = self._imitate(self._teacher, observations)
        names = ("actions", "values", "returns", "advantages")
        stored = {name: getattr(storage, name) for name in names}
        stored["log_prob"] = storage.actions_log_prob
        for index, value in enumerate(storage.distribution_params or ()):
            stored[f"{PARAMETER}{index}"] = value
        for name, value in stored.items():
            samples[name] = value.flatten(0, 1)[order]
        models = {"actor": self.actor, "critic": self.critic}
        if self._samples is None:
            kind = torch.bfloat16 if self.use_mixed_precision else torch.float32
            self._samples = dict(samples)
            for name, model in models.items():
                shape = (num, model.obs_dim)
                self._samples[name] = pad_columns(order.new_zeros(shape, dtype=kind))
        for name, value in samples.items():
            self._samples[name].copy_(value)
        for name, model in models.items():
            self._samples[name][:, : model.obs_dim].copy_(model.get_latent(observations))

    def _imitate(self, teacher: ExampleAction, seen: Any) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the teacher's actions, `(M, A)`, and the weights of the distances, `(M, 1)`.

        A teacher without weight is not asked: it costs a twentieth of a CPU's time.
        """
        along, beside = self.imitation
        if max(along, beside) == 0.0:
            nothing = torch.zeros(len(seen), self.storage.actions.shape[-1], device=self.device)
            return nothing, nothing[:, :1]
        wanted, is_along = teacher(seen)
        return wanted.clamp(-1.0, 1.0), torch.where(is_along, along, beside)[:, None]

    def _differentiate(self, first: int) -> None:
        """Differentiate the loss of the mini-batch that begins at row `first` of the samples."""
        rows = slice(first, first + self._batch_size())
        batch = {name: value[rows] for name, value in (self._samples or {}).items()}
        loss, figures = self._loss(batch)
        gradients = torch.autograd.grad(loss, self._trained, materialize_grads=True)
        torch.cat([*(g.flatten() for g in gradients), figures[-1:]], out=self._gathered)
        self._sums.add_(figures[:-1])

    def _measure_loss(self, batch: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the loss of a mini-batch, and `FIGURES` with the divergence at the end.

        Schulman et al. 2017, equations 7 and 9, with the weights of rsl-rl.
        """
        actor = self.actor
        old_values, returns, advantages, old_log_prob = (
            batch[name] for name in ("values", "returns", "advantages", "log_prob")
        )
        if self.normalize_advantage_per_mini_batch:
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        # not by calling the actor: that would draw actions, and torch's check of their spread asks
        # the host
        mixed = self.use_mixed_precision
        actor.distribution.update(run_network(actor.mlp, batch["actor"], mixed))  # type: ignore
        log_prob = actor.get_output_log_prob(batch["actions"])
        entropy = actor.output_entropy.mean()
        values = run_network(self.critic.mlp, batch["critic"], mixed)
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
        with torch.no_grad():
            new = actor.output_distribution_params
            old = tuple(batch[f"{PARAMETER}{index}"] for index in range(len(new)))
            divergence = _measure_divergence(old, new)
        if self._teacher is not None:
            distance = (actor.output_mean - batch["wanted"]).square()
            loss = loss + (batch["imitation"] * distance).mean()
        return loss, torch.stack((value_loss, surrogate_loss, entropy, divergence)).detach()

    def _sum_up(self) -> None:
        """Add up gradients and divergence of all processes; the host does not wait for it."""
        dist.all_reduce(self._gathered)

    def _descend(self) -> None:
        """Take one step of the optimiser along the mean gradient of all processes."""
        if self.is_multi_gpu:
            self._gathered.div_(self.gpu_world_size)
        if self.desired_kl is not None and self.schedule == "adaptive":
            self._adapt_rate(self._gathered[-1])
        for part in self._gathered[:-1].split(self._sizes):  # of the actor, of the critic
            part.mul_((self.max_grad_norm / (part.norm() + CLIP_MARGIN)).clamp(max=1.0))
        self.optimizer.step()

    def _adapt_rate(self, divergence: torch.Tensor) -> None:
        """Raise the learning rate where the policy moves too little, lower it where too much.

        `desired_kl` is the divergence of an update to aim at.
        """
        lower = (self._rate / RATE_FACTOR).clamp(min=LOWEST_RATE)
        higher = (self._rate * RATE_FACTOR).clamp(max=HIGHEST_RATE)
        too_near = (divergence < self._wanted / 2.0) & (divergence > 0.0)
        rate = torch.where(too_near, higher, self._rate)
        self._rate.copy_(torch.where(divergence > self._wanted * 2.0, lower, rate))


def _measure_divergence(
    old: tuple[torch.Tensor, ...], new: tuple[torch.Tensor, ...]
) -> torch.Tensor:
    """Return the mean divergence of two Gaussians, given by mean and spread each.

    In closed form: torch finds it by a search that torch 2.11 cannot compile.
    """
    (old_mean, old_std), (new_mean, new_std) = old, new
    spread, shift = (old_std / new_std).square(), ((old_mean - new_mean) / new_std).square()
    return (0.5 * (spread + shift - 1.0 - spread.log())).sum(-1).mean()


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
