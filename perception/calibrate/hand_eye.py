"""What a calibration is made of: a board, seen by the camera, at places of the arm that are known so well and no better."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from perception.calibrate import transforms

# --- from start: Closed forms to begin a calibration with: all poses together, and small groups
# of poses where some are wrong.
# --- from hand_eye: The camera's place from sights of a board on the arm: `A_i Y = X B_i` with
# both ends unknown, in the presence of wrong sights. Several closed forms are refined over all
# views by Gauss-Newton with damping. A residual is where the camera sees the board against where
# it should, weighed by what the corners' reprojection leaves open and by how well the arm's place
# is known, so that a poor arm does not ask the pixels to bend. Weights are Student's t (Lange,
# Little and Taylor, 1989): wrong sights lose their say and are left out in the end. How well the
# arm is known is itself estimated, as a factor on its slack, by the median of all views.


@dataclass(frozen=True)
class HandEyeViews:
    """`N` sights of a board that is fixed to a link of the arm.

    Small motions of the link are given in the base frame, `(6,)`: a point at `p` moves by `v + w x
    p`.

    Attributes:
        base_from_link: Where joint positions put the link, `(N, 4, 4)`.
        camera_from_board: Where the camera sees the board, `(N, C, 4, 4)`: `C` candidates, since a
            flat board seen from afar fits two poses about equally well; all the same where there is
            one.
        seen_cov: Covariance of each candidate as a small motion in the board's frame, `(N, C, 6,
            6)`.
        slack: Motions by which each link may be elsewhere independently, one standard deviation
            each, `(N, K, 6)`.
        shared: Motions for one unit of what is wrong in all views alike (zeros of joints, the
            clock), `(N, S, 6)`.
        shared_std: How wrong that may be, standard deviation in its unit, `(S,)`.
        names: Of the views.
        shared_names: Of what is wrong alike.
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

    def part(self, chosen: np.ndarray) -> HandEyeViews:
        """Returns the chosen views, by index."""
        return replace(
            self,
            base_from_link=self.base_from_link[chosen],
            camera_from_board=self.camera_from_board[chosen],
            seen_cov=self.seen_cov[chosen],
            slack=self.slack[chosen],
            shared=self.shared[chosen],
            names=tuple(self.names[int(k)] for k in chosen),
        )


@dataclass(frozen=True)
class HandEyeGuess:
    """What a calibration looks for.

    Attributes:
        base_from_camera: The camera, `(4, 4)`.
        link_from_board: The board, `(4, 4)`.
        shared: What is wrong in all views alike, `(S,)`, in its units.
    """

    base_from_camera: np.ndarray
    link_from_board: np.ndarray
    shared: np.ndarray


def predict_board_poses(views: HandEyeViews, guess: HandEyeGuess) -> np.ndarray:
    """Returns where the camera should see each board, `(N, 4, 4)`."""
    motion = np.einsum("nsk,s->nk", views.shared, guess.shared)
    link = views.base_from_link.copy()
    link[:, :3, 3] += motion[:, :3] + np.cross(motion[:, 3:], link[:, :3, 3])
    link[:, :3, :3] = transforms.Rotation.from_rotvec(motion[:, 3:]).as_matrix() @ link[:, :3, :3]
    return transforms.invert(guess.base_from_camera) @ link @ guess.link_from_board


def express_in_board(
    views: HandEyeViews, guess: HandEyeGuess, board: np.ndarray, motions: np.ndarray
) -> np.ndarray:
    """Returns motions of the link, `(N, K, 6)` in the base frame, as small motions of the boards, `(N, 6, K)`.

    Args:
        views: The views.
        guess: Where the camera is.
        board: Where it should see the boards, `(N, 4, 4)`.
        motions: Of the links.
    """
    turn = guess.base_from_camera[:3, :3]
    place = board[:, :3, 3] @ turn.T + guess.base_from_camera[:3, 3]
    own = np.swapaxes(turn @ board[:, :3, :3], 1, 2)  # board from base
    shift = motions[..., :3] + np.cross(motions[..., 3:], place[:, None])
    return np.concatenate(
        [own @ np.swapaxes(shift, 1, 2), own @ np.swapaxes(motions[..., 3:], 1, 2)], 1
    )


GROUP = 5
"""Poses of a group: three would do without noise."""
GROUPS = 150
KEPT = 5
"""Of the groups, those whose answer most poses agree with."""
LEAST_TURN = 0.05
"""Relative turns below this, rad, say nothing about an axis."""


def generate_starts(
    base_from_link: np.ndarray, camera_from_board: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields guesses of `base_from_camera` and `link_from_board`, `(4, 4)` each; never fails, may be far off.

    Args:
        base_from_link: `(N, 4, 4)`.
        camera_from_board: `(N, C, 4, 4)`.
    """
    count, num_candidates = camera_from_board.shape[:2]
    first = camera_from_board[:, 0]
    yield solve_kronecker(base_from_link, first)
    yield solve_motion_pairs(base_from_link, first)
    generator = np.random.default_rng(0)
    found = []
    for _ in range(GROUPS if count > GROUP else 0):
        group = generator.choice(count, GROUP, replace=False)
        which = (
            generator.integers(num_candidates, size=GROUP)
            if generator.random() < 0.5
            else np.zeros(GROUP, int)
        )
        guess = solve_kronecker(base_from_link[group], camera_from_board[group, which])
        found.append(
            (_compute_median_error(*guess, base_from_link, camera_from_board), len(found), guess)
        )
    for _, _, guess in sorted(found, key=lambda one: one[:2])[:KEPT]:
        yield guess


def solve_kronecker(
    base_from_link: np.ndarray, camera_from_board: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns camera and board at once: `A Y = X B` by the Kronecker product (Shah, 2013)."""
    turns_a, turns_b = base_from_link[:, :3, :3], camera_from_board[:, :3, :3]
    # A Y B' = X; with rows stacked, (A kron B) vec(Y) = vec(X): singular vectors of the largest
    # value of the sum
    table = np.einsum("nij,nkl->ikjl", turns_a, turns_b).reshape(9, 9)
    left, _, right = np.linalg.svd(table)
    x, y = left[:, 0].reshape(3, 3), right[0].reshape(3, 3)
    sign = np.sign(np.linalg.det(x)) or 1.0
    turn_x, turn_y = (
        transforms.find_nearest_rotation(sign * x),
        transforms.find_nearest_rotation(sign * y),
    )
    shift_x, shift_y = _solve_shifts(turn_x, base_from_link, camera_from_board)
    return transforms.make_transform(turn_x, shift_x), transforms.make_transform(turn_y, shift_y)


def solve_motion_pairs(
    base_from_link: np.ndarray, camera_from_board: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the board from the motions between all pairs of poses (Park and Martin, 1994), and the camera that follows."""
    one, other = np.triu_indices(len(base_from_link), 1)
    a = transforms.compute_rotation_vectors(
        np.swapaxes(base_from_link[one, :3, :3], 1, 2) @ base_from_link[other, :3, :3]
    )
    b = transforms.compute_rotation_vectors(
        np.swapaxes(camera_from_board[one, :3, :3], 1, 2) @ camera_from_board[other, :3, :3]
    )
    size = np.linalg.norm(a, axis=1)
    told = (size > LEAST_TURN) & (size < np.pi - 0.2)
    turn_y = transforms.find_nearest_rotation(a[told].T @ b[told]) if told.sum() >= 2 else np.eye(3)
    turn_x = transforms.find_nearest_rotation(
        (base_from_link[:, :3, :3] @ turn_y @ np.swapaxes(camera_from_board[:, :3, :3], 1, 2)).sum(
            0
        )
    )
    shift_x, shift_y = _solve_shifts(turn_x, base_from_link, camera_from_board)
    return transforms.make_transform(turn_x, shift_x), transforms.make_transform(turn_y, shift_y)


def _solve_shifts(
    turn_x: np.ndarray, base_from_link: np.ndarray, camera_from_board: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the shifts of camera and board by least squares: `R_A t_Y - t_X = R_X t_B - t_A`."""
    count = len(base_from_link)
    rows = np.concatenate(
        [np.broadcast_to(-np.eye(3), (count, 3, 3)), base_from_link[:, :3, :3]], 2
    ).reshape(-1, 6)
    right = (camera_from_board[:, :3, 3] @ turn_x.T - base_from_link[:, :3, 3]).reshape(-1)
    found = np.linalg.lstsq(rows, right, rcond=1e-9)[0]
    return found[:3], found[3:]


def _compute_median_error(
    x: np.ndarray, y: np.ndarray, base_from_link: np.ndarray, camera_from_board: np.ndarray
) -> float:
    """Returns how far off a guess typically is, in degrees plus units of 20 mm."""
    away = transforms.compute_motion(
        camera_from_board, (transforms.invert(x) @ base_from_link @ y)[:, None]
    )
    size = (
        np.degrees(np.linalg.norm(away[..., 3:], axis=-1))
        + np.linalg.norm(away[..., :3], axis=-1) / 0.02
    )
    return float(np.median(size.min(1)))


FREEDOM = 4.0
"""Degrees of freedom of the t: heavy tails, so that a quarter of wrong sights does no harm."""
FACTORS = np.geomspace(0.1, 10.0, 41)
"""Factors on the slack of the arm that are compared."""
HALF = float(chi2.ppf(0.5, 6))
OUTSIDE = float(chi2.ppf(0.999, 6))
"""Squared distance beyond which a sight is called wrong; one right sight in a thousand is."""
STEPS, ROUNDS = 40, 4
MIN_VIEWS = 4
"""Views that can be told from each other; three decide, a fourth contradicts."""


@dataclass(frozen=True)
class HandEyeSolution:
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

    guess: HandEyeGuess
    cov: np.ndarray
    factor: float
    away: np.ndarray
    distance: np.ndarray
    used: np.ndarray


def solve_hand_eye(views: HandEyeViews) -> HandEyeSolution | None:
    """Returns the best of several refined starts; `None` where there are too few views for any."""
    if len(views) < MIN_VIEWS:
        return None
    shared = np.zeros(len(views.shared_std))
    found: list[tuple[float, int, HandEyeGuess]] = []
    for camera, board in generate_starts(views.base_from_link, views.camera_from_board):
        guess = _minimise(views, HandEyeGuess(camera, board, shared), 1.0, None)
        found.append((float(_compute_deviance(views, guess, 1.0).sum()), len(found), guess))
    guess, factor = min(found, key=lambda one: one[:2])[2], 1.0
    for _ in range(ROUNDS):
        before, factor = factor, _estimate_arm_factor(views, guess)
        if factor == before:
            break
        guess = _minimise(views, guess, factor, None)
    return _finish_solution(views, guess, factor)


def refine_solution(views: HandEyeViews, solution: HandEyeSolution) -> HandEyeSolution:
    """Returns the answer of other views, or of some of them, begun at a solution and with its factor."""
    return _finish_solution(
        views, _minimise(views, solution.guess, solution.factor, None), solution.factor
    )


def _finish_solution(views: HandEyeViews, guess: HandEyeGuess, factor: float) -> HandEyeSolution:
    """Returns the answer of the views that are not wrong, each with its full say."""
    used = _compare(views, guess, factor).distance <= OUTSIDE
    for _ in range(ROUNDS):
        if used.sum() < MIN_VIEWS:
            used = np.ones(len(views), bool)
            break
        guess = _minimise(views, guess, factor, used.astype(float))
        now = _compare(views, guess, factor).distance <= OUTSIDE
        if (now == used).all():
            break
        used = now
    there = _compare(views, guess, factor)
    normal = _build_normal_equations(views, there, used.astype(float))[0]
    # where the views that are left disagree by more than they should, they say less than they claim
    excess = max(1.0, float(there.distance[used].sum()) / max(6.0 * used.sum() - len(normal), 1.0))
    return HandEyeSolution(
        guess,
        excess * np.linalg.pinv(normal, hermitian=True),
        factor,
        there.away,
        there.distance,
        used,
    )


@dataclass(frozen=True)
class _Comparison:
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


def _compare(views: HandEyeViews, guess: HandEyeGuess, factor: float) -> _Comparison:
    board = predict_board_poses(views, guess)
    slack = express_in_board(views, guess, board, views.slack)
    # a covariance of the board as expected is taken for that of the board as seen: they are close,
    # or the view is wrong anyway
    cov = views.seen_cov + factor**2 * (slack @ np.swapaxes(slack, 1, 2))[:, None]
    away = transforms.compute_motion(views.camera_from_board, board[:, None])
    information = np.linalg.inv(cov)
    distance = np.einsum("nci,ncij,ncj->nc", away, information, away)
    best, row = distance.argmin(1), np.arange(len(views))
    away, information = away[row, best], information[row, best]
    seen = views.camera_from_board[row, best]
    back = np.swapaxes(seen[:, :3, :3], 1, 2)
    turn = back @ board[:, :3, :3]
    slopes = np.zeros((len(views), 6, 12 + len(guess.shared)))
    slopes[:, :3, 0:3], slopes[:, :3, 3:6] = (
        -back,
        back @ transforms.build_cross_matrices(board[:, :3, 3]),
    )
    slopes[:, 3:, 3:6] = -np.swapaxes(board[:, :3, :3], 1, 2)
    slopes[:, :3, 6:9], slopes[:, 3:, 9:12] = turn, np.eye(3)
    slopes[:, :, 12:] = express_in_board(views, guess, board, views.shared)
    slopes[:, :3, 12:] = turn @ slopes[:, :3, 12:]
    # the motion's turn grows with a turn of the board not one to one but by the inverse Jacobian;
    # for 0.1 rad that is 5 %, and only the way to the answer, not the answer, depends on it
    return _Comparison(
        away,
        distance[row, best],
        information,
        -np.linalg.slogdet(information)[1],
        slopes,
        guess.shared,
    )


def _build_normal_equations(
    views: HandEyeViews, there: _Comparison, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    weighted = np.swapaxes(there.slopes, 1, 2) @ (weight[:, None, None] * there.information)
    normal = (weighted @ there.slopes).sum(0)
    gradient = (weighted @ there.away[..., None]).sum(0)[:, 0]
    trust = 1.0 / views.shared_std**2
    normal[np.arange(12, len(normal)), np.arange(12, len(normal))] += trust
    gradient[12:] += trust * there.shared
    return normal, gradient


def _minimise(
    views: HandEyeViews, guess: HandEyeGuess, factor: float, fixed: np.ndarray | None
) -> HandEyeGuess:
    """Returns the nearest minimum, by damped steps that never go uphill; with `fixed` weights, or those of Student's t."""

    def cost(there: _Comparison) -> float:
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
        normal, gradient = _build_normal_equations(views, there, weight)
        while damping < 1e8:
            scale = np.diag(normal) + 1e-12 * np.trace(normal)
            step = -np.linalg.solve(normal + damping * np.diag(scale), gradient)
            trial = HandEyeGuess(
                transforms.apply_motion(guess.base_from_camera, step[:6]),
                transforms.apply_motion(guess.link_from_board, step[6:12]),
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


def _compute_deviance(views: HandEyeViews, guess: HandEyeGuess, factor: float) -> np.ndarray:
    """Returns minus twice the logarithm of the likelihood of each view, but for a constant, `(N,)`."""
    there = _compare(views, guess, factor)
    return (FREEDOM + 6) * np.log1p(there.distance / FREEDOM) + there.spread


def _estimate_arm_factor(views: HandEyeViews, guess: HandEyeGuess) -> float:
    """Returns the least factor with which half of all views are as near as half of the right ones should be."""
    typical = [np.median(_compare(views, guess, factor).distance) for factor in FACTORS]
    return (
        float(FACTORS[np.searchsorted(-np.array(typical), -HALF)])
        if typical[-1] <= HALF
        else float(FACTORS[-1])
    )
