"""Modes: the verbs of the command.

`brokk_rl.checks` holds a public checker for each contract, for our own entries and for those of
extensions.
Axes: `N` environments, `J` joints, `H` samples of history (oldest first), `K` numbers that describe
a target.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    pass


class Mode(Protocol):
    """One verb of the command, `brokk mode=…`."""

    def run(self) -> float | None:
        """Do the work; returns the objective of a sweep, or `None`."""
        ...
