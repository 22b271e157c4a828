"""The camera's place from sights of a board on the arm: `A_i Y = X B_i` with both ends unknown, in the presence of wrong sights.

Several closed forms are refined over all views by Gauss-Newton with damping. A residual is where
the camera sees the board against where it should, weighed by what the corners' reprojection leaves
open and by how well the arm's place is known, so that a poor arm does not ask the pixels to bend.
Weights are Student's t (Lange, Little and Taylor, 1989): wrong sights lose their say and are left
out in the end. How well the arm is known is itself estimated, as a factor on its slack, by the
median of all views.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from perception.calibrate import rigid
from perception.calibrate.start import starts
from perception.calibrate.views import Guess, Views, expected, in_board

FREEDOM = 4.0
"""Degrees of freedom of the t: heavy tails, so that a quarter of wrong sights does no harm."""
FACTORS = np.geomspace(0.1, 10.0, 41)
"""Factors on the slack of the arm that are compared."""
HALF = float(chi2.ppf(0.5, 6))
OUTSIDE = float(chi2.ppf(0.999, 6))
"""Squared distance beyond which a sight is called wrong; one right sight in a thousand is."""
STEPS, ROUNDS = 40, 4
FEWEST = 4
"""Views that can be told from each other; three decide, a fourth contradicts."""


@dataclass(frozen=True)
class Solution:
    """What came out.

    Attributes:
        guess: Camera, board, and what is wrong in all views alike.
        cov: Covariance of a small motion of the camera in its own frame, of one of the board in its
            own frame, and of what is wrong alike, `(12 + S, 12 + S)`.
        factor: The arm is this many times less exact than was assumed.
        away: How far the camera sees each board from where it should, as a small motion in the
            board's frame, `(N, 6)`.
        distance: The same in standard deviations, squared, `(N,)`; its mean is 6 where all is as it
            should be.
        used: Which views were believed in the end, `(N,)` bool.
    """

    guess: Guess
    cov: np.ndarray
    factor: float
    away: np.ndarray
    distance: np.ndarray
    used: np.ndarray


def solve(views: Views) -> Solution | None:
    """Returns the best of several refined starts; `None` where there are too few views for any."""
    if len(views) < FEWEST:
        return None
    shared = np.zeros(len(views.shared_std))
    found: list[tuple[float, int, Guess]] = []
    for camera, board in starts(views.base_from_link, views.camera_from_board):
        guess = _refined(views, Guess(camera, board, shared), 1.0, None)
        found.append((float(_surprise(views, guess, 1.0).sum()), len(found), guess))
    guess, factor = min(found, key=lambda one: one[:2])[2], 1.0
    for _ in range(ROUNDS):
        before, factor = factor, _factor(views, guess)
        if factor == before:
            break
        guess = _refined(views, guess, factor, None)
    return _final(views, guess, factor)


def refine(views: Views, solution: Solution) -> Solution:
    """Returns the answer of other views, or of some of them, begun at a solution and with its factor."""
    return _final(views, _refined(views, solution.guess, solution.factor, None), solution.factor)


def _final(views: Views, guess: Guess, factor: float) -> Solution:
    """Returns the answer of the views that are not wrong, each with its full say."""
    used = _compare(views, guess, factor).distance <= OUTSIDE
    for _ in range(ROUNDS):
        if used.sum() < FEWEST:
            used = np.ones(len(views), bool)
            break
        guess = _refined(views, guess, factor, used.astype(float))
        now = _compare(views, guess, factor).distance <= OUTSIDE
        if (now == used).all():
            break
        used = now
    there = _compare(views, guess, factor)
    normal = _normal(views, there, used.astype(float))[0]
    # where the views that are left disagree by more than they should, they say less than they claim
    excess = max(1.0, float(there.distance[used].sum()) / max(6.0 * used.sum() - len(normal), 1.0))
    return Solution(
        guess,
        excess * np.linalg.pinv(normal, hermitian=True),
        factor,
        there.away,
        there.distance,
        used,
    )


@dataclass(frozen=True)
class _Compared:
    """Views against a guess.

    Attributes:
        away: Small motion from where each board is seen to where it is expected, `(N, 6)`.
        distance: The same in standard deviations, squared, `(N,)`.
        information: Inverse of its covariance, `(N, 6, 6)`.
        spread: Logarithm of the determinant of its covariance, `(N,)`.
        slopes: Its change by all that is looked for, `(N, 6, 12 + S)`.
        shared: What is wrong in all views alike, `(S,)`.
    """

    away: np.ndarray
    distance: np.ndarray
    information: np.ndarray
    spread: np.ndarray
    slopes: np.ndarray
    shared: np.ndarray


def _compare(views: Views, guess: Guess, factor: float) -> _Compared:
    board = expected(views, guess)
    slack = in_board(views, guess, board, views.slack)
    # a covariance of the board as expected is taken for that of the board as seen: they are close,
    # or the view is wrong anyway
    cov = views.seen_cov + factor**2 * (slack @ np.swapaxes(slack, 1, 2))[:, None]
    away = rigid.apart(views.camera_from_board, board[:, None])
    information = np.linalg.inv(cov)
    distance = np.einsum("nci,ncij,ncj->nc", away, information, away)
    best, row = distance.argmin(1), np.arange(len(views))
    away, information = away[row, best], information[row, best]
    seen = views.camera_from_board[row, best]
    back = np.swapaxes(seen[:, :3, :3], 1, 2)
    turn = back @ board[:, :3, :3]
    slopes = np.zeros((len(views), 6, 12 + len(guess.shared)))
    slopes[:, :3, 0:3], slopes[:, :3, 3:6] = -back, back @ rigid.crossing(board[:, :3, 3])
    slopes[:, 3:, 3:6] = -np.swapaxes(board[:, :3, :3], 1, 2)
    slopes[:, :3, 6:9], slopes[:, 3:, 9:12] = turn, np.eye(3)
    slopes[:, :, 12:] = in_board(views, guess, board, views.shared)
    slopes[:, :3, 12:] = turn @ slopes[:, :3, 12:]
    # the motion's turn grows with a turn of the board not one to one but by the inverse Jacobian;
    # for 0.1 rad that is 5 %, and only the way to the answer, not the answer, depends on it
    return _Compared(
        away,
        distance[row, best],
        information,
        -np.linalg.slogdet(information)[1],
        slopes,
        guess.shared,
    )


def _normal(views: Views, there: _Compared, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    weighted = np.swapaxes(there.slopes, 1, 2) @ (weight[:, None, None] * there.information)
    normal = (weighted @ there.slopes).sum(0)
    gradient = (weighted @ there.away[..., None]).sum(0)[:, 0]
    trust = 1.0 / views.shared_std**2
    normal[np.arange(12, len(normal)), np.arange(12, len(normal))] += trust
    gradient[12:] += trust * there.shared
    return normal, gradient


def _refined(views: Views, guess: Guess, factor: float, fixed: np.ndarray | None) -> Guess:
    """Returns the nearest minimum, by damped steps that never go uphill; with `fixed` weights, or those of Student's t."""

    def cost(there: _Compared) -> float:
        far = there.distance
        size = (
            (fixed * far).sum()
            if fixed is not None
            else ((FREEDOM + 6) * np.log1p(far / FREEDOM)).sum()
        )
        return float(size + (there.shared**2 / views.shared_std**2).sum())

    there = _compare(views, guess, factor)
    now, damping = cost(there), 1e-4
    for _ in range(STEPS):
        weight = fixed if fixed is not None else (FREEDOM + 6) / (FREEDOM + there.distance)
        normal, gradient = _normal(views, there, weight)
        while damping < 1e8:
            scale = np.diag(normal) + 1e-12 * np.trace(normal)
            step = -np.linalg.solve(normal + damping * np.diag(scale), gradient)
            trial = Guess(
                rigid.moved(guess.base_from_camera, step[:6]),
                rigid.moved(guess.link_from_board, step[6:12]),
                guess.shared + step[12:],
            )
            after = _compare(views, trial, factor)
            if (better := cost(after)) < now:
                break
            damping *= 10.0
        else:
            return guess
        gained, guess, there, now, damping = (
            now - better,
            trial,
            after,
            better,
            max(damping / 10.0, 1e-9),
        )
        if gained < 1e-7 * (1.0 + now):
            return guess
    return guess


def _surprise(views: Views, guess: Guess, factor: float) -> np.ndarray:
    """Returns minus twice the logarithm of the likelihood of each view, but for a constant, `(N,)`."""
    there = _compare(views, guess, factor)
    return (FREEDOM + 6) * np.log1p(there.distance / FREEDOM) + there.spread


def _factor(views: Views, guess: Guess) -> float:
    """Returns the least factor with which half of all views are as near as half of the right ones should be."""
    typical = [np.median(_compare(views, guess, factor).distance) for factor in FACTORS]
    return (
        float(FACTORS[np.searchsorted(-np.array(typical), -HALF)])
        if typical[-1] <= HALF
        else float(FACTORS[-1])
    )
