"""Subject and size of `mode=check`."""

from __future__ import annotations

import re
from pathlib import Path

from brokk_rl.errors import ConfigError
from brokk_rl.spec import spec


@spec
class CheckSubject:
    """Subject and size of a check.

    Attributes:
        model: URDF or MJCF of a new machine; `None` checks `machine=…`.
        name: Name of the new machine; `None`: that of its file.
        num_poses: Random poses from which the reach is read.
        num_starts: Starts of the task that are drawn.
    """

    model: str | None
    name: str | None
    num_poses: int
    num_starts: int

    def check(self) -> None:
        if self.num_poses < 1 or self.num_starts < 1:
            raise ConfigError(
                f"subject: expected num_poses and num_starts of 1 or more, got {self.num_poses} and {self.num_starts}"
            )
        if self.model is not None and not Path(self.model).is_file():
            raise ConfigError(
                f"subject.model={self.model}: there is no such file (seen from {Path.cwd()})"
            )
        if self.name is not None and not re.fullmatch(r"\w+", self.name):
            raise ConfigError(
                f"subject.name: expected letters, digits and _, got '{self.name}'; it names files and recordings"
            )
