"""Observation vector of the policy (paper, Table I), the same code in training and on the machine.

Order: borehole position (3), joint positions oldest sample first (H x J), commands oldest first
(H x J): 133 numbers for five joints and 13 samples. A task whose wanted pitch differs from episode
to episode appends it as one more number. A policy that proposes to a person appends its own
proposals, oldest first (H x J): the history holds the commands that the person gave.

Each part is normalised with an approximate mean and standard deviation that follow from the
configuration: a policy carries no hidden statistics.

"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from brokk_rl.bounds import require_number
from brokk_rl.machine import Machine
from brokk_rl.spec import spec


@spec
class TargetScaling:
    """Normalisation of the target.

    Attributes:
        target_mean_m: Approximate mean of the target point in the base frame.
        target_std_m: Its approximate standard deviation.
        pitch_rad: Approximate mean and standard deviation of the wanted pitch where it differs from
            episode to episode and so belongs to the vector; `null` where the task fixes it.
    """

    target_mean_m: tuple[float, float, float]
    target_std_m: tuple[float, float, float]
    pitch_rad: tuple[float, float] | None

    def check(self) -> None:
        for index, std_m in enumerate(self.target_std_m):
            require_number(f"task.scaling.target_std_m[{index}]", std_m, above=0)
        for index, mean_m in enumerate(self.target_mean_m):
            require_number(f"task.scaling.target_mean_m[{index}]", mean_m)
        if self.pitch_rad is not None:
            require_number("task.scaling.pitch_rad: mean", self.pitch_rad[0])
            require_number("task.scaling.pitch_rad: standard deviation", self.pitch_rad[1], above=0)


def compute_size(machine: Machine, with_pitch: bool = False, with_proposals: bool = False) -> int:
    """Return the length of the observation vector, with pitch and proposals if wanted."""
    return 3 + (2 + with_proposals) * machine.num_history * machine.num_joints + with_pitch


class ObservationEncoder:
    """Turns a history and a target into the policy's vector, and back.

    Args:
        machine: Gives the normalisation of joint positions (middle and quarter of the travel), rate
            and order.
        scaling: Normalisation of the target point.
        constant: Makes an array of the kind and on the device of the inputs; `numpy.asarray` on the
            machine.
        concat: `numpy.concatenate` or `torch.cat`, called as `concat(parts, 1)`.
        with_proposals: Whether the policy proposes to a person.
    """

    def __init__(
        self,
        machine: Machine,
        scaling: TargetScaling,
        constant: Callable[[np.ndarray], Any] = np.asarray,
        concat: Callable[[tuple[Any, ...], int], Any] = np.concatenate,
        with_proposals: bool = False,
    ) -> None:
        self.shape = (machine.num_history, machine.num_joints)
        self._machine, self._scaling = machine, scaling
        self.has_pitch = scaling.pitch_rad is not None
        self.has_proposals = with_proposals
        self.size = compute_size(machine, self.has_pitch, with_proposals)
        self._concat = concat
        self._target_mean_m = constant(np.array(scaling.target_mean_m, np.float32))
        self._target_std_m = constant(np.array(scaling.target_std_m, np.float32))
        self._pitch_mean_rad, self._pitch_std_rad = scaling.pitch_rad or (0.0, 1.0)
        self._q_mean = constant(((machine.lower + machine.upper) / 2).astype(np.float32))
        self._q_std = constant(((machine.upper - machine.lower) / 4).astype(np.float32))

    def encode(
        self, target_in_base_m: Any, q: Any, u: Any, pitch_rad: Any = None, proposed: Any = None
    ) -> Any:
        """Return the vector, shape `(N, size)`.

        Args:
            target_in_base_m: Estimated target point (the centre of the borehole's rim), shape `(N,
                3)`.
            q: Measured joint positions, oldest first, shape `(N, H, J)`, rad or m.
            u: Commands in force, oldest first, shape `(N, H, J)`, in [-1, 1].
            pitch_rad: Wanted pitch of the tool, shape `(N,)`; left out where the task fixes it.
            proposed: Proposals so far, oldest first, shape `(N, H, J)`; left out where no person
                stands between.
        """
        # the width is fixed and the batch is not: a length read here would be a constant of the
        # exported graph
        num = self.shape[0] * self.shape[1]
        target = (target_in_base_m - self._target_mean_m) / self._target_std_m
        joints = ((q - self._q_mean) / self._q_std).reshape(-1, num)
        parts = (target, joints, u.reshape(-1, num))
        if self.has_pitch:
            parts = (*parts, ((pitch_rad - self._pitch_mean_rad) / self._pitch_std_rad)[:, None])
        if self.has_proposals:
            parts = (*parts, proposed.reshape(-1, num))
        return self._concat(parts, 1)

    def decode(self, vector: Any) -> tuple[Any, Any, Any]:
        """Invert `encode`: returns target `(N, 3)` in m, positions and commands `(N, H, J)`."""
        num = self.shape[0] * self.shape[1]
        target = vector[:, :3] * self._target_std_m + self._target_mean_m
        q = vector[:, 3 : 3 + num].reshape(-1, *self.shape) * self._q_std + self._q_mean
        return target, q, vector[:, 3 + num : 3 + 2 * num].reshape(-1, *self.shape)

    def decode_pitch(self, vector: Any) -> Any:
        """Return the wanted pitch `(N,)` in rad, where `has_pitch`."""
        return (
            vector[:, 3 + 2 * self.shape[0] * self.shape[1]] * self._pitch_std_rad
            + self._pitch_mean_rad
        )

    def decode_proposals(self, vector: Any) -> Any:
        """Return the proposals, `(N, H, J)`, where `has_proposals`."""
        return vector[:, -self.shape[0] * self.shape[1] :].reshape(-1, *self.shape)

    def mirror(self, vector: Any, joint_signs: Any) -> Any:
        """Return the vector that the mirrored machine sees, `(N, size)`; see `brokk_rl.symmetry`.

        Args:
            vector: The vector, `(N, size)`.
            joint_signs: -1 for each joint that moves to the other side, else 1, `(J,)`.
        """
        target_m, q, u = self.decode(vector)
        parts = (target_m[:, :1], -target_m[:, 1:2], target_m[:, 2:])
        pitch_rad = self.decode_pitch(vector) if self.has_pitch else None
        proposed = self.decode_proposals(vector) * joint_signs if self.has_proposals else None
        target_m = self._concat(parts, 1)
        return self.encode(target_m, q * joint_signs, u * joint_signs, pitch_rad, proposed)

    def decode_inputs(self, vector: Any) -> dict[str, Any]:
        """Return target, history, pitch and proposals of vectors in their units, by name."""
        target_m, q, u = self.decode(vector)
        inputs = {"target_in_base_m": target_m, "q": q, "u": u}
        if self.has_pitch:
            inputs["pitch_rad"] = self.decode_pitch(vector)
        if self.has_proposals:
            inputs["proposals"] = self.decode_proposals(vector)
        return inputs

    def describe(self) -> dict[str, Any]:
        """Return order and scale of the vector as plain JSON data, for the contract of a policy."""
        lower, upper = self._machine.lower, self._machine.upper
        order = ["target_in_base_m (3)", "q oldest first (H x J)", "u oldest first (H x J)"]
        pitch = (
            {"pitch": {"mean_rad": self._pitch_mean_rad, "std_rad": self._pitch_std_rad}}
            if self.has_pitch
            else {}
        )
        order += ["pitch_rad (1)"] * self.has_pitch + [
            "proposals oldest first (H x J)"
        ] * self.has_proposals
        return {
            "size": self.size,
            "order": order,
            "target": {
                "mean_m": list(self._scaling.target_mean_m),
                "std_m": list(self._scaling.target_std_m),
            },
            "q": {"mean": ((lower + upper) / 2).tolist(), "std": ((upper - lower) / 4).tolist()},
            "u": {"mean": 0.0, "std": 1.0},
        } | pitch


@dataclass(frozen=True)
class ObservationPart:
    """A part of the vector of a task made of terms.

    Attributes:
        name: Name of its term.
        samples: Newest samples in the vector, oldest first.
        width: Numbers of a sample.
        mean: Subtracted.
        std: By which the difference is divided.
    """

    name: str
    samples: int
    width: int
    mean: float
    std: float


class PartsEncoder:
    """Turns the samples of named parts into one vector, and back; numpy and torch.

    Args:
        parts: In the order of the vector.
        concat: `numpy.concatenate` or `torch.cat`, called as `concat(parts, 1)`.
    """

    def __init__(
        self,
        parts: Sequence[ObservationPart],
        concat: Callable[[tuple[Any, ...], int], Any] = np.concatenate,
    ) -> None:
        self.parts, self._concat = tuple(parts), concat
        self.size = sum(part.samples * part.width for part in self.parts)

    def encode(self, samples: Mapping[str, Any]) -> Any:
        """Return the vector, `(N, size)`, of the samples by name, each `(N, samples, width)`."""
        scaled = []
        for part in self.parts:
            value = (samples[part.name] - part.mean) / part.std
            scaled.append(value.reshape(-1, part.samples * part.width))
        return self._concat(tuple(scaled), 1)

    def decode_inputs(self, vector: Any) -> dict[str, Any]:
        """Invert `encode`."""
        inputs, begin = {}, 0
        for part in self.parts:
            end = begin + part.samples * part.width
            value = vector[:, begin:end].reshape(-1, part.samples, part.width)
            inputs[part.name], begin = value * part.std + part.mean, end
        return inputs

    def describe(self) -> dict[str, Any]:
        """Return the parts as plain JSON data, for the contract of a policy."""
        order = [f"{part.name} ({part.samples} x {part.width})" for part in self.parts]
        parts = [asdict(part) for part in self.parts]
        return {"size": self.size, "order": order, "parts": parts}


TARGET_DISTANCE = "target.distance"
"""Name of the horizontal distance of the target in a range table."""
RangeTable = dict[str, tuple[float, float]]
"""Lowest and highest value by name: `target.x`, `target.distance`, `pitch`, `q.<joint>`."""


def measure_ranges(
    encoder: "ObservationEncoder", vectors: np.ndarray, joints: tuple[str, ...]
) -> RangeTable:
    """Return the range of targets and positions, in rad and m, over observation vectors.

    Args:
        encoder: The encoder of the vectors, with numpy arrays.
        vectors: Observation vectors, `(B, size)`.
        joints: Names of the joints, `J`.
    """
    target_m, q, _ = encoder.decode(vectors)
    values = {f"target.{letter}": target_m[:, axis] for axis, letter in enumerate("xyz")}
    values[TARGET_DISTANCE] = np.hypot(target_m[:, 0], target_m[:, 1])
    if encoder.has_pitch:
        values["pitch"] = encoder.decode_pitch(vectors)
    for column, joint in enumerate(joints):
        values[f"q.{joint}"] = q[:, :, column]
    return {name: (float(one.min()), float(one.max())) for name, one in values.items()}


def restore_encoder(
    machine: Machine, observation: Mapping[str, Any]
) -> ObservationEncoder | PartsEncoder:
    """Return the numpy encoder that `observation` of a policy's contract describes.

    Args:
        machine: The machine of the policy.
        observation: `describe` of the encoder, as it stands in `policy.json`.

    Raises:
        KeyError: A part of the description is missing.
    """
    if "parts" in observation:
        names = ObservationPart.__dataclass_fields__
        return PartsEncoder(
            [
                ObservationPart(**{name: part[name] for name in names})
                for part in observation["parts"]
            ]
        )
    pitch = observation.get("pitch")
    scaling = TargetScaling(
        target_mean_m=observation["target"]["mean_m"],
        target_std_m=observation["target"]["std_m"],
        pitch_rad=(pitch["mean_rad"], pitch["std_rad"]) if pitch else None,
    )
    proposals = any("proposals" in part for part in observation["order"])
    return ObservationEncoder(machine, scaling, with_proposals=proposals)
