"""What the policy is told is wrong by as much as the benchmark of perception has measured, by distance from the camera."""

from __future__ import annotations

import json
import logging
import math
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from brokk_rl.errors import ConfigError
from brokk_rl.spec import spec

ROOT = Path(__file__).parents[1]
"""Where the benchmark's files lie in a checkout; an installed package has none."""
P95_OF_LONGEST = 0.95
"""Of errors spread evenly between 0 and the longest, 95 % are shorter than this part of it."""
P95_OF_RMS = 1.614
"""Of a round Gaussian error in space: 2.795 standard deviations of an axis over the square root of
three."""
FIGURES = ("position_mm_p95", "along_std_m", "across_std_m")

log = logging.getLogger(__name__)


@spec
class MeasuredNoise:
    """Noise of the target by the table of `benchmarks/perception`, and by the calibration of the camera.

    Attributes:
        table: `table.json` of the benchmark: a path, or one within a checkout of the project.
        perception: The option whose rows count, as the benchmark names it.
        conditions: Rows that count; of each distance the worst of them.
        camera_in_base_m: Where the camera is.
        calibration_m: Standard deviation of a point by the calibration alone, `point_std_m` of
            `mode=calibrate`; part of the bias.
        frame_share: Part of the measured standard deviation that is another in each frame. The rest
            stays: a camera at rest looks at the same face with the same matcher.
        unmeasured_bias_m: Longest bias where there is no table yet.
        unmeasured_sample_m: Half width of the error of a sample there.
        filter: As in `tasks.control.ObservationNoise`, like all that follows.
        q_scale: Scale error of all measured positions (±).
        u_scale: Scale error of all recorded commands (±).
    """

    table: str
    perception: str
    conditions: tuple[str, ...]
    camera_in_base_m: tuple[float, float, float]
    calibration_m: float
    frame_share: float
    unmeasured_bias_m: float
    unmeasured_sample_m: float
    filter: Literal["none", "mean"]
    q_scale: float
    u_scale: float

    target_relative = 0.0

    def check(self) -> None:
        if (
            min(self.calibration_m, self.unmeasured_bias_m, self.unmeasured_sample_m) < 0
            or not 0 <= self.frame_share <= 1
        ):
            raise ConfigError(
                "noise: expected calibration_m and unmeasured_… of 0 or more, frame_share from 0 to 1"
            )
        self._laws()

    def bias_m(self, target_m: torch.Tensor) -> torch.Tensor | float:
        """Returns the longest constant error of targets, `(N, 3)` in the base frame, as `(N, 1)` m."""
        laws = self._laws()
        if laws is None:
            return self.unmeasured_bias_m
        (near, far), _ = laws
        calibration_m = self.calibration_m * P95_OF_RMS / P95_OF_LONGEST
        return ((near + far * self._squared_m(target_m)).square() + calibration_m**2).sqrt()

    def sample_m(self, target_m: torch.Tensor) -> torch.Tensor | float:
        """Returns the half width of the error of each sample and axis, `(N, 1)` m."""
        laws = self._laws()
        if laws is None:
            return self.unmeasured_sample_m
        near, far = laws[1]
        return near + far * self._squared_m(target_m)

    def _squared_m(self, target_m: torch.Tensor) -> torch.Tensor:
        x, y, z = self.camera_in_base_m
        away = (
            (target_m[:, 0:1] - x).square()
            + (target_m[:, 1:2] - y).square()
            + (target_m[:, 2:3] - z).square()
        )
        return away

    def _laws(self) -> tuple[tuple[float, float], tuple[float, float]] | None:
        """Returns longest bias and half width of a sample as laws `a + b distance^2`, `None` where nothing was measured."""
        return _fit_laws(self.table, self.perception, self.conditions, self.frame_share)


@cache
def _fit_laws(
    table: str, perception: str, conditions: tuple[str, ...], frame_share: float
) -> tuple[tuple[float, float], tuple[float, float]] | None:
    path = next((path for path in (Path(table), ROOT / table) if path.is_file()), None)
    if path is None:
        log.warning(
            "task/noise=measured: there is no file '%s' (seen from %s and %s); what is assumed where nothing was measured is used. "
            "`python benchmarks/perception/table.py` measures them.", table, Path.cwd(), ROOT,
        )  # fmt: skip
        return None
    rows = [
        row
        for row in _read_rows(path)
        if row["perception"] == perception and row["condition"] in conditions
    ]
    rows = [row for row in rows if all(row.get(name) is not None for name in FIGURES)]
    distances = sorted({float(row["distance_m"]) for row in rows})
    if len(distances) < 2:
        raise ConfigError(
            f"noise.table={path}: perception={perception} was measured at {len(distances)} distances under "
            f"{', '.join(conditions)}; two are needed"
        )
    bias, sample = [], []
    for distance_m in distances:
        here = [row for row in rows if row["distance_m"] == distance_m]
        bias.append(max(row["position_mm_p95"] for row in here) / 1000.0 / P95_OF_LONGEST)
        # of one axis, evenly spread: half width is the square root of three standard deviations
        std_m = max(
            math.sqrt((row["along_std_m"] ** 2 + 2.0 * row["across_std_m"] ** 2) / 3.0)
            for row in here
        )
        sample.append(frame_share * math.sqrt(3.0) * std_m)
    return _fit_law(distances, bias), _fit_law(distances, sample)


def _fit_law(distance_m: list[float], size_m: list[float]) -> tuple[float, float]:
    """Returns `a` and `b` of `a + b distance^2`, neither below 0, so that no measured point lies above it by much.

    Errors of stereo grow with the square of the distance. Relative least squares, since a tenth of
    a millimetre counts at 1 m.
    """
    squared, size = np.square(distance_m), np.array(size_m)
    best, least = (0.0, 0.0), np.inf
    for columns in ((0, 1), (0,), (1,)):
        rows = (
            np.stack([np.ones(len(size)), squared], 1)[:, columns] / np.maximum(size, 1e-6)[:, None]
        )
        found = np.zeros(2)
        found[list(columns)] = np.linalg.lstsq(rows, np.ones(len(size)), rcond=None)[0]
        away = float(
            (
                (np.stack([np.ones(len(size)), squared], 1) @ found / np.maximum(size, 1e-6) - 1.0)
                ** 2
            ).sum()
        )
        if found.min() >= 0 and away < least:
            best, least = (float(found[0]), float(found[1])), away
    return best


def _read_rows(path: Path) -> list[dict[str, Any]]:
    try:
        told = json.loads(path.read_text())
        return [row for row in told if {"perception", "condition", "distance_m"} <= row.keys()]
    except (OSError, ValueError, AttributeError, TypeError) as error:
        raise ConfigError(
            f"noise.table={path}: expected table.json of benchmarks/perception ({error})"
        ) from error
