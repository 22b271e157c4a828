"""Drives as networks for mjlab, Isaac Lab and Newton: from errors and speeds of some steps to a torque.

mjlab (`LearnedMlpActuatorCfg`) and Isaac Lab (`ActuatorNetMLPCfg`) load TorchScript, Newton
(`DriveNeuralMLP`) ONNX. The input is the same for all: scaled errors, newest first, then scaled speeds,
newest first. Axes: `E` examples, `H` steps of history, `J` joints.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from torch import nn

from brokk_rl.session import write_json

HIDDEN = 32
"""Units of both hidden layers, as in the networks of legged robots (Hwangbo and others, 2019)."""
EPOCHS, BATCH, LEARNING_RATE = 60, 1024, 3e-3
"""Chosen by hand: the loss no longer falls."""
HUBER = 0.05
"""Error, over the scale of the torque, from which the loss is linear. At a step of the target the torque
jumps to many times its scale; squares would see nothing else. Chosen by hand."""
DECAY = 0.01
"""Weight decay. Chosen by hand."""
RIDGE = 1e-6
"""Ridge of the linear part, over the mean square of an input."""
MAX_HISTORY = 40
"""Steps of history at most: a longer delay belongs into the simulator's own delay."""


@dataclass(frozen=True)
class NetworkContract:
    """Meaning of a network's numbers, written into its files.

    Attributes:
        joint: Joint that it drives.
        rate_hz: Physics rate at which it is asked.
        input_order: Errors of position before speeds.
        input_idx: Steps of history, 0 the newest.
        history_length: Number of them.
        pos_scale: Factor on errors (target less position), 1/rad or 1/m.
        vel_scale: Factor on speeds, s/rad or s/m.
        torque_scale: Factor on the output, Nm or N.
        effort_scale: The same; Newton's name for it.
        torque_rmse: Error of the torque on steps outside the fit, Nm or N.
    """

    joint: str
    rate_hz: float
    input_order: str
    input_idx: tuple[int, ...]
    history_length: int
    pos_scale: float
    vel_scale: float
    torque_scale: float
    effort_scale: float
    torque_rmse: float


class DriveNetwork(nn.Module):
    """A linear map and two hidden layers beside it: a drive is a gain first of all."""

    def __init__(self, num_inputs: int) -> None:
        super().__init__()
        self.gain = nn.Linear(num_inputs, 1)
        self.bend = nn.Sequential(
            nn.Linear(num_inputs, HIDDEN),
            nn.ELU(),
            nn.Linear(HIDDEN, HIDDEN),
            nn.ELU(),
            nn.Linear(HIDDEN, 1),
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return scaled torques `(E, 1)` from scaled inputs `(E, 2 H)`."""
        return self.gain(x) + self.bend(x)


def choose_history(delay_s: float, step_s: float) -> int:
    """Return the number of steps that span a delay and the change behind it."""
    return int(min(MAX_HISTORY, max(3, np.ceil(delay_s / step_s - 1e-9) + 3)))


def stack_history(values: np.ndarray, length: int, start: tuple[int, ...]) -> np.ndarray:
    """Return the last `length` values of each step, newest first, `(T, H)`; a run begins with its first value."""
    found = np.empty((len(values), length))
    bounds = [*start, len(values)]
    for begin, end in pairwise(bounds):
        padded = np.concatenate([np.repeat(values[begin], length - 1), values[begin:end]])
        windows = np.lib.stride_tricks.sliding_window_view(padded, length)
        found[begin:end] = windows[:, ::-1]
    return found


def fit_network(
    joint: str,
    error: np.ndarray,
    speed: np.ndarray,
    torque: np.ndarray,
    start: tuple[int, ...],
    step_s: float,
    history: int,
    seed: int,
) -> tuple[DriveNetwork, NetworkContract]:
    """Return the network of one joint and its contract; the last fifth of the steps is outside the fit."""
    scales = [1.0 / max(float(np.std(one)), 1e-9) for one in (error, speed, torque)]
    columns = [
        stack_history(error, history, start) * scales[0],
        stack_history(speed, history, start) * scales[1],
    ]
    x = torch.as_tensor(np.concatenate(columns, 1), dtype=torch.float32)
    y = torch.as_tensor(torque * scales[2], dtype=torch.float32)[:, None]
    generator = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        network = DriveNetwork(x.shape[1])
    fitted = slice(0, int(0.8 * len(x)))
    _solve_gain(network, x[fitted].double(), y[fitted].double())
    for parameter in network.bend[-1].parameters():
        nn.init.zeros_(parameter)
    optimiser = torch.optim.AdamW(network.parameters(), LEARNING_RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, EPOCHS)
    for _ in range(EPOCHS):
        for rows in torch.randperm(len(x[fitted]), generator=generator).split(BATCH):
            loss = nn.functional.smooth_l1_loss(network(x[rows]), y[rows], beta=HUBER)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        schedule.step()
    network.eval()
    with torch.no_grad():
        left = (network(x[fitted.stop :]) - y[fitted.stop :]).square().mean().sqrt()
    contract = NetworkContract(
        joint=joint,
        rate_hz=1.0 / step_s,
        input_order="pos_vel",
        input_idx=tuple(range(history)),
        history_length=history,
        pos_scale=scales[0],
        vel_scale=scales[1],
        torque_scale=1.0 / scales[2],
        effort_scale=1.0 / scales[2],
        torque_rmse=float(left) / scales[2],
    )
    return network, contract


def _solve_gain(network: DriveNetwork, x: torch.Tensor, y: torch.Tensor) -> None:
    """Set the linear part by least squares."""
    ones = torch.cat([x, torch.ones(len(x), 1, dtype=x.dtype)], 1)
    normal = ones.T @ ones
    normal += RIDGE * len(x) * torch.eye(len(normal), dtype=x.dtype)
    weight = torch.linalg.solve(normal, ones.T @ y)
    with torch.no_grad():
        network.gain.weight.copy_(weight[:-1].T)
        network.gain.bias.copy_(weight[-1])


def write_network(network: DriveNetwork, contract: NetworkContract, folder: Path) -> None:
    """Write `<joint>.pt` (TorchScript), `<joint>.onnx` and `<joint>.json`; both networks hold the contract.

    Raises:
        StorageError: A file could not be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{contract.joint}.{ending}" for ending in ("pt", "onnx", "json")]
    text = json.dumps(asdict(contract), indent=2)
    with warnings.catch_warnings():
        # TorchScript is deprecated; mjlab and Isaac Lab read nothing else.
        warnings.simplefilter("ignore", FutureWarning)
        warnings.simplefilter("ignore", DeprecationWarning)
        script = torch.jit.script(network)
        torch.jit.save(script, str(paths[0]), _extra_files={"contract.json": text.encode()})
    _write_onnx(network, contract, paths[1])
    write_json(paths[2], asdict(contract))


class DriveStack:
    """The networks of all joints as one drive that keeps its history, for a roll-out."""

    def __init__(self, drives: Sequence[tuple[DriveNetwork, NetworkContract]]) -> None:
        self._drives = drives
        self._error: np.ndarray | None = None
        self._speed: np.ndarray | None = None

    def __call__(self, error: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Return torques `(J,)` for errors and speeds `(J,)` of one physics step."""
        length = self._drives[0][1].history_length
        if self._error is None or self._speed is None:
            self._error, self._speed = np.tile(error, (length, 1)), np.tile(speed, (length, 1))
        self._error = np.concatenate([error[None], self._error[:-1]])
        self._speed = np.concatenate([speed[None], self._speed[:-1]])
        torques = []
        with torch.inference_mode():
            for place, (network, contract) in enumerate(self._drives):
                parts = (
                    self._error[:, place] * contract.pos_scale,
                    self._speed[:, place] * contract.vel_scale,
                )
                row = torch.as_tensor(np.concatenate(parts), dtype=torch.float32)
                torques.append(float(network(row[None])) * contract.torque_scale)
        return np.array(torques)


def _write_onnx(network: DriveNetwork, contract: NetworkContract, path: Path) -> None:
    """Write the network with operators that Newton's runtime has: Gemm, Elu, Add."""
    import onnx  # in the extra `train` only
    from onnx import TensorProto, helper, numpy_helper

    nodes, weights = [], []

    def add_layer(layer: nn.Linear, name: str, given: str) -> str:
        for part, value in (("weight", layer.weight), ("bias", layer.bias)):
            array = value.detach().numpy().astype(np.float32)
            weights.append(numpy_helper.from_array(array, f"{name}.{part}"))
        inputs = [given, f"{name}.weight", f"{name}.bias"]
        nodes.append(helper.make_node("Gemm", inputs, [name], transB=1))
        return name

    at = "input"
    for number, layer in enumerate(network.bend):
        if isinstance(layer, nn.Linear):
            at = add_layer(layer, f"bend.{number}", at)
        else:
            nodes.append(helper.make_node("Elu", [at], [f"bend.{number}"]))
            at = f"bend.{number}"
    straight = add_layer(network.gain, "gain", "input")
    nodes.append(helper.make_node("Add", [straight, at], ["torque"]))
    size = 2 * contract.history_length
    given = helper.make_tensor_value_info("input", TensorProto.FLOAT, ["batch", size])
    told = helper.make_tensor_value_info("torque", TensorProto.FLOAT, ["batch", 1])
    graph = helper.make_graph(nodes, "drive", [given], [told], weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    helper.set_model_props(model, {"metadata": json.dumps(asdict(contract))})
    onnx.checker.check_model(model)
    onnx.save(model, str(path))
