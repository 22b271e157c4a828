"""Measurements of the loop on the machine's computer, against the simulated machine."""

from __future__ import annotations

from pathlib import Path

from measurement import Measurement, Table, load_json

CODE = (
    "deploy/kernel", "deploy/checks", "deploy/bus", "deploy/runtime", "deploy/twin", "conf/guard", "conf/machine",
)  # fmt: skip


def read_reactions(folder: Path) -> Table:
    """Return the times of each kill, stop and fault."""
    reactions = load_json(folder / "reactions.json")["reactions"]
    return [{"event": event, **one} for event, one in reactions.items()]


def read_injections(folder: Path) -> Table:
    """Return how many faults were injected in each mode, what still moved, and the longest time."""
    modes: dict[str, list[dict[str, int]]] = {}
    for event, one in load_json(folder / "injections.json").items():
        if "trials" in one:
            modes.setdefault(event.split(":")[0], []).append(one)
    rows: Table = []
    for mode, found in modes.items():
        row = {"mode": mode, "kinds of faults": len(found)}
        row["trials"] = sum(one["trials"] for one in found)
        row["trials that still moved"] = sum(one["moves"] for one in found)
        row["longest, ms"] = max(one.get("worst_ms") or 0 for one in found)
        rows.append(row)
    return rows


def read_soak(folder: Path) -> Table:
    """Return the lateness of each process over the whole run."""
    soak = load_json(folder / "run/soak.json")
    rows: Table = []
    for one in soak["processes"]:
        row = {"process": one["process"], "cycles": one["cycles"], "missed": one["missed"]}
        row["late, ms, 99 %"] = round(1e3 * one["late_p99_s"], 2)
        row["longest, ms"] = round(1e3 * one["late_max_s"], 1)
        row["memory after 5 min, MB"] = soak["own_memory_growth_after_5_min_mb"][one["process"]]
        rows.append(row)
    return rows


MEASUREMENTS = (
    Measurement(
        name="reactions",
        title="Reaction times of real processes",
        conditions="Twin, bus process and commander as processes of one computer, with real-time priority where it is granted. Time until the valves get nothing any "
        "more, as a listener on the bus hears it. Without the guard the last command would stay in force.",
        commands=("python benchmarks/deploy/reactions.py {out}/reactions.json 60",),
        code=CODE,
        read=read_reactions,
        where="two cores",
        minutes=15,
    ),
    Measurement(
        name="injections",
        title="Faults on the way between gateway and computer",
        conditions="The same parts on a simulated clock; each trial begins at another phase of all cycles. `moves` counts trials in which the valves still got something "
        "at the end of the time watched.",
        commands=("python benchmarks/deploy/injections.py {out}/injections.json 60",),
        code=CODE,
        read=read_injections,
        where="one core",
        minutes=30,
    ),
    Measurement(
        name="soak",
        title="An hour of the loop",
        conditions="The loop against the twin with a simulated person, moving all the time. No record was lost and no counter of a message jumped.",
        commands=("python benchmarks/deploy/soak.py {out}/run 3600",),
        code=CODE,
        read=read_soak,
        where="two cores",
        minutes=60,
    ),
)
