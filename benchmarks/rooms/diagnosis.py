"""Measurements of the diagnosis."""

from __future__ import annotations

from pathlib import Path

from measurement import Measurement, Table, load_json

from exam.metrics import METRICS

CODE = (
    "diagnosis", "actuators/effects", "actuators/models", "actuators/identify",
    ":(exclude)actuators/identify/force_fit.py",  # of drives by force; no exam has one
)  # fmt: skip


def read_marks(folder: Path) -> Table:
    """Return every rate of the marks of an exam."""
    marks = load_json(folder / "marks/marks.json")["candidates"]["diagnosis"]
    rows: Table = []
    for name, metric in METRICS.items():
        one = marks.get(name)
        if one is not None and one["value"] is not None:
            low, high = one["ci95"]
            row = {"": metric.title, "reached": round(one["value"], 2), "of": one["of"]}
            row["95 %"] = f"{low:.2f} to {high:.2f}"
            rows.append(row)
    return rows


def describe_exam(
    make: str, title: str, conditions: str, words: str, num_cases: int, candidate: str, fit: str
) -> Measurement:
    """Return the measurement of a sealed exam, whose steps share the options `words`."""
    begin = f"brokk mode=exam {words}"
    return Measurement(
        name=f"exam_{make}",
        title=f"Sealed exam: {title}",
        conditions=f"{conditions} Baseline: one name always.",
        commands=(
            f"{begin} exam_protocol=sealed exam.mix.num_cases={num_cases} session.seed=<random, 1000 or more> exam.workers=2 session.out={{out}}/exam",
            f"{begin} exam_candidate={candidate} exam.do=run exam.folder={{out}}/exam session.out={{out}}/answers exam.workers=2",
            f"{begin} fit@exam.fit={fit} exam.do=score exam.folder={{out}}/exam +exam.answers.diagnosis={{out}}/answers session.out={{out}}/marks",
        ),
        code=(*CODE, "exam"),
        read=read_marks,
        where=f"two cores, {num_cases} min",
    )


MEASUREMENTS = (
    describe_exam(
        "valves", "machines with valves",
        "32 machines, answered once. A person drives 14 fields. The diagnosis has their equation of lag. Before: 64/81, 21/47, 2/35 of 232 others. On a plant from elsewhere 36/48, 3/12, 1/11 of 80 new machines, 5/9 unknown, by 3eca3039; before 271/364, 33/85, 9/86 of 640.",
        "exam_plants=valves exam_recording=operators", 32, "diagnosis", "valve",
    ),
    describe_exam(
        "circuits", "cranes on three hydraulic circuits",
        "16 cranes, answered once. A person drives 7 fields. Before: 26/41, 7/23, 2/17 of 116 others.",
        "machine=crane exam_plants=circuits exam_mix=circuits exam_recording=operators", 16, "diagnosis", "valve",
    ),
    describe_exam(
        "servos", "tabletop arms of position servos",
        "24 arms, answered once. Before: 44/44, 15/25, 0/19 of 126 others.",
        "machine=so101 exam_plants=servos exam_mix=servos", 24, "servo_diagnosis", "servo",
    ),
    Measurement(
        name="ablations",
        title="What the ingredients of the diagnosis decide",
        conditions="96 practice machines of two draws; rows of 48 hold the first one. By 1602d216, of those 48: without ageing 13/17 alone, without variance by motion 7/17, 2/10 and 2/7 accused. Just before 3eca3039 28/34, 12/20, 15/18.",
        commands=(
            "python benchmarks/diagnosis/ablations.py {out}/ablations.json <an exam: exam_plants=valves exam_recording=operators session.seed=71 exam.mix.num_cases=48> <another: session.seed=72>",
        ),
        code=CODE,
        read=lambda folder: load_json(folder / "ablations.json")["rows"],
        where="16 cores, 40 min",
    ),
)  # fmt: skip
