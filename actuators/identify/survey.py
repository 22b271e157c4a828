"""What recordings hold for a fit: how long each joint is commanded each way, and how noisy its sensor is."""

import logging
from collections.abc import Sequence

import numpy as np

from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.split import COMMANDED

log = logging.getLogger(__name__)

NEEDED_S = 15.0
"""Commanded time each way below which a fit is refused. Measured with `fit=mlp` on random levels of
the hydraulic plant: with 10 s each way the error of a free run of 5 s is three times that of an
ample fit, no better than a linear model; with 30 s 1.7 times."""
AMPLE_S = 200.0
"""Commanded time each way below which a warning stands: with 80 s that error is 1.15, with 200 s
1.07 times an ample fit's."""
SETTLED = 3
"""Histories without a command after which a joint is at rest: its dead time is over and what swung
has died away."""


def commanded_s(recordings: Sequence[Recording]) -> np.ndarray:
    """Returns for how long each joint is commanded forth and back, s, shape `(2, J)`."""
    both = [
        np.stack([(r.u > COMMANDED).sum(0), (r.u < -COMMANDED).sum(0)]) / r.rate_hz
        for r in recordings
    ]
    return np.sum(both, 0)


def check_enough(recordings: Sequence[Recording], machine: Machine) -> None:
    """Says where there is too little to fit to.

    Raises:
        RecordingError: a joint is hardly commanded, in figures.
    """
    found = commanded_s(recordings)
    for needed_s, fatal in ((NEEDED_S, True), (AMPLE_S, False)):
        lacking = "; ".join(
            f"{name} {forth_s / 60:.1f} min forth and {back_s / 60:.1f} min back"
            for name, (forth_s, back_s) in zip(machine.joint_names, found.T.tolist(), strict=True)
            if min(forth_s, back_s) < needed_s
        )
        if not lacking:
            continue
        found_text = f"{lacking} commanded (|u| > {COMMANDED:g}) in the {len(recordings)} recordings to fit to"
        advice = "Record more of these joints: small and large commands both ways over their whole travel (mode=collect)."
        if fatal:
            raise RecordingError(
                f"too little data: {found_text}, needed are {needed_s / 60:.2g} min each way. {advice}"
            )
        log.warning(
            "thin data: %s; errors hardly fall beyond %.2g min each way. %s",
            found_text,
            needed_s / 60,
            advice,
        )
        break


def check_together(recordings: Sequence[Recording]) -> None:
    """Warns where joints hardly move at the same time, so that nothing can be learned of what they do to each other."""
    together_s = float(
        sum(((np.abs(r.u) > COMMANDED).sum(1) > 1).sum() / r.rate_hz for r in recordings)
    )
    if together_s < AMPLE_S:
        log.warning(
            "thin data: several joints are commanded at once for %.1f min; how they share the pump shows in %.2g min or more. "
            "Record some (mode=collect excitation=levels), or fit=mlp, a network a joint",
            together_s / 60,
            AMPLE_S / 60,
        )


def resting_noise(recordings: Sequence[Recording], machine: Machine) -> np.ndarray:
    """Returns the size of an increment that is none, rad or m, shape `(J,)`: what the sensor shows of a joint at rest.

    The larger of two: the spread of the increments where the joint has long been without a command
    (68 of 100 are smaller; one standard deviation of normal noise), and the error of an increment
    from the sensor's own step, where it has a visible one: a difference of two values, each off by
    a step over the root of 12, is off by a step over the root of 6.
    """
    wait = SETTLED * machine.num_history
    noise = np.zeros(machine.num_joints)
    for joint, name in enumerate(machine.joint_names):
        still, moving = [], []
        for recording in recordings:
            commanded = np.abs(recording.u[:, joint]) > COMMANDED
            count = np.concatenate([np.zeros(wait), np.cumsum(commanded)])
            quiet = np.cumsum(commanded) == count[: len(commanded)]
            quiet[:wait] = False  # what came before the recording is not known
            q = recording.q[:, joint].astype(np.float64)
            still.append(np.diff(q)[quiet[:-1]])
            moving.append(q[~quiet])
        still, step = np.concatenate(still), _step(np.concatenate(moving))
        if not len(still):
            log.warning(
                "%s is never at rest in the recordings to fit to: its drift at rest will not be learned",
                name,
            )
        noise[joint] = max(
            float(np.quantile(np.abs(still), 0.68)) if len(still) else 0.0, step / np.sqrt(6.0)
        )
    return noise


def _step(q: np.ndarray) -> float:
    """Returns the step of a sensor that knows certain values only, `(T,)`; 0 where the values are continuous.

    Neighbours among the values that occur are then whole multiples of the step apart, most often
    one.
    """
    apart = np.diff(np.unique(q))
    apart = apart[apart > 1e-9]
    if len(apart) < 10:
        return 0.0
    step = float(np.quantile(apart, 0.05))
    multiple = apart / step
    return step if np.abs(multiple - np.round(multiple)).mean() < 0.1 else 0.0
