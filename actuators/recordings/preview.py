"""Contract of previews: which effects some motions could tell, and which they could not."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from brokk_rl.machine import Machine
    from brokk_rl.record import Recording

PreviewCallback = Callable[[str, float], None]
"""Receives the name of the step and the share of the whole that is done."""


@dataclass(frozen=True)
class EffectLimit:
    """Smallest size of an effect that would show in the motions.

    Sizes are distances from the value at which the effect does nothing.

    Attributes:
        effect: Name of the effect.
        number: Which of its numbers.
        joints: Joints that it is told on: one, or all where one cause is behind them.
        unit: SI unit of the sizes; `1` for none.
        typical: Typical size there.
        smallest: Smallest size that would be told; `None`: none of those that were tried.
        shows_in: Part of the recordings that shows it: `motion`, `scatter`, `frames`, `tool points`.
    """

    effect: str
    number: str
    joints: tuple[str, ...]
    unit: str
    typical: float
    smallest: float | None
    shows_in: str

    @property
    def is_told(self) -> bool:
        """True where the typical size would be told."""
        return self.smallest is not None and self.smallest <= self.typical


@dataclass(frozen=True)
class LookalikePair:
    """Two effects that cannot be told apart in the motions.

    Attributes:
        effects: Their names.
        joints: Joints on which they look alike.
    """

    effects: tuple[str, str]
    joints: tuple[str, ...]


@dataclass(frozen=True)
class PreviewResult:
    """Answer of a preview.

    Attributes:
        minutes: Length of the motions.
        limits: Effects, number by number and joint by joint.
        pairs: Effects that look alike.
        assumed: Simulator, price and expected errors that the answer rests on, plain JSON data.
    """

    minutes: float
    limits: tuple[EffectLimit, ...]
    pairs: tuple[LookalikePair, ...]
    assumed: dict[str, Any]

    def plain(self) -> dict[str, Any]:
        """Return it as plain JSON data."""
        rows = [asdict(one) | {"told": one.is_told} for one in self.limits]
        pairs = [asdict(one) for one in self.pairs]
        return {
            "minutes": self.minutes,
            "assumed": self.assumed,
            "effects": rows,
            "look_alike": pairs,
        }


class EffectPreview(Protocol):
    """The spec in `conf/preview.yaml`: foretells what a diagnosis could tell from some motions."""

    def assess(
        self,
        motions: Sequence[Recording],
        machine: Machine,
        tell: PreviewCallback,
        are_measured: bool,
    ) -> PreviewResult:
        """Return which effects these motions could tell.

        Args:
            motions: Recordings, or motions that are planned.
            machine: The machine.
            tell: Receives the progress.
            are_measured: The positions are readings of the machine's sensors, so that their noise
                is that of the recordings.

        Raises:
            RecordingError: no motion is long enough for a free run.
        """
        ...
