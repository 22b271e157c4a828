"""An exam on disk: cases in random order, their labels sealed, and what each cause does to the motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from brokk_rl.machine import Machine
from exam.making import Half, Made, Workshop
from exam.mix import Question

CASES = "cases"
HORIZON_S = 5.0


def write(
    workshop: Workshop,
    questions: Sequence[Question],
    reference: Half,
    field: Half,
    machine: Machine,
    folder: Path,
    workers: int,
    advance: Callable[[int], None],
) -> list[dict[str, Any]]:
    """Records all cases into `folder/cases/<id>`, in so many `workers`; returns their labels, plain JSON, in the same order."""
    names = [f"{number:04d}" for number in range(len(questions))]
    folders = [folder / CASES / name for name in names]
    halves = [
        workshop.planned(questions, half, is_field)
        for half, is_field in ((reference, False), (field, True))
    ]
    _, made = (workshop.record(jobs, folders, workers, advance) for jobs in halves)
    return [
        label(name, question, half, machine)
        for name, question, half in zip(names, questions, made, strict=True)
    ]


def label(name: str, question: Question, field: Made, machine: Machine) -> dict[str, Any]:
    """Returns what is true about a case.

    `moved_rad`: root mean square of what its cause changes of the measured motion in 5 s from equal
    beginnings, by joint.
    """
    return {
        "case": name,
        "kind": question.kind,
        "tracked": question.tracked,
        "effects": [
            {
                "effect": fault.effect,
                "joints": list(fault.joints),
                "size": fault.size,
                "parameters": {
                    key: {
                        joint: float(fault.parameters[key][machine.joint_names.index(joint)])
                        for joint in fault.joints
                    }
                    for key in fault.drawn
                },
                "nothing": fault.drawn,
            }
            for fault in question.faults
        ],
        "outside": None
        if question.ailment is None
        else {
            "ailment": question.ailment.kind,
            "joints": list(question.joints),
            "size": question.size,
        },
        "moved_rad": dict(zip(machine.joint_names, moved(field, machine).tolist(), strict=True)),
        "machine_seed": question.machine_seed,
        "chance": question.chance,
    }


def moved(field: Made, machine: Machine) -> np.ndarray:
    """Returns what the cause changes of the motion in windows of 5 s that begin alike, root mean square, `(J,)`."""
    steps, total, count = round(HORIZON_S / machine.period_s), 0.0, 0
    for q, without in zip(field.q, field.without_q, strict=True):
        apart = (q - without).astype(float)
        for begin in range(0, len(apart) - steps, steps // 2):
            growth = apart[begin + 1 : begin + 1 + steps] - apart[begin]
            total, count = total + (growth**2).sum(0), count + steps
    return np.sqrt(total / max(count, 1))
