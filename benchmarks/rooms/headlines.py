"""The figures of README's table, each with its baseline, read from the results."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from measurement import Table

Row = dict[str, Any]


@dataclass(frozen=True)
class Headline:
    """A figure of README.

    Attributes:
        claim: What it is a figure of.
        result: Name of the measurement that it is read from.
        read: Returns the figure as README writes it.
        baseline: Returns the figure of the baseline, or says in words what it would be.
    """

    claim: str
    result: str
    read: Callable[[Table], str]
    baseline: Callable[[Table], str]


def find_row(rows: Table, **cells: Any) -> Row:
    """Return the one row with these cells."""
    (row,) = [row for row in rows if all(row[name] == cell for name, cell in cells.items())]
    return row


def read_policy(column: str, **cells: Any) -> Callable[[Table], str]:
    """Return a reader of a share of episodes, in percent."""
    return lambda rows: f"{100 * find_row(rows, **cells)[column]:.1f} %"


def read_seeds(column: str, **cells: Any) -> Callable[[Table], str]:
    """Return a reader of the smallest and largest share of trained policies, in percent."""

    def read(rows: Table) -> str:
        wanted = {"policy": "trained"} | cells
        rows = [row for row in rows if all(row[name] == cell for name, cell in wanted.items())]
        shares = [100 * row[column] for row in rows]
        return f"{min(shares):.1f} to {max(shares):.1f} %"

    return read


def read_count(meaning: str) -> Callable[[Table], str]:
    """Return a reader of a rate of an exam as a count of cases."""

    def read(rows: Table) -> str:
        row = find_row(rows, **{"": meaning})
        return f"{round(row['reached'] * row['of'])} of {row['of']}"

    return read


def read_range(model: str) -> Callable[[Table], str]:
    """Return a reader of the smallest and largest error of a model over the joints."""

    def read(rows: Table) -> str:
        errors = [cell for name, cell in find_row(rows, model=model).items() if name != "model"]
        return f"{min(errors):.1f} to {max(errors):.1f} %"

    return read


def read_holes(distance_m: float) -> Callable[[Table], str]:
    """Return a reader of recall and error at one distance, over all conditions."""

    def read(rows: Table) -> str:
        row = find_row(rows, condition="all", **{"distance, m": distance_m})
        within = f"{row['position, mm, 95 %']:.1f} mm"
        return f"{100 * row['found']:.0f} % at {distance_m:.0f} m within {within}"

    return read


def read_worst(rows: Table) -> str:
    """Return the longest time until no valve gets anything, over all kills, stops and faults."""
    return f"{max(row['flow_worst_ms'] for row in rows):.0f} ms"


def read_rate(column: str) -> Callable[[Table], str]:
    """Return a reader of a rate with 16,384 worlds."""
    return lambda rows: f"{find_row(rows, worlds=16384)[column]:.1f} million"


def say(words: str) -> Callable[[Table], str]:
    """Return a reader of a baseline that needs no measurement."""
    return lambda rows: words


STRICT, INSERTED = "strict success", "inserted"
TWELVE = {"training, s": 12}
CHANGED = {"stage": "on_machine", "trained on": "gpu"}
ONE, SETS = "one effect: named first", "several effects: exact set"
NONE = "unchanged machines: an effect or `unknown`"
NO_FINDER, NO_GUARD = say("none was run"), say("the last command stays in force")
HEADLINES = (
    *(
        Headline(
            f"shipped policy, {column}, plant `{plant}`",
            "shipped_policy",
            read_policy(column, plant=plant, policy="trained"),
            read_policy(column, plant=plant, policy="classical"),
        )
        for plant, column in (("mlp", STRICT), ("hydraulic", STRICT), ("mlp", INSERTED))
    ),
    *(
        Headline(
            f"`make train`, {column}",
            "short_training",
            read_seeds(column),
            read_policy(column, policy="classical", seed="1"),
        )
        for column in (STRICT, INSERTED)
    ),
    Headline(
        f"`make train` on a GPU, {STRICT} after 12 s",
        "short_training_gpu",
        read_seeds(STRICT, **TWELVE),
        read_policy(STRICT, policy="classical", **TWELVE),
    ),
    Headline(
        f"a changed machine, {STRICT} after diagnosis and training",
        "gap_loop",
        read_policy(STRICT, policy="trained", **CHANGED),
        read_policy(STRICT, policy="before", **CHANGED),
    ),
    *(
        Headline(
            f"behind a person, {STRICT}, {delay_s} s",
            "guided_person",
            read_policy(STRICT, policy="trained", **{"delay of the person, s": delay_s}),
            read_policy(STRICT, policy="classical", **{"delay of the person, s": delay_s}),
        )
        for delay_s in ("0.1", "0.5")
    ),
    *(
        Headline(
            f"nobody identified `{plant}`, {STRICT} in 20 s",
            "unidentified_machine",
            read_policy(STRICT, plant=plant, policy="trained", follower="filter", episode_s=20),
            read_policy(STRICT, plant=plant, policy="classical", follower="none", episode_s=40),
        )
        for plant in ("load_sensing", "post_compensated", "open_center")
    ),
    Headline("error after 5 s, joints", "real_excavator", read_range("mlp"), read_range("arx")),
    *(
        Headline(f"{exam}: {meaning}", result, read_count(meaning), say(baseline))
        for exam, result, singles in (
            ("valves", "exam_valves", "1 of 11, one name always"),
            ("circuits", "exam_circuits", "1 of 6, one name always"),
            ("servos", "exam_servos", "1 of 8, one name always"),
        )
        for meaning, baseline in (
            (ONE, singles),
            (SETS, "0, one name always"),
            (NONE, "none or all"),
        )
    ),
    *(
        Headline(f"holes, {distance_m:.0f} m", "holes", read_holes(distance_m), NO_FINDER)
        for distance_m in (1.0, 4.0)
    ),
    Headline("no flow after any kill, stop or fault", "reactions", read_worst, NO_GUARD),
    Headline(
        "no flow after e-stop",
        "reactions",
        lambda rows: f"{find_row(rows, event='estop')['flow_worst_ms']} ms",
        NO_GUARD,
    ),
    Headline(
        "training, control steps a second",
        "rates",
        read_rate("training, 1e6 control steps/s"),
        read_rate("whole control step, 1e6/s"),
    ),
)
