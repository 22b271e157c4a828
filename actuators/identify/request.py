"""Request of an identification: which recordings a model is fitted to, and how it is judged.

Nothing here needs torch, so that the command refuses bad values before it is loaded.
"""

from __future__ import annotations

from typing import Annotated

from annotated_types import Ge

from brokk_rl import record
from brokk_rl.errors import ConfigError
from brokk_rl.spec import Positive, spec


@spec
class Identification:
    """Recordings to fit to and to judge by. Parts of one run always stay together.

    Attributes:
        recordings: Glob, or list of globs, of recordings to fit to.
        test: Glob or globs of unseen recordings to judge by, best of another excitation; `null`
            sets a part of `recordings` aside.
        folds: Cross-validation: each run is judged once, by a model fitted to the other folds; then
            one model is fitted to all runs and kept. For few recordings. `null`: one split.
        hold_out: One part in so many is kept from the fit to stop it by, and another one to judge
            by (without `test`).
        stride_s: Distance between the beginnings of two free runs.
    """

    recordings: str | tuple[str, ...]
    test: str | tuple[str, ...] | None
    folds: Annotated[int, Ge(2)] | None
    hold_out: Annotated[int, Ge(3)]
    stride_s: Positive

    def check(self) -> None:
        if self.folds is not None and self.test is not None:
            raise ConfigError("folds: folds and test are two ways of judging; give one of them")
        for patterns in (self.recordings, self.test):
            if patterns is not None:
                record.find_files(patterns, "recording")
