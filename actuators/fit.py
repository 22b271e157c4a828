"""Fits the actuator networks to recordings, all joints in one batch."""

import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from rich.progress import Progress

from actuators import checkpoint
from actuators.dataset import Windows
from actuators.mlp import Mlp
from actuators.network import JointNetworks
from brokk_rl.errors import BrokkError, ConfigError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.spec import spec

log = logging.getLogger(__name__)


@spec
class MlpFit:
    """The paper's networks, fitted by free runs over growing horizons (`rollout`) or step by step as in the paper (`one_step`).

    Attributes:
        name: Name of the model in tables and of its checkpoint.
        loss: `rollout` or `one_step`.
        width: Units in each of the two hidden layers.
        quiet: Increments up to this size are none (rad or m in a control period); about the noise of the measurement.
        one_step_updates: Updates on single steps, before the free runs.
        one_step_batch: Windows a joint in each of them.
        horizons_s: Horizons of the free runs, one after another.
        updates: Updates at each of the horizons.
        batch: Windows a joint in each of them.
        learning_rate: Of Adam, at the start; falls along a cosine.
        still_share: Part of the windows drawn from all times, the others are times at which the joint is commanded.
        average: Decay of the running average of the weights, which is what is validated and kept.
        validate_every: Updates between two validations.
        validation_s: Horizon of the free run on which the weights are chosen.
        patience: Validations without improvement after which a horizon is given up.
    """

    name: str
    loss: Literal["rollout", "one_step"]
    width: int
    quiet: float
    one_step_updates: int
    one_step_batch: int
    horizons_s: tuple[float, ...]
    updates: int
    batch: int
    learning_rate: float
    still_share: float
    average: float
    validate_every: int
    validation_s: float
    patience: int

    def check(self) -> None:
        if self.loss == "rollout" and not self.horizons_s:
            raise ConfigError("fit.horizons_s: loss=rollout needs at least one horizon")
        if min(self.width, self.batch, self.one_step_batch, self.validate_every, self.patience) < 1:
            raise ConfigError("fit: width, batches, validate_every and patience must be 1 or more")

    def fit(
        self,
        machine: Machine,
        train: Sequence[Recording],
        validation: Sequence[Recording],
        folder: Path,
        seed: int,
        device: torch.device,
    ) -> Mlp:
        """Fits to `train`, keeps the weights that run freely best on `validation`, writes `<name>.safetensors` into `folder`.

        Raises:
            RecordingError: too little data.
            StorageError: the checkpoint could not be written.
        """
        began = time.monotonic()
        generator = torch.Generator().manual_seed(seed)
        networks = JointNetworks(machine.num_joints, machine.num_history, self.width, generator).to(device)
        fitting = _Fitting(self, networks, machine, train, validation, generator, device)
        fitting.run()
        facts = {
            "width": self.width,
            "data": {
                "recordings": len(train),
                "minutes": round(sum(recording.duration_s for recording in train) / 60.0, 1),
                "sources": sorted({recording.metadata.get("source", "unknown") for recording in train}),
            },
            "fit": {
                "loss": self.loss,
                "seed": seed,
                "seconds": round(time.monotonic() - began, 1),
                "validation_rmse": dict(zip(machine.joint_names, fitting.best.tolist(), strict=True)),
                "validation_s": self.validation_s,
            },
        }
        path = folder / f"{self.name}.safetensors"
        checkpoint.write(path, "mlp", machine, networks.state_dict(), facts)
        return Mlp(checkpoint=str(path))


class _Fitting:
    """One fit at work."""

    def __init__(
        self,
        config: MlpFit,
        networks: JointNetworks,
        machine: Machine,
        train: Sequence[Recording],
        validation: Sequence[Recording],
        generator: torch.Generator,
        device: torch.device,
    ) -> None:
        self._config, self._networks, self._generator = config, networks, generator
        self._machine, self._train, self._device = machine, train, device
        self._lower = torch.as_tensor(machine.lower, dtype=torch.float32, device=device)
        self._upper = torch.as_tensor(machine.upper, dtype=torch.float32, device=device)
        self._normalise(Windows(train, machine, 1, device))
        held = Windows(validation, machine, self._steps(config.validation_s), device, "held out to stop the fit by")
        self._held = held.draw(512, 0.2, torch.Generator().manual_seed(0))
        self._average = {name: value.detach().clone() for name, value in networks.named_parameters()}
        self._kept = {name: value.clone() for name, value in self._average.items()}
        self.best = np.full(machine.num_joints, np.inf)
        self._done = 0

    def run(self) -> None:
        """Fits, and leaves the best averaged weights in the networks."""
        config = self._config
        stages = [(0.0, config.one_step_updates, config.one_step_batch)]
        if config.loss == "rollout":
            stages += [(horizon_s, config.updates, config.batch) for horizon_s in config.horizons_s]
        total = sum(updates for _, updates, _ in stages)
        optimiser = torch.optim.Adam(self._networks.parameters(), lr=config.learning_rate)
        with Progress(transient=True) as progress:
            task = progress.add_task("fit", total=total)
            for horizon_s, updates, batch in stages:
                windows = Windows(self._train, self._machine, max(1, self._steps(horizon_s)), self._device)
                stale = 0
                for update in range(updates):
                    done = progress.tasks[task].completed / total
                    for group in optimiser.param_groups:
                        group["lr"] = config.learning_rate * (0.02 + 0.98 * 0.5 * (1.0 + np.cos(np.pi * done)))
                    self._update(optimiser, windows, batch)
                    progress.advance(task)
                    if (update + 1) % config.validate_every == 0 or update + 1 == updates:
                        stale = 0 if self._validate() else stale + 1
                        progress.update(task, description=f"fit, {horizon_s:g} s, error {np.mean(self.best):.4f}")
                        if stale >= config.patience:
                            progress.advance(task, updates - update - 1)
                            break
        self._load(self._kept)

    def _update(self, optimiser: torch.optim.Optimizer, windows: Windows, batch: int) -> None:
        u, q = windows.draw(batch, self._config.still_share, self._generator)
        size, networks = self._machine.num_history, self._networks
        scale = networks.increment_scale[:, None, None]
        if windows.horizon == 1:
            # before the dead zone, whose gradient is zero where it acts
            output = networks(networks.inputs(u[..., :size], q[..., :size]))
            loss = (output - (q[..., size] - q[..., size - 1]) / scale[..., 0]).square().mean(1).sum()
        else:
            path = networks.roll_out(u[..., :-1], q[..., :size], self._lower, self._upper)
            ahead = torch.arange(1, windows.horizon + 1, device=u.device)
            # an error that grows with the square root of time counts the same early and late
            loss = (((path - q[..., size:]) / scale).square() / ahead).mean((1, 2)).sum()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        # joints are fitted independently: each has its own bound
        for group in self._networks.parameters():
            if group.grad is not None:
                norm = group.grad.flatten(1).norm(dim=1).clamp(min=1e-12)
                group.grad.mul_((1.0 / norm).clamp(max=1.0).view(-1, 1, 1))
        optimiser.step()
        self._done += 1
        decay = min(self._config.average, self._done / (self._done + 10.0))
        with torch.no_grad():
            for name, value in networks.named_parameters():
                self._average[name].lerp_(value, 1.0 - decay)

    @torch.no_grad()
    def _validate(self) -> bool:
        """Runs the averaged weights freely on unseen recordings; keeps, joint by joint, the best so far."""
        present = {name: value.detach().clone() for name, value in self._networks.named_parameters()}
        self._load(self._average)
        u, q = self._held
        size = self._machine.num_history
        path = self._networks.roll_out(u[..., :-1], q[..., :size], self._lower, self._upper)
        error = (path - q[..., size:]).square().mean((1, 2)).sqrt().cpu().numpy()
        if not np.isfinite(error).all():
            raise BrokkError("the fit diverged (NaN in the validation); lower fit.learning_rate")
        better = error < self.best
        self.best = np.where(better, error, self.best)
        rows = torch.as_tensor(better, device=self._device)
        for name, kept in self._kept.items():
            kept.copy_(torch.where(rows.view(-1, 1, 1), self._average[name], kept))
        self._load(present)
        return bool(better.any())

    @torch.no_grad()
    def _load(self, values: dict[str, torch.Tensor]) -> None:
        for name, value in self._networks.named_parameters():
            value.copy_(values[name])

    def _normalise(self, windows: Windows) -> None:
        """Sets the normalisation from the training data (increments, commands) and from the machine (positions)."""
        networks = self._networks
        increments = windows.q[:, 1:] - windows.q[:, :-1]
        moving = windows.u[:, 1:].abs() > 0.1
        for joint in range(len(increments)):
            moved = increments[joint][moving[joint]]
            moved = moved[moved.abs() < moved.abs().median() * 20.0 + 1e-9]  # without the jumps from one recording to the next
            networks.increment_scale[joint] = moved.square().mean().sqrt().clamp(min=1e-6)
            networks.command_scale[joint] = windows.u[joint][windows.u[joint].abs() > 0.02].square().mean().sqrt()
        networks.position_center.copy_((self._lower + self._upper) / 2.0)
        networks.position_scale.copy_((self._upper - self._lower) / 2.0)
        networks.quiet.fill_(self._config.quiet)

    def _steps(self, horizon_s: float) -> int:
        return round(horizon_s / self._machine.period_s)
