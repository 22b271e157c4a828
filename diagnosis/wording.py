"""A diagnosis in sentences: the answer, classes of effects that cannot be told apart, what is left, what to do next."""

from __future__ import annotations

from collections.abc import Sequence

from brokk_rl.report import Tone
from diagnosis.answer import Answer, Estimate, Gap, Selected

MOST = 0.5
"""A closed part of the gap from which the news are good."""


def headline(answer: Answer) -> tuple[str, Tone]:
    """Returns the answer in two or three sentences, and whether it is good news."""
    gap = answer.gap
    told = ""
    if gap is not None:
        told = f" Error over 5 s free runs: {size(gap.before, gap.unit)} before"
        told += f", {size(gap.after, gap.unit)} after" if answer.selected else ""
        told += "; " + _floor(gap) + "."
    told += _tool(answer)
    if answer.verdict == "none":
        return (
            f"No gap: the simulator is as right about these recordings as about its own.{told}",
            "good",
        )
    if answer.verdict == "unknown":
        place = _place(answer)
        because = (
            f" {answer.reason[0].upper()}{answer.reason[1:].rstrip('.')}." if answer.reason else ""
        )
        start = (
            f"There is a gap that no effect of the library explains{place}"
            if place
            else "There is no telling"
        )
        return f"{start}.{because}{told}", "warn"
    names = listed([named(one) for one in answer.selected])
    closed = gap.closed if gap else None
    left_over = answer.more.get("unknown_remainder")
    rest = f" An unknown remainder is left on {listed(left_over['joints'])}." if left_over else ""
    tone: Tone = "good" if closed is not None and closed.ci95[0] > MOST else "warn"
    if closed is None:
        return f"The simulator lacks {names}.{told}{rest}", tone
    it = "it" if len(answer.selected) == 1 else "them"
    share = f"{100 * closed.mean:.0f} % of the gap (95 %: {_percent_range(closed)})"
    return f"The simulator lacks {names}; adding {it} closes {share}.{told}{rest}", tone


def size(value: float, unit: str) -> str:
    """Returns an error as a person reads it: in mrad, mm, or in percent of the joints' travel where units differ."""
    return f"{100 * value:.1f} % of travel" if unit == "travel" else f"{1e3 * value:.1f} m{unit}"


def _tool(answer: Answer) -> str:
    """Returns how far off the tool is, where that is what a named effect moves: free runs of joints show nothing of it."""
    cause = str((answer.more.get("geometry") or {}).get("cause") or "").split(" ")[0]
    if cause not in {one.effect for one in answer.selected}:
        return ""
    texts = [
        stage["text"] for stage in answer.more.get("stages", ()) if stage["stage"] == "kinematics"
    ]
    return "".join(f" {text[0].upper()}{text[1:]}." for text in texts)


def _floor(gap: Gap) -> str:
    if gap.floor is None:
        return "without a reference, and with too little data for a flexible model, the floor is not known"
    whose = (
        ""
        if gap.floor_of == "reference"
        else f", that of a {gap.floor_of} on field recordings it was not fitted to"
    )
    return f"the floor is {size(gap.floor, gap.unit)}{whose}"


def named(one: Selected) -> str:
    """Returns an effect with its joints and probability."""
    return f"{said(one.effect)}{on(one.joints)} (probability {one.probability:.2f})"


def said(effect: str) -> str:
    """Returns the name of an effect as words."""
    return effect.replace("_", " ")


def on(joints: Sequence[str]) -> str:
    """Returns ` on q3 and q4`, nothing for an effect of the whole machine."""
    return f" on {listed(joints)}" if joints else ""


def listed(names: Sequence[str]) -> str:
    """Returns `a, b and c`."""
    return " and ".join(filter(None, (", ".join(names[:-1]), *names[-1:])))


def same_as(one: Selected) -> str:
    """Returns what an effect cannot be told from, and what would decide; nothing where it stands alone."""
    if not one.same_as:
        return ""
    others = listed([said(name) for name in one.same_as])
    text = f"These recordings cannot tell {said(one.effect)}{on(one.joints)} from {others}: "
    text += f"the probability of {one.probability:.2f} is that of one of them."
    return f"{text} What would decide: {one.decided_by}." if one.decided_by else text


def left(answer: Answer) -> str:
    """Returns what is left above the floor after the selected effects."""
    gap = answer.gap
    if gap is None or not answer.selected:
        return ""
    remainder = answer.more.get("unknown_remainder")
    above = 0.0 if gap.floor is None else max(gap.after**2 - gap.floor**2, 0.0) ** 0.5
    beyond = (
        f"{size(above, gap.unit)} beyond the floor"
        if gap.floor is not None
        else size(gap.after, gap.unit)
    )
    if remainder:
        return (
            f"An unknown remainder is left on {listed(remainder['joints'])} ({beyond}):"
            f" {remainder['reason']}, but no effect does."
        )
    return (
        f"What is left, {beyond}, is within what the simulator errs by anyway."
        if gap.floor is not None
        else ""
    )


def estimate(value: Estimate | None, factor: float = 1.0, style: str = ".3g") -> tuple[str, str]:
    """Returns a number and its interval as texts."""
    if value is None:
        return "–", ""
    low, high = (factor * bound for bound in value.ci95)
    return f"{factor * value.mean:{style}}", f"{low:{style}} to {high:{style}}"


def _place(answer: Answer) -> str:
    if not answer.where.joints:
        return ""
    joint, gap = max(answer.where.joints.items(), key=lambda pair: pair[1].share)
    regime = next((one for one in answer.where.regimes if one.joint == joint), None)
    text = f"; {100 * gap.share:.0f} % of it lies in {joint}"
    return text + (
        f", most of that ({100 * regime.share:.0f} %) {occasion(regime.regime)}" if regime else ""
    )


def occasion(regime: str) -> str:
    """Returns a regime as a phrase of a sentence."""
    phrases = {
        "hold": "at rest",
        "stop": "just after stops",
        "start": "at starts",
        "creep": "at small commands",
    }
    phrases |= {
        "cruise": "at larger commands, alone",
        "several joints at once": "while several joints move",
    }
    return phrases.get(regime, regime)


def _percent_range(value: Estimate) -> str:
    return f"{100 * value.ci95[0]:.0f} to {100 * value.ci95[1]:.0f} %"
