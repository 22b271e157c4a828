"""Export of a policy to ONNX, and proof that the file answers like the network."""

from __future__ import annotations

import copy
import io
import json
import logging
import warnings
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from rsl_rl.models import MLPModel

from brokk_rl.contracts.task import DeployableTask
from brokk_rl.errors import CheckpointError
from brokk_rl.rl.policy import CONTRACT, ONNX
from brokk_rl.session import write_json

TOLERANCE = 1e-3
"""Largest difference of a command (of 2 full strokes) between torch and onnxruntime over recorded
observations. Chosen by hand: far above the rounding of float32, far below what a valve resolves."""
MAX_EDGE_SHARE = 0.005
"""Share of observations that may differ by more: at the edge of a mask or of the dead band the last
bit of a float decides between two commands. Chosen by hand."""
OPSET = 18
"""ONNX operator set; chosen by hand, onnxruntime on the machine reads it."""
GOLDEN, NUM_GOLDEN = "golden.json", 16
"""Observations and the network's own commands: whoever runs the file elsewhere compares with them
first."""
NOT_DEPLOYABLE = (
    "the task ({task}) cannot be deployed, so there is no policy.onnx: it has no methods "
    "`describe` "
    "and `deployable` (brokk_rl.contracts.task.DeployableTask); policy=trained can evaluate the "
    "policy of a run folder without them"
)


class _OnnxActor(torch.nn.Module):
    """A copy of an actor on the CPU that takes a dictionary of groups: ONNX knows no TensorDict."""

    def __init__(self, actor: MLPModel) -> None:
        super().__init__()
        assert actor.distribution is not None
        self.groups = list(actor.obs_groups)
        self.normalizer = copy.deepcopy(actor.obs_normalizer).cpu()
        self.mlp = copy.deepcopy(actor.mlp).cpu()
        self.output = actor.distribution.as_deterministic_output_module()

    def forward(self, groups: dict[str, torch.Tensor]) -> torch.Tensor:
        latent = torch.cat([groups[name] for name in self.groups], dim=-1)
        return self.output(self.mlp(self.normalizer(latent)))


def export_onnx(
    folder: Path,
    actor: MLPModel,
    task: DeployableTask,
    contract: dict[str, Any],
    observations: torch.Tensor,
) -> float:
    """Write `policy.onnx`, with the contract as metadata, and `golden.json`.

    Args:
        folder: Where to; the contract there is completed by the parity figures.
        actor: The network.
        task: The policy's task, built on the CPU: constants of a GPU would travel with the file.
        contract: Contract that `write_bundle` returned.
        observations: Recorded observation vectors, `(B, O)`, over which file and network are
            compared.

    Returns:
        The largest difference of a command between onnxruntime and torch.

    Raises:
        CheckpointError: File and network differ; the file is removed.
    """
    module = task.deployable(_OnnxActor(actor).eval()).eval()
    part = folder / f".{ONNX}.part"
    _write_onnx(module, observations[:1].cpu(), part)
    with torch.no_grad():
        expected = module(observations.cpu()).numpy()
    metadata = {}
    for key, value in contract.items():
        if key != "network":
            metadata[f"brokk.{key}"] = _format_metadata(value)
    model = onnx.load(part)
    onnx.helper.set_model_props(model, metadata)
    onnx.save(model, part)

    session = onnxruntime.InferenceSession(part.read_bytes(), providers=["CPUExecutionProvider"])
    inputs = {"observation": observations.cpu().numpy().astype(np.float32)}
    difference = np.abs(session.run(None, inputs)[0] - expected).max(1)
    off = difference > TOLERANCE  # rows at an edge are counted, not compared
    if off.mean() > MAX_EDGE_SHARE:
        part.unlink()
        raise CheckpointError(
            f"the exported policy differs from the network in {off.mean():.1%} of {len(off)} "
            f"observations (largest {difference.max():.3g}); nothing was written. This is a bug of "
            "the exporter or of a custom network layer."
        )
    part.replace(folder / ONNX)
    largest = float(difference[~off].max())
    golden = np.flatnonzero(~off)[:: max(1, len(off) // NUM_GOLDEN)][:NUM_GOLDEN]
    answers = {
        "observation": observations[golden].cpu().numpy().astype(float).tolist(),
        "command": expected[golden].astype(float).tolist(),
    }
    write_json(folder / GOLDEN, answers)
    parity = {
        "observations": len(off),
        "largest_difference": largest,
        "at_an_edge": int(off.sum()),
        "onnxruntime": onnxruntime.__version__,
    }
    write_json(folder / CONTRACT, contract | {"parity": parity})
    return largest


def _write_onnx(module: torch.nn.Module, example: torch.Tensor, path: Path) -> None:
    """Write `module` as an ONNX file, without the exporter's warnings about its own internals."""
    torch_log = logging.getLogger("torch.onnx")
    level = torch_log.level
    with warnings.catch_warnings(), redirect_stdout(io.StringIO()), torch.no_grad():
        warnings.simplefilter("ignore")
        torch_log.setLevel(logging.ERROR)
        torch.onnx.export(
            module,
            (example,),
            str(path),
            input_names=["observation"],
            output_names=["command"],
            dynamic_axes={"observation": {0: "batch"}, "command": {0: "batch"}},
            opset_version=OPSET,
            dynamo=False,
        )
        torch_log.setLevel(level)


def _format_metadata(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
