"""Observation vectors of policies, the same code in training and on the machine.

A vector is a list of parts, each scaled by an approximate mean and standard deviation that follow
from the configuration: a policy carries no hidden statistics.

The vector of a task that moves the tool to a pose is the paper's, Table I: borehole position (3),
joint positions oldest sample first (H x J), commands oldest first (H x J), 133 numbers for five
joints and 13 samples. A task whose wanted pitch differs from episode to episode appends it. A
policy that proposes to a person appends its own proposals, oldest first (H x J): the history holds
the commands that the person gave.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from brokk_rl.machine import Machine
from brokk_rl.spec import Finite, Positive, spec

TARGET, PITCH, PROPOSALS = "target_in_base_m", "pitch_rad", "proposals"
"""Names of parts of a tool-pose vector; the others are `q` and `u`."""
ORDER = {
    TARGET: "target_in_base_m (3)",
    "q": "q oldest first (H x J)",
    "u": "u oldest first (H x J)",
    PITCH: "pitch_rad (1)",
    PROPOSALS: "proposals oldest first (H x J)",
}
"""Words for these parts in a policy's contract."""
TARGET_DISTANCE = "target.distance"
"""Name of the horizontal distance of the target in a range table."""
RangeTable = dict[str, tuple[float, float]]
"""Lowest and highest value by name: `target.x`, `target.distance`, `pitch`, `q.<joint>`."""


@spec
class TargetScaling:
    """Normalisation of the target.

    Attributes:
        target_mean_m: Approximate mean of the target point in the base frame.
        target_std_m: Its approximate standard deviation.
        pitch_rad: Approximate mean and standard deviation of the wanted pitch where it differs from
            episode to episode and so belongs to the vector; `null` where the task fixes it.
    """

    target_mean_m: tuple[Finite, Finite, Finite]
    target_std_m: tuple[Positive, Positive, Positive]
    pitch_rad: tuple[Finite, Positive] | None


@dataclass(frozen=True)
class ObservationPart:
    """A part of a vector.

    Attributes:
        name: Its name.
        shape: Shape of its value; of a history the samples, oldest first, and their width.
        mean: Subtracted; a number, or one for each column.
        std: By which the difference is divided, likewise.
    """

    name: str
    shape: tuple[int, ...]
    mean: Any
    std: Any

    @property
    def size(self) -> int:
        """Numbers in the vector."""
        return math.prod(self.shape)


class ObservationEncoder:
    """Turns the values of named parts into one vector, and back; numpy and torch.

    Args:
        parts: In the order of the vector.
        constant: Makes an array of the kind and on the device of the inputs.
        concat: `numpy.concatenate` or `torch.cat`, called as `concat(parts, 1)`.
    """

    def __init__(
        self,
        parts: Sequence[ObservationPart],
        constant: Callable[[np.ndarray], Any] = np.asarray,
        concat: Callable[[tuple[Any, ...], int], Any] = np.concatenate,
    ) -> None:
        def convert(value: Any) -> Any:
            return constant(np.array(value, np.float32)) if np.ndim(value) else float(value)

        self.parts = {part.name: part for part in parts}
        self.size = sum(part.size for part in parts)
        self._concat = concat
        # known before a control step is compiled
        self._scales: dict[str, tuple[Any, Any]] = {}
        for part in parts:
            if np.ndim(part.mean) or (part.mean, part.std) != (0.0, 1.0):
                self._scales[part.name] = convert(part.mean), convert(part.std)

    @property
    def has_target(self) -> bool:
        """True for the vector of a task that moves the tool to a pose."""
        return TARGET in self.parts

    def encode(self, values: Mapping[str, Any]) -> Any:
        """Return the vector, `(N, size)`, of values by name, each `(N, *shape)`."""
        scaled = []
        for name, part in self.parts.items():
            value = values[name]
            if name in self._scales:
                mean, std = self._scales[name]
                value = (value - mean) / std
            # the width is fixed and the batch is not: a length read here would be a constant of
            # the exported graph
            scaled.append(value.reshape(-1, part.size))
        return self._concat(tuple(scaled), 1)

    def decode(self, vector: Any) -> dict[str, Any]:
        """Invert `encode`: return the values of vectors in their units, by name."""
        values, begin = {}, 0
        for name, part in self.parts.items():
            value = vector[:, begin : begin + part.size].reshape(-1, *part.shape)
            if name in self._scales:
                mean, std = self._scales[name]
                value = value * std + mean
            values[name] = value
            begin += part.size
        return values

    def describe(self) -> dict[str, Any]:
        """Return order and scale of the vector as plain JSON data, for the contract of a policy."""
        if self.has_target:
            return {"size": self.size} | _describe_pose_parts(self.parts)
        order, parts = [], []
        for name, part in self.parts.items():
            samples, width = part.shape
            order.append(f"{name} ({samples} x {width})")
            sizes = {"name": name, "samples": samples, "width": width}
            parts.append(sizes | {"mean": part.mean, "std": part.std})
        return {"size": self.size, "order": order, "parts": parts}


def list_pose_parts(
    machine: Machine, scaling: TargetScaling, with_proposals: bool = False
) -> list[ObservationPart]:
    """Return the parts of the vector of a tool-pose task.

    Args:
        machine: Gives rate and order, and the normalisation of joint positions: middle and quarter
            of the travel.
        scaling: Normalisation of the target.
        with_proposals: Whether the policy proposes to a person.
    """
    history = (machine.num_history, machine.num_joints)
    middle = (machine.lower + machine.upper) / 2
    quarter = (machine.upper - machine.lower) / 4
    parts = [
        ObservationPart(TARGET, (3,), scaling.target_mean_m, scaling.target_std_m),
        ObservationPart("q", history, middle, quarter),
        ObservationPart("u", history, 0.0, 1.0),
    ]
    if scaling.pitch_rad is not None:
        parts.append(ObservationPart(PITCH, (), *scaling.pitch_rad))
    if with_proposals:
        parts.append(ObservationPart(PROPOSALS, history, 0.0, 1.0))
    return parts


def _describe_pose_parts(parts: Mapping[str, ObservationPart]) -> dict[str, Any]:
    target, q = parts[TARGET], parts["q"]
    description = {
        "order": [ORDER[name] for name in parts],
        "target": {"mean_m": list(target.mean), "std_m": list(target.std)},
        "q": {"mean": q.mean.tolist(), "std": q.std.tolist()},
        "u": {"mean": 0.0, "std": 1.0},
    }
    if PITCH in parts:
        description["pitch"] = {"mean_rad": parts[PITCH].mean, "std_rad": parts[PITCH].std}
    return description


def measure_ranges(
    encoder: ObservationEncoder, vectors: np.ndarray, joints: tuple[str, ...]
) -> RangeTable:
    """Return the range of targets and positions, in rad and m, over vectors of a tool-pose task.

    Args:
        encoder: The encoder of the vectors, with numpy arrays.
        vectors: Observation vectors, `(B, size)`.
        joints: Names of the joints, `J`.
    """
    seen = encoder.decode(vectors)
    target_m = seen[TARGET]
    values = {f"target.{letter}": target_m[:, axis] for axis, letter in enumerate("xyz")}
    values[TARGET_DISTANCE] = np.hypot(target_m[:, 0], target_m[:, 1])
    if PITCH in seen:
        values["pitch"] = seen[PITCH]
    for column, joint in enumerate(joints):
        values[f"q.{joint}"] = seen["q"][:, :, column]
    return {name: (float(one.min()), float(one.max())) for name, one in values.items()}


def restore_encoder(machine: Machine, observation: Mapping[str, Any]) -> ObservationEncoder:
    """Return the numpy encoder that `observation` of a policy's contract describes.

    Args:
        machine: The machine of the policy.
        observation: `describe` of the encoder, as it stands in `policy.json`.

    Raises:
        KeyError: A part of the description is missing.
    """
    if "parts" in observation:
        parts = []
        for one in observation["parts"]:
            shape = (one["samples"], one["width"])
            parts.append(ObservationPart(one["name"], shape, one["mean"], one["std"]))
        return ObservationEncoder(parts)
    pitch = observation.get("pitch")
    scaling = TargetScaling(
        target_mean_m=observation["target"]["mean_m"],
        target_std_m=observation["target"]["std_m"],
        pitch_rad=(pitch["mean_rad"], pitch["std_rad"]) if pitch else None,
    )
    with_proposals = ORDER[PROPOSALS] in observation["order"]
    return ObservationEncoder(list_pose_parts(machine, scaling, with_proposals))
