"""`brokk mode=perceive`: finds boreholes in frames of a folder or a camera, and says why others are none."""

from __future__ import annotations

import logging
import math
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, Literal, cast

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from brokk_rl.contracts.vision import (
    Ellipse,
    FinderSpec,
    FrameDetections,
    FrameSourceSpec,
    HolePose,
    Observer,
    Overlay,
    Rejection,
    Target,
)
from brokk_rl.errors import ConfigError, FrameError
from brokk_rl.session import Session, write_json, write_text
from brokk_rl.signals import Frame
from brokk_rl.spec import spec

log = logging.getLogger(__name__)


@spec
class PerceiveOptions:
    """What to look at.

    Attributes:
        input: Folder of frames, or of any pictures with `until: ellipses`.
        until: `holes`, or `ellipses` of the whole picture, which need neither depth nor a camera.
        frames: Frames to look at; `null` for all, which a live camera has no end of.
        pictures: Whether an overlay is written for each frame.
    """

    input: str | None
    until: Literal["holes", "ellipses"]
    frames: int | None
    pictures: bool

    def check(self) -> None:
        if self.frames is not None and self.frames < 1:
            raise ConfigError(
                f"perceive.frames: expected 1 or more, or null for all, got {self.frames}"
            )


@dataclass(frozen=True)
class FrameEntry:
    """One frame: its name, what came out of it, and why it was refused as a whole."""

    name: str
    sighting: FrameDetections | None
    target: Target | None
    refused: str | None

    def plain(self, until: str) -> dict[str, Any]:
        """Returns it as plain JSON data."""
        if self.sighting is None:
            return {"name": self.name, "refused": self.refused}
        plain: dict[str, Any] = {
            "name": self.name,
            "ms": {k: round(v, 3) for k, v in self.sighting.ms.items()},
        }
        if until == "ellipses":
            return plain | {"ellipses": [_describe_ellipse(one) for one in self.sighting.ellipses]}
        return plain | {
            "holes": [_describe_hole(one) for one in self.sighting.holes],
            "rejected": [_describe_rejection(one) for one in self.sighting.rejected],
            "target": self.target and {
                **_describe_hole(self.target.pose),
                "num_frames": self.target.num_frames, "age_s": self.target.age_s, "stale": self.target.stale,
            },
        }  # fmt: skip


@spec
class Perceive:
    """Finds boreholes in frames, and says of everything else why it is none.

    Attributes:
        session: Folder.
        perception: How holes are found.
        source: Where frames come from.
        gallery: Where pictures come from with `perceive.until: ellipses`.
        overlay: Draws what was seen.
        perceive: What to look at.
    """

    session: Session
    perception: FinderSpec
    source: FrameSourceSpec
    gallery: FrameSourceSpec
    overlay: Overlay
    perceive: PerceiveOptions

    def run(self) -> None:
        """Writes `holes.json`, `explain.txt` and `overlays/<name>.png` into the run folder.

        Raises:
            ConfigError: the option of perception does not look at pictures.
            FrameError: there is no frame at all, or none that can be used.
            StorageError: a file could not be written.
        """
        built = self.perception.build()
        if not hasattr(built, "look"):
            raise ConfigError(
                "this option of perception does not look at pictures; choose perception=plane_conic or paper"
            )
        observer = cast(Observer, built)
        folder = self.session.folder
        entries: list[FrameEntry] = []
        try:
            for entry, frame in self._entries(observer):
                entries.append(entry)
                if frame is not None and entry.sighting is not None and self.perceive.pictures:
                    (folder / "overlays").mkdir(exist_ok=True)
                    self.overlay.write(
                        folder / "overlays" / f"{entry.name}.png", frame, entry.sighting
                    )
        finally:
            if any(entry.sighting for entry in entries):
                self._write(folder, entries, observer)
        if entries and not any(entry.sighting for entry in entries):
            raise FrameError(
                f"none of {len(entries)} frames can be used. The first: {entries[0].refused}"
            )
        self._show(entries)
        log.info("holes: %s", folder / "holes.json")

    def _entries(self, observer: Observer) -> Iterator[tuple[FrameEntry, Frame | None]]:
        """Yields each frame of the source with what came out of it."""
        only_ellipses = self.perceive.until == "ellipses"
        with (
            (self.gallery if only_ellipses else self.source).build() as source,
            Progress(transient=True) as progress,
        ):
            total = _least(source.num_frames, self.perceive.frames)
            task = progress.add_task("looking", total=total)
            number = 0
            while total is None or number < total:
                try:
                    frame = source.read_latest()
                except FrameError as error:
                    yield FrameEntry(f"{number:05d}", None, None, str(error)), None
                    log.warning("%s", error)
                else:
                    if frame is None:
                        return
                    yield self._entry(observer, frame, number, only_ellipses), frame
                number += 1
                progress.update(task, completed=number)

    def _entry(
        self, observer: Observer, frame: Frame, number: int, only_ellipses: bool
    ) -> FrameEntry:
        name = Path(frame.name).name or f"{number:05d}"
        if only_ellipses:
            start = time.perf_counter()
            found = observer.ellipses(frame)
            return FrameEntry(
                name,
                FrameDetections(
                    [], [], found, None, {"ellipse": 1000.0 * (time.perf_counter() - start)}
                ),
                None,
                None,
            )
        try:
            sighting = observer.look(frame)
        except FrameError as error:
            log.warning("%s", error)
            return FrameEntry(name, None, None, str(error))
        return FrameEntry(name, sighting, observer.follow(sighting, frame.t_s), None)

    def _write(self, folder: Path, entries: list[FrameEntry], observer: Observer) -> None:
        write_json(
            folder / "holes.json",
            {"schema": 1, "frames": [entry.plain(self.perceive.until) for entry in entries]},
        )
        if self.perceive.until == "ellipses":
            return
        lines = []
        for entry in entries:
            lines.append(f"{entry.name}: {entry.refused or _count_holes(entry.sighting)}")
            lines += [
                f"  {observer.explain(one)}"
                for one in (entry.sighting.rejected if entry.sighting else ())
            ]
        write_text(folder / "explain.txt", "\n".join(lines) + "\n")

    def _show(self, entries: list[FrameEntry]) -> None:
        used = [entry.sighting for entry in entries if entry.sighting]
        table = Table(box=None, padding=(0, 2, 0, 0), show_header=False)
        table.add_row("frames", f"{len(used)} used, {len(entries) - len(used)} refused")
        if self.perceive.until == "ellipses":
            table.add_row("ellipses", str(sum(len(one.ellipses) for one in used)))
        else:
            table.add_row(
                "holes",
                f"{sum(len(one.holes) for one in used)} in {sum(bool(one.holes) for one in used)} frames",
            )
            counts = Counter(
                f"{one.stage}: {one.reason}" for sighting in used for one in sighting.rejected
            )
            for reason, count in counts.most_common():
                table.add_row("refused", f"{count} × {reason}")
            if target := next((entry.target for entry in reversed(entries) if entry.target), None):
                place = ", ".join(f"{value:.3f}" for value in target.pose.center_m)
                std = 1000.0 * math.sqrt(float(np.trace(target.pose.cov_m2)))
                stale = ", stale" if target.stale else ""
                table.add_row(
                    "target",
                    f"({place}) m in {target.pose.frame}, ±{std:.1f} mm, {target.num_frames} frames{stale}",
                )
        for stage in used[0].ms if used else ():
            table.add_row(f"ms, {stage}", f"{median(one.ms.get(stage, 0.0) for one in used):.0f}")
        Console().print(table)


def _least(*numbers: int | None) -> int | None:
    return min((number for number in numbers if number is not None), default=None)


def _count_holes(sighting: FrameDetections | None) -> str:
    count = len(sighting.holes) if sighting else 0
    return "no hole" if not count else "1 hole" if count == 1 else f"{count} holes"


def _describe_hole(pose: HolePose) -> dict[str, Any]:
    return {
        "center_m": pose.center_m.tolist(), "axis": pose.axis.tolist(), "radius_m": float(pose.radius_m),
        "cov_m2": pose.cov_m2.tolist(), "axis_cov_rad2": pose.axis_cov_rad2.tolist(),
        "frame": pose.frame, "score": float(pose.score),
    }  # fmt: skip


def _describe_rejection(one: Rejection) -> dict[str, Any]:
    value, limit = (float(v) if math.isfinite(v) else None for v in (one.value, one.limit))
    return {
        "stage": one.stage, "reason": one.reason, "value": value, "limit": limit,
        "ellipse": one.ellipse and _describe_ellipse(one.ellipse),
    }  # fmt: skip


def _describe_ellipse(one: Ellipse) -> dict[str, float]:
    return {
        "x": one.x,
        "y": one.y,
        "a": one.a,
        "b": one.b,
        "theta_rad": one.theta_rad,
        "score": one.score,
    }
