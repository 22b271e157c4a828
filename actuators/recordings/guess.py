"""Guesses about columns: evidence with a weight, a probability, what a person gives, and advice what to give.

The weight of an observation is the logarithm of the odds that it adds; the sum gives a probability. A
guess is `sure` from 0.97 on, `likely` from 0.8 on, `unsure` below. Advice of a message is the key that reads a
log, written as it is typed. A test follows each: with the key the same log is read, or refused for another reason.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import yaml

from brokk_rl.spec import Positive

Sureness = Literal["sure", "likely", "unsure"]
CommandKind = Literal["velocity", "position", "torque"]
"""Quantity that commands set."""
SURE, LIKELY = 0.97, 0.8
"""Least probabilities of a sure and of a likely guess."""
Damaged = Literal["refuse", "skip"]
"""Choices for damaged parts of a log."""
_TEXTS = yaml.safe_load(Path(__file__).with_name("advice.yaml").read_text())
ADVICE: dict[str, str] = _TEXTS["advice"]
"""Texts by the key that they advise; numbers and names are filled in."""
FOREIGN: dict[str, str] = _TEXTS["foreign"]
"""Files that are no logs yet, and what makes logs of them, by their ending."""
Evidence = tuple[str, float]
"""An observation as text, and the logarithm of the odds that it adds."""


@dataclass(frozen=True)
class Guess:
    """One guess.

    Attributes:
        subject: What is guessed, `boom: command`.
        value: The chosen value as text.
        evidence: What speaks for it and against it.
        others: Other candidates.
        is_given: A person gave the value.
        choice: The value itself, where it is more than a text: the clock of a table.
    """

    subject: str
    value: str
    evidence: Sequence[Evidence]
    others: tuple[str, ...] = ()
    is_given: bool = False
    choice: Any = None

    @property
    def probability(self) -> float:
        """Probability that the value is right."""
        return 1.0 / (1.0 + math.exp(-sum(weight for _, weight in self.evidence)))

    @property
    def sureness(self) -> Sureness:
        """Its word."""
        if self.probability >= SURE:
            return "sure"
        return "likely" if self.probability >= LIKELY else "unsure"

    @property
    def reason(self) -> str:
        """Evidence as text."""
        return "; ".join(text for text, _ in self.evidence if text)

    @property
    def is_open(self) -> bool:
        """True where a person has to fill in the value."""
        return self.sureness == "unsure" and not self.is_given

    def advise(self, text: str) -> Guess:
        """Return it with a remedy beside the evidence, where a person has to fill in the value."""
        return replace(self, evidence=[*self.evidence, (text, 0.0)]) if self.is_open else self

    def plain(self) -> dict[str, Any]:
        """Return it as plain JSON data."""
        return {
            "subject": self.subject,
            "value": self.value,
            "sureness": self.sureness,
            "probability": round(self.probability, 3),
            "reason": self.reason,
            "others": [*self.others],
        }


@dataclass(frozen=True)
class GivenColumns:
    """Meanings that a person gives.

    Attributes:
        joints: Columns of command and position by joint, where their names do not say it; `None` to find them.
        command: Quantity that commands set; `None` to guess it.
        position_unit: Unit of the positions, for all joints or by joint; `None` to guess it.
        clock_offset_s: Seconds added to the clocks of tables.
        time: Column of the time, or those of seconds and nanoseconds; `None` to guess it.
        rate_hz: Rate of equally spaced rows; `None` for a log with times.
        wraps: Value at which positions begin again, 0 for none; `None` to guess it.
        dbc: DBC file of logs of a CAN bus.
        channel: Channel of the recorder of a CAN bus; `None` for all.
        damaged: What to do about damaged parts.
    """

    joints: dict[str, tuple[str, str]] | None = None
    command: CommandKind | None = None
    position_unit: str | dict[str, str] | None = None
    clock_offset_s: dict[str, float] | None = None
    time: tuple[str, ...] | None = None
    rate_hz: Positive | None = None
    wraps: float | dict[str, float] | None = None
    dbc: str | None = None
    channel: int | str | None = None
    damaged: Damaged = "refuse"

    def find(self, key: Literal["position_unit", "wraps"], joint: str) -> Any:
        """Return what is given for a joint, `None` for nothing."""
        given = getattr(self, key)
        return given.get(joint) if isinstance(given, Mapping) else given


def advise(key: str, **values: object) -> str:
    """Return the advice of a key with its values."""
    return ADVICE[key].format(**values)
