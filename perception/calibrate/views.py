"""What a calibration is made of: a board, seen by the camera, at places of the arm that are known so well and no better."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from perception.calibrate import rigid


@dataclass(frozen=True)
class Views:
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

    def part(self, chosen: np.ndarray) -> Views:
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
class Guess:
    """What a calibration looks for.

    Attributes:
        base_from_camera: The camera, `(4, 4)`.
        link_from_board: The board, `(4, 4)`.
        shared: What is wrong in all views alike, `(S,)`, in its units.
    """

    base_from_camera: np.ndarray
    link_from_board: np.ndarray
    shared: np.ndarray


def expected(views: Views, guess: Guess) -> np.ndarray:
    """Returns where the camera should see each board, `(N, 4, 4)`."""
    motion = np.einsum("nsk,s->nk", views.shared, guess.shared)
    link = views.base_from_link.copy()
    link[:, :3, 3] += motion[:, :3] + np.cross(motion[:, 3:], link[:, :3, 3])
    link[:, :3, :3] = rigid.Rotation.from_rotvec(motion[:, 3:]).as_matrix() @ link[:, :3, :3]
    return rigid.inverse(guess.base_from_camera) @ link @ guess.link_from_board


def in_board(views: Views, guess: Guess, board: np.ndarray, motions: np.ndarray) -> np.ndarray:
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
