"""Target of the loop: the borehole named by configuration, a file, perception or a person."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np

from brokk_rl.errors import ConfigError
from brokk_rl.plain_files import read_json
from brokk_rl.spec import Share, spec
from deploy.runtime.shared_memory import Slot

NEAR_M = 0.1
"""Distance below which two boreholes are the same: holes of 0.1 m are drilled further apart."""


MOST_BYTES = 1 << 16
"""Size beyond which a file is none of a target."""


@dataclass(frozen=True)
class TargetPosition:
    """Position of a borehole.

    Attributes:
        center_in_base_m: Centre of the rim, `(3,)`.
        std_m: Standard deviation of each coordinate; 0 for unknown.
        t_s: Time of detection, monotonic; `None` for a fixed one that never grows old.
    """

    center_in_base_m: np.ndarray
    std_m: float
    t_s: float | None

    def write(self, slot: Slot) -> None:
        """Publish it as the target of the loop."""
        record = slot.new()
        record["t_s"] = time.monotonic() if self.t_s is None else self.t_s
        record["center_in_base_m"], record["std_m"] = self.center_in_base_m, self.std_m
        slot.write(record)


class TargetProvider(Protocol):
    """Reports the configured borehole."""

    def news(self, holes: list[Any], known: TargetPosition | None) -> TargetPosition | None:
        """Return the borehole if it is new, else `None`; called several times a second.

        Args:
            holes: Boreholes from perception, records of `deploy.runtime.shm_layout.HOLE`.
            known: Target until now.

        Raises:
            ConfigError: its source is invalid.
        """
        ...


class TargetSpec(Protocol):
    """A spec in `conf/target`."""

    def build(self) -> TargetProvider:
        """Return it at work."""
        ...


@spec
class GivenTarget:
    """Take a borehole given by its centre.

    Attributes:
        center_in_base_m: Centre of the rim in the base frame.
    """

    center_in_base_m: tuple[float, float, float]

    def build(self) -> Self:
        """Return it at work."""
        return self

    def news(self, holes: list[Any], known: TargetPosition | None) -> TargetPosition | None:
        """See `TargetProvider`."""
        if known is not None:
            return None
        return TargetPosition(np.array(self.center_in_base_m), 0.0, None)


@spec
class FileTarget:
    """Read a JSON file with `center_in_base_m` whenever it changes; its age counts from then on.

    Attributes:
        path: The file; need not exist yet.
    """

    path: str

    def build(self) -> TargetProvider:
        """Return it at work."""
        return _WatchedFile(Path(self.path))


@spec
class DetectedTarget:
    """Take the surest borehole of the camera (`camera=…`), until a person chooses another one.

    Attributes:
        score: Least score, in [0, 1].
    """

    score: Share

    def build(self) -> Self:
        """Return it at work."""
        return self

    def news(self, holes: list[Any], known: TargetPosition | None) -> TargetPosition | None:
        """See `TargetProvider`."""
        sure = max(holes, key=lambda hole: float(hole["score"]), default=None)
        # The first one is followed; only the operator changes to a surer one.
        if known is not None or sure is None or float(sure["score"]) < self.score:
            return None
        return locate_hole(sure)


class TargetSelector:
    """Select the target: the latest word of configuration, file, perception or a person counts.

    Detections of the same borehole keep it fresh.

    Args:
        target: Configured source.
        slot: Shared record of the target.
        holes: Shared record of the boreholes from perception.
    """

    def __init__(self, target: TargetProvider, slot: Slot, holes: Slot) -> None:
        self._target, self._slot, self._holes = target, slot, holes
        self._place: TargetPosition | None = None

    def refresh(self) -> None:
        """Publish a new target, or a new detection of the present one.

        Raises:
            ConfigError: the configured source is invalid now.
        """
        before, known = self._place, read_holes(self._holes)
        news = self._target.news(known, before)
        self._place = news or self._seen(known) or before
        if self._place is not None and (self._place is not before or self._place.t_s is None):
            self._place.write(self._slot)

    def choose(self, place: TargetPosition) -> None:
        """Publish the choice of a person."""
        self._place = place
        place.write(self._slot)

    def _seen(self, known: list[Any]) -> TargetPosition | None:
        """Return a new detection of the present target, `None` without one."""
        place = self._place
        if place is None:
            return None
        one = find_nearest(known, place.center_in_base_m)
        if one is None or (place.t_s is not None and float(one["t_s"]) <= place.t_s):
            return None
        return locate_hole(one)


def read_holes(slot: Slot) -> list[Any]:
    """Return the boreholes from perception, records of `HOLE`."""
    record = slot.read()
    return [] if record is None else list(record["holes"][: int(record["count"])])


def find_nearest(holes: Sequence[Any], center_m: np.ndarray) -> Any | None:
    """Return the one of `holes` at `center_m`, `None` for none."""

    def measure_m(hole: Any) -> float:
        return float(np.linalg.norm(np.array(hole["center_in_base_m"]) - center_m))

    near = [hole for hole in holes if measure_m(hole) <= NEAR_M]
    return min(near, key=measure_m, default=None)


def locate_hole(hole: Any) -> TargetPosition:
    """Return the position of a borehole from perception."""
    return TargetPosition(
        np.array(hole["center_in_base_m"]), float(hole["std_m"]), float(hole["t_s"])
    )


class _WatchedFile:
    def __init__(self, path: Path) -> None:
        self._path = path
        self._changed: int | None = None

    def news(self, holes: list[Any], known: TargetPosition | None) -> TargetPosition | None:
        try:
            changed = self._path.stat().st_mtime_ns
            if changed == self._changed:
                return None
            before, self._changed = self._changed, changed
            found = read_json(self._path, MOST_BYTES)
            center_m = np.array(found["center_in_base_m"], dtype=float)
            std_m = float(found.get("std_m", 0.0))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError, OverflowError) as error:
            raise ConfigError(
                f"target.path={self._path}: expected JSON with center_in_base_m: [x, y, z] ({error})"
            ) from error
        if center_m.shape != (3,) or not np.isfinite([*center_m, std_m]).all():
            raise ConfigError(
                f"target.path={self._path}: expected three finite numbers and a finite std_m, got "
                f"{center_m.tolist()} and {std_m:g}"
            )
        # A file that was there before has its age by the wall clock, which may be set at any time:
        # later changes are timed by the monotonic clock.
        age_s = max(0.0, time.time() - changed / 1e9) if before is None else 0.0
        return TargetPosition(center_m, std_m, time.monotonic() - age_s)
