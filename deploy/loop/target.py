"""Where the borehole is said to be: a file that perception or a person wrote, or numbers in the configuration."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Protocol

import numpy as np

from brokk_rl.errors import ConfigError
from brokk_rl.spec import spec
from deploy.loop.exchange import Slot


class Target(Protocol):
    """Knows the borehole."""

    def refresh(self, slot: Slot) -> None:
        """Writes the borehole into `slot` where there is news; called several times a second.

        Raises:
            ConfigError: what it says makes no sense.
        """
        ...


class TargetSource(Protocol):
    """A spec in `conf/target`."""

    def build(self) -> Target:
        """Returns it at work."""
        ...


@spec
class Given:
    """A borehole that does not move, given by its centre.

    Attributes:
        center_in_base_m: Centre of the rim in the base frame.
    """

    center_in_base_m: tuple[float, float, float]

    def build(self) -> Target:
        """Returns it at work; see `TargetSource`."""
        return _Fixed(np.array(self.center_in_base_m))


@spec
class File:
    """A JSON file with `center_in_base_m`, read again whenever it changes; its age counts from then on.

    Attributes:
        path: The file; need not exist yet.
    """

    path: str

    def build(self) -> Target:
        """Returns it at work; see `TargetSource`."""
        return _Watched(Path(self.path))


class _Fixed:
    def __init__(self, center_m: np.ndarray) -> None:
        self._center_m = center_m

    def refresh(self, slot: Slot) -> None:
        _write(slot, self._center_m, 0.0, 0.0)


class _Watched:
    def __init__(self, path: Path) -> None:
        self._path = path
        self._changed: int | None = None

    def refresh(self, slot: Slot) -> None:
        try:
            changed = self._path.stat().st_mtime_ns
            if changed == self._changed:
                return
            before, self._changed = self._changed, changed
            found = json.loads(self._path.read_text())
            center_m = np.array(found["center_in_base_m"], dtype=float)
            std_m = float(found.get("std_m", 0.0))
        except FileNotFoundError:
            return
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise ConfigError(f"target.path={self._path}: expected JSON with center_in_base_m: [x, y, z] ({error})") from error
        if center_m.shape != (3,) or not np.isfinite(center_m).all():
            raise ConfigError(f"target.path={self._path}: center_in_base_m is {center_m.tolist()}, expected three numbers")
        # only a file that lay there before goes by the wall clock, which may be set at any time
        age_s = max(0.0, time.time() - changed / 1e9) if before is None else 0.0
        _write(slot, center_m, std_m, age_s)


def _write(slot: Slot, center_m: np.ndarray, std_m: float, age_s: float) -> None:
    record = slot.new()
    record["t_s"], record["center_in_base_m"], record["std_m"] = time.monotonic() - age_s, center_m, std_m
    slot.write(record)
