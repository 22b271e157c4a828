"""Exporting a policy to ONNX, and proving that the file says the same as the network."""

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

from brokk_rl.contracts.task import TaskProcess
from brokk_rl.errors import CheckpointError
from brokk_rl.rl.policy import CONTRACT, ONNX
from brokk_rl.session import write_json

TOLERANCE = 1e-3
"""Largest difference of a command (of 2 full strokes) between torch and onnxruntime over recorded
observations."""

GOLDEN, NUM_GOLDEN = "golden.json", 16
"""Observations and the network's own answers: whoever runs the file elsewhere compares with them
first."""


class _OnnxActor(torch.nn.Module):
    """A copy of an actor on the CPU that takes a plain dictionary of groups: ONNX does not know the TensorDict."""

    def __init__(self, actor: MLPModel) -> None:
        super().__init__()
        assert actor.distribution is not None
        self.groups = list(actor.obs_groups)
        self.normalizer, self.mlp = (
            copy.deepcopy(actor.obs_normalizer).cpu(),
            copy.deepcopy(actor.mlp).cpu(),
        )
        self.output = actor.distribution.as_deterministic_output_module()

    def forward(self, groups: dict[str, torch.Tensor]) -> torch.Tensor:
        latent = torch.cat([groups[name] for name in self.groups], dim=-1)
        return self.output(self.mlp(self.normalizer(latent)))


def export_onnx(
    folder: Path,
    actor: MLPModel,
    task: TaskProcess,
    contract: dict[str, Any],
    observations: torch.Tensor,
) -> float:
    """Writes `policy.onnx`: from the observation vector to masked commands, with the contract as metadata; and `golden.json`.

    Args:
        folder: Where to; the contract there is completed by the parity figures.
        actor: The network.
        task: The policy's task, built on the CPU: constants of a GPU would travel with the file.
        contract: What `write_bundle` returned.
        observations: Recorded observation vectors, `(B, O)`, over which file and network are
            compared.

    Returns:
        The largest difference of a command between onnxruntime and torch.

    Raises:
        CheckpointError: The file says something else than the network; it is removed.
    """
    module = task.deployable(_OnnxActor(actor).eval()).eval()
    example = observations[:1].cpu()
    part = folder / f".{ONNX}.part"
    with warnings.catch_warnings(), redirect_stdout(io.StringIO()), torch.no_grad():
        warnings.simplefilter("ignore")  # the exporter warns about its own internals
        level = logging.getLogger("torch.onnx").level
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        torch.onnx.export(
            module, (example,), str(part), input_names=["observation"], output_names=["command"],
            dynamic_axes={"observation": {0: "batch"}, "command": {0: "batch"}}, opset_version=18, dynamo=False,
        )  # fmt: skip
        logging.getLogger("torch.onnx").setLevel(level)
        expected = module(observations.cpu()).numpy()
    model = onnx.load(part)
    onnx.helper.set_model_props(
        model,
        {
            f"brokk.{key}": _format_metadata(value)
            for key, value in contract.items()
            if key != "network"
        },
    )
    onnx.save(model, part)
    session = onnxruntime.InferenceSession(part.read_bytes(), providers=["CPUExecutionProvider"])
    found = session.run(None, {"observation": observations.cpu().numpy().astype(np.float32)})[0]
    # at the edge of a mask or of the dead band the last bit of a float decides between two
    # commands; such rows are counted, not compared
    difference = np.abs(found - expected).max(1)
    off = difference > TOLERANCE
    if off.mean() > 0.005:
        part.unlink()
        raise CheckpointError(
            f"the exported policy differs from the network in {off.mean():.1%} of {len(off)} observations "
            f"(largest {difference.max():.3g}); nothing was written. This is a bug of the exporter or of a custom network layer."
        )
    part.replace(folder / ONNX)
    largest = float(difference[~off].max())
    golden = np.flatnonzero(~off)[:: max(1, len(off) // NUM_GOLDEN)][:NUM_GOLDEN]
    write_json(
        folder / GOLDEN,
        {
            "observation": observations[golden].cpu().numpy().astype(float).tolist(),
            "command": expected[golden].astype(float).tolist(),
        },
    )
    parity = {
        "observations": len(off),
        "largest_difference": largest,
        "at_an_edge": int(off.sum()),
        "onnxruntime": onnxruntime.__version__,
    }
    write_json(folder / CONTRACT, contract | {"parity": parity})
    return largest


def _format_metadata(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
