"""A policy bundle of a trainer: `policy.onnx`, `policy.json` (the contract) and `golden.json`.

The network goes from the observation vector to the masked command; the golden answers are those
that it gave where it was made. A bundle is refused when it was made for another machine, joint
order, history or rate, when contract and network do not belong together, or when its answers differ
here.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

from brokk_rl.errors import CheckpointError, ConfigError
from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.machine import Machine
from brokk_rl.observation import PITCH, restore_encoder
from brokk_rl.plain_files import check_plain_file, parse_json, read_json
from brokk_rl.registry import resolve_package_path
from deploy.guidance import HandLag

CONTRACT, ONNX, GOLDEN = "policy.json", "policy.onnx", "golden.json"
SCHEMA = 2
"""Version of the contract that is read."""
MOST_JSON_BYTES, MOST_ONNX_BYTES = 1 << 21, 1 << 30
"""Sizes beyond which a file is none of a policy; the shipped ones have 150 KB and 300 KB."""
ERRORS_ONLY = 3
"""Severity of onnxruntime's log."""
ROUNDING = 1e-6
"""Largest difference of two equal numbers of a contract."""
TRAINED = 2.0
"""Distance of a target from the middle of those of the training, over their spread, up to which the
policy knows it. Chosen by hand: the shipped policy's targets lie within 1."""
TOLERANCE = 1e-3
"""Largest difference of a command (of full) to the golden answers; the same as at the export."""


class PolicyBundle:
    """A policy ready to act.

    Args:
        folder: Folder of the bundle, or `package:path`.
        machine: The machine it is to act on.

    Attributes:
        encoder: The training's own observation code, with the bundle's scaling.
        contract: Contents of `policy.json`.
        hand: What stands between the policy and the valves where nobody does; `None` where it
            learned without a person.

    Raises:
        CheckpointError: see the module; the message names the difference.
    """

    def __init__(self, folder: str, machine: Machine) -> None:
        try:
            self._load(folder, machine)
        # Whatever a file from elsewhere lacks or holds instead.
        except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
            raise CheckpointError(
                f"policy {folder}: {CONTRACT} or {GOLDEN} is malformed ({type(error).__name__}: "
                f"{error}); export it again (mode=export)"
            ) from error

    def _load(self, folder: str, machine: Machine) -> None:
        place, self._machine = resolve_package_path(folder), machine
        self.contract = _read(place / CONTRACT, folder)
        _check_contract(self.contract, machine, folder)
        observation = self.contract["observation"]
        if observation is None:
            raise CheckpointError(
                f"{folder}: the policy's task cannot be deployed, so there is no {ONNX}; see "
                "brokk_rl.contracts.task"
            )
        encoder = restore_encoder(machine, observation)
        if not encoder.has_target:
            raise CheckpointError(
                f"{folder}: the machine's loop gives target, positions and commands, but the policy "
                f"asks for {', '.join(observation['order'])}; run it in a loop of your own, as "
                "examples/run_policy.py does"
            )
        self.encoder, advice = encoder, observation.get("advice")
        self.hand = HandLag(advice, machine) if advice else None
        expected = self.encoder.describe()
        for key, value in expected.items():
            if key != "size" and _is_different(value, observation.get(key)):
                raise CheckpointError(
                    f"{folder}: the policy was told its observations otherwise ('{key}': {observation.get(key)}, here {value}); "
                    "train or export it again for this machine and version"
                )
        self._session = _open_session(place / ONNX, folder, self.contract)
        wanted = self._session.get_inputs()[0].shape[-1]
        if not expected["size"] == observation["size"] == wanted:
            raise CheckpointError(
                f"{folder}: an observation has {expected['size']} numbers here, {observation['size']} in the contract and {wanted} "
                f"in {ONNX}; history or joints differ"
            )
        self._check_golden(_read(place / GOLDEN, folder), folder)
        for name, bound in (self.contract.get("stop", {}).get("success") or {}).items():
            # No comparison with NaN holds: the machine would go on at the end of the episodes.
            if not math.isfinite(bound):
                raise ValueError(f"expected a finite bound {name} in stop.success, got {bound}")
        # An end that cannot be measured would show only once the machine moves.
        self.is_done(machine.home, np.array(observation["target"]["mean_m"]), None)

    def check_pitch(self, pitch_rad: float | None) -> None:
        """Refuse a wanted pitch that the policy does not ask for, and none where it asks for one.

        Raises:
            ConfigError: `pitch_rad` contradicts the policy's task.
        """
        if PITCH in self.encoder.parts and pitch_rad is None:
            raise ConfigError(
                "deploy.pitch_rad: the policy asks for the wanted pitch of the tool, got null; "
                "give deploy.pitch_rad=<rad>, 1.57 for straight down"
            )
        if pitch_rad is not None and PITCH not in self.encoder.parts:
            raise ConfigError(
                f"deploy.pitch_rad={pitch_rad} was asked for, but the policy's task fixes the pitch; "
                "leave it out, or give a policy that asks for one"
            )

    def is_trained_for(self, target_m: np.ndarray) -> bool:
        """Return whether a target, `(3,)`, lies near those of the training."""
        scaling = self.contract["observation"]["target"]
        off_m = np.abs(target_m - np.array(scaling["mean_m"]))
        return bool((off_m <= TRAINED * np.array(scaling["std_m"])).all())

    def is_done(self, q: np.ndarray, target_m: np.ndarray, pitch_rad: float | None) -> bool:
        """Return whether the tool, at joint positions `(J,)`, is where episodes of the training end.

        Args:
            q: Joint positions, `(J,)`.
            target_m: Target, `(3,)`.
            pitch_rad: Wanted pitch of the tool; `None`: straight down.
        """
        success = self.contract.get("stop", {}).get("success")
        if success is None or not self._machine.has_bodies:
            return False
        tool = compute_tool_kinematics(self._machine, q)
        wanted_rad = math.pi / 2 if pitch_rad is None else pitch_rad
        axis = _find_wanted_axis(target_m, wanted_rad)
        tip_m, along = tool.tip_in_base_m, tool.axis_in_base
        tool_pitch_rad = math.atan2(-along[2], along[:2] @ tip_m[:2] / np.hypot(*tip_m[:2]))
        past_m = tip_m - target_m
        depth_m = past_m @ axis
        measured = {
            "least_depth_below_target_m": depth_m,
            "largest_lateral_m": np.linalg.norm(past_m - depth_m * axis),
            "largest_distance_m": np.linalg.norm(past_m),
            "largest_pitch_error_rad": abs(wanted_rad - tool_pitch_rad),
        }
        within = []
        for name, bound in success.items():
            sign = -1.0 if name.startswith("least") else 1.0
            within.append(sign * measured[name] <= sign * bound)
        return all(within)

    def command(self, observation: np.ndarray) -> np.ndarray:
        """Return masked commands, `(B, J)`, for observation vectors, `(B, O)`."""
        return np.asarray(
            self._session.run(None, {"observation": observation.astype(np.float32)})[0]
        )

    def _check_golden(self, golden: dict[str, Any], folder: str) -> None:
        observations = np.array(golden["observation"], np.float32)
        expected = np.array(golden["command"], np.float32)
        if not len(observations) or observations.shape[1:] != (self.encoder.size,):
            raise CheckpointError(
                f"{folder}: {GOLDEN} holds no answers to compare; export it again (mode=export)"
            )
        for one, answer in zip(observations, expected, strict=True):
            found = self.command(one[None])[0]
            if found.shape != answer.shape or not np.abs(found - answer).max() <= TOLERANCE:
                raise CheckpointError(
                    f"{folder}: the policy answers {found.round(4)} where {answer.round(4)} is expected ({GOLDEN}); the bundle is "
                    "mixed or damaged: export it again (mode=export)"
                )


def _find_wanted_axis(target_m: np.ndarray, pitch_rad: float) -> np.ndarray:
    """Return the direction, `(3,)`, of a tool at `target_m` that has a pitch."""
    bearing_rad = math.atan2(target_m[1], target_m[0])
    out = math.cos(pitch_rad)
    return np.array(
        [out * math.cos(bearing_rad), out * math.sin(bearing_rad), -math.sin(pitch_rad)]
    )


def _check_contract(contract: dict[str, Any], machine: Machine, folder: str) -> None:
    if contract.get("schema") != SCHEMA:
        raise CheckpointError(
            f"{folder}: the contract has schema {contract.get('schema')}, expected {SCHEMA}; export "
            "it again (mode=export)"
        )
    machine.check_fingerprint(contract.get("fingerprint", {}), f"the policy in {folder}")
    facts = {
        "joints": list(machine.joint_names), "exclusive": list(machine.exclusive), "rate_hz": 1 / machine.period_s,
        "dead_time_s": machine.dead_time_s,
    }  # fmt: skip
    for name, here in facts.items():
        if _is_different(here, contract.get(name)):
            raise CheckpointError(
                f"{folder}: the policy's {name} is {contract.get(name)}, that of machine '{machine.name}' {here}"
            )
    command = contract.get("command", {})
    if command.get("order") != list(machine.joint_names) or not command.get("masked"):
        raise CheckpointError(
            f"{folder}: expected masked commands in the order {', '.join(machine.joint_names)}"
        )


def _is_different(mine: Any, other: Any) -> bool:
    """Return whether two pieces of plain data differ by more than rounding."""
    if isinstance(mine, dict) and isinstance(other, dict):
        return mine.keys() != other.keys() or any(_is_different(mine[k], other[k]) for k in mine)
    if isinstance(mine, (list, tuple)) and isinstance(other, list):
        return len(mine) != len(other) or any(map(_is_different, mine, other))
    if isinstance(mine, (int, float)) and isinstance(other, (int, float)):
        return not abs(mine - other) <= ROUNDING  # NaN is no number of a contract
    return mine != other


def _read(path: Path, folder: str) -> dict[str, Any]:
    try:
        return read_json(path, MOST_JSON_BYTES)
    except FileNotFoundError:
        raise CheckpointError(
            f"policy {folder}: {path.name} is missing; give the folder of an exported policy"
        ) from None
    except (OSError, ValueError) as error:
        raise CheckpointError(
            f"policy {folder}: {path.name} cannot be read ({error}); export it again (mode=export)"
        ) from error


def _open_session(
    path: Path, folder: str, contract: dict[str, Any]
) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    # a pool of threads would only wake up late
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = ERRORS_ONLY
    try:
        # Weights may lie in a file beside the network, which is looked for beside its path.
        for one in sorted({path, *path.parent.glob(f"{ONNX}*")}):
            check_plain_file(one, MOST_ONNX_BYTES)
        session = onnxruntime.InferenceSession(
            str(path), options, providers=["CPUExecutionProvider"]
        )
    except Exception as error:  # onnxruntime's errors have no base of their own
        raise CheckpointError(
            f"policy {folder}: {ONNX} cannot be read ({str(error).splitlines()[0]}); copy all files of the policy, "
            f"update onnxruntime {onnxruntime.__version__}, or export it again (mode=export)"
        ) from error
    metadata = session.get_modelmeta().custom_metadata_map
    said = {}
    for key in ("fingerprint", "task"):
        try:
            said[key] = parse_json(metadata.get(f"brokk.{key}", "null"))
        except ValueError as error:
            raise CheckpointError(f"policy {folder}: {ONNX} is damaged ({error})") from error
    if said != {"fingerprint": contract["fingerprint"], "task": contract.get("task")}:
        raise CheckpointError(
            f"policy {folder}: {CONTRACT} and {ONNX} do not belong together; export it again (mode=export)"
        )
    return session
