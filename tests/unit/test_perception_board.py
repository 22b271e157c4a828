"""The printed board: its size on paper, and OpenCV finds its corners where they belong."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from brokk_rl.errors import ConfigError
from brokk_rl.extensions import load_part
from brokk_rl.signals import Frame
from perception.modes.board import draw_board

POINTS_PER_M = 72.0 / 0.0254


def test_the_page_is_to_scale(brokk: Callable[..., Any], tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = brokk("mode=board", "board.square_m=0.05", "board.marker_m=0.0375", f"session.out={out}")
    assert done.code == 0, done.err
    box = re.search(rb"/MediaBox\s*\[([^\]]+)\]", (out / "board.pdf").read_bytes())
    assert box is not None
    # 8 x 6 squares of 5 cm, 3 cm of margin on each side: 46 x 36 cm
    size = [float(value) for value in box.group(1).split()][2:]
    np.testing.assert_allclose(size, np.array([0.46, 0.36]) * POINTS_PER_M, atol=0.01)


def test_opencv_finds_every_corner_at_its_place_on_the_page() -> None:
    board = load_part("board")
    figure = draw_board(board, 0.03)
    file = io.BytesIO()
    figure.savefig(file, dpi=50.8, format="png")  # 2 px for a millimetre
    page = np.asarray(cv2.imdecode(np.frombuffer(file.getvalue(), np.uint8), cv2.IMREAD_GRAYSCALE))
    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    drawn = cv2.aruco.CharucoBoard(
        (board.columns, board.rows), board.square_m, board.marker_m, markers
    )
    found, numbers, _, _ = cv2.aruco.CharucoDetector(drawn).detectBoard(page)
    assert len(numbers) == (board.columns - 1) * (board.rows - 1)
    all_m: Any = np.asarray(drawn.getChessboardCorners())
    corners_m = all_m[numbers[:, 0]][:, :2]
    # pixel centres lie half a pixel in; the detector refines to a tenth of a pixel
    np.testing.assert_allclose(found[:, 0], 2000 * (corners_m + 0.03) - 0.5, atol=0.6)


def test_small_blurred_markers_are_read_in_linear_light() -> None:
    charuco = load_part("board")
    picture = charuco.describe().generateImage((8 * 112, 6 * 112)).astype(np.float32) / 255
    picture = 0.05 + 0.85 * np.pad(picture, 80, constant_values=1.0)
    turned = cv2.warpAffine(
        picture,
        np.array([[0.9925, 0.1219, 0], [-0.1219, 0.9925, 100]]),
        (1160, 990),
        borderValue=0.5,
    )
    # 28 px a square, of which one of a marker's cells has 3 px.
    blurred = cv2.GaussianBlur(turned, (0, 0), 3.6)
    light = cv2.resize(blurred, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    coded = np.rint(255 * light ** (1 / 2.2)).astype(np.uint8)
    frame = Frame(
        color=np.repeat(coded[..., None], 3, 2),
        depth_m=np.ones(coded.shape, np.float32),
        camera_matrix=np.eye(3),
        base_from_camera=None,
        t_s=0.0,
        gamma=2.2,
    )
    assert len(charuco.find_corners(frame)[0]) == 35
    assert len(charuco.find_corners(replace(frame, gamma=1.0))[0]) < 30


def test_a_board_that_cannot_be_drawn_is_refused() -> None:
    board = load_part("board")
    with pytest.raises(ConfigError, match="has 50 markers, 12 x 10 squares need 60"):
        draw_board(replace(board, dictionary="DICT_4X4_50", columns=12, rows=10), 0.03)
