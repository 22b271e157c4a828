"""Parts of the report about rivals, gates, the edit test, and sizes at a bound; the gates in the terminal."""

from __future__ import annotations

from collections.abc import Sequence

from brokk_rl.report import Cell, Report
from diagnosis.answer import Answer, Selected, format_error
from diagnosis.attribution import MIN_RESTORED
from diagnosis.closure import Gate

RIVALS = {
    "hold": "standing still",
    "arx": "ARX with dead-band hinges, fitted to other parts of the field",
    "flexible": "flexible model, fitted to other parts of the field",
}
"""Rivals in words."""


def add_rivals(page: Report, answer: Answer) -> None:
    """Add the errors of simple rivals beside those of the simulator."""
    gap = answer.gap
    if gap is None or not answer.rivals:
        return
    rows: list[list[str | Cell | None]] = [
        ["simulator as it was", format_error(gap.before, gap.unit)]
    ]
    if answer.selected:
        rows.append(["simulator with the effects", format_error(gap.after, gap.unit)])
    if gap.floor is not None:
        rows.append(["floor: unchanged machine, this motion", format_error(gap.floor, gap.unit)])
    for name, one in answer.rivals.items():
        error = None if one.rmse is None else format_error(one.rmse, gap.unit)
        rows.append([Cell(RIVALS.get(name, name), one.reason), error])
    page.add_table(["model", "error"], rows, "Error of free runs on the same windows")


def add_gates(page: Report, answer: Answer) -> None:
    """Add the conditions of the verdict, the failed ones first."""
    if not answer.gates:
        return
    page.add_heading("Conditions of the verdict")
    rows: list[list[str | Cell | None]] = []
    for gate in sorted(answer.gates, key=lambda one: one.passed):
        held = "held" if gate.passed else "failed"
        rows.append([held, gate.text, *format_gate(gate)])
    page.add_table(["", "finding", "value", "limit"], rows)


def add_motion_delays(page: Report, answer: Answer) -> None:
    """Add the delay from command to motion by cross-correlation, measured and simulated."""
    told = answer.more.get("motion_delay_s") or {}
    rows: list[list[str | Cell | None]] = []
    for joint, one in told.items():
        if one is None:
            rows.append([joint, "not told", None, None])
            continue
        interval = f"95 %: {1e3 * one['ci95'][0]:.0f} to {1e3 * one['ci95'][1]:.0f}"
        measured = Cell(f"{1e3 * one['measured']:.0f}", interval)
        simulated = [one.get(name) for name in ("before", "after")]
        ends = [None if value is None else f"{1e3 * value:.0f}" for value in simulated]
        rows.append([joint, measured, *ends])
    if rows:
        page.add_table(
            ["joint", "measured, ms", "simulator as it was, ms", "with the effects, ms"],
            rows,
            "Delay from command to motion: the shift at which the speed resembles its command most. Dead time, "
            "lag, play and one control period add up to it.",
        )


def format_gate(gate: Gate) -> tuple[str | None, str | None]:
    """Return value and limit of a gate as texts."""
    value, limit = (
        None if number is None else f"{number:.3g}" for number in (gate.value, gate.limit)
    )
    return value, limit


def list_failed_gates(gates: Sequence[Gate]) -> list[str]:
    """Return a line for each gate that failed."""
    lines = []
    for gate in gates:
        if not gate.passed:
            value, limit = format_gate(gate)
            numbers = "" if value is None else f" ({value}, limit {limit})"
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
