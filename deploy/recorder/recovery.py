"""What `mode=recover` does: captures that a crash or a power failure cut off become whole ones beside them."""

from __future__ import annotations

import logging
from pathlib import Path

from rich.progress import track

from brokk_rl import record
from brokk_rl.errors import RecordingError
from brokk_rl.spec import spec
from deploy.recorder import reading

log = logging.getLogger(__name__)

KINDS = {".mcap": reading.recover_mcap, ".blf": reading.recover_blf}


@spec
class Recovery:
    """Captures to recover.

    Attributes:
        input: Glob, or list of globs, of `.mcap` and `.blf` files; what else lies beside them is
            left out.
    """

    input: str | tuple[str, ...]

    def run(self, folder: Path) -> None:
        """Writes each recovered file under its own name, led by that of its folder, into `folder`.

        Raises:
            RecordingError: nothing matches, two would have the same name, or nothing can be read of
                one.
        """
        matching = record.find_files(self.input, "capture")
        paths = [path for path in matching if path.suffix in KINDS]
        if not paths:
            raise RecordingError(
                f"recover.input: {matching[0]} is neither .mcap nor .blf, nor is anything else that matches"
            )
        names = [f"{path.resolve().parent.name}_{path.name}" for path in paths]
        if len(set(names)) < len(names):
            raise RecordingError(
                "recover.input: two captures lie in folders of the same name; recover one after the other"
            )
        for path, name in track(list(zip(paths, names, strict=True)), "recovering", transient=True):
            count = KINDS[path.suffix](path, folder / name)
            log.info("%s: %d messages recovered into %s", path, count, folder / name)
