"""`brokk mode=perceive`: find boreholes in frames of a folder or a camera, and explain refusals."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any, Literal

import numpy as np

from brokk_rl.console_table import print_table
from brokk_rl.contracts.vision import (
    BoreholeFinder,
    FinderSpec,
    FrameDetections,
    FrameSourceSpec,
    HoleTracker,
    Rejection,
    TrackedHole,
    TrackerSpec,
)
from brokk_rl.errors import ConfigError, FrameError
from brokk_rl.session import Session, write_json, write_text
from brokk_rl.signals import Frame
from brokk_rl.spec import Count, spec
from perception.finder import StagedFinder
from perception.overlay import OverlayDrawing
from perception.sources.look import look_at_frames

log = logging.getLogger(__name__)


@spec
class PerceiveOptions:
    """Input and extent of a perceive run.

    Attributes:
        input: Folder of frames.
        until: `holes`, or `ellipses` of the whole picture, which need no depth.
        frames: Number of frames; `null` for all, which a live camera has no end of.
        pictures: Write an overlay for each frame.
    """

    input: str | None
    until: Literal["holes", "ellipses"]
    frames: Count | None
    pictures: bool


@dataclass(frozen=True)
class FrameEntry:
    """Result of one frame.

    Attributes:
        name: Name of the frame.
        found: Its detections, `None` where the whole frame was refused.
        target: The hole that most frames support so far, and its age in s.
        refused: Reason why the whole frame was refused.
    """

    name: str
    found: FrameDetections | None
    target: tuple[TrackedHole, float] | None
    refused: str | None

    def as_json(self) -> dict[str, Any]:
        """Return it as plain JSON data."""
        if self.found is None:
            return {"name": self.name, "refused": self.refused}
        plain: dict[str, Any] = {
            "name": self.name,
            "ms": {stage: round(value, 3) for stage, value in self.found.ms.items()},
        }
        for name in ("holes", "rejected", "ellipses"):
            plain[name] = [_to_plain(asdict(one)) for one in getattr(self.found, name)]
        plain["target"] = None
        if self.target is not None:
            hole, age_s = self.target
            told = {"num_frames": hole.num_frames, "age_s": age_s, "stale": hole.stale}
            plain["target"] = _to_plain(asdict(hole.pose)) | told
        return plain


@spec
class Perceive:
    """Find boreholes in frames, and explain every refusal.

    Attributes:
        session: Run folder.
        perception: Finder of boreholes.
        tracker: Follows the boreholes over the frames.
        source: Source of the frames.
        overlay: Draws the detections.
        perceive: Input and extent.
    """

    session: Session
    perception: FinderSpec
    tracker: TrackerSpec
    source: FrameSourceSpec
    overlay: OverlayDrawing
    perceive: PerceiveOptions

    def run(self) -> None:
        """Write `holes.json`, `explain.txt` and `overlays/<name>.png` into the run folder.

        Raises:
            FrameError: there is no frame at all, or none that can be used.
            StorageError: a file could not be written.
        """
        finder = self.perception.build()
        results = self._find_holes(finder, self.tracker.build())
        folder = self.session.folder
        entries: list[FrameEntry] = []
        try:
            for entry, frame in results:
                entries.append(entry)
                if frame is not None and entry.found is not None and self.perceive.pictures:
                    # Only now: a run without a usable frame leaves no folder.
                    (folder / "overlays").mkdir(exist_ok=True)
                    path = folder / "overlays" / f"{entry.name}.png"
                    self.overlay.write(path, frame, entry.found)
        # Also after an interruption: found holes are not lost.
        finally:
            if any(entry.found for entry in entries):
                self._write(folder, entries, finder)
        # One refused frame is a warning, only refused frames are an error.
        if entries and not any(entry.found for entry in entries):
            first = f"The first: {entries[0].refused}"
            raise FrameError(f"none of {len(entries)} frames can be used. {first}")
        self._show(entries)
        log.info("holes: %s", folder / "holes.json")

    def _find_holes(
        self, finder: BoreholeFinder, tracker: HoleTracker
    ) -> Iterator[tuple[FrameEntry, Frame | None]]:
        """Yield the result of each frame of the source."""

        def look(frame: Frame) -> tuple[FrameDetections, Sequence[TrackedHole]]:
            found = finder.find(frame).in_base_frame(frame)
            return found, tracker.update(found.holes, frame.t_s)

        if self.perceive.until == "ellipses":
            if not isinstance(finder, StagedFinder):
                raise ConfigError(
                    f"perceive.until=ellipses: expected perception=plane_conic, got {type(finder).__name__}"
                )
            look = finder.find_ellipses

        def search(frame: Frame) -> tuple[Frame, tuple[FrameDetections, Sequence[TrackedHole]]]:
            return frame, look(frame)

        answers = look_at_frames(self.source, "looking", search, self.perceive.frames)
        for name, answer, reason in answers:
            if answer is None:
                log.warning("%s", reason)
                yield FrameEntry(name, None, None, reason), None
            else:
                frame, (found, tracked) = answer
                yield FrameEntry(name, found, _choose_target(tracked, frame.t_s), None), frame

    def _write(self, folder: Path, entries: list[FrameEntry], finder: BoreholeFinder) -> None:
        """Write `holes.json` and `explain.txt`."""
        frames = [entry.as_json() for entry in entries]
        write_json(folder / "holes.json", {"schema": 1, "frames": frames})
        lines = []
        for entry in entries:
            if entry.found is None:
                lines.append(f"{entry.name}: {entry.refused}")
                continue
            lines.append(f"{entry.name}: {len(entry.found.holes)} holes")
            for rejection in entry.found.rejected:
                lines.append(f"  {_explain(finder, rejection)}")
        write_text(folder / "explain.txt", "\n".join(lines) + "\n")

    def _show(self, entries: list[FrameEntry]) -> None:
        """Print a table of counts, refusals, the target and the durations."""
        used = [entry.found for entry in entries if entry.found]
        rows = [("frames", f"{len(used)} used, {len(entries) - len(used)} refused")]
        num_holes = sum(len(one.holes) for one in used)
        rows.append(("holes", f"{num_holes} in {sum(bool(one.holes) for one in used)} frames"))
        rows.append(("ellipses", str(sum(len(one.ellipses) for one in used))))
        counts: Counter[str] = Counter()
        for one in used:
            counts.update(f"{rejection.stage}: {rejection.reason}" for rejection in one.rejected)
        for reason, count in counts.most_common():
            rows.append(("refused", f"{count} × {reason}"))
        target = next((entry.target for entry in reversed(entries) if entry.target), None)
        if target is not None:
            rows.append(("target", _format_target(target[0])))
        stages = dict.fromkeys(stage for one in used for stage in one.ms)
        for stage in stages:
            rows.append((f"ms, {stage}", f"{median(one.ms.get(stage, 0.0) for one in used):.0f}"))
        print_table((), rows)


def _explain(finder: BoreholeFinder, rejection: Rejection) -> str:
    """Return a refusal in words: the finder's own if it has any."""
    if isinstance(finder, StagedFinder):
        return finder.explain(rejection)
    value, limit = f"{rejection.value:.4g}", f"{rejection.limit:.4g}"
    return f"{rejection.stage}: {rejection.reason} is {value}, limit {limit}"


def _choose_target(tracked: Sequence[TrackedHole], t_s: float) -> tuple[TrackedHole, float] | None:
    """Return the confirmed hole that most frames support, and its age; `None` without one."""
    confirmed = [hole for hole in tracked if hole.confirmed]
    best = max(confirmed, key=lambda hole: (hole.num_frames, hole.pose.score), default=None)
    return None if best is None else (best, t_s - best.seen_s)


def _format_target(hole: TrackedHole) -> str:
    place = ", ".join(f"{value:.3f}" for value in hole.pose.center_m)
    std_mm = 1000.0 * math.sqrt(float(np.trace(hole.pose.cov_m2)))
    stale = ", stale" if hole.stale else ""
    return f"({place}) m in {hole.pose.frame}, ±{std_mm:.1f} mm, {hole.num_frames} frames{stale}"


def _to_plain(value: Any) -> Any:
    """Return values as JSON has them: arrays as lists, `null` for what is no number."""
    if isinstance(value, dict):
        return {name: _to_plain(one) for name, one in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return None if isinstance(value, float) and not math.isfinite(value) else value
