"""Standard errors of numbers that least squares fitted."""

from collections.abc import Callable, Sequence

import numpy as np


def estimate_standard_errors(
    compute_errors: Callable[[np.ndarray], np.ndarray],
    x: np.ndarray,
    steps: np.ndarray,
    lengths: Sequence[int],
) -> np.ndarray:
    """Return standard errors by the sandwich over recordings (Liang and Zeger 1986), `(F,)`.

    The errors of a model that is not quite right hang together: the spread of the recordings' own
    gradients says how far a number would move with others. It is never less than white errors give.

    Args:
        compute_errors: Errors of all recordings, one after the other, for numbers `(F,)`.
        x: The numbers, `(F,)`.
        steps: Differences by which slopes are taken, `(F,)`.
        lengths: Number of errors of each recording.
    """
    errors = compute_errors(x)
    slopes = [compute_errors(x + one) - errors for one in np.diag(steps)]
    jacobian = np.stack(slopes, 1)
    inverse = np.linalg.pinv(jacobian.T @ jacobian)
    parts = np.split(jacobian * errors[:, None], np.cumsum(lengths)[:-1])
    scores = np.stack([part.sum(0) for part in parts])
    spread = inverse @ scores.T @ scores @ inverse
    white = inverse * np.square(errors).sum() / max(1, len(errors) - len(x))
    return steps * np.sqrt(np.maximum(np.diag(spread), np.diag(white)))
