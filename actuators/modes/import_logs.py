"""`brokk mode=import`: reads the logs of any robot; guesses first, and says how sure it is."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Annotated

from pydantic import StringConstraints

from actuators.recordings import log_draft
from actuators.recordings.guess import GivenColumns, Guess
from actuators.recordings.log_draft import Draft
from actuators.recordings.log_files import find_logs
from actuators.recordings.name_evidence import UNITS, read_unit
from brokk_rl.console_table import print_table, print_text
from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.report import embed_picture, render_page
from brokk_rl.session import Session, write_json, write_text
from brokk_rl.spec import spec

log = logging.getLogger(__name__)

MAP_FILE, MACHINE_FILE = "column_map.yaml", "machine.yaml"
GUESS_FILE, PICTURE_FILE, PAGE_FILE = "import.json", "import.png", "import.html"
HEAD = ["subject", "guess", "how sure", "evidence"]
TEMPLATE = Path(__file__).with_name("import.html.jinja")


MachineName = Annotated[str, StringConstraints(pattern=r"^[a-z]\w*$")]
"""A letter, then letters, digits and _."""


@spec
class LogSelection(GivenColumns):
    """Logs to import, and what a person says about them.

    Attributes:
        input: Glob, or list of globs, of logs of one kind; a folder stands for the logs in it.
        name: Name of the machine that is drafted; `null`: that of the folder of the logs.
    """

    input: str | tuple[str, ...]
    name: MachineName | None

    def check(self) -> None:
        given = self.position_unit
        for unit in given.values() if isinstance(given, dict) else (given,):
            if unit is not None and read_unit(unit) is None:
                raise ConfigError(
                    f"log.position_unit: unknown unit '{unit}'; {list_choices(unit, UNITS)}, or a number of one of them, "
                    "such as '0.00153 rad' for a count of an encoder"
                )


@spec
class ImportLogs:
    """Draft a column map and a machine from logs, by which `mode=convert` makes recordings of them.

    Attributes:
        session: Folder.
        log: Logs to import.
    """

    session: Session
    log: LogSelection

    def run(self) -> None:
        """Write a picture, the guesses, a column map and a machine file.

        Raises:
            RecordingError: No log matches, or one cannot be used; names its place.
            StorageError: A file could not be written.
        """
        paths = find_logs(self.log.input)
        name = self.log.name or _name_machine(paths[0])
        draft = log_draft.make_draft(paths, name, self.log)
        folder, guesses = self.session.folder, draft.list_guesses()
        log_draft.draw_draft(draft).savefig(folder / PICTURE_FILE, dpi=110)
        log.info("picture: %s", folder / PICTURE_FILE)
        write_text(folder / MAP_FILE, draft.format(log_draft.MAP_TEMPLATE))
        write_text(folder / MACHINE_FILE, draft.format(log_draft.MACHINE_TEMPLATE))
        num_unsure = sum(guess.sureness == "unsure" for guess in guesses)
        result = {
            "schema": 1,
            "machine": draft.name,
            "logs": [str(path) for path in paths],
            "minutes": draft.survey.minutes,
            "guesses": [guess.plain() for guess in guesses],
            "num_unsure": num_unsure,
            "remarks": list(draft.remarks),
        }
        write_json(folder / GUESS_FILE, result)
        logs = self.log.input
        given = logs if isinstance(logs, str) else f"[{','.join(logs)}]"
        command = (
            f"brokk mode=convert machine=@{folder / MACHINE_FILE} import=@{folder / MAP_FILE} "
            f"'convert.input={given}' session.out={folder.with_name(f'{folder.name}_recordings')}"
        )
        values = {
            "title": f"Logs of {draft.name}",
            "tone": "bad" if num_unsure else "",
            "summary": summarise(draft, guesses),
            "motion": embed_picture(folder / PICTURE_FILE),
            "head": HEAD,
            "guesses": guesses,
            "draft": draft,
            "command": command,
        }
        write_text(folder / PAGE_FILE, render_page(TEMPLATE, values))
        print_table(HEAD, [(one.subject, one.value, one.sureness, one.reason) for one in guesses])
        look = f"look at {folder / PAGE_FILE}, then:"
        for text in (*draft.remarks, values["summary"], look, command):
            print_text(text)


def _name_machine(path: Path) -> str:
    """Return a name for a machine: that of the folder of its logs."""
    words = re.findall(r"[a-z0-9]+", path.resolve().parent.name.lower())
    name = "_".join(words)
    return name if name[:1].isalpha() else f"machine_{name}".rstrip("_")


def summarise(draft: Draft, guesses: list[Guess]) -> str:
    """Return what was found in one sentence, and what is left to fill in."""
    unsure = sum(guess.sureness == "unsure" for guess in guesses)
    many = "1 guess is" if unsure == 1 else f"{unsure} guesses are"
    end = "No guess is unsure."
    if any(guess.is_open for guess in guesses):
        end = f"{many} unsure: fill in {log_draft.MISSING} in {MAP_FILE}."
    elif unsure:
        end = f"{many} unsure: the numbers speak against what was given."
    if any(joint.guesses["unit"].is_open for joint in draft.joints):
        end += f" Without a unit {MACHINE_FILE} lacks limits and speeds: better run this again with log.position_unit=…"
    if any(joint.kind == "torque" for joint in draft.joints):
        end += f" The force at full command is not in the logs: fill in {log_draft.MISSING} in {MACHINE_FILE}."
    return (
        f"{draft.survey.num_runs} runs, {draft.survey.minutes:.1f} minutes, {len(draft.joints)} joints at "
        f"{1.0 / draft.survey.period_s:.4g} Hz. {end}"
    )
