"""A fast model of people at work: how long a trial takes, with skill, practice, holes, guidance, chance; no machine is simulated.

    log T = log base + skill + hole - learning * log(trial number) + guidance + chance

Practice follows the power law (Newell and Rosenbloom 1981); a trial longer than the limit counts
with the limit. Thousands of studies can be drawn in a second, so that a plan can say how often it
would find effects that are not there, and miss real ones.
Axes: `S` studies, `P` persons, `K` trials in a period.
"""

from __future__ import annotations

import numpy as np
from scipy import optimize

from brokk_rl.errors import ConfigError
from brokk_rl.spec import Positive, spec
from brokk_rl.statistics import compute_wilson_interval
from study import permutation_tests

LARGE = 20_000
"""Persons from whose times the size of an effect is worked out."""
STRONGEST = -5.0
"""Logarithm of the shortest time that guidance can make of another."""


@spec
class Practice:
    """Model of trial times of simulated persons; standard deviations are of the logarithm.

    Attributes:
        base_s: Typical time of the very first trial.
        skill_sd: Differences between persons.
        hole_sd: Differences between holes.
        learning: Exponent of practice: twice as many trials make a trial 2**-learning as long.
        learning_sd: Differences between persons in it.
        guidance_sd: Differences between persons in the effect of guidance.
        chance_sd: From trial to trial.
    """

    base_s: Positive
    skill_sd: float
    hole_sd: float
    learning: float
    learning_sd: float
    guidance_sd: float
    chance_sd: Positive

    def draw(
        self,
        guided_first: np.ndarray,
        num_trials: int,
        practised: int,
        limit_s: float,
        effect: float,
        seed: int,
        studies: int = 1,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return mean times with and without guidance, `(S, P)` each, s.

        Args:
            guided_first: Who has guidance in the first period, `(P,)` bool.
            num_trials: Trials in a period, `K`.
            practised: Trials before the first period.
            limit_s: Time after which a trial ends.
            effect: Added to the logarithm of the time by guidance; below 0 it helps.
            seed: The same seed gives the same persons whatever the effect.
            studies: Number of studies.
        """
        generator = np.random.default_rng(seed)
        persons = (studies, len(guided_first), 1, 1)
        skill = self.skill_sd * generator.standard_normal(persons)
        learning = self.learning + self.learning_sd * generator.standard_normal(persons)
        gain = effect + self.guidance_sd * generator.standard_normal(persons)
        # Each hole occurs once in each period.
        hole = self.hole_sd * generator.standard_normal((studies, 1, 1, num_trials))
        chance = self.chance_sd * generator.standard_normal((*persons[:2], 2, num_trials))
        number = practised + 1 + np.arange(2 * num_trials).reshape(2, num_trials)
        guided = np.stack((guided_first, ~guided_first), 1)[None, :, :, None]
        time_s = self.base_s * np.exp(
            skill + hole + chance - learning * np.log(number) + gain * guided
        )
        period = np.minimum(time_s, limit_s).mean(3)
        first = np.where(guided_first, period[..., 0], period[..., 1])
        return first, np.where(guided_first, period[..., 1], period[..., 0])

    def effect_of(self, dz: float, num_trials: int, practised: int, limit_s: float) -> float:
        """Return the effect with which guidance shortens times by `dz` standard deviations of a person's difference.

        The standard deviation is that within sequences, without the effect of practice that all share.

        Raises:
            ConfigError: the limit is so short that no such effect could be seen.
        """
        first = np.arange(LARGE) % 2 == 0

        def found(effect: float) -> float:
            guided, unguided = self.draw(first, num_trials, practised, limit_s, effect, seed=1)
            saved = (unguided - guided)[0]
            spread = float(np.sqrt((saved[first].var() + saved[~first].var()) / 2))
            return (
                float(saved[first].mean() + saved[~first].mean()) / 2 / spread - dz
                if spread > 0
                else -dz
            )

        if found(STRONGEST) < 0:
            raise ConfigError(
                f"study.design.limit_s: nearly every trial of study.practice ends at the limit of {limit_s:g} s, so that no "
                f"effect of dz {dz:g} could be seen; raise the limit, or lower study.practice.base_s"
            )
        return float(optimize.brentq(found, STRONGEST, 5.0, xtol=1e-4))  # type: ignore[arg-type]


def share_significant(
    practice: Practice,
    num_persons: int,
    num_trials: int,
    practised: int,
    limit_s: float,
    dz: float,
    alpha: float,
    studies: int,
    seed: int,
    fixed: bool = False,
) -> dict[str, float | list[float]]:
    """Return in how many of many studies guidance would be called a help or a harm, with its 95 % interval.

    Args:
        practice: How persons work.
        num_persons: Participants of each study.
        num_trials: Trials in a period.
        practised: Trials before.
        limit_s: Time after which a trial ends.
        dz: True standardised effect of guidance; 0: none, and every finding is false.
        alpha: Level of the test.
        studies: Number of studies.
        seed: Of the draws.
        fixed: Guidance first for all, and the paired test, as there is no other; else
            counterbalanced, period in the model.
    """
    first = np.ones(num_persons, bool) if fixed else np.arange(num_persons) % 2 == 0
    effect = practice.effect_of(dz, num_trials, practised, limit_s) if dz else 0.0
    guided, unguided = practice.draw(first, num_trials, practised, limit_s, effect, seed, studies)
    if fixed:
        p = permutation_tests.compute_paired_p(guided - unguided)
    else:
        p = permutation_tests.compute_sequence_p(
            np.where(first, guided - unguided, unguided - guided),
            first,
            np.arange(num_persons) // 2,
        )
    hits = int((p <= alpha).sum())
    return {
        "share": hits / studies,
        "ci95": list(compute_wilson_interval(hits, studies)),
        "studies": studies,
    }
