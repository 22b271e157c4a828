"""Contract of a deployed policy: which columns of a log its observation vector is made of.

Two kinds of files are read. `policy.json` of this project's bundles names its terms in
`observation.order`. For any other ONNX file a contract lists them:

    {"rate_hz": 50, "joints": ["hip", "knee"],
     "observation": {"terms": [
       {"name": "q", "columns": ["q_hip_rad", "q_knee_rad"], "samples": 3, "newest": 0,
        "mean": [0, 0.4], "std": 1, "clip": null}]},
     "command": {"columns": ["u_hip", "u_knee"]}}

`docs/doctor.md` explains each field.
Axes: `T` rows of a log, `H` samples of history (oldest first), `C` columns of a term, `J` joints,
`O` numbers of the observation vector.
"""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

from brokk_rl.errors import CheckpointError
from brokk_rl.machine import Machine
from brokk_rl.record import name_command_column, name_position_column
from brokk_rl.registry import resolve_package_path

CONTRACT, ONNX = "policy.json", "policy.onnx"
ERRORS_ONLY = 3
"""Severity of onnxruntime's log."""
TARGET_COLUMNS = ("target_x_m", "target_y_m", "target_z_m")
PITCH_COLUMN = "target_pitch_rad"
OBSERVATION_COLUMN = "obs_{}"
"""Column of the observation vector as the network got it, by number."""


NEWEST = {"q": 0, "u": -1, "proposals": -1}
"""Row of the newest sample of the terms of a bundle that have a history."""


def name_advice_column(joint: str) -> str:
    """Return the column with the command that the policy gave for `joint`."""
    return f"advice_{joint}"


@dataclass(frozen=True)
class ObservationTerm:
    """A part of the observation vector: samples of some columns of the log.

    Attributes:
        name: Its name: `q`, `u`, `target`, `pitch`, `proposals`, or the author's own.
        columns: Columns of the log, `C`.
        samples: Samples of history, `H`.
        newest: Row of the newest sample, counted from the row of the decision; -1 for the commands
            in force before it.
        mean: Subtracted, `(C,)`.
        std: Divisor after that, `(C,)`.
        clip: Bound of the normalised values; `None` without one.
    """

    name: str
    columns: tuple[str, ...]
    samples: int
    newest: int
    mean: np.ndarray
    std: np.ndarray
    clip: float | None

    def list_numbers(self) -> list[str]:
        """Return a name for each number, oldest sample first."""
        found = []
        for sample in range(1 - self.samples, 1):
            lag = f"[{sample + self.newest}]" if self.samples > 1 else ""
            found += [f"{column}{lag}" for column in self.columns]
        return found


@dataclass(frozen=True)
class PolicyContract:
    """Contract of a policy, from either kind of file.

    Attributes:
        source: The file.
        rate_hz: Control rate.
        joints: Joints in the order of the command.
        terms: Parts of the observation vector, in their order.
        commands: Columns of the log with the command in force, in the order of the output.
        training: Statistics of the training's observations; `None` where there are none.
    """

    source: Path
    rate_hz: float
    joints: tuple[str, ...]
    terms: tuple[ObservationTerm, ...]
    commands: tuple[str, ...]
    training: Mapping[str, Any] | None

    @property
    def size(self) -> int:
        """Length of the observation vector, `O`."""
        return len(self.labels)

    @property
    def labels(self) -> tuple[str, ...]:
        """Name of each number of the observation vector."""
        return tuple(itertools.chain.from_iterable(term.list_numbers() for term in self.terms))

    @property
    def num_samples(self) -> int:
        """Rows that the longest history spans."""
        return max(term.samples - min(0, term.newest) for term in self.terms)

    @property
    def term_slices(self) -> dict[str, slice]:
        """Place of each term in the observation vector."""
        found, at = {}, 0
        for term in self.terms:
            end = at + term.samples * len(term.columns)
            found[term.name] = slice(at, end)
            at = end
        return found


class PolicyNetwork:
    """An ONNX policy: from observation vectors to commands.

    Args:
        path: The file.

    Raises:
        CheckpointError: It cannot be read.
    """

    def __init__(self, path: Path) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = ERRORS_ONLY
        try:
            content, providers = path.read_bytes(), ["CPUExecutionProvider"]
            self._session = onnxruntime.InferenceSession(content, options, providers=providers)
        except FileNotFoundError:
            raise CheckpointError(
                f"{path} is missing; give a folder with {CONTRACT} and {ONNX}"
            ) from None
        except Exception as error:  # onnxruntime's errors have no base of their own
            raise CheckpointError(
                f"{path} is damaged or no ONNX file ({str(error).splitlines()[0]})"
            ) from error
        entry = self._session.get_inputs()[0]
        self._input = entry.name
        self._one_by_one = entry.shape[0] == 1
        self.size = entry.shape[-1] if isinstance(entry.shape[-1], int) else None
        """Length of the observation vector; `None` where the file leaves it open."""

    def answer(self, vectors: np.ndarray) -> np.ndarray:
        """Return commands, `(B, J)`, for observation vectors, `(B, O)`; NaN where one holds NaN."""
        known = np.asarray(np.isfinite(vectors).all(1))[:, None]
        given = np.where(known, vectors, 0.0).astype(np.float32)
        answers = []
        for batch in np.split(given, len(given)) if self._one_by_one else [given]:
            answers.append(np.asarray(self._session.run(None, {self._input: batch})[0], float))
        return np.where(known, np.concatenate(answers), np.nan)


@dataclass(frozen=True)
class LoadedPolicy:
    """A policy with its contract.

    Attributes:
        contract: The contract.
        network: The network.
    """

    contract: PolicyContract
    network: PolicyNetwork


def load_policy(folder: str, machine: Machine) -> LoadedPolicy:
    """Read a policy.

    Args:
        folder: Folder with `policy.json` and `policy.onnx`, `package:path`, or an ONNX file beside
            its contract of the same name, `<name>.json`.
        machine: Machine of the log.

    Raises:
        CheckpointError: A file is missing, damaged, or does not fit the other.
    """
    place = resolve_package_path(folder)
    is_file = place.suffix == ".onnx"
    path = place.with_suffix(".json") if is_file else place / CONTRACT
    contract = read_contract(path, machine)
    network = PolicyNetwork(place if is_file else place / ONNX)
    if network.size is not None and network.size != contract.size:
        raise CheckpointError(
            f"{path}: its terms have {contract.size} numbers, the network takes {network.size}; "
            "mend observation.terms"
        )
    num_commands = network.answer(np.zeros((1, contract.size))).shape[-1]
    if num_commands != len(contract.commands):
        raise CheckpointError(
            f"{path}: the network gives {num_commands} commands, the contract names {len(contract.commands)} "
            f"({', '.join(contract.commands)}); mend joints or command.columns"
        )
    return LoadedPolicy(contract, network)


def read_contract(path: Path, machine: Machine) -> PolicyContract:
    """Read a contract of either kind.

    Raises:
        CheckpointError: It is missing, damaged or incomplete.
    """
    try:
        data = json.loads(path.read_text())
        observation = data["observation"]
        if observation is None:
            raise CheckpointError(f"{path}: the policy's task cannot be deployed: it has no {ONNX}")
        if "parts" in observation:
            raise CheckpointError(
                f"{path}: the observation has terms of the task's own "
                f"({', '.join(part['name'] for part in observation['parts'])}), whose columns in a log are not known; give "
                f"the {ONNX} beside a contract that names them (docs/doctor.md)"
            )
        is_own = "order" in observation
        unknown = [name for name in data["joints"] if name not in machine.joint_names]
        if is_own and unknown:
            raise CheckpointError(
                f"{path}: the policy commands {', '.join(data['joints'])}, but machine '{machine.name}' has "
                f"{', '.join(machine.joint_names)}, without {', '.join(unknown)}; give the policy's machine=…"
            )
        terms = _list_own_terms(data, machine) if is_own else observation["terms"]
        joints = tuple(data["joints"])
        commands = data.get("command", {}).get("columns") or map(name_command_column, joints)
        return PolicyContract(
            source=path,
            rate_hz=float(data["rate_hz"]),
            joints=joints,
            terms=tuple(map(_read_term, terms)),
            commands=tuple(commands),
            training=data.get("training_observations"),
        )
    except FileNotFoundError:
        raise CheckpointError(
            f"{path} is missing; give the folder of a policy, or an ONNX file with its contract"
        ) from None
    except (OSError, KeyError, ValueError, TypeError, AttributeError) as error:
        fault = f"cannot be used ({type(error).__name__}: {error})"
        if isinstance(error, KeyError):
            fault = f"lacks {error}"
        text = f"{path}: this contract {fault}; docs/doctor.md lists its fields"
        raise CheckpointError(text) from error


def _list_own_terms(data: Mapping[str, Any], machine: Machine) -> list[dict[str, Any]]:
    """Return the terms of a bundle of this project, as a contract for any network lists them."""
    joints, observation = data["joints"], data["observation"]
    units = {joint.name: joint.unit for joint in machine.joints}
    columns = {
        "target": TARGET_COLUMNS,
        "q": [name_position_column(name, units[name]) for name in joints],
        "u": [*map(name_command_column, joints)],
        "pitch": [PITCH_COLUMN],
        "proposals": [*map(name_advice_column, joints)],
    }
    terms = []
    for part in observation["order"]:
        name = re.split(r"\W|_", part)[0]  # `pitch_rad (1)`
        term = {"name": name, "columns": columns[name]}
        if name in NEWEST:
            term |= {"samples": data["history"]["samples"], "newest": NEWEST[name]}
        for key, value in observation.get(name, {}).items():
            term[key.partition("_")[0]] = value  # `mean_rad`
        terms.append(term)
    return terms


def _read_term(term: Mapping[str, Any]) -> ObservationTerm:
    """Return a term of a contract for any network."""
    columns = tuple(term["columns"])
    samples, newest = int(term.get("samples", 1)), int(term.get("newest", 0))
    std = np.broadcast_to(np.asarray(term.get("std", 1.0), float), (len(columns),))
    if samples < 1 or newest > 0 or not (std > 0.0).all():
        raise ValueError(
            f"term {term['name']}: expected samples of 1 or more, newest of 0 or less and std above 0, got {samples}, "
            f"{newest} and {std.tolist()}"
        )
    mean = np.broadcast_to(np.asarray(term.get("mean", 0.0), float), (len(columns),))
    name, clip = str(term["name"]), term.get("clip")
    return ObservationTerm(name, columns, samples, newest, mean, std, clip)
