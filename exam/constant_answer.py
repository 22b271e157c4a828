"""A candidate that gives every case the same answer, whose score any other has to beat."""

from __future__ import annotations

from pathlib import Path

from brokk_rl.machine import Machine
from brokk_rl.spec import Share, spec
from diagnosis.answer import ANSWER_FILE, Answer, Ranked, Selected, Verdict


@spec
class ConstantAnswer:
    """Give the same answer to every case: an effect on all joints, or no gap.

    Attributes:
        effect: The effect; `null` for none.
        probability: With which it is stated.
    """

    effect: str | None
    probability: Share

    def answer(self, case: Path, out: Path, machine: Machine) -> None:
        """Write it."""
        out.mkdir(parents=True, exist_ok=True)
        verdict: Verdict = "none"
        joints: tuple[str, ...] = ()
        selected: tuple[Selected, ...] = ()
        if self.effect is not None:
            verdict, joints = "effects", machine.joint_names
            named = {"effect": self.effect, "joints": joints, "probability": self.probability}
            selected = (Selected(**named, parameters={}, gap_closed=None),)
        said = Answer(
            verdict=verdict,
            selected=selected,
            ranking=(Ranked(self.effect or "none", joints, self.probability),),
            gap=None,
        )
        said.write(out / ANSWER_FILE)
