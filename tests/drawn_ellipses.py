"""Pictures of ellipses, and of shapes that are none, for tests of the detector."""

from __future__ import annotations

import cv2
import numpy as np

FINE = 4
"""Each picture is drawn this many times larger, then averaged."""


def draw_pattern(condition: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns a grey picture of dark and bright ellipses, `(384, 512)`, and their rows `(n, 5)`."""
    generator = np.random.default_rng(seed)
    large = np.full((384 * FINE, 512 * FINE), 170, np.float32)
    rows = []
    for x in range(45, 490, 70):
        for y in range(45, 360, 70):
            a = generator.uniform(9, 28)
            b = a * generator.uniform(0.5, 1.0)
            theta = generator.uniform(0, np.pi)
            rows.append((x, y, a, b, theta))
            fill(large, rows[-1], float(generator.choice([40.0, 250.0])))
    gray = cv2.resize(large, (512, 384), interpolation=cv2.INTER_AREA)
    gray = cv2.GaussianBlur(gray, (0, 0), 2.0 if condition == "blur" else 0.7)
    if condition == "dark":
        gray = 0.15 * gray
    if condition == "haze":
        gray = 130 + 0.25 * (gray - 128)
    gray += generator.normal(0, 25.0 if condition == "noise_25" else 1.0, gray.shape)
    return np.clip(np.rint(gray), 0, 255).astype(np.uint8), np.array(rows)


def draw_negative(kind: str) -> np.ndarray:
    """Returns a grey picture without an ellipse, `(384, 512)`."""
    generator = np.random.default_rng(3)
    gray = np.full((384, 512), 190, np.float32)
    if kind == "noise":
        return generator.integers(0, 256, (384, 512)).astype(np.uint8)
    if kind == "spiral":
        way = np.linspace(0, 14 * np.pi, 2000)
        line = np.column_stack([256 + 3.8 * way * np.cos(way), 192 + 3.8 * way * np.sin(way)])
        cv2.polylines(gray, [np.int32(line * 16)], False, 40.0, 3, cv2.LINE_AA, 4)
    if kind == "squares":
        square = np.array([[-0.7, -0.7], [0.7, -0.7], [0.7, 0.7], [-0.7, 0.7]])
        for x in range(70, 480, 90):
            for y in range(60, 350, 90):
                place = square * generator.uniform(18, 36) + (x, y)
                cv2.fillPoly(gray, [np.int32(place * 16)], 40.0, cv2.LINE_AA, 4)
    gray = cv2.GaussianBlur(gray, (0, 0), 0.8) + generator.normal(0, 1, gray.shape)
    return np.clip(gray, 0, 255).astype(np.uint8)


def fill(canvas: np.ndarray, row: tuple[float, ...], level: float) -> None:
    """Fills an ellipse of a picture that is `FINE` times as large."""
    x, y, a, b, theta = row
    place = np.rint(((np.array([x, y]) + 0.5) * FINE - 0.5) * 16).astype(int).tolist()
    axes = (round(a * FINE * 16), round(b * FINE * 16))
    cv2.ellipse(canvas, place, axes, float(np.degrees(theta)), 0, 360, level, -1, cv2.LINE_AA, 4)


def overlap(one: np.ndarray, other: np.ndarray) -> float:
    """Returns intersection over union of two ellipses `(5,)`, counted on a grid."""
    if np.hypot(*(one[:2] - other[:2])) > one[2] + other[2]:
        return 0.0
    reach = max(one[2], other[2])
    middle = (one[:2] + other[:2]) / 2
    side = np.linspace(-2 * reach, 2 * reach, 200)
    x, y = np.meshgrid(middle[0] + side, middle[1] + side)
    masks = []
    for row in (one, other):
        c, s = np.cos(row[4]), np.sin(row[4])
        u, v = c * (x - row[0]) + s * (y - row[1]), c * (y - row[1]) - s * (x - row[0])
        masks.append((u / row[2]) ** 2 + (v / row[3]) ** 2 <= 1)
    return float((masks[0] & masks[1]).sum() / (masks[0] | masks[1]).sum())


def count_matches(found: list[np.ndarray], truth: np.ndarray) -> int:
    """Returns how many true ellipses one of those found covers by more than 0.8."""
    return sum(any(overlap(one, row) > 0.8 for one in found) for row in truth)
