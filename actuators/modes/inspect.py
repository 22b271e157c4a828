"""`brokk mode=inspect`: shows the contents of recordings, broken ones too."""

import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from actuators.identify import dead_time
from actuators.motion_panels import Shade, draw_joint_tracks
from actuators.recordings.inspection import (
    Inspection,
    RecordingFinding,
    inspect_recording,
    to_json_number,
)
from actuators.recordings.recording_checks import REMARKS, list_remarks, tabulate_remarks
from brokk_rl import record
from brokk_rl.console_table import print_table, print_text
from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from brokk_rl.plot import save_figure
from brokk_rl.progress import track_items
from brokk_rl.record import Breach
from brokk_rl.report import embed_picture, render_page
from brokk_rl.session import Session, write_json, write_text
from brokk_rl.spec import Index, spec

log = logging.getLogger(__name__)

PAGE_FILE = "inspection.html"
TEMPLATE = Path(__file__).with_name("inspection.html.jinja")
JOINTS = ["joint", "measured", "limits", "commanded", "at limit", "noise", "step", "dead time"]
OVERALL = {"lowest": "min", "highest": "max", "fastest": "max", "noise": "median", "step": "median"}
"""Figure over all recordings of those that are no means."""
FINDING, BREACH = "#e69f00", "#b00020"
THINNEST = 0.002
"""A finding is drawn at least this wide, as a part of the picture, so that a single row can be
seen."""

FILES = ["file", "minutes", "rate", "jitter", "breaches", "findings"]


@spec
class InspectionRequest:
    """Recordings to inspect.

    Attributes:
        recordings: Glob, or list of globs, of recordings.
        pictures: One picture a recording up to so many recordings, beyond that those with the most
            findings.
    """

    recordings: str | tuple[str, ...]
    pictures: Index

    def check(self) -> None:
        record.find_files(self.recordings, "recording")  # refused before torch is loaded


@dataclass(frozen=True)
class InspectedFile:
    """One file: its format breaches, and its inspection where it could be read."""

    path: Path
    breaches: list[Breach]
    inspection: Inspection | None

    @property
    def minutes(self) -> float:
        """Length of the recording."""
        return (self.inspection.timing["duration_s"] or 0.0) / 60.0 if self.inspection else 0.0

    @property
    def findings(self) -> list[RecordingFinding]:
        """Findings, none of a file that cannot be read."""
        return self.inspection.findings if self.inspection else []

    @property
    def num_remarks(self) -> int:
        """Number of breaches and findings."""
        return len(self.breaches) + len(self.findings)

    def plain(self) -> dict[str, Any]:
        """Return it as plain JSON data."""
        seen = self.inspection
        return {
            "path": str(self.path),
            "run": seen and seen.recording.run,
            "num_samples": seen and seen.recording.num_samples,
            "breaches": [asdict(breach) for breach in self.breaches],
            "timing": seen and seen.timing,
            "joints": seen and seen.joints,
            "findings": [asdict(finding) for finding in self.findings],
        }

    def format_row(self) -> list[str]:
        """Return the cells of the table of recordings."""
        timing = self.inspection.timing if self.inspection else {}
        return [
            self.path.name,
            f"{self.minutes:.1f}",
            _format(timing.get("rate_hz"), "{:.2f} Hz"),
            _format(timing.get("jitter_s"), "{:.4f} s"),
            str(len(self.breaches) or "–"),
            str(len(self.findings) or "–"),
        ]


@spec
class Inspect:
    """Shows rates, gaps, ranges, noise, format breaches and findings of recordings."""

    session: Session
    machine: Machine
    inspect: InspectionRequest

    def run(self) -> None:
        """Write `inspection.json`, `inspection.html` and pictures, and print the tables.

        Raises:
            RecordingError: no recording matches; a broken one is no error here.
            StorageError: a file could not be written.
        """
        paths = record.find_files(self.inspect.recordings, "recording")
        inspected = [self._look(path) for path in track_items(paths, "inspecting")]
        folder = self.session.folder
        known = [one.inspection for one in inspected if one.inspection]
        remarks = list_remarks(known, self.machine)
        result = {
            "schema": 1,
            "machine": self.machine.name,
            "delay_s": self._delays(inspected),
            "joints": self._overall(known),
            "recordings": [one.plain() for one in inspected],
        }
        write_json(folder / "inspection.json", result)
        tables = {
            "recordings": (FILES, [one.format_row() for one in inspected]),
            "joints, all recordings": (JOINTS, self._figures(result)),
            "findings": tabulate_remarks(remarks),
        }
        pictures: dict[str, str] = {}
        for one in sorted(inspected, key=lambda one: -one.num_remarks)[: self.inspect.pictures]:
            if one.inspection:
                path = folder / f"{one.path.stem}.png"
                draw_recording(path, self.machine, one.inspection, one.breaches)
                pictures[one.path.name] = embed_picture(path)
        values = {
            "title": f"Recordings of {self.machine.name}",
            "inspected": inspected,
            "tables": tables,
            "pictures": pictures,
            "kinds": REMARKS,
        }
        write_text(folder / PAGE_FILE, render_page(TEMPLATE, values))
        for title, (head, rows) in tables.items():
            print_table(head, rows, title)
        for one in inspected:
            for breach in one.breaches:
                print_text(f"{one.path}: {breach}")
        log.info("report: %s", folder / PAGE_FILE)

    def _look(self, path: Path) -> InspectedFile:
        recording, breaches = record.examine_recording(path, self.machine)
        found = None
        if recording is not None and recording.num_samples > 1:
            found = inspect_recording(recording, self.machine)
        return InspectedFile(path, breaches, found)

    def _delays(self, inspected: Sequence[InspectedFile]) -> dict[str, Any]:
        """Return each joint's dead time from all sound recordings, `None` where unknown."""
        generator = self.session.generator("delay")
        files = [one for one in inspected if not one.breaches]
        sound = [one.inspection.recording for one in files if one.inspection]
        try:
            found = dead_time.estimate_dead_times(sound, self.machine, generator)
        except RecordingError:
            return dict.fromkeys(self.machine.joint_names)
        return {name: one and one.plain() for name, one in found.items()}

    def _overall(self, known: Sequence[Inspection]) -> dict[str, dict[str, float | None]]:
        """Return figures of each joint over all recordings: extremes, medians and weighted means."""
        seconds = [max(one.timing["duration_s"] or 0.0, 1e-9) for one in known]
        table = {}
        for joint in self.machine.joints:
            limits = {"lower_limit": joint.lower.value, "upper_limit": joint.upper.value}
            rows = pd.DataFrame([one.joints[joint.name] for one in known], dtype=float)
            weights: Any = rows.notna().mul(seconds, axis=0)
            figures = (rows * weights).sum() / weights.sum()
            for key in OVERALL.keys() & rows:
                figures[key] = rows[key].agg(OVERALL[key])
            table[joint.name] = limits | {key: to_json_number(figures[key]) for key in rows}
        return table

    def _figures(self, result: dict[str, Any]) -> list[list[str]]:
        """Return the cells of the table of joints."""
        rows = []
        for joint in self.machine.joints:
            entry, delay = result["joints"][joint.name], result["delay_s"][joint.name]
            ends = ("lowest", "highest", "lower_limit", "upper_limit")
            low, high, lower, upper = (_format(entry.get(key), "{:.2g}") for key in ends)
            row = [joint.name, f"{low} … {high} {joint.unit}", f"{lower} … {upper}"]
            row += [_format(entry.get(key), "{:.1%}") for key in ("commanded", "at_limit")]
            row += [_format(entry.get(key), "{:.2g}") for key in ("noise", "step")]
            rows.append([*row, _format(delay and delay["value"], "{:.2f} s")])
        return rows


def _format(value: float | None, form: str) -> str:
    return "–" if value is None else form.format(value)


def draw_recording(
    path: Path, machine: Machine, inspection: Inspection, breaches: Sequence[Breach]
) -> None:
    """Draw commands, positions, findings (shaded) and breaches (lines) as PNG."""
    recording = inspection.recording
    t_s, shades = recording.t_s, []
    span_s = float(np.nanmax(t_s) - np.nanmin(t_s))
    for one in inspection.findings:
        end_s = one.t_s + max(one.duration_s, THINNEST * span_s)
        joint = None if one.joint is None else machine.joint_names.index(one.joint)
        shades.append(Shade(joint, one.t_s, end_s, FINDING))
    figure, axes = draw_joint_tracks(machine, t_s, recording.q, recording.u, shades)
    for joint, axis in zip(machine.joints, axes, strict=True):
        own = {f"u_{joint.name}", f"q_{joint.name}_{joint.unit}", "t_s"}
        for breach in breaches:
            if breach.row is not None and breach.column in own and np.isfinite(t_s[breach.row]):
                axis.axvline(t_s[breach.row], color=BREACH, linewidth=1.0)
    name = recording.path.name if recording.path else "recording"
    title = f"{name}: findings are shaded, breaches of the format are vertical lines"
    figure.suptitle(title, x=0.01, ha="left", fontsize=12)
    save_figure(figure, path)
