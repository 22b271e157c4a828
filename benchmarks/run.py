"""Measure figures, and render `docs/results.md` from them.

    python benchmarks/run.py list                          # names, where they run, and how long
    python benchmarks/run.py measure shipped_policy        # runs the commands, writes benchmarks/results/shipped_policy.json
    python benchmarks/run.py take exam_valves <folder>     # reads a folder that the commands left on another computer
    python benchmarks/run.py page                          # renders docs/results.md

A result holds commands, machine, commit, and a hash of the code that was measured. The page says
where that code has changed since.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from measurement import RESULTS, ROOT, Measurement, Table, hash_code, load_json, run_git
from rooms import ROOMS
from rooms.headlines import HEADLINES

PAGE = ROOT / "docs/results.md"
SHOWN = 1
"""Commands of a result that the page shows; its file holds them all."""
HEAD = """# Results

<!-- rendered by `python benchmarks/run.py page`; edit benchmarks/rooms instead -->

All machines are simulated, but for logs that are said to be real. *Older* means that code which the figure
depends on, listed in its file, has changed since: today's may give another figure.

* **Strict success:** the tip is 0.10 m or more below the rim, inside the hole with 1 cm of clearance, tilted
  by 0.11 rad at most, and no contact force of the episode was above 10 kN.
* **Inserted:** the same without force and tilt.
* **Paper's criterion:** the weaker one of the paper.
* **Plant:** a simulated machine that judges a policy. `mlp` is the network through which policies are
  trained, `hydraulic` the plant to which it was fitted; nothing was fitted to the others.

## README's figures

`python benchmarks/run.py measure <name>` makes one again, with the commands below.

"""


def list_measurements() -> dict[str, Measurement]:
    """Return all measurements by name, in the order of the page."""
    found: dict[str, Measurement] = {}
    for measurements in ROOMS.values():
        for one in measurements:
            found[one.name] = one
    return found


def measure(one: Measurement) -> None:
    """Run the commands of a measurement and write its result."""
    with tempfile.TemporaryDirectory() as folder:
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        environment = os.environ | {"PYTHONPATH": str(ROOT), "PATH": path}
        for command in one.commands:
            words = shlex.split(command.format(out=folder))
            subprocess.run(words, cwd=ROOT, env=environment, check=True)
        take(one, Path(folder))


def take(one: Measurement, folder: Path, machine: str | None = None) -> None:
    """Write the result of a folder that the commands have filled."""
    result = {
        "commands": list(one.commands),
        "machine": machine or describe_machine(),
        "commit": run_git("rev-parse", "--short=8", "HEAD").strip(),
        "date": datetime.date.today().isoformat(),
        "code": list(one.code),
        "code_sha256": hash_code(one.code),
        "rows": one.read(folder),
    }
    (RESULTS / f"{one.name}.json").write_text(json.dumps(result, indent=1) + "\n")


def describe_machine() -> str:
    """Return processor, cores, load and GPU of this computer."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    processor = names[0] if names else platform.processor()
    text = f"{os.cpu_count()} cores of {processor}, load {os.getloadavg()[2]:.0f}"
    import torch

    return f"{torch.cuda.get_device_name()}, {text}" if torch.cuda.is_available() else text


def render_headlines() -> str:
    """Return the table of README's figures, with what each rests on."""
    table: Table = []
    for one in HEADLINES:
        result = load_json(RESULTS / f"{one.result}.json")
        row = {"claim": one.claim, "figure": one.read(result["rows"])}
        row["baseline"] = one.baseline(result["rows"])
        row["name"] = f"[{one.result}](../benchmarks/results/{one.result}.json)"
        row["commit"] = result["commit"]
        row["code"] = "today's" if is_current(result) else "older"
        table.append(row)
    return render_table(table) + "\n"


def is_current(result: dict[str, Any]) -> bool:
    """Return whether the code that a result depends on has not changed since."""
    return hash_code(result["code"]) == result["code_sha256"]


def render_page() -> str:
    """Return the page of all results."""
    parts = [HEAD + render_headlines()]
    for room, measurements in ROOMS.items():
        present = [one for one in measurements if (RESULTS / f"{one.name}.json").exists()]
        if present:
            parts.append(f"## {room}\n")
        for one in present:
            parts.append(render_result(one, load_json(RESULTS / f"{one.name}.json")))
    return "\n".join(parts)


def render_result(one: Measurement, result: dict[str, Any]) -> str:
    """Return heading, conditions, table and origin of one result."""
    shown = [command.replace("{out}", "<out>") for command in result["commands"][:SHOWN]]
    if len(result["commands"]) > SHOWN:
        shown.append(f"# {len(result['commands']) - SHOWN} more")
    age = "Today's code." if is_current(result) else "**Older than its code.**"
    origin = f"{result['machine']}; commit {result['commit']}, {result['date']}"
    lines = [
        f"### {one.title}",
        "",
        one.conditions,
        "",
        render_table(result["rows"]),
        "",
        f"{origin}. {age} [File](../benchmarks/results/{one.name}.json).",
        "",
        "```",
        *shown,
        "```",
        "",
    ]
    return "\n".join(lines)


def render_table(rows: Table) -> str:
    """Return rows as a Markdown table; the first row names the columns."""
    # A detail, which has names of its own, stands in the file alone.
    shown = [name for row in rows for name in row if not isinstance(row[name], dict)]
    columns = list(dict.fromkeys(shown))
    lines = ["|".join(columns), "|".join("---" for _ in columns)]
    for row in rows:
        cells = [row.get(name) for name in columns]
        lines.append("|".join("" if cell is None else str(cell) for cell in cells))
    return "\n".join(f"|{line}|" for line in lines)


def main() -> None:
    """Do what the command line asks."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("do", choices=["list", "measure", "take", "page"])
    parser.add_argument("name", nargs="?", choices=list(list_measurements()))
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("--machine", help="computer on which the folder was made")
    given = parser.parse_args()
    known = list_measurements()
    if given.do == "list":
        for one in known.values():
            print(f"{one.name:22} {one.where}")
    elif given.do == "page":
        PAGE.write_text(render_page())
    elif given.name is None:
        parser.error("expected the name of a measurement; `list` shows them")
    elif given.do == "measure":
        measure(known[given.name])
    elif given.folder is None:
        parser.error("expected the folder that the commands have filled")
    else:
        take(known[given.name], given.folder, given.machine)


if __name__ == "__main__":
    main()
