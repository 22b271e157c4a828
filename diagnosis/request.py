"""Subject of a diagnosis, with the penalties and the calibration by which it decides."""

from __future__ import annotations

from dataclasses import field
from pathlib import Path

from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.spec import spec

OUTSIDE_SIGNS = ("constant", "clue", "form", "curve", "scatter", "strays", "tool")
EFFECT_SIGNS = ("constant", "margin", "adds", "size", "names", "outside")
GAP_SIGNS = (*OUTSIDE_SIGNS, "error", "worst", "gain")
CHOICE_SIGNS = {
    "effects": ("gain", "reference", "joints", "size", "shared"),
    "none": GAP_SIGNS,
    "unknown": GAP_SIGNS,
    "stakes": ("effects", "none", "unknown"),
}
"""Signs of the hypotheses of each verdict, and the verdicts that have a stake; see `hypotheses`."""
FITS = {"speed": "valve", "position": "servo", "torque": "force"}
"""Fit of each command interface."""
STAGES = ("timing", "actuation", "sensing", "kinematics", "perception")


@spec
class Penalties:
    """Penalties of effects, nats of log likelihood on recordings outside the fit.

    Attributes:
        joint: For each joint that has it, unless one cause is behind it on all joints.
        reference: Factor on its gain on reference recordings.
        name: For the effect as such.
        partial: For each joint that lacks an effect with one cause for all joints.
        share: Least part of the gain of its joint's set: an effect that adds less only corrects the
            form of another.
    """

    joint: float
    reference: float
    name: float
    partial: float
    share: float


@spec
class ProbabilityModel:
    """Weights of signs, and how far forms of effects differ.

    Attributes:
        outside: Of the signs that the cause lies outside the library; their weighted sum is the
            logarithm of the odds.
        right: Of the signs that an effect is rightly named.
        form: Relative model-form error of the size of an effect, 1 sigma, by stage.
        form_of_effect: The same of single effects, in place of that of their stage.
        choice: Of the signs of hypotheses, by verdict, and the `stakes`: factors on the probability of
            each verdict when one is told.
    """

    outside: dict[str, float]
    right: dict[str, float]
    form: dict[str, float]
    choice: dict[str, dict[str, float]]
    form_of_effect: dict[str, float] = field(default_factory=dict)  # older files lack it

    def get_form_error(self, effect: str, stage: str) -> float:
        """Return the relative 1-sigma model-form error of an effect that lies on `stage`."""
        return self.form_of_effect.get(effect, self.form[stage])

    def check(self) -> None:
        known = {
            "outside": OUTSIDE_SIGNS,
            "right": EFFECT_SIGNS,
            "form": STAGES,
            "choice": tuple(CHOICE_SIGNS),
        }
        given = {name: getattr(self, name) for name in known}
        for verdict, signs in CHOICE_SIGNS.items():
            known[f"choice.{verdict}"] = signs
            given[f"choice.{verdict}"] = self.choice.get(verdict, {})
        for name, signs in known.items():
            for sign in given[name]:
                if sign not in signs:
                    raise ConfigError(
                        f"certainty.{name}: '{sign}' is no sign; {list_choices(sign, signs)}"
                    )
            if missing := [sign for sign in signs if sign not in given[name]]:
                raise ConfigError(
                    f"certainty.{name}: expected a number for {', '.join(missing)} too"
                )
        for name in ("form", "form_of_effect"):
            for key, value in getattr(self, name).items():
                if value < 0:
                    raise ConfigError(f"certainty.{name}.{key}: expected 0 or more, got {value}")


@spec
class DiagnosisSubject:
    """Recordings to diagnose.

    Attributes:
        case: Folder with `reference/` and `field/`; or `null`.
        field: Glob or globs of recordings of the machine as it is, held against `actuator`; instead
            of a case.
        unseen: Glob or globs of further recordings of the machine as it is, to which nothing is
            fitted: how far the effects carry.
        effects: Names of the effects to choose among; `null`: all that are registered.
        workers: Processes that share the work; 1 where the system has no safe fork.
        prices: Penalties of effects.
        certainty: Calibration of the probabilities.
    """

    case: str | None
    field: str | tuple[str, ...] | None
    unseen: str | tuple[str, ...] | None
    effects: tuple[str, ...] | None
    workers: int
    prices: Penalties
    certainty: ProbabilityModel

    def check(self) -> None:
        if self.workers < 1:
            raise ConfigError(f"diagnosis.workers: expected 1 or more, got {self.workers}")
        if (self.case is None) == (self.field is None):
            raise ConfigError(
                "diagnosis: give either case=<folder with reference/ and field/>, or field=<glob> and actuator=<simulator>"
            )
        if self.case is not None and not Path(self.case).is_dir():
            raise ConfigError(
                f"diagnosis.case={self.case}: there is no such folder (seen from {Path.cwd()})"
            )
