"""Measurements of the loop on the machine's computer, against the simulated machine."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

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


BEFORE = {
    "processes": "page dead or hung: flow for 20 s",
    "sensors": "no alarm, advice valid",
    "valves": "no alarm; flow for 4 s",
    "description": "not noticed; bus process killed",
    "borehole": "1.7 to 5.9 s of motion; 0.47 m/s at the face; jumps followed",
    "envelope": "0.25 to 2.43 rad deeper",
    "stops": "0.20 and 0.23 rad beyond",
    "clock": "stopped until a restart",
    "capture": "7,093 of 78,503 messages read, exit code 0",
    "pulses": "30 in 3 s, 50 in 5 s, no alarm",
    "vigilance": "flow for 88 s, not asked",
    "files": "hung, 30 s, 4 GB, tracebacks",
    "page": "not said; 8 px; page.url: 666",
}
"""Figures of the same injections before these checks were built."""
FOUND = (
    "tests/unit/test_deploy_found.py", "tests/unit/test_deploy_processes.py", "tests/unit/test_deploy_recorder.py",
    "tests/unit/test_deploy_loop.py", "tests/unit/test_page_browser.py", "tests/unit/test_page_rules.py",
)  # fmt: skip


def read_found(folder: Path) -> Table:
    """Return the figures that tests have noted, by what was found: the least and the largest."""
    rows: Table = []
    noted = [one.attrib for one in ElementTree.parse(folder / "found.xml").iter("property")]
    for what, before in BEFORE.items():
        figures: dict[str, list[str]] = {}
        injections: dict[str, list[str]] = {}
        for one in noted:
            kind, _, injection = one["name"].partition(": ")
            if kind == what:
                injections.setdefault(injection, []).append(one["value"])
                figures.setdefault(injection.rpartition("; ")[2], []).append(one["value"])
        now = []
        for figure, values in figures.items():
            if values[0][0] in "-0123456789":
                now.append(f"{figure}: {find_ends(values)}")
        row = {
            "what": what,
            "injections": {name: find_ends(injections[name]) for name in injections},
        }
        rows.append(row | {"before": before, "now": "; ".join(now)})
    return rows


def find_ends(values: list[str]) -> str:
    """Return the least and the largest of figures; of words the first."""
    try:
        ordered = sorted(values, key=float)
    except ValueError:
        return values[0]
    return ordered[0] if ordered[0] == ordered[-1] else f"{ordered[0]} to {ordered[-1]}"


MEASUREMENTS = (
    Measurement(
        name="found",
        title="What was found, injected again",
        conditions="Injected into the running twin and loop again: on a simulated clock, by real processes or in a browser. *Before* is the figure when it was found.",
        commands=(
            f"python -m pytest -q -o junit_family=xunit1 --junitxml={{out}}/found.xml {' '.join(FOUND)}",
        ),
        code=(*CODE, "deploy/page", "deploy/policy", "deploy/recorder"),
        read=read_found,
        where="two cores, 4 min",
    ),
    Measurement(
        name="reactions",
        title="Reaction times of real processes",
        conditions="Twin, bus process and commander as processes of one computer. Time until the valves get nothing any more, as a listener on the bus hears it. Without the guard the last command would stay in force.",
        commands=("python benchmarks/deploy/reactions.py {out}/reactions.json 40",),
        code=CODE,
        read=read_reactions,
        where="two cores, 10 min",
    ),
    Measurement(
        name="injections",
        title="Faults on the way between gateway and computer",
        conditions="The same parts on a simulated clock; each trial begins at another phase of all cycles. A gateway's clock that is 1 % wrong is noticed after 5 s (too fast) or 10 s (too slow).",
        commands=("python benchmarks/deploy/injections.py {out}/injections.json 4",),
        code=CODE,
        read=read_injections,
        where="one core, 3 min",
    ),
)
