"""`brokk mode=render`: synthetic stereo pairs of boreholes with depth and truth."""

from __future__ import annotations

import logging
from pathlib import Path

from brokk_rl.errors import ConfigError
from brokk_rl.progress import track_items
from brokk_rl.session import Session
from brokk_rl.spec import Count, Index, spec
from perception import dataset
from perception.render.frame_renderer import FrameRenderer

log = logging.getLogger(__name__)

FOLDER = "frames"


@spec
class Rendering:
    """Frames to render.

    Attributes:
        count: Number of frames.
        first: Number of the first one, so that several processes can share the work.
    """

    count: Count
    first: Index


@spec
class Render:
    """Render stereo pairs of scenes with depth and truth; a seed repeats its files."""

    session: Session
    resume: str | None
    studio: FrameRenderer
    render: Rendering

    def run(self) -> None:
        """Write `frames/<number>.*` into the run folder; frames that exist are kept.

        Raises:
            ConfigError: `resume` names another folder than `session.out`.
            StorageError: a file could not be written.
        """
        folder = self.session.folder / FOLDER
        if self.resume is not None and Path(self.resume).resolve() != self.session.folder.resolve():
            raise ConfigError(
                f"resume={self.resume}: rendering goes on in its own folder; add "
                f"session.out={self.resume}"
            )
        numbers = range(self.render.first, self.render.first + self.render.count)
        compose = self.studio.prepare(folder, self.session, numbers.stop)
        done = 0
        for number in track_items(numbers, "frames"):
            stem = folder / f"{number:05d}"
            if dataset.is_whole(stem):
                continue
            self.studio.shoot(stem, *compose(number))
            done += 1
        log.info("%d frames rendered, %d were there; see %s", done, len(numbers) - done, folder)
