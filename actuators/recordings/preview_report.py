"""Preview of a diagnosis in the terminal and in reports."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from actuators.recordings.preview import EffectLimit, EffectPreview, PreviewResult
from brokk_rl.console_table import print_table, print_text
from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from brokk_rl.progress import SHARE, ItemProgress
from brokk_rl.record import Recording

log = logging.getLogger(__name__)

Rows = tuple[list[str], list[list[str]]]
"""Heading and cells of a table."""
EXPLANATION = (
    "Smallest size that would be told, as a distance from the value without the effect. In brackets: "
    "larger than the typical size. – : none of the sizes that were tried."
)
UNTOLD = {
    "tool points": "only measured tool points (ee_x_m, ee_y_m, ee_z_m) show them",
    "frames": "the more often commands change, the smaller ones show",
}
"""What is said of effects whose smallest size is not foretold."""


def run_preview(
    preview: EffectPreview, motions: Sequence[Recording], machine: Machine, are_measured: bool
) -> PreviewResult | None:
    """Return the preview of some motions, with a bar of progress.

    `None` where none is long enough, or where joints are not commanded by speed: the expected error of
    the preview is that of a valve.
    """
    if machine.interface != "speed":
        log.info("no preview: its expected error is known for joints commanded by speed only")
        return None
    try:
        with ItemProgress("preview", SHARE) as progress:
            return preview.assess(
                motions, machine, lambda doing, done: progress.reach(done, doing), are_measured
            )
    except RecordingError as error:
        log.warning("no preview of the effects that these motions could tell: %s", error)
        return None


def describe_effects(result: PreviewResult, machine: Machine) -> Rows:
    """Return the table of effects: a row a number, a column a joint."""
    head = ["effect", *machine.joint_names, "unit", "typical"]
    rows, names = [], _name_numbers(result)
    for limits in _group_limits(result):
        first = limits[0]
        sizes: dict[str, str] = dict.fromkeys(machine.joint_names, "")
        for one in limits:
            first_joint, shared = one.joints[0], "all " if len(one.joints) > 1 else ""
            sizes[first_joint] = shared + _format_size(one)
        typical = sorted({f"{one.typical:.2g}" for one in limits}, key=float)
        rows.append(
            [
                names[first.effect, first.number],
                *sizes.values(),
                " or ".join(sorted({one.unit.replace("1", "–") for one in limits})),
                " to ".join([typical[0], typical[-1]] if len(typical) > 1 else typical),
            ]
        )
    return head, rows


def describe_pairs(result: PreviewResult) -> Rows:
    """Return the table of effects that look alike."""
    head, rows = ["look alike", "joints"], []
    for pair in result.pairs:
        rows.append([" and ".join(pair.effects), ", ".join(pair.joints)])
    return head, rows


def list_remarks(result: PreviewResult) -> list[str]:
    """Return what the tables leave out, and what they rest on."""
    found = []
    for place, text in UNTOLD.items():
        if hidden := sorted({one.effect for one in result.limits if one.shows_in == place}):
            found.append(f"{', '.join(hidden)}: {text}")
    source = "of these recordings" if result.assumed["noise_is_measured"] else "expected"
    price = sum(result.assumed["price"].values())
    found.append(
        f"simulator: {result.assumed['simulator']}; noise of the sensors: {source}; an effect on one joint is told "
        f"from {price:g} nats of log likelihood on, one with a cause behind all joints from "
        f"{result.assumed['price']['name']:g}"
    )
    return found


def show_preview(result: PreviewResult, machine: Machine) -> None:
    """Print the tables."""
    untold = [one for one in result.limits if not one.is_told and one.shows_in not in UNTOLD]
    title = (
        f"effects that {result.minutes:.1f} minutes of these motions would tell "
        f"({len(untold)} of {len(result.limits)} numbers not at their typical size)"
    )
    for name, (head, rows) in {
        title: describe_effects(result, machine),
        "pairs": describe_pairs(result),
    }.items():
        if rows:
            print_table(head, rows, name)
    for remark in (EXPLANATION, *list_remarks(result)):
        print_text(remark)


def _group_limits(result: PreviewResult) -> list[list[EffectLimit]]:
    """Return the limits of each number that commands and positions show."""
    found: dict[tuple[str, str], list[EffectLimit]] = {}
    for one in result.limits:
        if one.shows_in not in UNTOLD:
            found.setdefault((one.effect, one.number), []).append(one)
    return list(found.values())


def _name_numbers(result: PreviewResult) -> dict[tuple[str, str], str]:
    """Return the name of each number: that of the effect where it has no other."""
    numbers: dict[str, set[str]] = {}
    for one in result.limits:
        numbers.setdefault(one.effect, set()).add(one.number)
    found = {}
    for effect, several in numbers.items():
        for number in several:
            found[effect, number] = effect if len(several) == 1 else f"{effect} {number}"
    return found


def _format_size(one: EffectLimit) -> str:
    if one.smallest is None:
        return "–"
    return f"{one.smallest:.2g}" if one.is_told else f"({one.smallest:.2g})"
