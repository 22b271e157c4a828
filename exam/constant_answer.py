"""A candidate that gives every case the same answer, whose score any other has to beat."""

from __future__ import annotations

from pathlib import Path

from brokk_rl.machine import Machine
from brokk_rl.spec import Share, spec
from diagnosis.answer import ANSWER_FILE, Answer, Ranked, Selected, Verdict, Where


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
        build_single_answer(self.effect, machine.joint_names, self.probability).write(
            out / ANSWER_FILE
        )


def build_single_answer(effect: str | None, joints: tuple[str, ...], probability: float) -> Answer:
    """Return an answer that names one effect, or `none`, and nothing else."""
    verdict: Verdict = "effects" if effect else "none"
    selected = (
        Selected(
            effect=effect, joints=joints, probability=probability, parameters={}, gap_closed=None
        )
        if effect
        else None
    )
    return Answer(
        verdict=verdict,
        selected=(selected,) if selected else (),
        ranking=(Ranked(effect or "none", joints if effect else (), probability),),
        where=Where({}, (), None),
        gap=None,
        next_experiment=None,
    )
