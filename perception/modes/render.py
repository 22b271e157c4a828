"""`brokk mode=render`: pictures of boreholes that were never drilled, with depth and truth."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Protocol

import numpy as np
from rich.progress import Progress

from brokk_rl.errors import ConfigError
from brokk_rl.session import Session
from brokk_rl.spec import spec

log = logging.getLogger(__name__)

FOLDER = "frames"


class FrameMaker(Protocol):
    """Makes frames on disk."""

    def prepare(self, folder: Path) -> None:
        """Writes what all frames of a folder share."""
        ...

    def has(self, stem: Path) -> bool:
        """Says whether the frame at `stem` is there, whole."""
        ...

    def shoot(self, stem: Path, generator: np.random.Generator) -> None:
        """Writes the frame at `stem`; the generator is the only source of chance.

        Raises:
            StorageError: a file could not be written.
        """
        ...


@spec
class Rendering:
    """How much to render.

    Attributes:
        count: Number of frames.
        first: Number of the first one; so several processes share the work.
    """

    count: int
    first: int

    def check(self) -> None:
        if self.count < 1 or self.first < 0:
            raise ConfigError(
                f"render: expected count of 1 or more and first of 0 or more, got {self.count} and {self.first}"
            )


@spec
class Render:
    """Renders stereo pairs of scenes drawn by chance, with depth and truth; the same seed makes the same files."""

    session: Session
    resume: str | None
    studio: FrameMaker
    render: Rendering

    def run(self) -> None:
        """Writes `frames/<number>.*` into the run folder; a frame that is there already is left alone.

        Raises:
            ConfigError: `resume` names another folder than `session.out`.
            StorageError: a file could not be written.
        """
        folder = self.session.folder / FOLDER
        if self.resume is not None and Path(self.resume).resolve() != self.session.folder.resolve():
            raise ConfigError(
                f"resume={self.resume}: rendering goes on in its own folder; add session.out={self.resume}"
            )
        self.studio.prepare(folder)
        numbers = range(self.render.first, self.render.first + self.render.count)
        done = 0
        with Progress(transient=True) as progress:
            for number in progress.track(numbers, description=f"{len(numbers)} frames"):
                stem = folder / f"{number:05d}"
                if self.studio.has(stem):
                    continue
                self.studio.shoot(stem, self.session.generator(f"scene/{number}"))
                done += 1
        log.info("%d frames rendered, %d were there; see %s", done, len(numbers) - done, folder)
