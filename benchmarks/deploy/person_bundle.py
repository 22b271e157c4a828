"""The classical controller that knows of the person at the levers, as a policy bundle: python benchmarks/deploy/person_bundle.py
<folder>.

No policy trained behind a person is better yet (docs/operator.md), so this is what `preset=bench bench=guided` is measured with.
The network of the residual task is zero; guidance, masks and proposals are those of training, in the same exported module.
"""

from __future__ import annotations

import json
import logging
import sys
import warnings
from pathlib import Path

import hydra
import numpy as np
import onnx
import torch
from hydra.utils import instantiate

from brokk_rl.session import write_json


class Zero(torch.nn.Module):
    """A network that changes nothing of what the classical controller wants."""

    def forward(self, groups: dict[str, torch.Tensor]) -> torch.Tensor:
        return torch.zeros_like(groups["guide"][:, :5])


def main(folder: Path) -> None:
    with hydra.initialize_config_module("conf", version_base="1.3"):
        cfg = hydra.compose("config", overrides=["mode=evaluate", "follower=person", "policy=classical"])
    machine, task = instantiate(cfg.machine, _convert_="all"), instantiate(cfg.task, _convert_="all")
    process = task.build(machine, 1, torch.device("cpu"))
    module = process.deployable(Zero()).eval()
    generator = torch.Generator().manual_seed(0)
    observations = 0.6 * torch.randn((64, process.describe()["size"]), generator=generator)
    size = machine.num_history * machine.num_joints
    for block in (slice(3 + size, 3 + 2 * size), slice(-size, None)):  # commands and proposals under the masks, mostly zero
        some = (torch.rand((64, machine.num_history, machine.num_joints), generator=generator) < 0.3) * 0.5
        some[..., machine.is_exclusive] = 0.0
        observations[:, block] = some.reshape(64, -1)
    folder.mkdir(parents=True, exist_ok=True)
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            module, (observations[:1],), str(folder / "policy.onnx"), input_names=["observation"], output_names=["command"],
            dynamic_axes={"observation": {0: "batch"}, "command": {0: "batch"}}, opset_version=18, dynamo=False,
        )  # fmt: skip
        expected = torch.cat([module(one[None]) for one in observations]).numpy()
    contract = {
        "schema": 1, "machine": machine.name, "fingerprint": machine.fingerprint(), "rate_hz": 1 / machine.period_s,
        "dead_time_s": machine.dead_time_s, "joints": list(machine.joint_names), "exclusive": list(machine.exclusive),
        "command": {"range": [-1.0, 1.0], "order": list(machine.joint_names), "masked": True}, "observation": process.describe(),
        "trained": {"network": "none: the classical controller"},
    }  # fmt: skip
    model = onnx.load(folder / "policy.onnx")
    texts = {f"brokk.{key}": value if isinstance(value, str) else json.dumps(value) for key, value in contract.items()}
    onnx.helper.set_model_props(model, texts)
    onnx.save(model, folder / "policy.onnx")
    write_json(folder / "policy.json", contract)
    rows = np.linspace(0, 63, 16).astype(int)
    golden = {"observation": observations.numpy()[rows].astype(float).tolist(), "command": expected[rows].astype(float).tolist()}
    write_json(folder / "golden.json", golden)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
