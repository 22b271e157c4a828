"""What a grey-box fit leaves: its numbers with intervals, what the recordings do not tell, and a config option to run it again."""

import dataclasses
import logging
from typing import Any

import numpy as np
import yaml

from actuators.identify.gauss_newton import Certainty, FreeRuns
from brokk_rl.machine import Machine

log = logging.getLogger(__name__)

TOLD = 0.5
"""A number whose interval is wider than this part of its range is one that the recordings do not
tell."""
TANGLED = 0.95
"""Correlation from which on two numbers stand for each other."""


def table(
    found: dict[str, dict[str, float]], runs: FreeRuns, x: np.ndarray, sure: Certainty
) -> dict[str, Any]:
    """Returns each number `found` by name and joint with its standard error, its interval, and whether the recordings tell it."""
    low, high = (
        runs.values(np.clip(x - sure.half, 0.0, 1.0)),
        runs.values(np.clip(x + sure.half, 0.0, 1.0)),
    )
    width = runs.values(np.ones_like(x)) - runs.values(np.zeros_like(x))
    return {
        name: {
            joint: {
                "value": value,
                "standard_error": float(sure.deviation[p, j] * width[p, j]),
                "ci95": [float(low[p, j]), float(high[p, j])],
                "told": bool(2.0 * sure.half[p, j] <= TOLD),
                "at_bound": bool(x[p, j] <= 0.0 or x[p, j] >= 1.0),
                "runs": int(sure.runs[j]),
            }
            for j, (joint, value) in enumerate(row.items())
        }
        for p, (name, row) in enumerate(found.items())
    }


def tangled(machine: Machine, runs: FreeRuns, sure: Certainty) -> list[dict[str, Any]]:
    """Returns the pairs of numbers that stand for each other: their correlation exceeds `TANGLED`."""
    labels = [f"{name} {joint}" for name in runs.names for joint in machine.joint_names]
    pairs = np.argwhere(np.triu(np.abs(sure.correlation), 1) > TANGLED)
    return [
        {"pair": [labels[a], labels[b]], "correlation": round(float(sure.correlation[a, b]), 3)}
        for a, b in pairs
    ]


def option(fitted: Any, facts: dict[str, Any]) -> str:
    """Returns the text of a config option of the group `actuator`."""
    kind = type(fitted)
    node = {"_target_": f"{kind.__module__}.{kind.__qualname__}", **dataclasses.asdict(fitted)}
    lines = [
        f"# {kind.__name__} fitted to {facts['recordings']} recordings ({facts['runs']} runs, {facts['minutes']:g} min) of machine "
        f"'{facts['machine']}', {facts['created']}.",
        "# Use: actuator=@<this file>. A number that the recordings do not tell has its whole range as interval.",
        f"# Error of free runs of {facts['horizon_s']:g} s on the validation recordings, at their end, rad or m: "
        + ", ".join(
            f"{joint} {'-' if value is None else f'{value:.4f}'}"
            for joint, value in facts["validation_rmse"].items()
        ),
        "# 95 % intervals:",
    ]
    for name, row in facts["parameters"].items():
        cells = [
            f"{joint} {cell['ci95'][0]:.4g} to {cell['ci95'][1]:.4g}{'' if cell['told'] else ' (not told)'}"
            for joint, cell in row.items()
        ]
        lines.append(f"#   {name}: {', '.join(cells)}")
    return (
        "\n".join(lines)
        + "\n"
        + yaml.safe_dump(node, sort_keys=False, default_flow_style=None, width=132)
    )


def tell(facts: dict[str, Any]) -> None:
    """Logs what the recordings do not determine."""
    for name, row in facts["parameters"].items():
        if vague := [joint for joint, cell in row.items() if not cell["told"]]:
            log.warning(
                "%s: the recordings do not tell it for %s (interval over half of fit.free.%s)",
                name,
                ", ".join(vague),
                name,
            )
        if stuck := [joint for joint, cell in row.items() if cell["at_bound"]]:
            log.warning(
                "%s: at the end of fit.free.%s for %s; widen it if that makes sense",
                name,
                name,
                ", ".join(stuck),
            )
    for pair in facts["tangled"]:
        log.warning(
            "%s and %s stand for each other (correlation %.2f)", *pair["pair"], pair["correlation"]
        )
