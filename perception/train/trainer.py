"""Training of the segmenter on any device; the best network by unseen frames is kept."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from annotated_types import Ge

from brokk_rl.errors import CheckpointError, ConfigError
from brokk_rl.progress import ItemProgress
from brokk_rl.session import Session
from brokk_rl.spec import Count, Positive, spec
from perception.segment import unet
from perception.segment.network import LEAST_BLOCK, THRESHOLD, find_weights
from perception.segment.unet import UNet, compute_loss, read_checkpoint
from perception.segment.window import center_window, cover_picture
from perception.train import samples as training_data
from perception.train.samples import (
    LOOKS,
    PICTURES,
    ROOM,
    Augmentation,
    Crop,
    Samples,
    TrainingViews,
)

BATCH = 32


def crop_segmenter_views(
    views: TrainingViews, size_px: tuple[int, int]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the segmenter's pictures, `(F, 2, 3, h, w)` uint8, and their masks, `(F, 2, 2, h, w)`."""
    width, height = size_px
    full = tuple(views.layers.shape[3:])
    height_px, width_px = full
    beside = 0.5 * (1.0 - 1.0 / ROOM)
    room = (width_px * beside, height_px * beside, width_px / ROOM, height_px / ROOM)
    seen = np.empty((len(views), len(LOOKS), 5, height, width), np.uint8)
    windows = cover_picture(full, size_px), center_window(room, size_px, 0.0)
    for look, window in enumerate(windows):
        for frame in range(len(views)):
            layers = views.layers[frame, look].numpy().transpose(1, 2, 0)
            for part in (slice(0, 3), slice(3, 5)):
                taken = window.take(np.ascontiguousarray(layers[..., part]), size_px)
                seen[frame, look, part] = taken.transpose(2, 0, 1)
    layers = torch.from_numpy(seen)
    return layers[:, :, :3], layers[:, :, 3:] > 127


@torch.no_grad()
def predict(network: UNet, pictures: torch.Tensor, device: torch.device) -> torch.Tensor:
    """Return probabilities, `(F, 2, 2, h, w)` on the CPU, for pictures `(F, 2, 3, h, w)` uint8."""
    network.eval()
    flat, found = pictures.flatten(0, 1), []
    for first in range(0, len(flat), BATCH):
        batch = flat[first : first + BATCH].to(device).float() / 255.0
        found.append(torch.sigmoid(network(batch)).float().cpu())
    return torch.cat(found).unflatten(0, pictures.shape[:2])


def compute_metrics(
    probabilities: torch.Tensor, known: torch.Tensor, conditions: Sequence[str]
) -> dict[str, dict[str, Any]]:
    """Return figures for each condition, and for all frames under `all`.

    `block`: intersection over union of the block, seen as a whole. `mouth`: that of mouths, in the
    closer view; both over all pixels of all frames, `None` where there is nothing to find.
    `frames`: how many.
    """
    said = probabilities > THRESHOLD
    block, mouth = (said[:, 0, 0], known[:, 0, 0]), (said[:, 1, 1], known[:, 1, 1])
    table = {}
    for name in ("all", *sorted(set(conditions))):
        chosen = np.array([name in ("all", condition) for condition in conditions])
        index = torch.from_numpy(chosen)
        table[name] = {
            "block": _compute_iou(block[0][index], block[1][index]),
            "mouth": _compute_iou(mouth[0][index], mouth[1][index]),
            "frames": int(chosen.sum()),
        }
    return table


def _compute_iou(said: torch.Tensor, known: torch.Tensor) -> float | None:
    return float((said & known).sum() / (said | known).sum()) if known.any() else None


log = logging.getLogger(__name__)


@spec
class SegmenterTraining:
    """Fits a U-Net to frames with masks.

    Attributes:
        frames: Folder, or list of folders, of frames with masks, those below them too.
        negatives: Folder, or list of folders, of pictures without a block, such as photographs;
            one in `hold_out` is judged by. `null` for none.
        validation: Folders to judge by; `null` sets a part of `frames` aside.
        hold_out: Without `validation`, one part in so many is kept from the training: a run of
            frames at the end.
        size_px: Width and height of the network's picture.
        widths: Channels of the network at each size, the full picture first.
        start: Checkpoint whose weights it begins with, to go on with other frames: a path, or the
            name of one that ships with the package; `null` begins with chance.
        updates: Steps of the optimiser.
        max_seconds: It ends after as many seconds too; `null` for no such end. The result then
            depends on the speed of the machine.
        batch: Samples a step.
        rate: Learning rate at its highest; it rises for a twentieth of the updates, then falls as a
            cosine to nothing.
        decay: Weight decay.
        average: The network is the running mean of its weights over about this part of the
            training: the steps of the last batches are as much chance as gain.
        bfloat16: Whether the network is trained in sixteen bits: in half the time on a graphics
            card or a processor that can.
        closer: How often a sample is cut from the closer view of the block.
        margin: Room around the block in that view, as a part of its box; that of the segmenter.
        validate_every: Updates between two judgements; the best network so far is kept then.
        crop: Random crop around the segmenter's view.
        augment: Changes of the pictures.
    """

    frames: str | tuple[str, ...]
    negatives: str | tuple[str, ...] | None
    validation: str | tuple[str, ...] | None
    hold_out: Annotated[int, Ge(2)]
    size_px: tuple[Count, Count]
    widths: tuple[int, ...]
    start: str | None
    updates: Count
    max_seconds: Positive | None
    batch: Count
    rate: Positive
    decay: float
    average: Positive
    bfloat16: bool
    closer: float
    margin: float
    validate_every: Count
    crop: Crop
    augment: Augmentation

    def check(self) -> None:
        multiple = 2 ** (len(self.widths) - 1)
        if any(side % multiple for side in self.size_px):
            raise ConfigError(
                f"size_px: {len(self.widths)} widths halve it {len(self.widths) - 1} times, so expected multiples of "
                f"{multiple}, got {list(self.size_px)}"
            )

    def fit(self, session: Session) -> dict[str, Any]:
        """Train; write the network (safetensors, ONNX) into the session's folder.

        One that is stopped leaves the best network so far, with which `start` goes on.

        Returns:
            The content of `training.json`: `conditions` (see `compute_metrics`),
                `best_update`, `parameters`, `parity`, …

        Raises:
            FrameError: frames or masks cannot be used.
            CheckpointError: there is nothing to start with, or the export says something else.
        """
        return _Training(self, session).run()


class _Training:
    """A training under way."""

    def __init__(self, settings: SegmenterTraining, session: Session) -> None:
        self._settings, self._session, self._folder = settings, session, session.folder
        self._device = session.torch_device()
        # Before anything random: weights, views and samples follow from the session's seed.
        session.seed_all()
        self._read_views()
        self._network = self._build_network().to(self._device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        # `fused` moves all weights in one kernel.
        self._optimizer = torch.optim.AdamW(
            self._network.parameters(), lr=settings.rate, weight_decay=settings.decay, fused=True
        )
        # The running mean is the network that is judged and kept.
        self._mean = {name: value.clone() for name, value in self._network.state_dict().items()}
        self._update, self._best, self._curve = 0, {"score": -1.0, "update": 0}, []
        self._seconds = 0.0
        self._best_network = self._network

    def run(self) -> dict[str, Any]:
        settings = self._settings
        pictures, known = crop_segmenter_views(self._unseen, settings.size_px)
        total = torch.zeros((), device=self._device)
        counts = len(self._train), len(self._unseen)
        log.info("%d frames to train on, %d to judge by, %s", *counts, self._device)
        begun = time.monotonic()
        change = settings.augment.build()
        samples = Samples(
            self._train, settings.crop, change, settings.size_px, settings.closer, self._device
        )
        # The start itself is judged, so that a training that only harms is noticed.
        if settings.start is not None:
            self._validate(pictures, known, None)
        with ItemProgress("training", settings.updates) as progress:
            while self._spent() < 1.0:
                before = self._spent()
                total += self._step(*samples.draw(settings.batch))
                self._update += 1
                # The clock is read before judging: validation is part of the training's time.
                self._seconds = time.monotonic() - begun
                # The part that is spent, not the number of steps: the mean spans the same share
                # however long it runs.
                self._remember(1.0 - math.exp((before - self._spent()) / settings.average))
                progress.advance()
                over = self._spent() >= 1.0
                if self._update % settings.validate_every == 0 or over:
                    since = self._update - (self._curve[-1]["update"] if self._curve else 0)
                    self._validate(pictures, known, float(total) / since)
                    total.zero_()
        return self._finish(pictures, known)

    def _build_network(self) -> UNet:
        """Return the network as the training begins with it."""
        network, settings = UNet(self._settings.widths), self._settings
        if settings.start is not None:
            first, _ = read_checkpoint(find_weights(settings.start))
            if first.widths != network.widths:
                raise CheckpointError(
                    f"training.start: {settings.start} has widths {list(first.widths)}, training.widths are "
                    f"{list(network.widths)}; both must be the same"
                )
            network.load_state_dict(first.state_dict())
        return network

    def _read_views(self) -> None:
        """Read what is learned from, and what is judged by: frames, and pictures without a block."""
        settings, seed = self._settings, self._session.stream("views")
        stems = training_data.list_frames(settings.frames, "training.frames")
        # Frames of a run resemble each other: the last ones are set aside together.
        if settings.validation is None:
            last = max(1, len(stems) // settings.hold_out)
            stems, unseen = stems[:-last], stems[-last:]
        else:
            unseen = training_data.list_frames(settings.validation, "training.validation")
            # The same frame on both sides would make the network look better than it is.
            if shared := {path.resolve() for path in stems} & {path.resolve() for path in unseen}:
                raise ConfigError(
                    f"training.validation: {min(shared)} is also among training.frames; judge by "
                    "other frames"
                )
        if not stems:
            raise ConfigError("training.frames: one frame is too few to train on and to judge by")
        pictures: list[Path] = []
        if settings.negatives is not None:
            where = "training.negatives"
            pictures = training_data.list_files(settings.negatives, PICTURES, where)
        quiet = pictures[:: settings.hold_out]
        learned = [*stems, *(path for path in pictures if path not in set(quiet))]
        paths = [*learned, *unseen, *quiet]
        views = training_data.read_views(paths, settings.size_px, settings.margin, seed)
        ends = len(learned), len(learned) + len(unseen)
        self._train, self._unseen = views.part(slice(0, ends[0])), views.part(slice(*ends))
        # As the segmenter sees them, `(F, 2, 3, h, w)`; none where there are no negatives.
        rest = views.part(slice(ends[1], None))
        self._negatives = crop_segmenter_views(rest, settings.size_px)[0]

    def _step(self, picture: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        self._network.train()
        for group in self._optimizer.param_groups:
            group["lr"] = self._rate()
        # Sixteen bits only in the forward pass; loss and weights keep 32.
        with torch.autocast(self._device.type, torch.bfloat16, enabled=self._settings.bfloat16):
            logits = self._network(picture.to(memory_format=torch.channels_last))
        value = compute_loss(logits.float(), target)
        self._optimizer.zero_grad(set_to_none=True)
        value.backward()
        # A norm of 1 tames the rare batch of extreme pictures. Chosen by hand; not searched.
        torch.nn.utils.clip_grad_norm_(self._network.parameters(), 1.0)
        self._optimizer.step()
        return value.detach()

    @torch.no_grad()
    def _remember(self, part: float) -> None:
        """Move the mean network by a part of the way to the one under training."""
        means, now = [], []
        for name, value in self._network.state_dict().items():
            if value.is_floating_point():
                means.append(self._mean[name])
                now.append(value)
        # all at once: a graphics card takes longer to be told of each of a hundred small tensors
        # than to move them
        torch._foreach_lerp_(means, now, part)

    def _spent(self) -> float:
        """Return which part of the training is over, by updates or by seconds, in [0, 1]."""
        # Without a limit in time the share in time is 0.
        in_time = self._seconds / (self._settings.max_seconds or math.inf)
        return min(1.0, max(self._update / self._settings.updates, in_time))

    def _rate(self) -> float:
        fall = 0.5 * (1.0 + math.cos(math.pi * self._spent()))
        # The learning rate rises over the first twentieth.
        rise = 20.0 * (self._spent() + 1.0 / self._settings.updates)
        return self._settings.rate * min(1.0, rise) * fall

    def _validate(
        self, pictures: torch.Tensor, known: torch.Tensor, mean_loss: float | None
    ) -> None:
        # A separate network: the one under training must not change.
        network = UNet(self._settings.widths).to(self._device)
        network.load_state_dict(self._mean)
        probabilities = predict(network, pictures, self._device)
        figures = compute_metrics(probabilities, known, self._unseen.conditions)["all"]
        block, mouth = figures["block"] or 0.0, figures["mouth"] or 0.0
        quiet = self._measure_quiet(network)
        point = {"update": self._update, "loss": mean_loss}
        self._curve.append(point | {"block": block, "mouth": mouth, "quiet": quiet})
        if mean_loss is not None and not math.isfinite(mean_loss):
            raise CheckpointError(f"diverged before update {self._update}; lower training.rate")
        score = block + mouth + (quiet or 0.0)
        if score > self._best["score"]:
            self._best = {"score": score, "update": self._update}
            # On the processor: the best weights must not occupy the card twice.
            self._best_network = network.cpu().eval().requires_grad_(False)
            header = self._build_header(block, mouth)
            unet.write_checkpoint(self._folder / unet.TENSORS, self._best_network, header)
        passed = "" if mean_loss is None else f"loss {mean_loss:.4f}, "
        told = self._update, passed, block, mouth
        log.info("update %d: %soverlap of blocks %.3f, of mouths %.3f", *told)

    def _measure_quiet(self, network: UNet) -> float | None:
        """Return the share of unseen negatives on which the network names no block."""
        if not len(self._negatives):
            return None
        probabilities = predict(network, self._negatives, self._device)
        named = (probabilities[:, :, 0] > THRESHOLD).float().mean((2, 3)).amax(1)
        return float((named < LEAST_BLOCK).float().mean())

    def _build_header(self, block: float, mouth: float) -> dict[str, Any]:
        """Return the header of the network's files, with its overlaps on unseen frames."""
        facts = {
            "overlap": {"block": block, "mouth": mouth},
            "frames": len(self._train),
            "update": self._update,
            "margin": self._settings.margin,
        }
        return unet.build_header(self._network, self._settings.size_px, facts)

    def _finish(self, pictures: torch.Tensor, known: torch.Tensor) -> dict[str, Any]:
        network = self._best_network
        probabilities = predict(network.to(self._device), pictures, self._device)
        conditions = compute_metrics(probabilities, known, self._unseen.conditions)
        network.cpu()
        _, header = read_checkpoint(self._folder / unet.TENSORS)
        # Eight pictures show a wrong export as surely as all.
        compared = pictures[: min(len(pictures), 8)].flatten(0, 1).float() / 255.0
        parity = unet.write_onnx(self._folder / unet.ONNX, network, header, compared)
        return {
            "schema": 1,
            "conditions": conditions,
            "best_update": self._best["update"],
            "updates": self._update,
            "seconds": self._seconds,
            "parameters": sum(value.numel() for value in network.parameters()),
            "onnx_bytes": (self._folder / unet.ONNX).stat().st_size,
            "parity": parity,
            "frames": {"train": len(self._train), "validation": len(self._unseen)},
            "device": str(self._device),
            "curve": self._curve,
        }
