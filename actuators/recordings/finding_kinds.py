"""Kinds of findings in single recordings: severity, meaning and remedy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Severity = Literal["note", "warn", "bad"]


@dataclass(frozen=True)
class FindingKind:
    """Severity, meaning and remedy of a kind of finding.

    Attributes:
        severity: `bad`: conclusions about this joint are likely wrong; `warn`: they may be; `note`: good to know.
        meaning: Possible causes.
        advice: The remedy.
    """

    severity: Severity
    meaning: str
    advice: str


FINDINGS = {
    "command without motion": FindingKind(
        "warn",
        "a dead band wider than expected, an interlock or dead-man that is not logged, or a load too heavy",
        "log the interlocks; leave these stretches out if the machine was not allowed to move",
    ),
    "does not obey": FindingKind(
        "bad",
        "the joint stays away from its target: its drive is off or blocked, or too weak for the load",
        "leave these stretches out, or log the enable signal and use the parts in which the drive is on",
    ),
    "jumps": FindingKind(
        "bad",
        "the position steps by more than a machine moves: an angle or a counter that wraps, a sign bit, a reset, or two sources",
        "import again with log.wraps, or leave the other source out; no model can follow these steps",
    ),
    "motion without command": FindingKind(
        "warn",
        "the load sinks (a leak), or the joint was moved by something that is not logged",
        "log every input; a slow sinking towards the load is the effect 'creep'",
    ),
    "unlogged input": FindingKind(
        "bad",
        "the joint moves at a working speed without command: something moves it that is not logged",
        "log every input that moves the machine: levers, a second operator, automatic functions",
    ),
    "frozen sensor": FindingKind(
        "warn",
        "equal samples, then a jump, or equal samples of a sensor with noise: it did not measure",
        "check sensor and cable; the motion is real",
    ),
    "lost frames": FindingKind(
        "note",
        "all joints repeat the row before while one of them moves: positions were lost on their way",
        "record frame counters; small rates are the effect 'frame_loss' or a slow sensor",
    ),
    "beyond limit": FindingKind(
        "warn",
        "measured beyond the limits of the machine's file",
        "measure the end stops; correct the machine's file",
    ),
    "exclusive joint": FindingKind(
        "bad",
        "an exclusive joint is commanded together with others, which the machine forbids: one of both is not carried out",
        "record what was really sent",
    ),
    "irregular clock": FindingKind(
        "warn",
        "rows are not equally spaced in time",
        "stamp rows where they are measured, not where they are written",
    ),
    "saturated sensor": FindingKind(
        "bad",
        "the sensor stays at one end of its range, away from the joint's stops: it cannot say more, or a stop is nearer than known",
        "check the sensor's range and the machine's limits",
    ),
}
"""Findings in single recordings."""
