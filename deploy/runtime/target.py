"""Where the borehole is said to be: by a file, by numbers in the configuration, by perception, or by a person at the page."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from brokk_rl.errors import ConfigError
from brokk_rl.spec import spec
from deploy.runtime.shared_memory import Slot

NEAR_M = 0.1
"""Boreholes that are nearer to each other than this are one: two drillings are further apart."""


@dataclass(frozen=True)
class TargetPosition:
    """Where a borehole is said to be.

    Attributes:
        center_in_base_m: Centre of the rim, `(3,)`.
        std_m: Standard deviation of that; 0 where nobody has said.
        t_s: When it was found, monotonic; `None`: it stays where it is, and never grows old.
    """

    center_in_base_m: np.ndarray
    std_m: float
    t_s: float | None

    def write(self, slot: Slot) -> None:
        """Make it the loop's target."""
        record = slot.new()
        record["t_s"] = time.monotonic() if self.t_s is None else self.t_s
        record["center_in_base_m"], record["std_m"] = self.center_in_base_m, self.std_m
        slot.write(record)


class TargetProvider(Protocol):
    """Knows the borehole."""

    def news(self, holes: list[Any]) -> TargetPosition | None:
        """Return the borehole where there is news of it, else `None`; called several times a second.

        Args:
            holes: What perception knows, records of `deploy.runtime.shm_layout.HOLE`.

        Raises:
            ConfigError: it makes no sense.
        """
        ...


class TargetSpec(Protocol):
    """A spec in `conf/target`."""

    def build(self) -> TargetProvider:
        """Return it at work."""
        ...


@spec
class GivenTarget:
    """A borehole that does not move, given by its centre.

    Attributes:
        center_in_base_m: Centre of the rim in the base frame.
    """

    center_in_base_m: tuple[float, float, float]

    def build(self) -> TargetProvider:
        """Return it at work; see `TargetSource`."""
        return _FixedTarget(TargetPosition(np.array(self.center_in_base_m), 0.0, None))


@spec
class FileTarget:
    """A JSON file with `center_in_base_m`, read again whenever it changes; its age counts from then on.

    Attributes:
        path: The file; need not exist yet.
    """

    path: str

    def build(self) -> TargetProvider:
        """Return it at work; see `TargetSource`."""
        return _WatchedFile(Path(self.path))


@spec
class DetectedTarget:
    """The surest borehole that the camera shows (`camera=…`), until a person chooses another at the page.

    Attributes:
        score: How sure it must be, in [0, 1].
    """

    score: float

    def build(self) -> TargetProvider:
        """Return it at work; see `TargetSource`."""
        return _SurestHole(self.score)


class TargetSelector:
    """The borehole that the advice is for: that of whoever spoke last, configuration, file, perception or a person.

    What the camera then sees of it keeps it fresh.

    Args:
        target: What the configuration says.
        slot: Where the loop reads it.
        holes: What perception knows.
    """

    def __init__(self, target: TargetProvider, slot: Slot, holes: Slot) -> None:
        self._target, self._slot, self._holes = target, slot, holes
        self._place: TargetPosition | None = None

    def refresh(self) -> None:
        """Take over news.

        Raises:
            ConfigError: the configured source makes no sense now.
        """
        before, known = self._place, read_holes(self._holes)
        news = self._target.news(known)
        self._place = news or self._seen(known) or before
        if self._place is not None and (self._place is not before or self._place.t_s is None):
            self._place.write(self._slot)

    def choose(self, place: TargetPosition) -> None:
        """Take what a person has chosen."""
        self._place = place
        place.write(self._slot)

    def _seen(self, known: list[Any]) -> TargetPosition | None:
        """Return what the camera says of the borehole since the last time."""
        place = self._place
        if place is None:
            return None
        one = find_nearest(known, place.center_in_base_m)
        if one is None or (place.t_s is not None and float(one["t_s"]) <= place.t_s):
            return None
        return locate_hole(one)


def read_holes(slot: Slot) -> list[Any]:
    """Return the boreholes that perception knows, records of `HOLE`."""
    record = slot.read()
    return [] if record is None else list(record["holes"][: int(record["count"])])


def find_nearest(holes: list[Any], center_m: np.ndarray) -> Any | None:
    """Return that of `holes` which is the borehole at `center_m`, if any."""
    one = min(
        holes,
        key=lambda hole: float(np.linalg.norm(hole["center_in_base_m"] - center_m)),
        default=None,
    )
    return (
        one
        if one is not None and np.linalg.norm(one["center_in_base_m"] - center_m) <= NEAR_M
        else None
    )


def locate_hole(hole: Any) -> TargetPosition:
    """Return where a borehole is that perception knows."""
    return TargetPosition(
        np.array(hole["center_in_base_m"]), float(hole["std_m"]), float(hole["t_s"])
    )


class _FixedTarget:
    def __init__(self, place: TargetPosition) -> None:
        self._place: TargetPosition | None = place

    def news(self, holes: list[Any]) -> TargetPosition | None:
        place, self._place = self._place, None
        return place


class _SurestHole:
    def __init__(self, score: float) -> None:
        self._score, self._said = score, False

    def news(self, holes: list[Any]) -> TargetPosition | None:
        sure = max(holes, key=lambda hole: float(hole["score"]), default=None)
        if self._said or sure is None or float(sure["score"]) < self._score:
            return None
        self._said = (
            True  # from now on it is followed; a surer one next to it is the operator's choice
        )
        return locate_hole(sure)


class _WatchedFile:
    def __init__(self, path: Path) -> None:
        self._path = path
        self._changed: int | None = None

    def news(self, holes: list[Any]) -> TargetPosition | None:
        try:
            changed = self._path.stat().st_mtime_ns
            if changed == self._changed:
                return None
            before, self._changed = self._changed, changed
            found = json.loads(self._path.read_text())
            center_m = np.array(found["center_in_base_m"], dtype=float)
            std_m = float(found.get("std_m", 0.0))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise ConfigError(
                f"target.path={self._path}: expected JSON with center_in_base_m: [x, y, z] ({error})"
            ) from error
        if center_m.shape != (3,) or not np.isfinite(center_m).all():
            raise ConfigError(
                f"target.path={self._path}: center_in_base_m is {center_m.tolist()}, expected three numbers"
            )
        # only a file that lay there before goes by the wall clock, which may be set at any time
        age_s = max(0.0, time.time() - changed / 1e9) if before is None else 0.0
        return TargetPosition(center_m, std_m, time.monotonic() - age_s)
