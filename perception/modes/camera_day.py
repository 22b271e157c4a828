"""`brokk mode=camera_day`: render, calibrate, label, train and perceive in a row, and report.

The report is `camera_day.html`. It compares each step with the truth of the rendered frames, and is
made from the files of the stages: parts of unfinished stages are left out.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from rich.console import Console
from scipy.spatial.transform import Rotation

from brokk_rl import plot, story
from brokk_rl.errors import ConfigError
from brokk_rl.report import Report, Tone
from brokk_rl.session import Session, read_record, write_json
from brokk_rl.spec import spec
from perception import dataset
from perception.benchmark.label_score import compare_corners, compute_overlap
from perception.benchmark.session_score import SessionScore, score_session
from perception.modes.calibrate import FILE as CALIBRATION
from perception.render.board_on_arm import TRUTH
from perception.render.stereo_camera import StereoRig

DAY_FILE, FIGURES_FILE = "camera_day.html", "camera_day.json"
GROUPS = ("rig",)
"""Groups that stages can take from the day."""
PICTURE_PX = 900
"""Width of a picture on the page."""
BOARD, CALIBRATED, FOOTAGE, LABELS, NETWORK, SITE = (
    "board", "calibration", "footage", "labels", "network", "site",
)  # fmt: skip
"""Stages whose files the page reads."""
PERCEIVED = {
    "uncalibrated": "the pair as it is, the camera's place as mounted",
    "perceived": "calibrated",
    "own_network": "calibrated, block by the trained network",
}
"""Stages that leave a `holes.json`, and with what they looked."""


@spec
class CameraDay:
    """Run the steps of a day with a new camera, each in a folder of its own, and compare them with the truth.

    Attributes:
        session: Folder, seed, device.
        rig: The camera pair that is rendered.
        stages: The steps, in order.
        resume: Run folder of an interrupted day; finished stages are kept. The same as
            `session.out`.
    """

    session: Session
    rig: StereoRig
    stages: dict[str, story.StoryStage]
    resume: str | None

    def check(self) -> None:
        if not self.stages:
            raise ConfigError(
                "mode=camera_day has no stages of its own; give some, as experiment=camera_day does"
            )
        story.check_story(self.session, self.stages, self.resume, GROUPS)

    def run(self) -> None:
        """Run the stages that are not finished; write `camera_day.html` after each of them.

        Raises:
            BrokkError: a stage failed; the day goes on from there with `resume=`.
        """
        folder = self.session.folder.resolve()
        story.write_groups(folder, GROUPS)
        titles = {name: stage.title for name, stage in self.stages.items()}
        story.run_story(self.session, self.stages, lambda: write_day(folder, titles))
        Console().print(f"camera day: {self.session.folder / DAY_FILE}", highlight=False)


def write_day(folder: Path, titles: Mapping[str, str]) -> None:
    """Write `camera_day.html`, and its figures as `camera_day.json`.

    Args:
        folder: Run folder of the day, with one folder a stage.
        titles: Purpose of each stage.

    Raises:
        StorageError: it could not be written.
    """
    scores = {}
    for name in PERCEIVED:
        if (folder / name / "holes.json").is_file():
            scores[name] = score_session(folder / name / "holes.json", folder / SITE / "frames")
    page = Report("A day with a new camera", *_summarize_day(scores))
    page.add_text(
        "Every picture is rendered; no figure here comes from a real camera. The steps and "
        "commands are those of a real day, and the renderer knows what each step should find."
    )
    _add_calibration(page, folder)
    _add_labels(page, folder)
    _add_network(page, folder)
    _add_holes(page, folder, scores)
    story.add_stages(page, folder, titles)
    page.write(folder / DAY_FILE)
    write_json(folder / FIGURES_FILE, _collect_figures(folder, scores, list(titles)))


def _collect_figures(
    folder: Path, scores: Mapping[str, SessionScore], stages: list[str]
) -> dict[str, Any]:
    """Return the figures of the page as plain data: holes of each stage, and minutes."""
    rows = {}
    for name, score in scores.items():
        rows[name] = {
            "holes": score.num_holes,
            "found": score.num_found,
            "false": score.num_false,
            "position_m_median": score.compute_position_m(50),
            "position_m_p95": score.compute_position_m(95),
            "inside_3_sigma": score.count_inside(3.0),
        }
    seconds = {}
    for name in stages:
        record = read_record(folder / name)
        if record is not None:
            seconds[name] = story.measure_seconds(record)
    return {"schema": 1, "perceived": rows, "stage_s": seconds}


def _summarize_day(scores: Mapping[str, SessionScore]) -> tuple[str, Tone]:
    score = scores.get("perceived")
    if score is None:
        return "The day goes on.", "plain"
    text = f"After calibration {score.num_found} of {score.num_holes} holes are found, "
    median_m = score.compute_position_m(50)
    if median_m is not None:
        text += f"half of them within {1000 * median_m:.1f} mm. "
    text += f"{score.num_false} targets are no hole."
    good = score.num_found == score.num_holes and not score.num_false
    return text, "good" if good else "warn"


def _add_calibration(page: Report, folder: Path) -> None:
    found = _read_yaml(folder / CALIBRATED / CALIBRATION)
    truth = _read_yaml(folder / BOARD / TRUTH)
    if found is None or truth is None:
        return
    page.add_heading("1. Calibration: a board on the arm")
    _add_frame(page, folder / BOARD / "frames", "The board before the tool.")
    true = np.array(truth["T_base_cam"])
    pose = np.array(found["T_base_cam"])
    away_m = float(np.linalg.norm(pose[:3, 3] - true[:3, 3]))
    turn = Rotation.from_matrix(true[:3, :3].T @ pose[:3, :3]).magnitude()
    std_m, std_rad = np.linalg.norm(found["std_m"]), np.linalg.norm(found["std_rad"])
    rows: list[list[str | float | None]] = [
        ["camera's place, error, mm", "0", f"{1000 * away_m:.2f}", f"{1000 * std_m:.2f}"],
        ["camera's direction, error, mrad", "0", f"{1000 * turn:.2f}", f"{1000 * std_rad:.2f}"],
    ]
    for name, zero in (found.get("joint_zeros") or {}).items():
        true_zero = truth["joint_zeros"].get(name)
        row = [
            f"zero of {name}, mrad",
            f"{1000 * true_zero:.2f}" if true_zero is not None else None,
        ]
        rows.append([*row, f"{1000 * zero['mean']:.2f}", f"{1000 * zero['std']:.2f}"])
    if clock := found.get("clock"):
        rows.append(
            ["camera's clock, s", f"{truth['clock_s']:.3f}", f"{clock['offset_s']:.3f}", None]
        )
    if disparity := found.get("disparity"):
        names = ("disparity's error, px", "its slope across, px", "its slope down, px")
        for name, was, is_now in zip(
            names, truth["disparity_error_px"], disparity["error_px"], strict=True
        ):
            rows.append([name, f"{was:.3f}", f"{is_now:.3f}", f"{disparity['std_px']:.3f}"])
    caption = (
        f"Verdict: {found['verdict']['status']}; {found['num_used']} frames used, "
        f"{found['num_left_out']} left out"
    )
    page.add_table(["", "true", "found", "standard deviation"], rows, caption)


def _add_labels(page: Report, folder: Path) -> None:
    found = _read_json(folder / LABELS / "labels.json")
    if found is None:
        return
    page.add_heading("2. Labels: one block, a board beside it, three clicks")
    kept = [name for name, entry in found["frames"].items() if entry["left_out"] is None]
    overlaps, holes, corners_m = [], [], []
    for name in kept:
        label = dataset.read_label(folder / LABELS / "frames" / name)
        true = dataset.read_label(folder / FOOTAGE / "frames" / name)
        overlaps.append(compute_overlap(label.block, true.block))
        if true.hole_mask.any():
            holes.append(compute_overlap(label.hole_mask, true.hole_mask))
        corners_m.append(
            compare_corners(folder / LABELS / "frames" / name, folder / FOOTAGE / "frames" / name)
        )
    _add_picture(
        page,
        folder / LABELS / "overlays" / f"{kept[len(kept) // 2]}.png",
        "A label: block green, insides of holes red, what hides them orange.",
    )
    rows: list[list[str | float | None]] = [
        ["frames kept", f"{len(kept)} of {len(found['frames'])}"],
        ["overlap with the true block, least and median", _format_pair(overlaps)],
        ["overlap with the true insides of holes", _format_pair(holes)],
        ["corner of the block, largest error, mm", f"{1000 * max(corners_m):.1f}"],
    ]
    page.add_table(["", ""], rows)


def _add_network(page: Report, folder: Path) -> None:
    found = _read_json(folder / NETWORK / "training.json")
    if found is None:
        return
    page.add_heading("3. Training: the network that ships goes on with these labels")
    picture = folder / NETWORK / "samples.png"
    if picture.is_file():
        _add_picture(page, picture, "Frames set aside: labels as lines, the network as colour.")
    curve = found["curve"]
    best = next(one for one in curve if one["update"] == found["best_update"])
    rows: list[list[str | float | None]] = []
    for name, text in (("block", "block"), ("mouth", "inside of holes")):
        rows.append([text, f"{curve[0][name]:.3f}", f"{best[name]:.3f}"])
    frames = found["frames"]
    page.add_table(
        ["overlap", "before", "after"],
        rows,
        f"{frames['train']} frames to train on, {frames['validation']} to judge by, of the same "
        f"block; {found['updates']} updates in {found['seconds']:.0f} s. It shows that the steps "
        "fit together, not how a network does on other blocks",
    )


def _add_holes(page: Report, folder: Path, scores: Mapping[str, SessionScore]) -> None:
    if not scores:
        return
    page.add_heading("4. Perception: other blocks before the camera on the machine")
    overlays = sorted((folder / "perceived" / "overlays").glob("*.png"))
    if overlays:
        _add_picture(page, overlays[0], "A hole, found; its axis and its uncertainty.")
    rows: list[list[str | float | None]] = []
    for name, score in scores.items():
        median, high = (score.compute_position_m(part) for part in (50, 95))
        rows.append(
            [
                PERCEIVED[name],
                f"{score.num_found} of {score.num_holes}",
                f"{score.num_false}",
                None if median is None else f"{1000 * median:.1f}",
                None if high is None else f"{1000 * high:.1f}",
                f"{score.count_inside(3.0)} of {len(score.errors)}",
            ]
        )
    page.add_table(
        ["", "holes found", "no hole", "median, mm", "95 %, mm", "inside 3 σ"],
        rows,
        "Errors of the centre in the base frame; σ as each hole states it",
    )
    page.add_picture(_draw_errors(scores), "Errors by distance; lines reach to 1 σ as stated.")


def _draw_errors(scores: Mapping[str, SessionScore]) -> Any:
    """Return a figure of errors over distance, with the stated standard deviations."""
    figure = plot.make_figure(8.0, 3.4)
    axis = figure.add_subplot()
    colours = (plot.GREY, plot.BLUE, plot.ORANGE)
    for (name, score), colour, marker in zip(scores.items(), colours, "xos", strict=False):
        distance = [one.distance_m for one in score.errors]
        axis.plot(
            distance,
            [1000 * one.position_m for one in score.errors],
            marker,
            color=colour,
            label=PERCEIVED[name],
        )
        axis.vlines(distance, 0, [1000 * one.std_m for one in score.errors], colour, alpha=0.4)
    axis.set(xlabel="distance, m", ylabel="error of the centre, mm", ylim=(0, None))
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(frameon=False, loc="upper left")
    return figure


def _format_pair(values: list[float]) -> str | None:
    return f"{min(values):.3f}, {np.median(values):.3f}" if values else None


def _add_frame(page: Report, folder: Path, caption: str) -> None:
    stems = dataset.list_stems(folder)
    _add_picture(page, stems[len(stems) // 2].with_suffix(dataset.COLOR), caption)


def _add_picture(page: Report, path: Path, caption: str) -> None:
    """Add a picture, smaller, so that the page stays a few MB."""
    picture = cv2.imread(str(path))
    if picture is None:
        return
    small = path.parents[1] / "page" / f"{path.parent.name}_{path.name.split('.')[0]}.jpg"
    small.parent.mkdir(exist_ok=True)
    scale = min(1.0, PICTURE_PX / picture.shape[1])
    cv2.imwrite(
        str(small), cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    )
    page.add_picture(small, caption)


def _read_yaml(path: Path) -> dict[str, Any] | None:
    return yaml.safe_load(path.read_text()) if path.is_file() else None


def _read_json(path: Path) -> dict[str, Any] | None:
    return json.loads(path.read_text()) if path.is_file() else None
