"""Subject of a diagnosis."""

from __future__ import annotations

from pathlib import Path

from brokk_rl.errors import ConfigError
from brokk_rl.spec import Count, NonNegative, spec

FITS = {"speed": "valve", "position": "servo", "torque": "force"}
"""Fit of each command interface."""


@spec
class DiagnosisSubject:
    """Recordings to diagnose.

    Attributes:
        case: Folder with `reference/` and `field/`; or `null`.
        field: Glob or globs of recordings of the machine as it is, held against `actuator`; instead
            of a case.
        effects: Names of the effects to choose among; `null`: all that are registered.
        repeatability: How much the machine repeats from day to day, standard deviation over the
            value; where the reference is of two days or more it is measured.
        workers: Processes that share the work; 1 where the system has no safe fork.
    """

    case: str | None
    field: str | tuple[str, ...] | None
    effects: tuple[str, ...] | None
    repeatability: NonNegative
    workers: Count

    def check(self) -> None:
        if (self.case is None) == (self.field is None):
            raise ConfigError(
                "diagnosis: give either case=<folder with reference/ and field/>, or field=<glob> and actuator=<simulator>"
            )
        if self.case is not None and not Path(self.case).is_dir():
            raise ConfigError(
                f"diagnosis.case={self.case}: there is no such folder (seen from {Path.cwd()})"
            )
