"""Sentences about gates, the edit test, and sizes at a bound, for the report and the terminal."""

from __future__ import annotations

from collections.abc import Sequence

from diagnosis.answer import Selected
from diagnosis.closure import MIN_RESTORED, Gate


def list_failed_gates(gates: Sequence[Gate]) -> list[str]:
    """Return a line for each gate that failed."""
    lines = []
    for gate in gates:
        if not gate.passed:
            numbers = "" if gate.value is None else f" ({gate.value:.3g}, limit {gate.limit:.3g})"
            lines.append(f"failed: {gate.name}{numbers}: {gate.text}")
    return lines


def describe_bounds(one: Selected) -> str:
    """Return which sizes of an effect ended at a bound, or nothing."""
    names = []
    for name, values in one.parameters.items():
        names += [f"{name} {joint}" for joint, value in values.items() if value.at_bound]
    if not names:
        return ""
    effect = one.effect.replace("_", " ")
    return f"At its bound: {', '.join(names)} of {effect}. The true size may lie beyond, or another effect is meant."


def describe_edit(one: Selected) -> str:
    """Return that an effect failed the edit test, or nothing."""
    if one.identified is not False or one.edit is None:
        return ""
    effect = one.effect.replace("_", " ")
    return (
        f"Not identified: without {effect} the repaired simulator's error rises by "
        f"{100 * one.edit['restored']:.0f} % of this effect's part; "
        f"{100 * MIN_RESTORED:.0f} % or more are expected."
    )
