"""Robot-world and hand-eye calibration, `A_i Y = X B_i`, in the presence of wrong detections.

Two closed forms of OpenCV are refined over all views by least squares. A residual
compares where the camera sees the board with where it should. Its covariance holds the reprojection
error of the corners and the uncertainty of the arm, so that a poor arm does not distort the optics.
Weights are Student's t (Lange, Little and Taylor, 1989): wrong detections lose their weight and are
left out in the end. One factor on the arm's uncertainty is estimated by the median of all views.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from perception.calibrate import transforms

STUDENT_T_FREEDOM = 4.0
"""Degrees of freedom of the t: heavy tails, so that a quarter of wrong views does no harm."""
ARM_FACTORS = np.geomspace(0.1, 10.0, 41)
"""Factors on the arm's uncertainty that are compared: steps of 12 %; chosen by hand."""
MEDIAN_DISTANCE = float(chi2.ppf(0.5, 6))
"""Median squared distance of a right view, six degrees of freedom."""
MAX_DISTANCE = float(chi2.ppf(0.999, 6))
"""Squared distance beyond which a view is called wrong; one right view in a thousand is."""
MAX_STEPS = 40
"""Steps of least squares; a bound, chosen by hand."""
MAX_ROUNDS = 4
"""Rounds in which arm factor or used views are chosen anew; a bound, chosen by hand."""
MIN_VIEWS = 4
"""Views that can be told from each other; three decide, a fourth contradicts."""


@dataclass(frozen=True)
class HandEyeViews:
    """`N` views of a board that is fixed to a link of the arm.

    Small motions of the link are given in the base frame, `(6,)`: a point at `p` moves by `v + w x
    p`.

    Attributes:
        base_from_link: Pose of the link by the joint positions, `(N, 4, 4)`.
        camera_from_board: Pose of the board as seen, `(N, C, 4, 4)`. There are `C` candidates,
            since a flat board seen from afar fits two poses about equally well.
        seen_cov: Covariance of each candidate as a small motion in the board's frame, `(N, C, 6,
            6)`.
        slack: Independent errors of each link as motions of one standard deviation, `(N, K, 6)`.
        shared: Motions for one unit of each systematic error (zeros of joints, clock), `(N, S, 6)`.
        shared_std: Standard deviation of the systematic errors in their units, `(S,)`.
        names: Of the views.
        shared_names: Of the systematic errors.
    """

    base_from_link: np.ndarray
    camera_from_board: np.ndarray
    seen_cov: np.ndarray
    slack: np.ndarray
    shared: np.ndarray
    shared_std: np.ndarray
    names: tuple[str, ...]
    shared_names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.base_from_link)


@dataclass(frozen=True)
class HandEyeGuess:
    """Unknowns of the calibration.

    Attributes:
        base_from_camera: The camera, `(4, 4)`.
        link_from_board: The board, `(4, 4)`.
        shared: Systematic errors, `(S,)`, in their units.
    """

    base_from_camera: np.ndarray
    link_from_board: np.ndarray
    shared: np.ndarray


@dataclass(frozen=True)
class HandEyeSolution:
    """Result of a calibration.

    Attributes:
        guess: Camera, board and systematic errors.
        cov: Covariance of a small motion of the camera in its own frame, of one of the board in its
            own frame, and of the systematic errors, `(12 + S, 12 + S)`.
        factor: The arm's uncertainty over the assumed one.
        away: Residual of each view as a small motion in the board's frame, `(N, 6)`.
        distance: Squared Mahalanobis distance of each, `(N,)`; 6 on average if the model is right.
        used: Views that were used in the end, `(N,)` bool.
    """

    guess: HandEyeGuess
    cov: np.ndarray
    factor: float
    away: np.ndarray
    distance: np.ndarray
    used: np.ndarray


def predict_board_poses(views: HandEyeViews, guess: HandEyeGuess) -> np.ndarray:
    """Return where the camera should see each board, `(N, 4, 4)`."""
    motion = np.einsum("nsk,s->nk", views.shared, guess.shared)
    link = views.base_from_link.copy()
    link[:, :3, 3] += motion[:, :3] + np.cross(motion[:, 3:], link[:, :3, 3])
    link[:, :3, :3] = Rotation.from_rotvec(motion[:, 3:]).as_matrix() @ link[:, :3, :3]
    return np.linalg.inv(guess.base_from_camera) @ link @ guess.link_from_board


def express_in_board(guess: HandEyeGuess, board: np.ndarray, motions: np.ndarray) -> np.ndarray:
    """Return motions of the link, `(N, K, 6)` in the base frame, as the boards', `(N, 6, K)`.

    Args:
        guess: Gives the camera's pose.
        board: Predicted poses of the boards, `(N, 4, 4)`.
        motions: Of the links.
    """
    turn = guess.base_from_camera[:3, :3]
    place = board[:, :3, 3] @ turn.T + guess.base_from_camera[:3, 3]
    board_from_base = np.swapaxes(turn @ board[:, :3, :3], 1, 2)
    shift = motions[..., :3] + np.cross(motions[..., 3:], place[:, None])
    shift_in_board = board_from_base @ np.swapaxes(shift, 1, 2)
    turn_in_board = board_from_base @ np.swapaxes(motions[..., 3:], 1, 2)
    return np.concatenate([shift_in_board, turn_in_board], 1)


def generate_starts(
    base_from_link: np.ndarray, camera_from_board: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield closed-form guesses of `base_from_camera` and `link_from_board`, `(4, 4)` each.

    Args:
        base_from_link: `(N, 4, 4)`.
        camera_from_board: `(N, 4, 4)`.
    """
    # OpenCV's equation with its names in ours: world = board, gripper = base, base = link
    seen = list(camera_from_board[:, :3, :3]), list(camera_from_board[:, :3, 3])
    link = list(base_from_link[:, :3, :3]), list(base_from_link[:, :3, 3])
    for method in (cv2.CALIB_ROBOT_WORLD_HAND_EYE_SHAH, cv2.CALIB_ROBOT_WORLD_HAND_EYE_LI):
        try:
            solution = cv2.calibrateRobotWorldHandEye(*seen, *link, method=method)
        except cv2.error:  # an arm that does not move
            continue
        board_turn, board_shift, camera_turn, camera_shift = solution
        if not all(np.isfinite(one).all() for one in solution):
            continue
        yield (
            _invert_estimate(camera_turn, camera_shift),
            _invert_estimate(board_turn, board_shift),
        )


def _invert_estimate(rotation: np.ndarray, shift_m: np.ndarray) -> np.ndarray:
    """Return the inverse of a transform whose rotation is orthonormal but for rounding."""
    nearest = Rotation.from_matrix(rotation).as_matrix()
    return np.linalg.inv(transforms.make_transform(nearest, np.ravel(shift_m)))


def solve_hand_eye(views: HandEyeViews) -> HandEyeSolution | None:
    """Return the best of several refined starts; `None` where there are too few views."""
    if len(views) < MIN_VIEWS:
        return None
    shared = np.zeros(len(views.shared_std))
    best_deviance, guess = np.inf, HandEyeGuess(np.eye(4), np.eye(4), shared)
    for camera, board in generate_starts(views.base_from_link, views.camera_from_board[:, 0]):
        refined, _ = _minimise(views, HandEyeGuess(camera, board, shared), 1.0, None)
        deviance = compute_deviance(views, refined)
        if deviance < best_deviance:
            best_deviance, guess = deviance, refined
    factor = 1.0
    for _ in range(MAX_ROUNDS):
        before, factor = factor, _estimate_arm_factor(views, guess)
        if factor == before:
            break
        guess, _ = _minimise(views, guess, factor, None)
    return _select_views(views, guess, factor)


def _select_views(views: HandEyeViews, guess: HandEyeGuess, factor: float) -> HandEyeSolution:
    """Return the solution of the views that are not wrong, each with its full weight."""
    used = _compare(views, guess, factor).distance <= MAX_DISTANCE
    slopes = np.zeros((0, 12 + len(views.shared_std)))
    for _ in range(MAX_ROUNDS):
        is_enough = used.sum() >= MIN_VIEWS
        used = used if is_enough else np.ones(len(views), bool)
        guess, slopes = _minimise(views, guess, factor, used)
        now = _compare(views, guess, factor).distance <= MAX_DISTANCE
        if not is_enough or (now == used).all():
            break
        used = now
    residuals = _compare(views, guess, factor)
    # views that disagree by more than they should inflate the covariance
    freedom = max(6.0 * used.sum() - slopes.shape[1], 1.0)
    excess = max(1.0, float(residuals.distance[used].sum()) / freedom)
    cov = excess * np.linalg.pinv(slopes.T @ slopes, hermitian=True)
    return HandEyeSolution(guess, cov, factor, residuals.away, residuals.distance, used)


@dataclass(frozen=True)
class _Residuals:
    """Residuals of the views at a guess, each view with its better candidate.

    Attributes:
        away: Small motion from the board as seen to the board as predicted, `(N, 6)`.
        whitened: The same in standard deviations, `(N, 6)`.
        distance: Squared Mahalanobis distance, `(N,)`.
        log_det: Logarithm of the covariance's determinant, `(N,)`.
    """

    away: np.ndarray
    whitened: np.ndarray
    distance: np.ndarray
    log_det: np.ndarray


def _compare(views: HandEyeViews, guess: HandEyeGuess, factor: float) -> _Residuals:
    board = predict_board_poses(views, guess)
    slack = express_in_board(guess, board, views.slack)
    # the covariance of the board as predicted stands for that of the board as seen: they are close,
    # or the view is wrong anyway
    cov = views.seen_cov + factor**2 * (slack @ np.swapaxes(slack, 1, 2))[:, None]
    away = transforms.compute_motion(views.camera_from_board, board[:, None])
    root = np.linalg.cholesky(cov)
    whitened = np.linalg.solve(root, away[..., None])[..., 0]
    distance = (whitened**2).sum(-1)
    best, row = distance.argmin(1), np.arange(len(views))
    log_det = 2.0 * np.log(np.diagonal(root[row, best], axis1=1, axis2=2)).sum(1)
    return _Residuals(away[row, best], whitened[row, best], distance[row, best], log_det)


def _minimise(
    views: HandEyeViews, start: HandEyeGuess, factor: float, used: np.ndarray | None
) -> tuple[HandEyeGuess, np.ndarray]:
    """Return the nearest minimum, and the slopes of the whitened residuals there, `(…, 12 + S)`.

    Args:
        views: The views.
        start: Where to begin.
        factor: On the arm's uncertainty.
        used: Views that count, `(N,)` bool; `None` for all of them by Student's t.
    """

    def move(motion: np.ndarray) -> HandEyeGuess:
        camera = transforms.apply_motion(start.base_from_camera, motion[:6])
        board = transforms.apply_motion(start.link_from_board, motion[6:12])
        return HandEyeGuess(camera, board, start.shared + motion[12:])

    def compute_residuals(motion: np.ndarray) -> np.ndarray:
        guess = move(motion)
        found = _compare(views, guess, factor)
        weight = used
        if weight is None:
            # the sum of squares is then the deviance of the t
            weight = compute_student_deviance(found) / np.maximum(found.distance, 1e-12)
        weighted = np.sqrt(weight)[:, None] * found.whitened
        return np.concatenate([weighted.ravel(), guess.shared / views.shared_std])

    size = 12 + len(start.shared)
    found = least_squares(compute_residuals, np.zeros(size), x_scale="jac", max_nfev=MAX_STEPS)
    return move(found.x), found.jac


def compute_student_deviance(residuals: _Residuals) -> np.ndarray:
    """Return minus twice the logarithm of Student's t, `(N,)`, but for the determinant."""
    far = residuals.distance
    return (STUDENT_T_FREEDOM + 6) * np.log1p(far / STUDENT_T_FREEDOM)


def compute_deviance(views: HandEyeViews, guess: HandEyeGuess) -> float:
    """Return minus twice the logarithm of the likelihood of all views, but for a constant."""
    residuals = _compare(views, guess, 1.0)
    return float((compute_student_deviance(residuals) + residuals.log_det).sum())


def _estimate_arm_factor(views: HandEyeViews, guess: HandEyeGuess) -> float:
    """Return the least factor at which the median view is as near as the median right one."""
    typical = [np.median(_compare(views, guess, factor).distance) for factor in ARM_FACTORS]
    if typical[-1] > MEDIAN_DISTANCE:
        return float(ARM_FACTORS[-1])
    return float(ARM_FACTORS[np.searchsorted(-np.array(typical), -MEDIAN_DISTANCE)])
