"""A look at each frame of a source; a frame that cannot be used ends nothing, its reason is kept."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

from brokk_rl.contracts.vision import FrameSourceSpec
from brokk_rl.errors import FrameError
from brokk_rl.progress import ItemProgress
from brokk_rl.signals import Frame

T = TypeVar("T")


def look_at_frames(
    spec: FrameSourceSpec, title: str, look: Callable[[Frame], T], most: int | None = None
) -> Iterator[tuple[str, T | None, str]]:
    """Yield the name of each frame and the answer of `look`, or `None` and why there is none.

    Args:
        spec: The source.
        title: Work that is done, for the progress.
        look: Answers a frame, or refuses it by a `FrameError`.
        most: Frames, at most; `None` for all, which a live camera has no end of.
    """
    with spec.build() as source:
        # A live source has no number of frames.
        counts = [count for count in (source.num_frames, most) if count is not None]
        with ItemProgress(title, min(counts, default=None)) as progress:
            for number in itertools.count():
                if number == min(counts, default=None):
                    return
                name = f"{number:05d}"
                try:
                    frame = source.read_latest()
                    if frame is None:
                        return
                    name = Path(frame.name).name or name
                    answer, reason = look(frame), ""
                except FrameError as error:
                    answer, reason = None, str(error)
                yield name, answer, reason
                progress.advance()
