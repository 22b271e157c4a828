"""Search of successive frames: whole pictures now and then, known holes alone in between."""

from __future__ import annotations

from collections.abc import Sequence

from brokk_rl.contracts.vision import BoreholeFinder, FrameDetections, HoleTracker, TrackedHole
from brokk_rl.signals import Frame
from perception.finder import StagedFinder


class SteeredSearch:
    """A finder that its tracker steers.

    Args:
        finder: Finds holes; it is steered if it is a `StagedFinder`.
        tracker: Follows them over the frames.
    """

    def __init__(self, finder: BoreholeFinder, tracker: HoleTracker) -> None:
        self._finder, self._tracker = finder, tracker
        self._known: Sequence[TrackedHole] = ()
        self._num_followed = 0

    def update(self, frame: Frame) -> tuple[FrameDetections, Sequence[TrackedHole]]:
        """Return the holes of a frame, in the base frame where it is known, and all tracked ones.

        Raises:
            FrameError: the frame cannot be used; the tracker is not told.
        """
        found = self._look(frame).in_base_frame(frame)
        self._known = self._tracker.update(found.holes, frame.t_s)
        return found, self._known

    def _look(self, frame: Frame) -> FrameDetections:
        finder = self._finder
        known = [hole.pose for hole in self._known if hole.confirmed and not hole.stale]
        if not isinstance(finder, StagedFinder) or not known:
            return finder.find(frame)
        self._num_followed += 1
        if self._num_followed < finder.search_every:
            found = finder.follow(frame, known)
            if found.holes:
                return found
        self._num_followed = 0
        return finder.find(frame)
