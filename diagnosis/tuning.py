"""The last touch on a simulator: its own numbers, by free runs through reference recordings that it was not fitted to.

A fit and a diagnosis weigh errors differently, and a dead time that is ten milliseconds off is
evidence for a delay in every case. Only for simulators whose numbers can be set (`parameters`);
what changes is the same for all parts that were left out.
Axes: `F` parts of the reference, `P` numbers, `J` joints, `E` entries.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from brokk_rl.contracts.actuator import Actuator
from brokk_rl.machine import Machine
from diagnosis.evidence import Evidence
from diagnosis.noise import loss, weight

STEPS = 3
SECONDS = 0.004
"""Finite difference of a time; numbers without a unit: `PART`."""
PART = 0.01
FREE = 4.0
"""Prior: numbers are off by so many finite differences."""


def changes(parts: Sequence[Evidence]) -> dict[str, np.ndarray]:
    """Returns by how much the simulator's numbers should change, by name, each `(J,)`; empty where they cannot be set."""
    first = parts[0].candidates
    model: Any = first.base.build(first.machine, 1, torch.device("cpu"))
    if not (own := getattr(model, "parameters", None)):
        return {}
    names = list(own)
    start = np.stack([own[name][0].numpy().astype(float) for name in names])  # (P, J)
    size = np.array([SECONDS if name.endswith("_s") else PART for name in names])[:, None]
    reach = first.machine.num_history * first.machine.period_s - 2.0 * first.machine.period_s
    most = np.where(np.array([name.endswith("_s") for name in names])[:, None], reach, np.inf)
    now, best, lowest = start.copy(), start.copy(), np.full(start.shape[1], np.inf)
    for _ in range(STEPS + 1):
        errors, slopes = _linear(parts, names, now, size)
        total = loss(errors, 1) + 0.5 * np.square((now - start) / size / FREE).sum(0)
        better = total < lowest
        best, lowest = np.where(better, now, best), np.minimum(total, lowest)
        step = np.zeros_like(now)
        for j in range(now.shape[1]):
            weighted = slopes[j] * weight(errors[j])
            normal = weighted @ slopes[j].T + np.eye(len(names)) / FREE**2
            step[:, j] = np.linalg.solve(
                normal, weighted @ errors[j] - (now - start)[:, j] / size[:, 0] / FREE**2
            )
        now = np.clip(
            np.where(better, now + step * size, (now + best) / 2),
            np.minimum(start, 0.0),
            np.maximum(start, most),
        )
    return {
        name: row for name, row in zip(names, best - start, strict=True) if np.abs(row).max() > 0
    }


def changed(actuator: Actuator, by: dict[str, np.ndarray], machine: Machine) -> Actuator:
    """Returns `actuator` with its numbers changed."""
    model: Any = actuator.build(machine, 1, torch.device("cpu"))
    tables: Any = {
        name: dict(
            zip(
                machine.joint_names,
                (model.parameters[name][0].numpy() + row).clip(0.0).tolist(),
                strict=True,
            )
        )
        for name, row in by.items()
    }
    return dataclasses.replace(actuator, **tables)  # pyright: ignore[reportArgumentType, reportCallIssue]


def _linear(
    parts: Sequence[Evidence], names: list[str], now: np.ndarray, size: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns errors over the noise of all parts, `(J, E)`, and what a finite difference of each number takes off, `(J, P, E)`."""
    count = len(names)
    varied = np.repeat(now[None], count + 1, 0)  # (P + 1, P, J)
    for p in range(count):
        varied[p + 1, p] += size[p]
    errors, slopes = [], []
    for part in parts:
        paths = part.candidates.paths(
            [], count + 1, {name: varied[:, p] for p, name in enumerate(names)}
        )
        z = part.whitened(part.error_of(paths))
        errors.append(z[:, 0])
        slopes.append(z[:, :1] - z[:, 1:])
    return np.concatenate(errors, 1), np.concatenate(slopes, 2)
