"""Synthetic pictures of calibration patterns with their ellipses, and pictures without any.

They stand for photographs: dots and rings in perspective, antialiased, lit unevenly, blurred,
noisy, hazy, dark, partly covered.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from brokk_rl.contracts.vision import Ellipse
from perception.ellipse import conic

CONDITIONS = ("clean", "noise_10", "noise_25", "blur", "dark", "haze", "stripes", "half")
NEGATIVES = ("hearts", "octagons", "spiral", "noise", "squares", "lines", "texture")
SUPERSAMPLING = 4


def draw_pattern(
    generator: np.random.Generator, condition: str, width: int = 1024, height: int = 768
) -> tuple[np.ndarray, np.ndarray]:
    """Return a picture, `(height, width)` uint8, of a pattern and its ellipses, `(C, 5)`.

    Args:
        generator: Decides everything.
        condition: One of `CONDITIONS`.
        width: In px.
        height: In px.
    """
    num_x, num_y = int(generator.integers(5, 16)), int(generator.integers(4, 12))
    pitch = 1.0
    radius = generator.uniform(0.12, 0.4)
    rings = bool(generator.random() < 0.25)
    corners = np.array([[-1, -1], [num_x, -1], [num_x, num_y], [-1, num_y]], np.float32) * pitch
    base = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    place = base + generator.uniform(0.0, 0.22, (4, 2)) * np.array([width, height]) * np.array(
        [[1, 1], [-1, 1], [-1, -1], [1, -1]]
    )
    homography = cv2.getPerspectiveTransform(corners, place.astype(np.float32)).astype(float)
    forms, levels = [], []
    paper, ink = generator.uniform(170, 240), generator.uniform(10, 70)
    for i in range(num_x):
        for j in range(num_y):
            parts = (1.0, 0.62, 0.3) if rings and radius > 0.2 else (1.0,)
            for k, part in enumerate(parts):
                circle = np.array([[i, j, radius * part, radius * part, 0.0]])
                forms.append(transform_circles(circle, homography))
                levels.append(ink if k % 2 == 0 else paper)
    ellipses = np.concatenate(forms)
    table = _draw_table(generator, width, height)
    canvas = cv2.resize(
        table, None, fx=SUPERSAMPLING, fy=SUPERSAMPLING, interpolation=cv2.INTER_LINEAR
    )
    sheet = ((place + 0.5) * SUPERSAMPLING - 0.5).round().astype(np.int32)
    cv2.fillPoly(canvas, [sheet], float(paper))
    for ellipse, level in zip(ellipses, levels, strict=True):
        _fill_ellipse(canvas, ellipse, float(level))
    picture = cv2.resize(canvas, (width, height), interpolation=cv2.INTER_AREA)
    lit = picture * draw_light(generator, width, height)
    large = (
        (ellipses[:, 3] >= 2.5)
        & (ellipses[:, 0] - ellipses[:, 2] > 2)
        & (ellipses[:, 0] + ellipses[:, 2] < width - 2)
    )
    return degrade(lit, condition, generator, ellipses), ellipses[large]


def degrade(
    picture: np.ndarray, condition: str, generator: np.random.Generator, ellipses: np.ndarray
) -> np.ndarray:
    """Return a float picture as a camera gives it under a condition, uint8."""
    height, width = picture.shape
    if condition == "stripes":
        x, y = np.meshgrid(np.arange(width), np.arange(height))
        period = float(generator.uniform(36, 60))
        covered = ((x + y) / np.sqrt(2)) % period < 0.25 * period
        picture = np.where(covered, 128.0, picture)
    elif condition == "half":
        for x, y, a, b, _ in ellipses:
            angle = generator.uniform(0, 2 * np.pi)
            reach = generator.uniform(-0.1, 0.35) * b
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            box = np.array(
                [[reach, -1.1 * a], [1.25 * a, -1.1 * a], [1.25 * a, 1.1 * a], [reach, 1.1 * a]]
            ) @ turn.T + (x, y)
            cv2.fillPoly(
                picture,
                [np.round(box * 16).astype(np.int32)],
                float(generator.uniform(90, 150)),
                cv2.LINE_AA,
                4,
            )
    picture = cv2.GaussianBlur(
        picture, (0, 0), 2.0 if condition == "blur" else generator.uniform(0.5, 0.9)
    )
    if condition == "dark":
        picture = picture * 0.15
    if condition == "haze":
        picture = 128 + (picture - 128) * 0.25
    std = {"noise_10": 10.0, "noise_25": 25.0, "dark": 0.7}.get(
        condition, generator.uniform(0.7, 2.0)
    )
    return np.clip(np.rint(picture + generator.normal(0, std, picture.shape)), 0, 255).astype(
        np.uint8
    )


def draw_negative(
    kind: str, generator: np.random.Generator, width: int = 1024, height: int = 768
) -> np.ndarray:
    """Return a picture without ellipses; `kind` is one of `NEGATIVES`."""
    if kind == "noise":
        return np.clip(generator.normal(128, 50, (height, width)), 0, 255).astype(np.uint8)
    if kind == "texture":
        return np.clip(128 + 60 * draw_clouds(generator, width, height, 1.2), 0, 255).astype(
            np.uint8
        )
    big = np.full((height * 2, width * 2), 230.0, np.float32)
    ink = 40.0
    if kind == "spiral":
        turn = np.linspace(0, 2 * np.pi * 8, 4000)
        gap = generator.uniform(25, 45) * 2
        curve = np.column_stack([np.cos(turn), np.sin(turn)]) * (turn / (2 * np.pi) * gap)[
            :, None
        ] + (width, height)
        cv2.polylines(
            big,
            [np.round(curve * 16).astype(np.int32)],
            False,
            ink,
            int(generator.integers(4, 20)),
            cv2.LINE_AA,
            4,
        )
    elif kind == "lines":
        for _ in range(60):
            ends = (generator.uniform(0, 1, (2, 2)) * (2 * width, 2 * height)).astype(int).tolist()
            cv2.line(big, ends[0], ends[1], ink, int(generator.integers(2, 12)), cv2.LINE_AA)
    else:
        for i in range(6):
            for j in range(4):
                size, turn = generator.uniform(30, 130), generator.uniform(0, 2 * np.pi)
                shape = _build_shape(kind) * size
                matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
                place = shape @ matrix.T + ((i + 0.5) * width / 3, (j + 0.5) * height / 2)
                cv2.fillPoly(big, [np.round(place * 16).astype(np.int32)], ink, cv2.LINE_AA, 4)
    picture = cv2.GaussianBlur(
        cv2.resize(big, (width, height), interpolation=cv2.INTER_AREA), (0, 0), 0.7
    )
    return np.clip(np.rint(picture + generator.normal(0, 1.0, picture.shape)), 0, 255).astype(
        np.uint8
    )


def compute_ellipse_overlap(first: np.ndarray, second: np.ndarray) -> float:
    """Return intersection over union of two ellipses `(5,)`."""
    if np.hypot(first[0] - second[0], first[1] - second[1]) > first[2] + second[2]:
        return 0.0
    angles = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    one = conic.sample_ellipses(first[None], angles)[0][0].astype(np.float32)
    two = conic.sample_ellipses(second[None], angles)[0][0].astype(np.float32)
    shared = cv2.intersectConvexConvex(one, two)[0]
    return float(shared / (cv2.contourArea(one) + cv2.contourArea(two) - shared))


def count_matches(found: Sequence[Ellipse], truth: np.ndarray, least: float = 0.8) -> int:
    """Return the number of ellipses found, each once, with at least this overlap."""
    rows = [np.array([e.x, e.y, e.a, e.b, e.theta_rad]) for e in found]
    pairs = []
    for i, row in enumerate(rows):
        near = np.flatnonzero(np.hypot(truth[:, 0] - row[0], truth[:, 1] - row[1]) < row[2])
        pairs += [(compute_ellipse_overlap(row, truth[j]), i, int(j)) for j in near]
    used_rows, used_truth = set(), set()
    for value, i, j in sorted(pairs, reverse=True):
        if value > least and i not in used_rows and j not in used_truth:
            used_rows.add(i)
            used_truth.add(j)
    return len(used_rows)


def transform_circles(circle: np.ndarray, homography: np.ndarray) -> np.ndarray:
    """Return the ellipses `(C, 5)` that circles, rows like theirs, are after a homography."""
    back = np.linalg.inv(homography)
    return conic.convert_forms_to_ellipses(back.T @ conic.build_quadratic_forms(circle) @ back)


def _fill_ellipse(canvas: np.ndarray, ellipse: np.ndarray, level: float) -> None:
    x, y, a, b, theta = ellipse
    place = ((np.array([x, y]) + 0.5) * SUPERSAMPLING - 0.5) * 16
    size = (round(a * SUPERSAMPLING * 16), round(b * SUPERSAMPLING * 16))
    cv2.ellipse(
        canvas,
        (round(place[0]), round(place[1])),
        size,
        float(np.degrees(theta)),
        0,
        360,
        level,
        -1,
        cv2.LINE_AA,
        4,
    )


def draw_clouds(
    generator: np.random.Generator, width: int, height: int, power: float
) -> np.ndarray:
    """Return noise whose spectrum falls with frequency, of unit variance."""
    fy, fx = np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)
    spectrum = (
        np.fft.rfft2(generator.normal(size=(height, width)))
        / np.maximum(np.hypot(fx, fy), 1 / width) ** power
    )
    clouds = np.fft.irfft2(spectrum, (height, width))
    return ((clouds - clouds.mean()) / clouds.std()).astype(np.float32)


def _draw_table(generator: np.random.Generator, width: int, height: int) -> np.ndarray:
    table = generator.uniform(60, 180) + 12 * draw_clouds(generator, width, height, 1.5)
    for _ in range(int(generator.integers(0, 12))):
        ends = (generator.uniform(0, 1, (2, 2)) * (width, height)).astype(int).tolist()
        cv2.rectangle(table, ends[0], ends[1], float(generator.uniform(0, 255)), -1)
    return table


def draw_light(generator: np.random.Generator, width: int, height: int) -> np.ndarray:
    """Return how bright a lamp from one side makes each place of a picture, `(height, width)`."""
    slope = generator.uniform(-0.25, 0.25, 2)
    x, y = np.meshgrid(
        np.linspace(-1, 1, width, dtype=np.float32), np.linspace(-1, 1, height, dtype=np.float32)
    )
    return np.clip(0.85 + slope[0] * x + slope[1] * y, 0.3, 1.15)


def _build_shape(kind: str) -> np.ndarray:
    if kind == "octagons":
        turn = (np.arange(8) + 0.5) * np.pi / 4
        return np.column_stack([np.cos(turn), np.sin(turn)])
    if kind == "squares":
        return np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * 0.7
    t = np.linspace(0, 2 * np.pi, 200)
    return (
        np.column_stack(
            [
                16 * np.sin(t) ** 3,
                -(13 * np.cos(t) - 5 * np.cos(2 * t) - 2 * np.cos(3 * t) - np.cos(4 * t)),
            ]
        )
        / 16
    )
