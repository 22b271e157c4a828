"""A rival answers one case: `python sit.py <rival> <case> <out> <machine.yaml>`.

The exam starts it as a candidate's program. It writes `changes.json`, every number that the rival
fitted, `fitted.json`, its parameter vectors, and by the rule of `rules.json` `diagnosis.json` and
`effects.yaml`.
"""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import naming
from case_data import read_arm, write_changes

RULES_FILE = Path(__file__).with_name("rules.json")
NO_RULE = {"spreads": {}, "threshold": float("inf")}


def main(rival: str, case: Path, out: Path, machine: Path) -> None:
    """Fit, write all changes, name some of them."""
    changes, fitted = importlib.import_module(rival).find_changes(case, read_arm(machine))
    write_changes(changes, out)
    (out / "fitted.json").write_text(json.dumps(fitted) + "\n")
    rules = json.loads(RULES_FILE.read_text()) if RULES_FILE.is_file() else {}
    rule = rules.get(rival)
    if rule is None:  # before a rule is chosen
        spreads = {f"{change.effect}.{change.parameter}": 1.0 for change in changes}
        rule = {**NO_RULE, "spreads": spreads}
    naming.write_answer(changes, rule, out)


if __name__ == "__main__":
    main(sys.argv[1], *map(Path, sys.argv[2:5]))
