"""Pictures of half-hidden ellipses, and of shapes that resemble them; held out of tuning."""

from __future__ import annotations

import cv2
import numpy as np

from perception.benchmark.calibration_patterns import SUPERSAMPLING, draw_clouds, draw_light
from perception.ellipse import conic

STYLES = ("behind", "outlines", "halves", "covered")
SHAPES = ("hearts of arcs", "hearts of curves", "spirals", "polygons", "salt")
MIN_VISIBLE = 0.4
"""Part of a rim that must be visible for its ellipse to count as true."""


def draw_occluded_ellipses(
    generator: np.random.Generator, style: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return a picture, `(h, w)` uint8, and its ellipses, `(C, 5)`, visible by `MIN_VISIBLE`.

    Args:
        generator: Decides everything.
        style: `behind`, discs one before the other (after Prasad et al. 2012); `outlines`, thin
            lines across each other; `halves`, of which nothing but a half is there; `covered`, half
            of each behind a patch of any brightness, plain or grained.
    """
    width, height = (300, 300) if style in ("behind", "outlines") else (800, 600)
    ellipses = _scatter_ellipses(
        generator, int(generator.integers(4, 25)), width, height, apart=1.3 if width > 300 else 0.0
    )
    size = (height * SUPERSAMPLING, width * SUPERSAMPLING)
    canvas = np.full(
        size,
        generator.uniform(150, 255) if style != "behind" else generator.uniform(0, 255),
        np.float32,
    )
    owner = np.zeros(size, np.int16)  # which ellipse is seen at each place, 0 for none
    if style == "outlines":
        for ellipse in ellipses:
            _draw_ellipse(canvas, ellipse, 0.0, SUPERSAMPLING + 2)
        return _simulate_camera(canvas, generator, width, height), ellipses
    ink = generator.uniform(5, 80)
    for number, ellipse in enumerate(ellipses, 1):
        _draw_ellipse(
            canvas, ellipse, float(generator.uniform(0, 255)) if style == "behind" else ink
        )
        _draw_ellipse(owner, ellipse, number)
    if style != "behind":
        paper = float(canvas[0, 0])
        grain = cv2.resize(
            draw_clouds(generator, width, height, 1.3), size[::-1], interpolation=cv2.INTER_LINEAR
        )
        for number, ellipse in enumerate(ellipses, 1):
            there = _draw_patch(generator, ellipse, size)
            if style == "halves":
                there &= owner == number
            level = paper if style == "halves" else generator.uniform(0, 255)
            rough = 25 * generator.integers(2) if style == "covered" else 0
            canvas[there] = np.clip(level + rough * np.asarray(grain)[there], 0, 255)
            owner[there] = 0
    picture = _simulate_camera(canvas, generator, width, height)
    return picture, ellipses[_compute_visible_shares(owner, ellipses) >= MIN_VISIBLE]


def draw_lookalikes(
    generator: np.random.Generator, kind: str, width: int = 800, height: int = 600
) -> np.ndarray:
    """Return a picture without ellipses, `(height, width)` uint8; `kind` is one of `SHAPES`."""
    if kind == "salt":
        grains = generator.random((height, width))
        return np.where(grains < 0.1, 0, np.where(grains > 0.9, 255, 128)).astype(np.uint8)
    canvas = np.full((height * SUPERSAMPLING, width * SUPERSAMPLING), 250.0, np.float32)
    ink, line = float(generator.uniform(0, 80)), int(generator.integers(4, 20))
    if kind == "spirals":
        turn = np.linspace(0.2, 2 * np.pi * generator.uniform(3, 6), 4000)
        even = turn * generator.uniform(3, 8)
        radius = (
            even if generator.random() < 0.5 else 3 * np.exp(turn * generator.uniform(0.1, 0.15))
        )
        curve = (
            np.column_stack([np.cos(turn), generator.uniform(0.6, 1.0) * np.sin(turn)])
            * radius[:, None]
        )
        within = np.abs(curve).max(1) < 2 * width
        cv2.polylines(
            canvas,
            [_to_fixed_point(curve[within] + (width / 2, height / 2))],
            False,
            ink,
            line,
            cv2.LINE_AA,
            4,
        )
        return _simulate_camera(canvas, generator, width, height)
    for row in range(3):
        for column in range(4):
            turn = generator.uniform(0, 2 * np.pi)
            matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
            size = generator.uniform(20, 70)
            outline = _to_fixed_point(
                _build_shape(generator, kind) @ matrix.T * size
                + ((column + 0.5) * width / 4, (row + 0.5) * height / 3)
            )
            if generator.random() < 0.3:
                cv2.polylines(canvas, [outline], True, ink, line, cv2.LINE_AA, 4)
            else:
                cv2.fillPoly(canvas, [outline], ink, cv2.LINE_AA, 4)
    return _simulate_camera(canvas, generator, width, height)


def _build_shape(generator: np.random.Generator, kind: str) -> np.ndarray:
    if kind == "polygons":
        turn = np.arange(number := int(generator.integers(5, 10))) * 2 * np.pi / number
        return np.column_stack([np.cos(turn), generator.uniform(0.7, 1.0) * np.sin(turn)])
    # Two half circles and the lines from them to the tip, which they touch.
    if kind == "hearts of arcs":
        tip = generator.uniform(1.0, 1.4)
        touch = np.arctan2(tip, -0.5) - np.arccos(0.5 / np.hypot(0.5, tip))
        turn = np.linspace(-np.pi, touch, 60)
        side = np.column_stack([0.5 + 0.5 * np.cos(turn), 0.5 * np.sin(turn)])
        side = np.vstack([side, [[0.0, tip]]])
    else:
        part = np.linspace(0, 1, 60)[:, None]
        knots = np.array([[0, -0.3], [0.3, -1.0], [1.4, -0.7], [0, 0.9]]) * (
            generator.uniform(0.8, 1.2),
            1,
        )
        # A cubic of Bézier.
        side = sum(
            one * (1 - part) ** (3 - k) * part**k * (1, 3, 3, 1)[k] for k, one in enumerate(knots)
        )
    return np.vstack([side, (np.asarray(side) * (-1, 1))[::-1]])


def _scatter_ellipses(
    generator: np.random.Generator, number: int, width: int, height: int, apart: float
) -> np.ndarray:
    """Return random ellipses, `(C, 5)`, `apart` times the sum of their sizes apart."""
    found: list[np.ndarray] = []
    for _ in range(3 * number):
        a = generator.uniform(12, 60)
        x, y = generator.uniform(a + 2, width - a - 2), generator.uniform(a + 2, height - a - 2)
        one = np.array([x, y, a, a * generator.uniform(0.4, 1.0), generator.uniform(0, np.pi)])
        if len(found) < number and all(
            np.hypot(*(one[:2] - other[:2])) > apart * (a + other[2]) for other in found
        ):
            found.append(one)
    return np.array(found)


def _draw_patch(
    generator: np.random.Generator, ellipse: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """Return where a patch lies that hides about half of an ellipse, `size` bool."""
    x, y, a, b, theta = ellipse
    turn = generator.uniform(0, 2 * np.pi)
    along, across = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    extent = np.hypot(a * np.cos(turn - theta), b * np.sin(turn - theta))
    edge = generator.uniform(-0.12, 0.12) * extent
    wide = generator.uniform(1.1, 1.6, 4) * a * (-1, 1, 1, -1)
    far = np.array([edge, edge, 1.3 * a, 1.3 * a])
    there = np.zeros(size, np.uint8)
    cv2.fillPoly(
        there,
        [_to_fixed_point((x, y) + far[:, None] * along + wide[:, None] * across)],
        1,
        cv2.LINE_8,
        4,
    )
    return there > 0


def _compute_visible_shares(owner: np.ndarray, ellipses: np.ndarray) -> np.ndarray:
    """Return the part of each rim inside which its own ellipse is seen, `(C,)`."""
    inner = ellipses - (0, 0, 0.7, 0.7, 0)
    points, _, length = conic.sample_ellipses(inner, np.arange(180) * (np.pi / 90))
    place = np.rint((points + 0.5) * SUPERSAMPLING - 0.5).astype(int)
    mine = owner[place[..., 1], place[..., 0]] == np.arange(1, len(ellipses) + 1)[:, None]
    return (mine * length).sum(1) / length.sum(1)


def _draw_ellipse(canvas: np.ndarray, ellipse: np.ndarray, level: float, line: int = -1) -> None:
    (x, y), (a, b) = (
        _to_fixed_point(ellipse[:2]).tolist(),
        np.round(ellipse[2:4] * SUPERSAMPLING * 16).astype(int).tolist(),
    )
    cv2.ellipse(
        canvas, (x, y), (a, b), float(np.degrees(ellipse[4])), 0, 360, level, line, cv2.LINE_8, 4
    )


def _to_fixed_point(places: np.ndarray) -> np.ndarray:
    """Return places of the picture in sixteenths of canvas pixels, as OpenCV draws them."""
    return np.round(((places + 0.5) * SUPERSAMPLING - 0.5) * 16).astype(np.int32)


def _simulate_camera(
    canvas: np.ndarray, generator: np.random.Generator, width: int, height: int
) -> np.ndarray:
    picture = np.asarray(
        cv2.resize(canvas, (width, height), interpolation=cv2.INTER_AREA)
    ) * draw_light(generator, width, height)
    picture = cv2.GaussianBlur(picture, (0, 0), generator.uniform(0.4, 1.0))
    return np.clip(
        np.rint(picture + generator.normal(0, generator.uniform(0.5, 3), picture.shape)), 0, 255
    ).astype(np.uint8)
