"""`mode=import` without its command: the draft of a log, and the recordings that it makes."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from conftest import Done
from mcap.writer import Writer

from actuators.modes.import_logs import summarise
from actuators.recordings import log_draft
from actuators.recordings.guess import GivenColumns
from actuators.recordings.log_files import find_logs
from brokk_rl import extensions
from brokk_rl.errors import BrokkError


def delay(values: np.ndarray, num: int) -> np.ndarray:
    """Returns values `(T, …)` so many rows later, at rest before."""
    return np.concatenate([np.repeat(values[:1], num, 0), values[:-num]])


def write_csv(path: str | Path, columns: Mapping[str, np.ndarray]) -> None:
    """Writes columns of numbers, each with all its digits."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    rows = zip(*(values.tolist() for values in columns.values()), strict=True)
    lines = [",".join(columns), *(",".join(map(repr, row)) for row in rows)]
    Path(path).write_text("\n".join(lines) + "\n")


def make_draft(*options: str) -> log_draft.Draft:
    values: dict[str, Any] = {}
    for option in options:
        key, _, value = option.removeprefix("log.").partition("=")
        values[key] = yaml.safe_load(value)
    paths = find_logs(values.pop("input"))
    return log_draft.make_draft(paths, "leg", GivenColumns(**values))


def describe_draft(draft: log_draft.Draft) -> str:
    """Returns what the command prints about a draft."""
    guesses = draft.list_guesses()
    lines = [f"{one.subject}: {one.value} ({one.sureness}) {one.reason}" for one in guesses]
    return "\n".join([*lines, *draft.remarks, summarise(draft, guesses)])


def try_draft(*options: str) -> Done:
    """Returns the draft as the command prints it, or its refusal."""
    try:
        return Done(0, describe_draft(make_draft(*options)), "")
    except BrokkError as error:
        return Done(2, "", str(error))


def import_log(*options: str) -> tuple[Done, list[dict[str, np.ndarray]]]:
    """Returns the draft as text, and the columns of the recordings that it makes."""
    try:
        draft = make_draft(*options)
    except BrokkError as error:
        return Done(2, "", str(error)), []
    made = []
    templates = {"machine": log_draft.MACHINE_TEMPLATE, "import": log_draft.MAP_TEMPLATE}
    for group, template in templates.items():
        Path(f"{group}.yaml").write_text(draft.format(template))
        made.append(extensions.load_option(group, f"@{group}.yaml"))
    machine, reader = made
    found = []
    (given,) = [one.partition("=")[2] for one in options if one.startswith("log.input=")]
    for path in find_logs(given):
        for one in reader.read(path, machine):
            columns = {"t_s": one.t_s}
            for j, (name, unit) in enumerate(zip(one.joints, one.units, strict=True)):
                columns[f"q_{name}_{unit}"] = one.q[:, j]
            found.append(columns)
    return Done(0, describe_draft(draft), ""), found


def write_messages(
    path: str | Path, messages: Iterable[tuple[float, str, Any]], chunk_size: int = 1 << 20
) -> None:
    """Writes an MCAP file of time in s, topic and content, as JSON or as bytes, of each message."""
    with Path(path).open("wb") as file:
        writer = Writer(file, chunk_size=chunk_size)
        writer.start()
        schema = writer.register_schema("any", "jsonschema", b"{}")
        channels: dict[str, int] = {}
        for t_s, topic, content in messages:
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "json", schema)
            time_ns = 1_700_000_000_000_000_000 + round(t_s * 1e9)
            data = content if isinstance(content, bytes) else json.dumps(content).encode()
            writer.add_message(channels[topic], time_ns, data, time_ns)
        writer.finish()
