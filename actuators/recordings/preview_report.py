"""Preview of a diagnosis in the terminal and in reports."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

from actuators.recordings.preview import EffectLimit, EffectPreview, PreviewResult
from brokk_rl.console_table import print_table, print_text
from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from brokk_rl.progress import SHARE, ItemProgress
from brokk_rl.record import Recording

log = logging.getLogger(__name__)

EXPLANATION = (
    "Smallest size that would be told, as a distance from the value without the effect. In brackets: "
    "larger than the typical size. – : none of the sizes that were tried."
)
UNTOLD = {
    "tool points": "only measured tool points (ee_x_m, ee_y_m, ee_z_m) show them",
    "frames": "the more often commands change, the smaller ones show",
}
"""What is said of effects whose smallest size is not foretold."""


@dataclass(frozen=True)
class PreviewText:
    """A preview as it is shown.

    Attributes:
        head: Heading of the table of effects.
        rows: Its cells: a row a number of an effect, a column a joint.
        remarks: What the table leaves out, and what it rests on.
    """

    head: list[str]
    rows: list[list[str]]
    remarks: list[str]


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


def describe_preview(result: PreviewResult, machine: Machine) -> PreviewText:
    """Return a preview as it is shown."""
    by_number: dict[tuple[str, str], dict[str, EffectLimit]] = {}
    untold: dict[str, set[str]] = {}
    for one in result.limits:
        if one.shows_in in UNTOLD:
            untold.setdefault(one.shows_in, set()).add(one.effect)
        else:
            by_number.setdefault((one.effect, one.number), {})[one.joints[0]] = one
    rows = []
    for (effect, number), limits in by_number.items():
        sizes = [_format_size(limits.get(joint)) for joint in machine.joint_names]
        units = sorted({one.unit.replace("1", "–") for one in limits.values()})
        typical = sorted({f"{one.typical:.2g}" for one in limits.values()}, key=float)
        both = [typical[0], typical[-1]] if len(typical) > 1 else typical
        rows.append([f"{effect} {number}", *sizes, " or ".join(units), " to ".join(both)])
    remarks = [EXPLANATION]
    for pair in result.pairs:
        remarks.append(f"{' and '.join(pair.effects)} look alike on {', '.join(pair.joints)}")
    for place, effects in untold.items():
        remarks.append(f"{', '.join(sorted(effects))}: {UNTOLD[place]}")
    price = result.assumed["price"]
    remarks.append(
        f"simulator: {result.assumed['simulator']}; noise of the sensors: "
        f"{'of these recordings' if result.assumed['noise_is_measured'] else 'expected'}; an effect on one joint is told "
        f"from {sum(price.values()):g} nats of log likelihood on, one with a cause behind all joints from {price['name']:g}"
    )
    return PreviewText(["effect", *machine.joint_names, "unit", "typical"], rows, remarks)


def show_preview(result: PreviewResult, machine: Machine) -> None:
    """Print a preview."""
    untold = [one for one in result.limits if not one.is_told and one.shows_in not in UNTOLD]
    title = (
        f"effects that {result.minutes:.1f} minutes of these motions would tell "
        f"({len(untold)} of {len(result.limits)} numbers not at their typical size)"
    )
    shown = describe_preview(result, machine)
    if shown.rows:
        print_table(shown.head, shown.rows, title)
    for remark in shown.remarks:
        print_text(remark)


def _format_size(one: EffectLimit | None) -> str:
    if one is None:
        return ""
    shared = "all " if len(one.joints) > 1 else ""
    if one.smallest is None:
        return f"{shared}–"
    return f"{shared}{one.smallest:.2g}" if one.is_told else f"{shared}({one.smallest:.2g})"
