"""Export of a policy to ONNX, and proof that the file answers as the training run recorded."""

from __future__ import annotations

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
from brokk_rl.machine import Machine
from brokk_rl.policy_folder import ONNX, TOLERANCE, write_golden_answers
from brokk_rl.rl.policy import PlainActor

MAX_EDGE_SHARE = 0.005
"""Share of observations that may differ by more: at the edge of a mask or of the dead band the last
bit of a float decides between two commands. Chosen by hand."""
OPSET = 18
"""ONNX operator set; chosen by hand, onnxruntime on the machine reads it."""
NOT_DEPLOYABLE = "policy=<run folder> evaluates the policy without policy.onnx"
"""Advice for a task whose policies cannot be exported."""


def export_onnx(
    folder: Path,
    actor: MLPModel,
    task: TaskProcess,
    machine: Machine,
    contract: dict[str, Any],
    answers: tuple[torch.Tensor, torch.Tensor],
) -> float:
    """Write `policy.onnx`, with the contract as metadata, and `golden.json`.

    Args:
        folder: Where to; the contract there is completed by the parity figures.
        actor: The network.
        task: The policy's task, built on the CPU: constants of a GPU would travel with the file.
        machine: The machine.
        contract: Contract that `write_policy` wrote.
        answers: Observation vectors, `(B, O)`, and the commands, `(B, J)`, that the network gave
            for them in the run that trained it (`ControlLoop.record_answers`).

    Returns:
        The largest difference of a command between onnxruntime and the recorded ones.

    Raises:
        CheckpointError: The file answers otherwise than the run did; it is removed.
    """
    module = task.deployable(PlainActor(actor).cpu().eval()).eval()
    part = folder / f".{ONNX}.part"
    observations, expected = answers[0].float(), answers[1].numpy()
    _write_onnx(module, observations[:1], part)
    metadata = {}
    for key, value in contract.items():
        if key != "network":
            metadata[f"brokk.{key}"] = value if isinstance(value, str) else json.dumps(value)
    model = onnx.load(part)
    onnx.helper.set_model_props(model, metadata)
    onnx.save(model, part)

    session = onnxruntime.InferenceSession(part.read_bytes(), providers=["CPUExecutionProvider"])
    found = session.run(None, {"observation": observations.numpy()})[0]
    difference = np.abs(found - expected).max(1)
    off = difference > TOLERANCE  # rows at an edge are counted, not compared
    if not off.sum() <= max(1, MAX_EDGE_SHARE * len(off)):
        part.unlink()
        raise CheckpointError(
            f"the exported policy differs from the answers that its training recorded in {off.mean():.1%} "
            f"of {len(off)} observations (largest {difference.max():.3g}); nothing was written. The "
            "task or the network built here is not that of the run, or a custom layer is exported wrongly."
        )
    part.replace(folder / ONNX)
    largest = float(difference[~off].max())
    parity = {
        "observations": len(off),
        "largest_difference": largest,
        "at_an_edge": int(off.sum()),
        "onnxruntime": onnxruntime.__version__,
    }
    write_golden_answers(
        folder, contract | {"parity": parity}, machine, observations.numpy(), expected, ~off
    )
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
