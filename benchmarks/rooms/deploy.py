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


def read_lateness(folder: Path) -> Table:
    """Return the lateness of each process over the whole run."""
    rows: Table = []
    for one in load_json(folder / "run/timing.json")["processes"]:
        row = {"process": one["process"], "cycles": one["cycles"], "missed": one["missed"]}
        row["late, ms, 99 %"] = round(1e3 * one["late_p99_s"], 2)
        row["longest, ms"] = round(1e3 * one["late_max_s"], 1)
        rows.append(row)
    return rows


MEASUREMENTS = (
    Measurement(
        name="reactions",
        title="Reaction times of real processes",
        conditions="Twin, bus process and commander as processes of one computer. Time until the valves get nothing any more, as a listener on the bus hears it. Without the guard the last command would stay in force.",
        commands=("python benchmarks/deploy/reactions.py {out}/reactions.json 40",),
        code=CODE,
        read=read_reactions,
        where="two cores",
        minutes=10,
    ),
    Measurement(
        name="injections",
        title="Faults on the way between gateway and computer",
        conditions="The same parts on a simulated clock; each trial begins at another phase of all cycles. A gateway's clock that is 1 % wrong is noticed after 5 s (too fast) or 10 s (too slow).",
        commands=("python benchmarks/deploy/injections.py {out}/injections.json 4",),
        code=CODE,
        read=read_injections,
        where="one core",
        minutes=3,
    ),
    Measurement(
        name="soak",
        title="Lateness of the loop",
        conditions="Policy and bus process against the twin for ten minutes, with the recorder and the page. A cycle is missed if it begins later than the next one.",
        commands=(
            "brokk preset=bench deploy=auto deploy.seconds=600 page.port=0 session.out={out}/run",
        ),
        code=CODE,
        read=read_lateness,
        where="two cores",
        minutes=10,
    ),
)
