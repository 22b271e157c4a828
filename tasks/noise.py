"""Errors of the observation: a target seen by a camera, scaled positions and commands.

`ObservationNoise` takes its numbers from the configuration. `MeasuredNoise` takes those of the
target from the benchmark of perception, by distance from the camera.
"""

from __future__ import annotations

import json
import logging
import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from brokk_rl.bounds import require_number
from brokk_rl.errors import ConfigError
from brokk_rl.spec import spec

if TYPE_CHECKING:
    import torch

ROOT = Path(__file__).parents[1]
"""Folder of the benchmark's files in a checkout; an installed package has none."""
P95_OF_LONGEST = 0.95
"""Of errors spread evenly between 0 and the longest, 95 % are shorter than this part of it."""
P95_OF_RMS = 1.614
"""95 % quantile over root mean square of a round Gaussian error in space: 2.795 standard deviations
of an axis (chi distribution, 3 degrees of freedom) over the square root of three."""
FIGURES = ("position_mm_p95", "along_std_m", "across_std_m")
"""Columns of the benchmark's table that the laws need."""
MIN_SIZE_M = 1e-6
"""Floor of the weights of relative least squares: an error of zero must not weigh infinitely."""

log = logging.getLogger(__name__)


@spec
class ObservationNoise:
    """Ranges of the observation's errors; drawn anew each episode unless said otherwise.

    Attributes:
        target_sample_m: Uniform error of the target in each sample and axis (±).
        target_bias_m: Length of the constant error of the target, uniform from 0, in a random
            direction.
        target_relative: Uniform error of each sample as a share of each coordinate (±); the paper's
            5 %.
        filter: `mean` gives the policy the mean of all estimates of the episode, as a tracker of a
            fixed hole does; `none` each sample.
        q_scale: Scale error of all measured positions (±).
        q_scale_of: What `q_scale` scales. `position`: each position, as a wrong encoder would.
            `motion`: the distance of earlier positions from the newest, as a machine does that is
            faster or slower than its model.
        u_scale: Scale error of all recorded commands (±).
    """

    target_sample_m: float
    target_bias_m: float
    target_relative: float
    filter: Literal["none", "mean"]
    q_scale: float
    q_scale_of: Literal["position", "motion"]
    u_scale: float

    def check(self) -> None:
        for name in ("target_sample_m", "target_bias_m", "target_relative", "q_scale", "u_scale"):
            require_number(f"task.noise.{name}", getattr(self, name), least=0)

    def bias_m(self, target_m: torch.Tensor) -> torch.Tensor | float:
        """Return the longest constant error of targets, `(N, 3)` in the base frame."""
        return self.target_bias_m

    def sample_m(self, target_m: torch.Tensor) -> torch.Tensor | float:
        """Return the half width of the error of each sample and axis."""
        return self.target_sample_m


@spec
class MeasuredNoise:
    """Noise of the target by the table of `benchmarks/perception` and the camera's calibration.

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
        filter: As in `ObservationNoise`, like all that follows.
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
    q_scale_of = "position"

    def check(self) -> None:
        sizes = ("calibration_m", "unmeasured_bias_m", "unmeasured_sample_m", "q_scale", "u_scale")
        for name in sizes:
            require_number(f"task.noise.{name}", getattr(self, name), least=0)
        require_number("task.noise.frame_share", self.frame_share, least=0, most=1)
        self._laws()

    def bias_m(self, target_m: torch.Tensor) -> torch.Tensor | float:
        """Return the longest constant error of targets, `(N, 3)` in the base frame, as `(N, 1)`."""
        laws = self._laws()
        if laws is None:
            return self.unmeasured_bias_m
        calibration_m = self.calibration_m * P95_OF_RMS / P95_OF_LONGEST
        bias_m = laws.bias.at(self._squared_distance_m2(target_m))
        return (bias_m.square() + calibration_m**2).sqrt()

    def sample_m(self, target_m: torch.Tensor) -> torch.Tensor | float:
        """Return the half width of the error of each sample and axis, `(N, 1)`."""
        laws = self._laws()
        if laws is None:
            return self.unmeasured_sample_m
        return laws.sample.at(self._squared_distance_m2(target_m))

    def _squared_distance_m2(self, target_m: torch.Tensor) -> torch.Tensor:
        x, y, z = self.camera_in_base_m
        return (
            (target_m[:, 0:1] - x).square()
            + (target_m[:, 1:2] - y).square()
            + (target_m[:, 2:3] - z).square()
        )

    def _laws(self) -> _NoiseLaws | None:
        """Return the laws of the table, `None` where nothing was measured."""
        return _fit_laws(self.table, self.perception, self.conditions, self.frame_share)


@dataclass(frozen=True)
class _DistanceLaw:
    """Size of an error over the distance d from the camera: `near + far d²`, m.

    The error of stereo grows with the square of the distance.
    """

    near: float
    far: float

    def at(self, squared_distance_m2: torch.Tensor) -> torch.Tensor:
        return self.near + self.far * squared_distance_m2


@dataclass(frozen=True)
class _NoiseLaws:
    """Longest bias, and half width of the error of a sample."""

    bias: _DistanceLaw
    sample: _DistanceLaw


@cache
def _fit_laws(
    table: str, perception: str, conditions: tuple[str, ...], frame_share: float
) -> _NoiseLaws | None:
    """Fit the laws to the rows of the benchmark's table that count."""
    path = next((path for path in (Path(table), ROOT / table) if path.is_file()), None)
    if path is None:
        log.warning(
            "task/noise=measured: there is no file '%s' (looked in %s and %s); the assumed sizes "
            "unmeasured_bias_m and unmeasured_sample_m are used. "
            "`python benchmarks/perception/table.py` measures them.",
            table,
            Path.cwd(),
            ROOT,
        )
        return None
    rows: list[dict[str, Any]] = []
    for row in _read_rows(path):
        counts = row["perception"] == perception and row["condition"] in conditions
        if counts and all(row.get(name) is not None for name in FIGURES):
            rows.append(row)
    distances = sorted({float(row["distance_m"]) for row in rows})
    if len(distances) < 2:
        raise ConfigError(
            f"noise.table={path}: perception={perception} was measured at {len(distances)} "
            f"distances under {', '.join(conditions)}; two are needed"
        )
    bias_m, sample_m = [], []
    for distance_m in distances:
        here = [row for row in rows if row["distance_m"] == distance_m]
        bias_m.append(max(row["position_mm_p95"] for row in here) / 1000.0 / P95_OF_LONGEST)
        std_m = max(_average_std_m(row) for row in here)
        # a uniform distribution's half width is the square root of three standard deviations
        sample_m.append(frame_share * math.sqrt(3.0) * std_m)
    return _NoiseLaws(bias=_fit_law(distances, bias_m), sample=_fit_law(distances, sample_m))


def _average_std_m(row: dict[str, Any]) -> float:
    """Return the root mean square over three axes of a row's standard deviation."""
    return math.sqrt((row["along_std_m"] ** 2 + 2.0 * row["across_std_m"] ** 2) / 3.0)


def _fit_law(distance_m: list[float], size_m: list[float]) -> _DistanceLaw:
    """Fit a law by relative least squares, neither of its numbers below 0.

    Relative, since a tenth of a millimetre counts at 1 m.
    """
    size = np.array(size_m)
    terms = np.stack([np.ones(len(size)), np.square(distance_m)], 1)
    weight = np.maximum(size, MIN_SIZE_M)
    best, least = np.zeros(2), np.inf
    # with both terms, or where one of them came out negative with the other alone
    for columns in ([0, 1], [0], [1]):
        found = np.zeros(2)
        rows = terms[:, columns] / weight[:, None]
        found[columns] = np.linalg.lstsq(rows, np.ones(len(size)), rcond=None)[0]
        residual = float(((terms @ found / weight - 1.0) ** 2).sum())
        if found.min() >= 0 and residual < least:
            best, least = found, residual
    return _DistanceLaw(near=float(best[0]), far=float(best[1]))


def _read_rows(path: Path) -> list[dict[str, Any]]:
    try:
        table = json.loads(path.read_text())
        rows = []
        for row in table:
            if {"perception", "condition", "distance_m"} <= row.keys():
                rows.append(row)
        return rows
    except (OSError, ValueError, AttributeError, TypeError) as error:
        raise ConfigError(
            f"noise.table={path}: expected table.json of benchmarks/perception ({error})"
        ) from error
