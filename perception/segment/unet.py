"""Small U-Net (Ronneberger et al., 2015): masks of block and holes from a picture, and its files.

Files are safetensors to train on and ONNX to run, with a check that both agree.
"""

from __future__ import annotations

import io
import json
import logging
import warnings
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import nn
from torch.nn import functional

from brokk_rl.errors import CheckpointError
from brokk_rl.session import write_bytes
from perception.segment.network import PREFIX, SCHEMA

CHANNELS = ("block", "mouth")
"""Channels of the output; they overlap, since a hole lies in its block."""
DARKEST = 0.01
"""Contrast added to a picture's own, so that noise is not stretched: a few grey levels of 255."""
BRIGHTEST = 2.0
"""Standard deviations from the mean at which brightness is clipped, so that a lit block on black
ground is no special case."""


class UNet(nn.Module):
    """Halves the picture `len(widths) - 1` times and comes back, with a bridge at each size.

    Args:
        widths: Channels at each size, the full picture first.
    """

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        self.widths = tuple(widths)
        self.down = nn.ModuleList(
            _ConvolutionPair(before, after)
            for before, after in zip((3, *widths[:-1]), widths, strict=True)
        )
        back = list(widths[::-1])
        # Each step up joins its input and the bridge, and leaves the channels of the size above.
        below, steps = back[0], []
        for here, above in zip(back[1:], [*back[2:], back[-1]], strict=True):
            steps.append(_ConvolutionPair(below + here, above))
            below = above
        self.up = nn.ModuleList(steps)
        self.head = nn.Conv2d(below, len(CHANNELS), 1)
        nn.init.constant_(self.head.bias, -2.0)  # type: ignore[arg-type] (both are rare in a picture)

    def forward(self, picture: torch.Tensor) -> torch.Tensor:
        """Return logits, `(B, 2, h, w)`, of RGB pictures `(B, 3, h, w)` in [0, 1]."""
        # In the square root photon noise is the same at every brightness, and shade is not black.
        # Each picture is normalised by its own brightness and contrast against dusk and dust.
        picture = picture.sqrt()
        mean = average_picture(picture)
        spread = average_picture((picture - mean).square()).sqrt()
        x, bridges = ((picture - mean) / (spread + DARKEST)).clamp(-BRIGHTEST, BRIGHTEST), []
        for number, pair in enumerate(self.down):
            x = pair(x if number == 0 else functional.max_pool2d(x, 2))
            bridges.append(x)
        for pair, bridge in zip(self.up, bridges[-2::-1], strict=True):
            x = pair(
                torch.cat([functional.interpolate(x, scale_factor=2.0, mode="nearest"), bridge], 1)
            )
        return self.head(x)


def read_checkpoint(path: Path) -> tuple[UNet, dict[str, Any]]:
    """Return the network of a checkpoint, on the CPU and ready to use, and its header.

    Raises:
        CheckpointError: the file is corrupt or holds something else.
    """
    try:
        with safe_open(path, framework="pt") as file:
            header = json.loads((file.metadata() or {})["brokk"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
        network = UNet(header["widths"])
        network.load_state_dict(tensors)
    except (SafetensorError, OSError, KeyError, ValueError, RuntimeError) as error:
        raise CheckpointError(
            f"{path}: corrupt or no segmenter of ours ({error}); `brokk mode=train_perception` makes "
            "one"
        ) from error
    return network.eval().requires_grad_(False), header


def average_picture(values: torch.Tensor) -> torch.Tensor:
    """Return the mean of each picture, `(B, 1, 1, 1)`."""
    # Rows first: ONNX Runtime adds all 184,320 numbers of a picture in sequence, with rounding
    # errors.
    return values.mean(3, keepdim=True).mean((1, 2), keepdim=True)


def compute_loss(logits: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return binary cross-entropy plus Dice (Milletari et al., 2016), both averaged over the channels.

    Args:
        logits: `(B, 2, h, w)`.
        target: Part of each pixel that shows the channel, same shape, in [0, 1].
    """
    entropy = functional.binary_cross_entropy_with_logits(logits, target)
    probability = torch.sigmoid(logits)
    # Over the whole batch: the overlap of a picture without a hole is undefined.
    shared, both = (probability * target).sum((0, 2, 3)), (probability + target).sum((0, 2, 3))
    return entropy + (1.0 - (2.0 * shared + 1.0) / (both + 1.0)).mean()


class _ConvolutionPair(nn.Sequential):
    """Two 3 x 3 convolutions, each normalised over the batch and rectified."""

    def __init__(self, before: int, after: int) -> None:
        layers: list[nn.Module] = []
        for channels in (before, after):
            layers += [
                nn.Conv2d(channels, after, 3, padding=1, bias=False),
                nn.BatchNorm2d(after),
                nn.ReLU(inplace=True),
            ]
        super().__init__(*layers)


TENSORS, ONNX = "segmenter.safetensors", "segmenter.onnx"
TOLERANCE = 1e-3
"""Largest difference of a probability between torch and onnxruntime."""


def build_header(
    network: UNet, size_px: tuple[int, int], facts: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the header of a network's files: input, output and `facts` about its training."""
    return {
        "schema": SCHEMA,
        "channels": list(CHANNELS),
        "size_px": list(size_px),
        "widths": list(network.widths),
        "input": "RGB, (1, 3, height, width) float32 in [0, 1], the frame scaled to fit, black around it",
        "output": "probabilities, (1, 2, height, width)",
        **facts,
    }


def write_checkpoint(path: Path, network: UNet, header: Mapping[str, Any]) -> None:
    """Write a checkpoint in one step.

    Raises:
        StorageError: it could not be written.
    """
    tensors = {}
    for name, value in network.state_dict().items():
        tensors[name] = value.detach().cpu().contiguous()
    write_bytes(path, save(tensors, metadata={"brokk": json.dumps(header)}))


def write_onnx(
    path: Path, network: UNet, header: Mapping[str, Any], pictures: torch.Tensor
) -> float:
    """Write an ONNX file with the header as metadata, and compares it with the network.

    Args:
        path: Where to.
        network: The network, on the CPU.
        header: Of `build_header`.
        pictures: On which file and network are compared, `(B, 3, h, w)` float32 in [0, 1].

    Returns:
        The largest difference of a probability.

    Raises:
        CheckpointError: the file says something else than the network; nothing is written.
        StorageError: it could not be written.
    """
    import onnx
    import onnxruntime

    module = torch.nn.Sequential(network, torch.nn.Sigmoid()).eval()
    log = logging.getLogger("torch.onnx")
    level, part = log.level, path.with_name(f".{path.name}.exported")
    with warnings.catch_warnings(), redirect_stdout(io.StringIO()), torch.no_grad():
        warnings.simplefilter("ignore")  # the exporter warns about its own internals
        log.setLevel(logging.ERROR)
        torch.onnx.export(
            module, (pictures[:1],), str(part), input_names=["picture"], output_names=["probability"],
            dynamic_axes={"picture": {0: "batch"}, "probability": {0: "batch"}}, opset_version=18, dynamo=False,
        )  # fmt: skip
        log.setLevel(level)
        expected = module(pictures).numpy()
    model = onnx.load(part)
    part.unlink()
    onnx.helper.set_model_props(
        model, {f"{PREFIX}{key}": json.dumps(value) for key, value in header.items()}
    )
    session = onnxruntime.InferenceSession(
        model.SerializeToString(), providers=["CPUExecutionProvider"]
    )
    largest = float(
        np.abs(np.asarray(session.run(None, {"picture": pictures.numpy()})[0]) - expected).max()
    )
    if not largest <= TOLERANCE:
        raise CheckpointError(
            f"the exported network differs from the one in torch by {largest:.3g} of "
            f"probability, over {TOLERANCE}; {path} was not "
            "written. This is a bug of the exporter or of a layer."
        )
    write_bytes(path, model.SerializeToString())
    return largest
