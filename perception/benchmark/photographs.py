"""Pictures like photographs of calibration patterns with their ellipses; held out of tuning.

The detector was tuned on `perception.benchmark.calibration_patterns` and is judged on these too.
"""

from __future__ import annotations

import cv2
import numpy as np

from perception.benchmark.calibration_patterns import (
    SUPERSAMPLING,
    draw_clouds,
    draw_light,
    transform_circles,
)

STYLES = ("dots", "few", "rings", "targets", "board", "coded")
SMALLEST_PX = 3.0


def draw_photograph(
    generator: np.random.Generator, style: str, width: int = 1024, height: int = 768
) -> tuple[np.ndarray, np.ndarray]:
    """Return a grey picture `(height, width)` uint8, as JPEG leaves it, and its ellipses `(C, 5)`.

    Args:
        generator: Decides everything.
        style: One of `STYLES`.
        width: In px.
        height: In px.
    """
    most = (4, 4) if style == "few" else (14, 11)
    num_x, num_y = (int(generator.integers(1 if style == "few" else 4, one)) for one in most)
    radius = generator.uniform(0.15, 0.42)
    sheet, homography = _draw_sheet(generator, num_x, num_y, width, height)
    canvas = _draw_clutter(generator, width, height)
    paper = (
        generator.uniform(170, 245, 3)
        if generator.random() < 0.5
        else np.repeat(generator.uniform(190, 245), 3)
    )
    ink = (
        generator.uniform(5, 80, 3)
        if generator.random() < 0.5
        else np.repeat(generator.uniform(5, 60), 3)
    )
    if generator.random() < 0.2:
        paper, ink = ink, paper
    cv2.fillPoly(
        canvas,
        [((sheet + 0.5) * SUPERSAMPLING - 0.5).round().astype(np.int32)],
        paper.tolist(),
        cv2.LINE_AA,
    )
    ellipses = []
    for i in range(num_x):
        for j in range(num_y):
            if style == "board" and (i + j) % 2:
                _draw_square(canvas, homography, i, j, ink)
                continue
            for k, part in enumerate(
                {"rings": (1.0, 0.6), "targets": (1.0, 0.75, 0.5, 0.25), "coded": (1.0, 0.4)}.get(
                    style, (1.0,)
                )
            ):
                ellipses.append(
                    _draw_disc(canvas, homography, i, j, radius * part, paper if k % 2 else ink)
                )
            if style == "coded":
                _draw_code(canvas, homography, i, j, radius * 0.7, paper, generator)
    picture = (
        cv2.resize(canvas, (width, height), interpolation=cv2.INTER_AREA)
        * draw_light(generator, width, height)[..., None]
    )
    found = np.array(ellipses)
    x, y, a, b = found[:, :4].T
    seen = (
        (b >= SMALLEST_PX) & (x - a > 2) & (x + a < width - 2) & (y - a > 2) & (y + a < height - 2)
    )
    return _simulate_camera(picture, generator), found[seen]


def _draw_sheet(
    generator: np.random.Generator, num_x: int, num_y: int, width: int, height: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the sheet's corners in the picture, `(4, 2)`, and the pattern's homography to it."""
    corners = np.array([[-1, -1], [num_x, -1], [num_x, num_y], [-1, num_y]], np.float32)
    frame = np.array([[0, 0], [width, 0], [width, height], [0, height]])
    inward = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * (width, height)
    sheet = (frame + generator.uniform(0, 0.25, (4, 2)) * inward).astype(np.float32)
    return sheet, np.asarray(cv2.getPerspectiveTransform(corners, sheet), float)


def _draw_clutter(generator: np.random.Generator, width: int, height: int) -> np.ndarray:
    """Return a coloured table with lines and scraps on it, supersampled, `(h, w, 3)`."""
    table = [
        draw_clouds(generator, width, height, generator.uniform(1.0, 1.8))
        * generator.uniform(5, 35)
        + generator.uniform(30, 220)
        for _ in range(3)
    ]
    canvas = np.asarray(cv2.resize(np.stack(table, -1), None, fx=SUPERSAMPLING, fy=SUPERSAMPLING))
    size = np.array([width, height]) * SUPERSAMPLING
    for _ in range(int(generator.integers(0, 20))):
        ends = (generator.uniform(0, 1, (2, 2)) * size).astype(int).tolist()
        cv2.line(
            canvas,
            ends[0],
            ends[1],
            generator.uniform(0, 255, 3).tolist(),
            int(generator.integers(2, 40)),
            cv2.LINE_AA,
        )
    for _ in range(int(generator.integers(0, 6))):
        scrap = (
            generator.uniform(0, 1, (1, 2)) * size + generator.uniform(-300, 300, (4, 2))
        ).astype(np.int32)
        cv2.fillConvexPoly(
            canvas, cv2.convexHull(scrap), generator.uniform(0, 255, 3).tolist(), cv2.LINE_AA
        )
    return canvas


def _draw_disc(
    canvas: np.ndarray, homography: np.ndarray, i: float, j: float, radius: float, color: np.ndarray
) -> np.ndarray:
    ellipse = transform_circles(np.array([[i, j, radius, radius, 0.0]]), homography)[0]
    center, axes = _to_fixed_point(ellipse)
    cv2.ellipse(
        canvas,
        center,
        axes,
        float(np.degrees(ellipse[4])),
        0,
        360,
        color.tolist(),
        -1,
        cv2.LINE_AA,
        4,
    )
    return ellipse


def _draw_code(
    canvas: np.ndarray,
    homography: np.ndarray,
    i: float,
    j: float,
    radius: float,
    color: np.ndarray,
    generator: np.random.Generator,
) -> None:
    """Draw a piece of a ring, as coded targets have; it is no ellipse."""
    ellipse = transform_circles(np.array([[i, j, radius, radius, 0.0]]), homography)[0]
    center, axes = _to_fixed_point(ellipse)
    start, width = generator.uniform(0, 360), max(2, int(ellipse[3] * SUPERSAMPLING * 0.25))
    stop = start + generator.uniform(30, 120)
    cv2.ellipse(
        canvas,
        center,
        axes,
        float(np.degrees(ellipse[4])),
        start,
        stop,
        color.tolist(),
        width,
        cv2.LINE_AA,
        4,
    )


def _draw_square(
    canvas: np.ndarray, homography: np.ndarray, i: float, j: float, color: np.ndarray
) -> None:
    corners = (
        np.array(
            [
                [i - 0.5, j - 0.5, 1],
                [i + 0.5, j - 0.5, 1],
                [i + 0.5, j + 0.5, 1],
                [i - 0.5, j + 0.5, 1],
            ]
        )
        @ homography.T
    )
    place = ((corners[:, :2] / corners[:, 2:] + 0.5) * SUPERSAMPLING - 0.5) * 16
    cv2.fillPoly(canvas, [place.round().astype(np.int32)], color.tolist(), cv2.LINE_AA, 4)


def _to_fixed_point(ellipse: np.ndarray) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return centre and axes on the supersampled canvas in sixteenths, as OpenCV draws them."""
    x, y = ((ellipse[:2] + 0.5) * SUPERSAMPLING - 0.5) * 16
    a, b = ellipse[2:4] * SUPERSAMPLING * 16
    return (round(x), round(y)), (round(a), round(b))


def _simulate_camera(picture: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Return a picture after blur, sometimes motion blur, noise and JPEG, in grey."""
    picture = cv2.GaussianBlur(picture, (0, 0), generator.uniform(0.4, 1.6))
    if generator.random() < 0.2:
        picture = cv2.filter2D(
            picture, -1, np.eye(length := int(generator.integers(2, 5))) / length
        )
    noisy = picture + generator.normal(0, generator.uniform(0.5, 6), picture.shape)
    data = cv2.imencode(
        ".jpg",
        np.clip(noisy, 0, 255).astype(np.uint8),
        [cv2.IMWRITE_JPEG_QUALITY, int(generator.integers(45, 95))],
    )[1]
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), np.uint8)
