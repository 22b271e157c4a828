"""The lenses of a pair come out of pictures of a board, or it is said what they lack."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from brokk_rl.errors import FrameError
from perception.calibrate.pair_lens import BoardPair, calibrate_pair
from perception.sources.lens_file import read_pair_lens

SIZE_PX = (1280, 720)
BOARD_M = np.array([[0.1 * x, 0.1 * y, 0.0] for y in range(5) for x in range(7)], np.float32)
LEFT = np.array([[530.0, 0.0, 650.0], [0.0, 532.0, 352.0], [0.0, 0.0, 1.0]])
RIGHT = np.array([[527.0, 0.0, 633.0], [0.0, 529.0, 366.0], [0.0, 0.0, 1.0]])
BENT = np.array([-0.05, 0.02, 0.0, 0.0, 0.0])
TURN_RAD, SHIFT_M = np.array([0.004, -0.006, 0.01]), np.array([-0.12, 0.001, -0.0005])


def view_boards(count: int, tilt_rad: float, noise_px: float = 0.1) -> list[BoardPair]:
    """Returns views of a board at 0.8 to 2 m, tilted to all sides, as OpenCV projects them."""
    chance, pairs = np.random.default_rng(0), []
    for number in range(count):
        angle = 2.4 * number
        turn = tilt_rad * np.array([np.cos(angle), np.sin(angle), 0.1])
        shift = np.array([-0.3, -0.2, 0.8 + 1.2 * number / count]) + chance.uniform(-0.1, 0.1, 3)
        board_to_right = cv2.composeRT(turn, shift, TURN_RAD, SHIFT_M)[:2]
        left_px = cv2.projectPoints(BOARD_M, turn, shift, LEFT, BENT)[0][:, 0]
        right_px = cv2.projectPoints(BOARD_M, *board_to_right, RIGHT, BENT)[0][:, 0]
        left_px, right_px = (
            (one + chance.normal(0, noise_px, one.shape)).astype(np.float32)
            for one in (left_px, right_px)
        )
        pairs.append(BoardPair(BOARD_M, left_px, right_px))
    return pairs


def test_lenses_and_baseline_come_out_of_boards() -> None:
    found = calibrate_pair(view_boards(16, 0.5), SIZE_PX)
    np.testing.assert_allclose(found["K1"], LEFT, atol=2.5)
    np.testing.assert_allclose(found["K2"], RIGHT, atol=2.5)
    np.testing.assert_allclose(found["T"], SHIFT_M, atol=5e-4)
    np.testing.assert_allclose(cv2.Rodrigues(np.array(found["R"]))[0][:, 0], TURN_RAD, atol=3e-3)
    assert found["size_px"] == [1280, 720]
    # Noise of 0.1 px in each direction of both pictures.
    assert found["error_px"] == pytest.approx(0.1 * np.sqrt(2.0), rel=0.1)


@pytest.mark.parametrize(
    ("pairs", "lack"),
    [
        (view_boards(5, 0.5), "expected 8 pairs or more"),
        (view_boards(12, 0.01), "tilt the board"),
        (view_boards(12, 0.5, noise_px=3.0), "miss by|tilt the board"),
    ],
)
def test_views_that_determine_no_lens_are_refused_by_what_they_lack(
    pairs: list[BoardPair], lack: str
) -> None:
    with pytest.raises(FrameError, match=lack):
        calibrate_pair(pairs, SIZE_PX)


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("D2", None, "got no D2"), ("R", 2 * np.eye(3), "no rigid transform"), ("R", np.eye(2), r"R has shape \(2, 2\)"),
        ("T", [-0.12, 0.0], r"T has shape \(2,\)"), ("D1", [np.nan] * 5, "camera 1: dist"), ("T", [-120.0, 0.0, 0.0], "mm"),
    ],
)  # fmt: skip
def test_a_lens_file_without_a_number_or_with_impossible_ones_is_refused(
    name: str, value: Any, told: str
) -> None:
    content = {"K1": LEFT, "D1": BENT, "K2": RIGHT, "D2": BENT, "R": np.eye(3), "T": [[-0.12], [0], [0]]}  # fmt: skip
    assert read_pair_lens(Path("lens.yaml"), content, SIZE_PX).baseline_m == pytest.approx(0.12)
    wrong = content | {name: value}
    with pytest.raises(FrameError, match=told):
        read_pair_lens(Path("lens.yaml"), wrong, SIZE_PX)
