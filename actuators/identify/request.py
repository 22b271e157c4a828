"""Request of an identification: which recordings a model is fitted to, and how it is judged.

Nothing here needs torch, so that the command refuses bad values before it is loaded.
"""

from __future__ import annotations

from brokk_rl.errors import ConfigError
from brokk_rl.spec import spec


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
        threads: CPU threads for the fit; the networks are so small that one is fastest, above all
            beside other work.
    """

    recordings: str | tuple[str, ...]
    test: str | tuple[str, ...] | None
    folds: int | None
    hold_out: int
    stride_s: float
    threads: int

    def check(self) -> None:
        if self.hold_out < 3:
            raise ConfigError(f"identify.hold_out: expected 3 or more, got {self.hold_out}")
        if self.threads < 1:
            raise ConfigError(f"identify.threads: expected 1 or more, got {self.threads}")
        if self.stride_s <= 0:
            raise ConfigError(f"identify.stride_s: expected more than 0, got {self.stride_s}")
        if self.folds is not None and self.folds < 2:
            raise ConfigError(
                f"identify.folds: expected 2 or more, or null for one split, got {self.folds}"
            )
        if self.folds is not None and self.test is not None:
            raise ConfigError("identify: folds and test are two ways of judging; give one of them")
