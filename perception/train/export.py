"""Networks in files: safetensors to train on, ONNX to run, and a check that both agree."""

from __future__ import annotations

import io
import json
import logging
import warnings
from collections.abc import Mapping
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save

from brokk_rl.errors import CheckpointError
from brokk_rl.session import write_bytes
from perception.segment.network import PREFIX, SCHEMA
from perception.segment.unet import CHANNELS, UNet

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
