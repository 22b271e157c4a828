"""Fits of actuator networks to recordings, all joints in one batch; their training data are windows of all recordings."""

from __future__ import annotations

import copy
import logging
import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import nn

from actuators.contracts import FitTask
from actuators.identify.option_file import write_option
from actuators.models import checkpoint
from actuators.models.machine_tensors import MachineTensors
from actuators.models.network import JointNetworks, Mlp
from actuators.recordings.inspection import estimate_step
from actuators.recordings.split import COMMANDED, list_sources
from brokk_rl.errors import BrokkError, RecordingError
from brokk_rl.machine import Machine
from brokk_rl.progress import ItemProgress
from brokk_rl.record import Recording
from brokk_rl.spec import Count, Share, spec

log = logging.getLogger(__name__)

VALIDATED = 512
"""Windows on which the weights of a network are chosen."""

BEYOND_DEAD_BAND = 0.1
"""Commands from which increments count for their normalisation."""


@spec
class NetworkFit:
    """Actuator networks, fitted by single steps and then by free runs.

    Attributes:
        name: Name of the model in tables and of its checkpoint.
        width: Units a joint in each of the two hidden layers.
        quiet: Increments up to this size are none (rad or m in a control period); `null`: the noise
            of the resting sensor, estimated from the recordings joint by joint.
        one_step_updates: Updates on single steps, before the free runs.
        one_step_batch: Windows a joint in each of them.
        horizons_s: Horizons of the free runs, one after another; none: single steps only, as in the
            paper.
        updates: Updates at each of the horizons.
        batch: Windows a joint in each of them.
        learning_rate: Of Adam, at the start; falls along a cosine.
        still_share: Part of the windows drawn from all times; most others are times at which the
            joint is commanded.
        average: Decay of the running average of the weights, which is validated and kept.
        validate_every: Updates between two validations.
        validation_s: Horizon of the free run on which the weights are chosen.
        patience: Validations without improvement after which a horizon is given up.
    """

    name: str
    width: Count
    quiet: float | None
    one_step_updates: int
    one_step_batch: Count
    horizons_s: tuple[float, ...]
    updates: int
    batch: Count
    learning_rate: float
    still_share: Share
    average: float
    validate_every: Count
    validation_s: float
    patience: Count

    def fit(self, task: FitTask) -> Mlp:
        """Fit to `train`, keep the best weights on `validation`, write `<name>.safetensors` and `<name>.yaml`.

        Raises:
            RecordingError: too little data.
            StorageError: a file could not be written.
        """
        machine = task.machine
        check_enough(task.train, machine)
        fitting = _NetworkFitting(self, task)
        fitting.run()
        tensors, errors = fitting.result
        facts = {
            "width": self.width,
            "sources": list_sources(task.train),
            "fit": {"horizons_s": self.horizons_s, "seed": task.seed, "device": task.device.type},
            "validation_rmse": dict(zip(machine.joint_names, errors, strict=True)),
        }
        path = task.folder / f"{self.name}.safetensors"
        checkpoint.write_checkpoint(path, "mlp", machine, tensors, facts)
        fitted = Mlp(checkpoint=str(path))
        write_option(task.folder, self.name, fitted, f"fitted to recordings of {machine.name}")
        return fitted


class _NetworkFitting:
    """One fit at work: Adam on free runs, with a running average of the weights, which is validated and kept."""

    def __init__(self, config: NetworkFit, task: FitTask) -> None:
        self._config, self._machine, self._train = config, task.machine, task.train
        self._generator = torch.Generator().manual_seed(task.seed)
        machine, device = task.machine, task.device
        self._device, joints = device, machine.num_joints
        networks = JointNetworks(joints, machine.num_history, config.width, self._generator)
        self._normalise(networks)
        self._networks = networks.to(device)
        self._averaged = copy.deepcopy(self._networks).requires_grad_(False)
        self._plant = MachineTensors(machine, device)
        self._adam = torch.optim.Adam(networks.parameters(), lr=config.learning_rate, fused=True)
        self._kept = {name: value.clone() for name, value in self._averaged.named_parameters()}
        self._best = torch.full((joints,), math.inf, device=device)
        steps, purpose = self._steps(config.validation_s), "held out to stop the fit by"
        held = TrainingWindows(task.validation, machine, steps, device, purpose)
        self._held = held.draw(VALIDATED, 0.2, self._generator)
        self._total = config.one_step_updates + len(config.horizons_s) * config.updates

    def run(self) -> None:
        """Run single steps, then free runs over one horizon after another."""
        config = self._config
        with ItemProgress("fit", self._total) as self._progress:
            self._run_stage(0.0, 0, config.one_step_updates, config.one_step_batch)
            for number, horizon_s in enumerate(config.horizons_s):
                before = config.one_step_updates + number * config.updates
                self._run_stage(horizon_s, before, config.updates, config.batch)

    @property
    def result(self) -> tuple[dict[str, torch.Tensor], list[float]]:
        """The best averaged networks, with normalisation, and each joint's validation error."""
        return {**self._averaged.state_dict(), **self._kept}, self._best.tolist()

    def _run_stage(self, horizon_s: float, before: int, updates: int, batch: int) -> None:
        """Run so many updates over a horizon, after those before, until they gain nothing more."""
        config, stale = self._config, 0
        steps = max(1, self._steps(horizon_s))
        windows = TrainingWindows(self._train, self._machine, steps, self._device)
        for done in range(1, updates + 1):
            number = before + done - 1
            fall = 0.02 + 0.98 * 0.5 * (1.0 + math.cos(math.pi * number / self._total))
            self._adam.param_groups[0]["lr"] = config.learning_rate * fall
            self._update(*windows.draw(batch, config.still_share, self._generator))
            kept = min(config.average, (number + 1.0) / (number + 11.0))
            pairs = zip(self._averaged.parameters(), self._networks.parameters(), strict=True)
            with torch.no_grad():
                for mean, value in pairs:
                    mean.lerp_(value, 1.0 - kept)
            if done % config.validate_every == 0 or done == updates:
                stale = 0 if self._validate() else stale + 1
                note = f"free runs of {horizon_s:g} s, error {self._best.mean().item():.4f}"
                self._progress.reach(number, note=note)
            self._progress.reach(number + 1)
            if stale >= config.patience:
                break

    def _update(self, u: torch.Tensor, q: torch.Tensor) -> None:
        """Descend on windows `(J, B, H + K)`."""
        networks = self._networks
        size = networks.num_history
        scale = networks.increment_scale[:, None, None]
        horizon = q.shape[2] - size
        if horizon == 1:
            # before the dead zone, whose gradient is zero where it acts
            output = networks(networks.inputs(u[..., :size], q[..., :size]))
            moved = (q[..., size] - q[..., size - 1]) / scale[..., 0]
            loss = (output - moved).square().mean(1).sum()
        else:
            ahead = torch.arange(1, horizon + 1, device=q.device)
            # an error that grows with the square root of time counts the same early and late
            error = (self._roll_out(networks, u, q) - q[..., size:]) / scale
            loss = (error.square() / ahead).mean((1, 2)).sum()
        self._adam.zero_grad()
        loss.backward()
        for parameter in networks.parameters():
            # joints are fitted independently: each has its own bound
            assert parameter.grad is not None, "all weights act"
            norm = parameter.grad.flatten(1).norm(dim=1).clamp(min=1.0)
            parameter.grad.div_(norm.view(-1, 1, 1))
        self._adam.step()

    def _roll_out(self, networks: JointNetworks, u: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
        """Return free runs through windows, `(J, B, K)`."""
        begin = q[..., : networks.num_history]
        return networks.roll_out(u[..., :-1], begin, self._plant.lower, self._plant.upper)

    @torch.no_grad()
    def _validate(self) -> bool:
        """Validate the averaged weights by free runs; keep the best of each joint."""
        u, q = self._held
        averaged = self._averaged
        path = self._roll_out(averaged, u, q)
        error = (path - q[..., averaged.num_history :]).square().mean((1, 2)).sqrt()
        if not bool(error.isfinite().all()):
            raise BrokkError("the fit diverged (NaN in the validation); lower fit.learning_rate")
        better = error < self._best
        self._best.copy_(torch.where(better, error, self._best))
        for name, value in averaged.named_parameters():
            self._kept[name].copy_(torch.where(better.view(-1, 1, 1), value, self._kept[name]))
        return bool(better.any())

    def _normalise(self, networks: JointNetworks) -> None:
        """Set the normalisation from training data and machine limits."""
        for joint in range(self._machine.num_joints):
            commands = np.concatenate([r.u[1:, joint] for r in self._train])
            moved = np.concatenate([np.diff(r.q[:, joint]) for r in self._train])
            moved = moved[np.abs(commands) > min(BEYOND_DEAD_BAND, 0.5 * np.abs(commands).max())]
            networks.increment_scale[joint] = max(1e-6, _measure_rms(moved))
            networks.command_scale[joint] = _measure_rms(commands[np.abs(commands) > COMMANDED])
        plant = MachineTensors(self._machine, networks.quiet.device)
        networks.position_center.copy_(plant.middle)
        networks.position_scale.copy_(plant.half_travel)
        quiet = self._config.quiet
        if quiet is None:
            quiet = estimate_resting_noise(self._train, self._machine)
        networks.quiet.copy_(torch.as_tensor(quiet))

    def _steps(self, horizon_s: float) -> int:
        return round(horizon_s / self._machine.period_s)


def _measure_rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))


class TrainingWindows:
    """Windows of `H + K` samples from a set of recordings, joint by joint.

    Args:
        recordings: Where from; no window crosses from one into the next.
        machine: Gives joints and history.
        horizon: Steps to predict, `K`.
        device: Where the tensors live.
        purpose: Their purpose, in error messages.

    Attributes:
        u: Commands of all recordings, `(J, T)`.
        q: Positions of all recordings, `(J, T)`.
        starts: Samples at which a window may begin, `(S,)`.

    Raises:
        RecordingError: no recording is long enough for a single window, or a joint is never
            commanded.
    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        machine: Machine,
        horizon: int,
        device: torch.device,
        purpose: str = "to fit to",
    ) -> None:
        def join(parts: Sequence[np.ndarray]) -> torch.Tensor:
            return torch.cat([torch.as_tensor(part) for part in parts]).T.contiguous().to(device)

        self.u = join([recording.u for recording in recordings])
        self.q = join([recording.q for recording in recordings])
        self.num_history, self.horizon = machine.num_history, horizon
        self._length = machine.num_history + horizon
        starts, begin = [], 0
        for recording in recordings:
            count = max(0, recording.num_samples - self._length + 1)
            starts.append(torch.arange(begin, begin + count))
            begin += recording.num_samples
        self.starts = torch.cat(starts).to(device)
        if not len(self.starts):
            longest = max((recording.num_samples for recording in recordings), default=0)
            raise RecordingError(
                f"too little data: the longest of {len(recordings)} recordings {purpose} has {longest} samples, one window needs "
                f"{self._length} ({machine.num_history} of history and {horizon} to predict)"
            )
        self._moving = []
        for joint, u in zip(machine.joint_names, self.u, strict=True):
            # starts of windows in which the joint is commanded at some time
            count = nn.functional.pad((u.abs() > COMMANDED).cumsum(0), (1, 0))
            found = self.starts[count[self.starts + self._length] > count[self.starts]]
            self._moving.append(found)
            if not len(found):
                raise RecordingError(
                    f"too little data: joint {joint} is never commanded in the {len(recordings)} recordings {purpose}"
                )

    def draw(
        self, batch: int, still_share: float, generator: torch.Generator
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Draw windows for each joint, mostly of times at which it is commanded.

        Args:
            batch: Number of windows drawn a joint.
            still_share: Part drawn from all times instead.
            generator: Draws them.

        Returns:
            Commands and positions, each `(J, B, H + K)`.
        """
        still = round(batch * still_share)
        u, q = [], []
        for joint, moving in enumerate(self._moving):
            index = []
            for places, count in ((self.starts, still), (moving, batch - still)):
                drawn = torch.randint(len(places), (count,), generator=generator)
                index.append(places[drawn.to(places.device)])
            rows = torch.cat(index)
            u.append(self.u[joint].unfold(0, self._length, 1)[rows])
            q.append(self.q[joint].unfold(0, self._length, 1)[rows])
        return torch.stack(u), torch.stack(q)


NEEDED_S = 15.0
"""Commanded time each way below which a fit is refused. Measured with `fit=mlp` on random levels of
the hydraulic plant: with 10 s each way the error of a free run of 5 s is three times that of an
ample fit, no better than a linear model; with 30 s 1.7 times."""
SETTLED = 3
"""Histories without a command after which a joint is at rest: its dead time is over and what swung
has died away."""


def check_enough(recordings: Sequence[Recording], machine: Machine) -> None:
    """Check that each joint is commanded long enough each way.

    Raises:
        RecordingError: a joint is hardly commanded, in figures.
    """
    lacking = []
    forth_s = np.sum([(one.u > COMMANDED).sum(0) / one.rate_hz for one in recordings], 0)
    back_s = np.sum([(one.u < -COMMANDED).sum(0) / one.rate_hz for one in recordings], 0)
    for name, forth, back in zip(machine.joint_names, forth_s, back_s, strict=True):
        if min(forth, back) < NEEDED_S:
            lacking.append(f"{name} {forth / 60:.1f} min forth and {back / 60:.1f} min back")
    if lacking:
        raise RecordingError(
            f"too little data: {'; '.join(lacking)} commanded (|u| > {COMMANDED:g}) in the {len(recordings)} recordings to fit to, "
            f"needed are {NEEDED_S / 60:.2g} min each way. Record more of these joints: small and large commands both ways over "
            "their whole travel (mode=collect)."
        )


def estimate_resting_noise(recordings: Sequence[Recording], machine: Machine) -> np.ndarray:
    """Return the size of increments at rest, rad or m, shape `(J,)`.

    The larger of two: the spread of the increments where the joint has long been without a command
    (68 of 100 are smaller; one standard deviation of normal noise), and the error of an increment
    from the sensor's own step, where it has a visible one: a difference of two values, each off by
    a step over the root of 12, is off by a step over the root of 6.
    """
    wait = SETTLED * machine.num_history
    noise = np.zeros(machine.num_joints)
    for joint, name in enumerate(machine.joint_names):
        still, moving = [], []
        for recording in recordings:
            commanded = np.abs(recording.u[:, joint]) > COMMANDED
            count = np.concatenate([np.zeros(wait), np.cumsum(commanded)])
            quiet = np.cumsum(commanded) == count[: len(commanded)]
            quiet[:wait] = False  # what came before the recording is not known
            q = recording.q[:, joint].astype(np.float64)
            still.append(np.diff(q)[quiet[:-1]])
            moving.append(q[~quiet])
        still, step = np.concatenate(still), estimate_step(np.concatenate(moving))
        noise[joint] = np.nan_to_num(step) / np.sqrt(6.0)
        if len(still):
            noise[joint] = max(noise[joint], float(np.quantile(np.abs(still), 0.68)))
        else:
            text = "%s is never at rest in the recordings to fit to: its drift at rest will not be learned"
            log.warning(text, name)
    return noise
