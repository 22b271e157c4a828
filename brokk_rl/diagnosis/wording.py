"""A diagnosis in sentences: the answer, classes of effects that cannot be told apart, what is left, what to do next."""

from __future__ import annotations

from collections.abc import Sequence

from brokk_rl.diagnosis.answer import Answer, Estimate, Selected
from brokk_rl.report import Tone

MOST = 0.5
"""A closed part of the gap from which the news are good."""


def headline(answer: Answer) -> tuple[str, Tone]:
    """Returns the answer in two or three sentences, and whether it is good news."""
    gap = answer.gap
    size = ""
    if gap is not None:
        size = f" Error over 5 s free runs: {1e3 * gap.before:.1f} mrad before"
        size += f", {1e3 * gap.after:.1f} mrad after" if answer.selected else ""
        size += f"; the floor is {1e3 * gap.floor:.1f} mrad."
    if answer.verdict == "none":
        return f"No gap: the simulator is as right about these recordings as about its own.{size}", "good"
    if answer.verdict == "unknown":
        place = _place(answer)
        because = f" {answer.reason[0].upper()}{answer.reason[1:].rstrip('.')}." if answer.reason else ""
        start = f"There is a gap that no effect of the library explains{place}" if place else "There is no telling"
        return f"{start}.{because}{size}", "warn"
    names = listed([named(one) for one in answer.selected])
    closed = gap.closed if gap else None
    share = f" closes {100 * closed.mean:.0f} % of the gap (95 %: {_percent_range(closed)})." if closed else "."
    it = "it" if len(answer.selected) == 1 else "them"
    tone: Tone = "good" if closed is not None and closed.ci95[0] > MOST else "warn"
    return f"The simulator lacks {names}; adding {it}{share}{size}" if closed else f"The simulator lacks {names}.{size}", tone


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
    above = 1e3 * max(gap.after**2 - gap.floor**2, 0.0) ** 0.5
    if above < 0.3 * 1e3 * gap.floor:
        return f"What is left, {above:.1f} mrad beyond the floor, is within what the simulator errs by anyway."
    return f"{above:.1f} mrad (RMS, beyond the floor) are left, which no effect of the library explains: an unknown remainder."


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
    return text + (f", most of that ({100 * regime.share:.0f} %) {occasion(regime.regime)}" if regime else "")


def occasion(regime: str) -> str:
    """Returns a regime as a phrase of a sentence."""
    phrases = {"hold": "at rest", "stop": "just after stops", "start": "at starts", "creep": "at small commands"}
    phrases |= {"cruise": "at larger commands, alone", "several joints at once": "while several joints move"}
    return phrases.get(regime, regime)


def _percent_range(value: Estimate) -> str:
    return f"{100 * value.ci95[0]:.0f} to {100 * value.ci95[1]:.0f} %"
