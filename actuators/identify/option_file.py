"""Files of a fit: an option of the group `actuator`, and what is known about its numbers; their standard errors."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from brokk_rl.machine import Machine
from brokk_rl.session import write_json, write_text


def write_option(folder: Path, name: str, actuator: Any, comment: str) -> None:
    """Write `<name>.yaml` for `actuator=@…`.

    Raises:
        StorageError: the file could not be written.
    """
    kind = type(actuator)
    # through JSON, which makes lists of tuples as YAML wants them
    numbers = json.loads(json.dumps(dataclasses.asdict(actuator)))
    node = {"_target_": f"{kind.__module__}.{kind.__qualname__}", **numbers}
    text = yaml.safe_dump(node, sort_keys=False, default_flow_style=None, width=130)
    write_text(folder / f"{name}.yaml", f"# {comment}\n{text}")


def write_numbers(
    folder: Path,
    name: str,
    actuator: Any,
    machine: Machine,
    numbers: Mapping[str, np.ndarray],
    errors: Mapping[str, np.ndarray],
) -> Any:
    """Write `<name>.yaml` with fitted numbers, and `<name>.json` with their standard errors, if there are any.

    Args:
        folder: Where to.
        name: Name of the model.
        actuator: The model with the numbers that are not fitted.
        machine: The machine.
        numbers: By name, `(J,)`, or rows of them `(J, M)`; written with five digits.
        errors: Standard errors of some of them, `(J,)`; NaN for a joint that lacks the number.

    Returns:
        The fitted actuator.

    Raises:
        StorageError: a file could not be written.
    """
    values = {}
    for key, column in numbers.items():
        values[key] = {}
        for joint, row in zip(machine.joint_names, column, strict=True):
            found = tuple(float(f"{one:.5g}") for one in np.atleast_1d(row))
            values[key][joint] = found if np.ndim(row) else found[0]
    told: dict[str, dict[str, dict[str, float]]] = {}
    for key, column in errors.items():
        told[key] = {}
        for joint, value, error in zip(machine.joint_names, numbers[key], column, strict=True):
            if np.isfinite(error):
                told[key][joint] = {"value": float(value), "standard_error": float(error)}
    fitted = dataclasses.replace(actuator, **values)
    if errors:
        write_json(folder / f"{name}.json", {"schema": 1, "parameters": told})
    write_option(folder, name, fitted, f"fitted to recordings of {machine.name}")
    return fitted


def estimate_standard_errors(
    compute_errors: Callable[[np.ndarray], np.ndarray],
    x: np.ndarray,
    steps: np.ndarray,
    lengths: Sequence[int],
) -> np.ndarray:
    """Return standard errors by the sandwich over recordings (Liang and Zeger 1986), `(F,)`.

    The errors of a model that is not quite right hang together: the spread of the recordings' own
    gradients says how far a number would move with others. It is never less than white errors give.

    Args:
        compute_errors: Errors of all recordings, one after the other, for numbers `(F,)`.
        x: The numbers, `(F,)`.
        steps: Differences by which slopes are taken, `(F,)`.
        lengths: Number of errors of each recording.
    """
    errors = compute_errors(x)
    slopes = [compute_errors(x + one) - errors for one in np.diag(steps)]
    jacobian = np.stack(slopes, 1)
    inverse = np.linalg.pinv(jacobian.T @ jacobian)
    parts = np.split(jacobian * errors[:, None], np.cumsum(lengths)[:-1])
    scores = np.stack([part.sum(0) for part in parts])
    spread = inverse @ scores.T @ scores @ inverse
    white = inverse * np.square(errors).sum() / max(1, len(errors) - len(x))
    return steps * np.sqrt(np.maximum(np.diag(spread), np.diag(white)))
