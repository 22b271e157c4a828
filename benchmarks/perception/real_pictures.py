"""Real photographs: the plane of a board, pairs without a hole, ellipses.

    apt-get download opencv-doc && dpkg -x opencv-doc_*.deb opencv
    pip download scikit-image==0.26.0 --no-deps && unzip scikit_image*.whl 'skimage/data/*' -d skimage
    python benchmarks/perception/real_pictures.py <out.json> --skimage skimage/skimage/data
        --opencv opencv/usr/share/doc/opencv-doc/examples/data

Board: OpenCV ships 13 pairs of a hand-held chessboard of 25 mm squares, 0.3 to 0.4 m away, by two
cameras of 640 x 480. Each half of the pairs is rectified by a calibration with the other half. The
plane around the middle of the board is found like that of a face around a hole. It is compared with
the board by its corners: in the left picture alone, and triangulated by both pictures. The first
shows errors of the rig too, the second those of matching alone.

Pairs without a hole: the same, and two of Middlebury (Scharstein et al. 2014; Hirschmüller and
Scharstein 2007). Every target found in them is false.

Ellipses: coins, sweets and lids. Their outlines are moments of regions of brightness or colour, and
by hand where regions touch; all were checked by eye.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from speed import configured

from brokk_rl.contracts.vision import Ellipse
from brokk_rl.signals import Frame
from perception.pose import alignment, plane
from perception.pose.plane import FacePlane
from perception.pose.plane_conic import PlaneConic, convert_to_gray
from perception.sources.folder import read_picture
from perception.stereo import Stereo

CORNERS, SQUARE_M, SIZE_PX = (9, 6), 0.025, (640, 480)
"""Inner corners and squares of the board, by `left_intrinsics.yml` beside the pictures."""
NUMBERS = (1, 2, 3, 4, 5, 6, 7, 8, 9, 11, 12, 13, 14)
NEAREST_M = 0.25
PLACE_M = 0.02
"""Radius of the circle around which the plane is fitted: from 2.5 to 24 cm, so all of the board."""
LARGEST_PX = 1.0
"""Corners that lie on other rows in the other picture were not found well."""
ONE_SIGMA_2D = 1.515
"""Radius that holds 68.3 % of a round Gaussian in two dimensions."""
MIDDLEBURY = {
    "motorcycle": ("skimage", "motorcycle_left.png", "motorcycle_right.png", 994.978, 0.193001, 31.086),
    "aloe": ("opencv", "aloeL.jpg", "aloeR.jpg", 3740 / 3, 0.16, 90.0),
}  # fmt: skip
"""Pictures, focal length px, baseline m, and disparity of infinity px, as published with them."""
ROUND = {
    "coins": ("skimage", "coins.png", (
        (334.7, 43.4, 30.1, 28.6, -3.09), (155.3, 50.9, 24.0, 22.8, -3.05), (215.3, 51.1, 24.1, 22.0, -3.13),
        (275.9, 52.4, 21.3, 19.3, -2.92), (44.2, 54.5, 22.7, 19.5, 2.90), (100.4, 56.2, 20.2, 18.0, -3.02),
        (270.7, 119.0, 26.2, 24.5, 3.12), (44.8, 124.3, 21.8, 20.3, 2.61), (205.3, 124.0, 21.2, 19.5, 2.67),
        (336.5, 124.4, 20.5, 19.9, 2.80), (102.4, 125.6, 20.1, 18.7, 2.72), (153.6, 127.2, 20.7, 18.0, 3.14),
        (212.4, 193.1, 24.8, 23.8, -3.07), (273.9, 194.0, 24.4, 21.6, -2.56), (101.7, 195.5, 22.8, 21.8, -3.11),
        (43.5, 197.2, 20.0, 19.2, 1.01), (154.0, 197.8, 20.4, 19.4, -3.13), (172.3, 261.1, 29.7, 26.2, -3.12),
        (300.9, 263.2, 27.3, 24.6, 2.61), (244.0, 263.2, 25.1, 23.7, 2.76), (113.8, 265.6, 22.1, 21.7, -2.92),
        (347.0, 187.0, 31.7, 30.8, 0.0), (46.0, 260.0, 27.7, 27.2, 0.0), (358.0, 268.0, 22.3, 20.6, 0.0),
    )),
    "sweets": ("opencv", "smarties.png", (
        (377.1, 81.4, 27.0, 26.7, 1.32), (268.6, 117.2, 26.9, 26.7, 1.97), (205.0, 211.2, 27.2, 26.4, 1.35),
        (288.4, 213.9, 28.3, 25.7, -2.76), (33.2, 228.2, 27.1, 25.3, -2.69), (347.1, 237.9, 27.1, 26.7, 2.47),
        (219.2, 306.0, 29.5, 27.0, 0.90), (294.0, 320.1, 28.7, 26.7, 0.95), (97.9, 259.2, 26.5, 26.9, 0.0),
        (152.7, 272.0, 26.2, 26.8, 0.0), (134.4, 327.0, 27.0, 27.5, 0.0), (387.0, 170.2, 26.5, 26.5, 0.0),
    )),
    "lids": ("opencv", "stuff.jpg", (
        (394.0, 186.0, 58.0, 59.0, 0.0), (229.0, 57.0, 38.0, 39.0, 0.0), (209.0, 308.0, 20.0, 20.0, 0.0),
    )),
}  # fmt: skip
"""True ellipses of a picture: centre, semi-axes px, direction rad."""


@dataclass(frozen=True)
class RealRig:
    """A calibrated pair.

    Attributes:
        maps: What `cv2.remap` rectifies the left and the right picture with.
        camera_matrix: Of both rectified pictures, `(3, 3)` px.
        baseline_m: Distance between the cameras.
        error_px: Root mean square reprojection error of the calibration.
    """

    maps: tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
    camera_matrix: np.ndarray
    baseline_m: float
    error_px: float

    def rectify(self, pair: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the rectified pictures."""
        return [
            cv2.remap(one, *maps, cv2.INTER_CUBIC)
            for one, maps in zip(pair, self.maps, strict=True)
        ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--opencv", type=Path, required=True, help="samples of OpenCV")
    parser.add_argument("--skimage", type=Path, required=True, help="data of scikit-image")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    folders = {"opencv": given.opencv, "skimage": given.skimage}
    stereo = configured("stereo", "mode=render", f"stereo.nearest_m={NEAREST_M}")
    perception = configured("perception", "mode=perceive", "perceive.input=.")
    finder = perception.build()
    boards, pairs = [], []
    for number, frame, error_px in list_board_frames(given.opencv, stereo):
        boards.append(
            {"number": number, "calibration_px": error_px, **measure_board(frame, perception.pose)}
        )
        pairs.append({"pair": f"board {number}", **count_targets(finder, frame)})
    for name, (folder, left, right, focal_px, baseline_m, infinity_px) in MIDDLEBURY.items():
        pair = [read_color(folders[folder] / one) for one in (left, right)]
        shift = np.array([[1.0, 0.0, -infinity_px], [0.0, 1.0, 0.0]])
        pair[1] = cv2.warpAffine(pair[1], shift, pair[1].shape[1::-1], flags=cv2.INTER_CUBIC)
        height, width = pair[0].shape[:2]
        matrix = np.array([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]])
        frame = make_frame(pair, matrix, baseline_m, stereo)
        pairs.append({"pair": name, **count_targets(finder, frame)})
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True
    ).stdout.strip()
    content = {
        "command": "python benchmarks/perception/real_pictures.py <out.json> --opencv <samples> "
        "--skimage <data>",
        "machine": "two shared cores",
        "commit": commit,
        "board": summarize_boards(boards),
        "ellipses": list(judge_ellipses(folders)),
        "boards": boards,
        "pairs": pairs,
    }
    given.out.write_text(json.dumps(content, indent=1) + "\n")
    print(json.dumps({key: content[key] for key in ("board", "ellipses", "pairs")}, indent=1))


def list_board_frames(folder: Path, stereo: Stereo) -> Iterator[tuple[int, Frame, float]]:
    """Yield each pair, rectified by the other half of the pairs, and the error of that calibration."""
    for half in (0, 1):
        rig = calibrate_pair(folder, NUMBERS[half::2])
        for number in NUMBERS[1 - half :: 2]:
            pair = rig.rectify(read_pair(folder, number))
            frame = make_frame(pair, rig.camera_matrix, rig.baseline_m, stereo)
            yield number, frame, rig.error_px


def read_pair(folder: Path, number: int) -> list[np.ndarray]:
    """Return the left and the right picture of the board, RGB."""
    return [read_color(folder / f"{side}{number:02d}.jpg") for side in ("left", "right")]


def read_color(path: Path) -> np.ndarray:
    """Return a picture, RGB; a grey one with three equal channels."""
    picture = read_picture(path)
    return picture if picture.ndim == 3 else cv2.cvtColor(picture, cv2.COLOR_GRAY2RGB)


def make_frame(
    pair: Sequence[np.ndarray], matrix: np.ndarray, baseline_m: float, stereo: Stereo
) -> Frame:
    """Return the frame of a rectified pair."""
    depth_m = stereo.depth_m(pair[0], pair[1], float(matrix[0, 0]), baseline_m)
    return Frame(
        pair[0], depth_m, matrix, None, 0.0, right=pair[1], baseline_m=baseline_m, gamma=2.2
    )


def find_corners(picture: np.ndarray) -> np.ndarray | None:
    """Return the inner corners of the board, `(54, 2)` px."""
    gray = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    flags = cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_EXHAUSTIVE
    found, corners = cv2.findChessboardCornersSB(gray, CORNERS, flags=flags)
    return corners.reshape(-1, 2) if found else None


def list_board_points() -> np.ndarray:
    """Return the inner corners on the board around their middle, `(54, 3)` m."""
    across, down = np.meshgrid(np.arange(CORNERS[0]), np.arange(CORNERS[1]))
    points = SQUARE_M * np.stack([across, down, 0 * down], -1).reshape(-1, 3)
    return points - points.mean(0)


def calibrate_pair(folder: Path, numbers: Sequence[int]) -> RealRig:
    """Calibrate both lenses and the pair by OpenCV, with its model of five coefficients."""
    seen = []
    for number in numbers:
        corners = [find_corners(picture) for picture in read_pair(folder, number)]
        known = [one.astype(np.float32) for one in corners if one is not None]
        if len(known) == len(corners):
            seen.append(known)
    board = [list_board_points().astype(np.float32)] * len(seen)
    left, right = ([pair[side] for pair in seen] for side in (0, 1))
    first, second = (
        cv2.calibrateCamera(board, some, SIZE_PX, np.eye(3), np.zeros(5))[1:3]
        for some in (left, right)
    )
    error_px, k1, d1, k2, d2, rotation, shift_m = cv2.stereoCalibrate(
        board, left, right, *first, *second, SIZE_PX, flags=cv2.CALIB_USE_INTRINSIC_GUESS
    )[:7]
    r1, r2, p1, p2 = cv2.stereoRectify(k1, d1, k2, d2, SIZE_PX, rotation, shift_m, alpha=0)[:4]
    maps = (
        cv2.initUndistortRectifyMap(k1, d1, r1, p1, SIZE_PX, cv2.CV_32FC1),
        cv2.initUndistortRectifyMap(k2, d2, r2, p2, SIZE_PX, cv2.CV_32FC1),
    )
    return RealRig(maps, p1[:, :3], float(-p2[0, 3] / p1[0, 0]), float(error_px))


def measure_board(frame: Frame, pose: PlaneConic) -> dict[str, Any]:
    """Return the errors of the plane around the middle of the board."""
    assert frame.right is not None
    corners, others = find_corners(frame.color), find_corners(frame.right)
    assert corners is not None
    by_picture = locate_by_picture(corners, frame.camera_matrix)
    face = find_face(frame, pose, corners, by_picture)
    ray = np.linalg.solve(frame.camera_matrix, [*corners.mean(0), 1.0])
    row = {
        "range_m": float(np.linalg.norm(by_picture.point(ray))),
        "picture": compare_planes(face, by_picture, ray, frame, pose),
    }
    if others is None or np.abs(corners - others)[:, 1].max() > LARGEST_PX:
        return row | {"triangulated": None}
    by_pair = triangulate(corners, others, frame)
    return row | {"triangulated": compare_planes(face, by_pair, ray, frame, None)}


def locate_by_picture(corners: np.ndarray, matrix: np.ndarray) -> FacePlane:
    """Return the plane of the board by its corners in one picture and its size."""
    board, pixels = list_board_points(), corners.astype(float)
    _, turn, shift = cv2.solvePnP(board, pixels, matrix, None)
    turn, shift = cv2.solvePnPRefineLM(board, pixels, matrix, None, turn, shift)
    seen, slopes = cv2.projectPoints(board, turn, shift, matrix, None)[:2]
    off = seen.reshape(-1, 2) - pixels
    pose = np.concatenate([turn, shift]).ravel()
    cov = np.linalg.inv(slopes[:, :6].T @ slopes[:, :6]) * (off**2).sum() / (off.size - 6)

    def compute_plane(six: np.ndarray) -> np.ndarray:
        normal = cv2.Rodrigues(six[:3])[0][:, 2]
        return normal / (normal @ six[3:])

    steps = 1e-6 * np.eye(6)
    change = np.stack(
        [(compute_plane(pose + one) - compute_plane(pose - one)) / 2e-6 for one in steps], 1
    )
    return FacePlane(compute_plane(pose), change @ cov @ change.T, 0.0, len(board), 0.0)


def triangulate(corners: np.ndarray, others: np.ndarray, frame: Frame) -> FacePlane:
    """Return the plane of the board by its corners in both pictures."""
    assert frame.baseline_m is not None
    pull_px = float(frame.camera_matrix[0, 0]) * frame.baseline_m
    rays = np.column_stack([corners, np.ones(len(corners))]) @ np.linalg.inv(frame.camera_matrix).T
    inverse = (corners - others)[:, 0] / pull_px
    m = np.linalg.lstsq(rays, inverse, rcond=None)[0]
    off = inverse - rays @ m
    cov = np.linalg.inv(rays.T @ rays) * float(off @ off) / (len(off) - 3)
    return FacePlane(m, cov, float(off.std()), len(off), 0.0)


def find_face(frame: Frame, pose: PlaneConic, corners: np.ndarray, near: FacePlane) -> FacePlane:
    """Return the plane of the board as the finder fits the face around a hole in its middle."""
    grid = corners.reshape(CORNERS[1], CORNERS[0], 2)
    outer = [2 * grid[0, 0] - grid[1, 1], 2 * grid[0, -1] - grid[1, -2],
             2 * grid[-1, -1] - grid[-2, -2], 2 * grid[-1, 0] - grid[-2, 1]]  # fmt: skip
    allowed = np.zeros(frame.depth_m.shape, np.uint8)
    cv2.fillConvexPoly(allowed, np.rint(outer).astype(np.int32), 1)
    # The circle only bounds the part that is looked at: its tilt in the picture does not matter.
    x, y = corners.mean(0)
    ray = np.linalg.solve(frame.camera_matrix, [x, y, 1.0])
    a = float(frame.camera_matrix[0, 0]) * PLACE_M * float(near.m @ ray)
    row = np.array([x, y, a, a * abs(float(near.normal @ ray)) / float(np.linalg.norm(ray)), 0.0])
    reach = (PLACE_M, pose.inner, pose.rings[0], pose.rings[-1])
    points = plane.collect_support(
        frame.depth_m, allowed > 0, frame.camera_matrix, row, *reach, pose.max_pixels, pose.cell_px
    )
    face = plane.fit_plane(points, pose.rings, pose.noise_floor_per_m, np.random.default_rng(0))
    assert face is not None
    face = replace(face, cov=face.cov * pose.matcher_alike)
    both = alignment.crop_pair(frame, convert_to_gray(frame), face.m, row, face.extent)
    assert both is not None
    last = (row, pose.inner, pose.cell_px, pose.matcher_bias_per_m)
    agreed = alignment.align_plane(both, face, frame, allowed > 0, *last)
    return face if agreed is None else agreed


def compare_planes(
    face: FacePlane, true: FacePlane, ray: np.ndarray, frame: Frame, pose: PlaneConic | None
) -> dict[str, float]:
    """Return errors of a plane where a ray meets it, in units and in their sigmas.

    The sigma of the truth counts; that of the rig does where `pose` is given.
    """
    cov = face.cov + true.cov
    if pose is not None:
        assert frame.baseline_m is not None
        std_per_m = pose.rig_px / (float(frame.camera_matrix[0, 0]) * frame.baseline_m)
        cov = cov + np.eye(3) * std_per_m**2
    ray = ray / np.linalg.norm(ray)
    range_m = 1.0 / float(true.m @ ray)
    range_std_m = range_m**2 * float(np.sqrt(ray @ cov @ ray))
    off_m = 1.0 / float(face.m @ ray) - range_m
    across = np.linalg.svd(true.normal[None])[2][1:]
    turned = across @ (face.normal - true.normal)
    spread = across @ replace(true, cov=cov).normal_cov_rad2() @ across.T
    return {
        "range_mm": 1000 * abs(off_m),
        "range_sigmas": abs(off_m) / range_std_m,
        "normal_deg": float(np.degrees(np.linalg.norm(turned))),
        "normal_sigmas": float(np.sqrt(turned @ np.linalg.solve(spread, turned))),
    }


def summarize_boards(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return median, largest error and share inside 1 sigma, by each truth."""
    summary: dict[str, Any] = {}
    for truth in ("picture", "triangulated"):
        known = [row[truth] for row in rows if row[truth] is not None]
        summary[truth] = {"pairs": len(known)}
        for name, unit, limit in (("range", "mm", 1.0), ("normal", "deg", ONE_SIGMA_2D)):
            errors = [one[f"{name}_{unit}"] for one in known]
            inside = [one[f"{name}_sigmas"] < limit for one in known]
            summary[truth][name] = {
                "median": float(np.median(errors)),
                "most": max(errors),
                "inside_1_sigma": sum(inside),
            }
    return summary


def count_targets(finder: Any, frame: Frame) -> dict[str, Any]:
    """Return the targets found in a frame without a hole, and the reasons of the refused places."""
    found = finder.find(frame)
    reasons = sorted({one.reason for one in found.rejected})
    return {"targets": len(found.holes), "reasons": reasons}


def judge_ellipses(folders: dict[str, Path]) -> Iterator[dict[str, Any]]:
    """Yield how many round things of each picture are found."""
    detector = configured("perception", "mode=perceive").ellipse.build()
    for name, (folder, file, true) in ROUND.items():
        gray = cv2.cvtColor(read_color(folders[folder] / file), cv2.COLOR_RGB2GRAY)
        seen = detector.detect(gray, None, None)
        hits = sum(any(is_alike(one, row) for one in seen) for row in true)
        yield {"picture": name, "true": len(true), "found": hits, "others": len(seen) - hits}


def is_alike(one: Ellipse, row: Sequence[float]) -> bool:
    """Return whether an ellipse has the place and size of a true one, x, y, a, b, to a tenth."""
    away = np.abs(np.array([one.x, one.y, one.a, one.b]) - np.array(row[:4]))
    return bool(away.max() < 0.1 * row[2])


if __name__ == "__main__":
    main()
