"""Measurements of the diagnosis."""

from __future__ import annotations

from pathlib import Path

from measurement import Measurement, Table, load_json

from exam.metrics import METRICS

CODE = ("diagnosis", "actuators/effects", "actuators/models", "actuators/identify")


def read_marks(folder: Path) -> Table:
    """Return every rate of the marks of an exam."""
    marks = load_json(folder / "marks/marks.json")["candidates"]["diagnosis"]
    rows: Table = []
    for name, metric in METRICS.items():
        one = marks.get(name)
        if one is not None and one["value"] is not None:
            low, high = one["ci95"]
            title = metric.title.replace("  ", "… ")
            row = {"": title, "reached": round(one["value"], 2), "of": one["of"]}
            row["95 %"] = f"{low:.2f} to {high:.2f}"
            rows.append(row)
    return rows


def list_exam_commands(words: str, num_cases: int, run: str, score: str) -> tuple[str, ...]:
    """Return the commands that make an exam, answer it and open its labels, each with words of its own."""
    begin = f"brokk mode=exam {words}"
    return (
        f"{begin} exam_protocol=sealed exam.mix.num_cases={num_cases} session.seed=<random, 1000 or more> exam.workers=2 session.out={{out}}/exam",
        f"{begin} {run} exam.do=run exam.folder={{out}}/exam session.out={{out}}/answers exam.workers=2",
        f"{begin} {score} exam.do=score exam.folder={{out}}/exam +exam.answers.diagnosis={{out}}/answers session.out={{out}}/marks",
    )


MEASUREMENTS = (
    Measurement(
        name="exam_valves",
        title="Sealed exam: machines with valves",
        conditions="150 simulated machines of a make that nothing was fitted to until then (`held_out`, today `valves`), answered once, sealed by a hash. An earlier engine had 0.58 of 105, exact sets 0.20 of 60. Baseline: one name always.",
        commands=list_exam_commands(
            "exam_plants=valves", 150, "exam_candidate=diagnosis", "fit@exam.fit=valve"
        ),
        code=(*CODE, "exam"),
        read=read_marks,
        where="two cores",
        minutes=600,
    ),
    Measurement(
        name="exam_servos",
        title="Sealed exam: tabletop arms of position servos",
        conditions="100 simulated arms, the fourth sealed exam of this kind. An earlier engine had 33 of 35 single effects. Baseline: one name always.",
        commands=list_exam_commands(
            "machine=so101 exam_plants=servos exam_mix=servos",
            100,
            "exam_candidate=servo_diagnosis",
            "fit@exam.fit=servo",
        ),
        code=(*CODE, "exam"),
        read=read_marks,
        where="two cores",
        minutes=300,
    ),
    Measurement(
        name="ablations",
        title="What each ingredient of the diagnosis earns",
        conditions="The same development cases of valves, answered with one ingredient of the engine switched off. The baseline is the first row, with nothing switched off.",
        commands=(
            "brokk mode=exam exam.mix.num_cases=100 session.seed=78 exam.workers=32 session.out={out}/exam",
            "python benchmarks/diagnosis/ablations.py {out}/ablations.json {out}/exam --workers 32",
        ),
        code=CODE,
        read=lambda folder: load_json(folder / "ablations.json")["rows"],
        where="32 cores",
        minutes=30,
    ),
)
