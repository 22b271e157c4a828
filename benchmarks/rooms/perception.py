"""Measurements of the borehole finder on rendered stereo pairs."""

from __future__ import annotations

from pathlib import Path

from measurement import Measurement, Table, load_json

CODE = ("perception", "conf/perception", "conf/stereo.yaml", "conf/scene", "conf/rig")


def read_holes(folder: Path) -> Table:
    """Return recall and errors for each condition and distance."""
    rows: Table = []
    for one in load_json(folder / "table.json"):
        row = {"condition": one["condition"], "distance, m": one["distance_m"]}
        for title, name, digits in (
            ("found", "recall", 2),
            ("discs taken for holes", "decoys_accepted", 2),
            ("position, mm, 95 %", "position_mm_p95", 1),
            ("inside 1 sigma, along", "along_inside_1_sigma", 2),
        ):
            row[title] = None if one[name] is None else round(one[name], digits)
        rows.append(row)
    return rows


MEASUREMENTS = (
    Measurement(
        name="holes",
        title="Boreholes in rendered pictures",
        conditions="Stereo pairs of 1080p by a perfect rig, scenes of seed 7. No picture of a real block was seen. In `decoy` and `empty` flat discs or nothing stand in the place of holes.",
        commands=(
            "python benchmarks/perception/table.py {out} plane_conic --count 12 --seed 7 --render rig/sensor=mosaic",
        ),
        code=CODE,
        read=read_holes,
        where="two cores, 60 min",
    ),
)
