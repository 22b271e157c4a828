"""Exams that rivals sit: who sits, and the options that make and score them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Sitting:
    """One exam with rivals.

    Attributes:
        name: Name of the files with the results.
        rivals: Modules of the adapters.
        options: Options of `mode=exam` that score it, beside step, folders and workers.
        run_options: Those by which rivals answer.
        development: Those of the exam on which rules are chosen.
    """

    name: str
    rivals: tuple[str, ...]
    options: tuple[str, ...]
    run_options: tuple[str, ...]
    development: tuple[str, ...]


SERVOS = ("machine=so101", "exam_plants=servos", "exam_mix=servos")
SITTINGS = {
    "held_out": Sitting(
        name="rivals",
        rivals=("mujoco_sysid", "pace"),
        options=("exam_protocol=sealed", "session.seed=1000"),
        run_options=(),
        development=("session.seed=611", "exam.mix.num_cases=24"),
    ),
    "servos": Sitting(
        name="servos",
        rivals=("servo_sysid", "servo_pace", "servo_bam"),
        options=(*SERVOS, "fit@exam.fit=servo"),
        run_options=SERVOS,
        development=("session.seed=702", "exam.mix.num_cases=24"),
    ),
}


def describe_command(sitting: str) -> str:
    """Return the command that writes the results of a sitting, for its files."""
    return f"python benchmarks/exam/rivals/run_sitting.py {sitting} <exam> <marks> <work>"
