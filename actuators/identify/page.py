"""Report of an identification: one HTML page, the verdict first, pictures beside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from actuators.identify.results import HOLD, LINEAR, VerdictSentence
from actuators.identify.scores import REGIMES
from brokk_rl.machine import Machine
from brokk_rl.plot import save_figure
from brokk_rl.report import Cell, Report

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE = "identification.html"


def write_page(
    folder: Path,
    result: Mapping[str, Any],
    findings: Sequence[VerdictSentence],
    drawings: Mapping[str, Figure],
    machine: Machine,
) -> None:
    """Write the pictures as `<stem>.png` and the page `identification.html` into `folder`.

    Raises:
        StorageError: something could not be written.
    """
    for stem, figure in drawings.items():
        save_figure(figure, folder / f"{stem}.png")
    page = Report(
        f"{result['model']}, actuator model of {machine.name}", findings[0].text, findings[0].tone
    )
    for finding in findings[1:]:
        page.add_text(finding.text, finding.tone)
    _add_usage(page, result, machine)
    page.add_heading("Measured and predicted")
    caption = (
        "Free runs on runs the model has not seen: it is given the recorded commands (grey, below) and its own predictions. "
        "Typical: the window of median error among those in which the joint is commanded; liveliest: of the longest way; worst: of "
        "the largest error. Red dots: end of travel."
    )
    page.add_picture(folder / "prediction.png", caption)
    _add_errors(page, result, folder, machine)
    _add_comparisons(page, result)
    _add_regimes(page, result, folder)
    _add_dead_times(page, result, folder, machine)
    _add_data(page, result)
    page.write(folder / PAGE)


def _add_usage(page: Report, result: Mapping[str, Any], machine: Machine) -> None:
    page.add_heading("Use it")
    if not result["use"]:
        page.add_text(
            f"No option of the group actuator loads {result['model']}: it is there to compare with."
        )
        return
    use = result["use"]
    if machine.mjcf is None:
        page.add_text(
            f"{machine.name} is known by its joints only; with a model of its bodies (mjcf) policies can be trained through this:"
        )
    page.add_code(
        f"brokk mode=train {use}\nbrokk mode=evaluate policy=<run folder> {use}\nbrokk mode=bench {use}"
    )


def _add_errors(page: Report, result: Mapping[str, Any], folder: Path, machine: Machine) -> None:
    page.add_heading("Error of free runs")
    horizons = list(result["overall"][result["model"]])
    rows = []
    for joint, models in result["joints"].items():
        unit = machine.joints[machine.joint_names.index(joint)].unit
        for number, (name, figures) in enumerate(models.items()):
            first = result["one_step"][joint]
            cells = [_format_percent(first[name], [row["percent"] for row in first.values()], unit)]
            cells += [
                _format_percent(
                    figures[h], [row[h]["percent"] for row in models.values() if row[h]], unit
                )
                for h in horizons
            ]
            rows.append([joint if number == 0 else "", name, *cells])
    for number, (name, figures) in enumerate(result["overall"].items()):
        cells = []
        for h in horizons:
            cells.append(
                _format_percent(
                    figures[h],
                    [row[h]["percent"] for row in result["overall"].values() if row[h]],
                    "",
                )
            )
        rows.append(["all joints" if number == 0 else "", name, None, *cells])
    windows, judged = result["data"]["windows"], result["data"]["test"]
    caption = (
        f"Root mean square error at the end of the horizon, % of travel; below it rad or m. {windows} windows of {judged['runs']} "
        f"runs, {judged['minutes']:g} minutes. ▸ smallest. One step hardly separates models: it is there to show that."
    )
    page.add_table(["joint", "model", "one step", *(f"{h} s" for h in horizons)], rows, caption)
    page.add_picture(
        folder / "error_over_horizon.png",
        "Error over the time of the free run. Bands: 95 % intervals from resampling whole runs.",
    )
    last = [h for h in horizons if result["overall"][result["model"]][h]][-1]
    rows = [
        [
            joint,
            *(
                f"{models[result['model']][last][key]:.4f}"
                for key in ("path_mean", "end_mean", "path_rmse", "rmse")
            ),
        ]
        for joint, models in result["joints"].items()
    ]
    with page.add_details(f"Along the path and at its end, {result['model']} over {last} s"):
        caption = "rad or m. Mean: of the absolute error."
        page.add_table(
            ["joint", "mean, path", "mean, end", "RMSE, path", "RMSE, end"], rows, caption
        )


def _add_comparisons(page: Report, result: Mapping[str, Any]) -> None:
    model, rivals = result["model"], result["against"]
    page.add_heading("Is it really better?")
    page.add_text(
        f"The part of a rival's error that {model} does away with, %, with 95 % intervals from resampling the same runs for both; "
        "▸ better beyond doubt: the interval excludes 0."
    )
    for rival in sorted(rivals, key=lambda name: name == HOLD):
        rows = []
        for joint, figures in rivals[rival].items():
            rows.append(
                [
                    "all joints" if joint == "overall" else joint,
                    *(
                        row
                        and Cell(
                            f"{row['reduction_percent']:.0f}",
                            _format_range(row["reduction_ci95"], ".0f"),
                            _is_surely_better(row),
                        )
                        for row in figures.values()
                    ),
                ]
            )
        columns = ["joint", *(f"{horizon} s" for horizon in rivals[rival]["overall"])]
        with page.add_details(f"against {rival}", is_open=rival == LINEAR):
            page.add_table(columns, rows)


def _add_regimes(page: Report, result: Mapping[str, Any], folder: Path) -> None:
    page.add_heading("Where it fails")
    text = (
        "Free runs cut into seconds, by the commands that were acting (those of a dead time before) and by where the joint was. A "
        "drift while the joint should rest points at leaks or a model that creeps; more drift with others than alone at a shared "
        "pump; after a reversal at play or hysteresis; at small commands at the dead band."
    )
    page.add_picture(folder / "regimes.png", text)
    model, rows = result["model"], []
    for joint, cells in result["regimes"].items():
        for number, regime in enumerate(name for name in REGIMES if name in cells):
            cell = cells[regime]
            figure = cell["models"][model]
            shares = f"{100 * cell['time']:.0f}", f"{100 * figure['share']:.0f}"
            rows.append(
                [
                    joint if number == 0 else "",
                    regime,
                    *shares,
                    Cell(f"{figure['drift_per_s']:.5f}", _format_range(figure["ci95"], ".5f")),
                ]
            )
    with page.add_details(f"The same for {model} in figures"):
        page.add_table(
            ["joint", "regime", "% of the time", "% of squared drift", "drift per s, rad or m"],
            rows,
            "Regimes overlap: shares do not add up.",
        )


def _add_dead_times(
    page: Report, result: Mapping[str, Any], folder: Path, machine: Machine
) -> None:
    page.add_heading("Dead time")
    caption = (
        "What is left of the motion's variance when a static curve of the command, delayed by so much, has explained its part. The "
        "lag of spool and oil counts as delay here: this is the time a controller has to look ahead."
    )
    page.add_picture(folder / "dead_time.png", caption)
    rows = [
        [joint, None, None] if delay is None else
        [joint, Cell(f"{delay['value']:.2f}", _format_range(delay["ci95"], ".3f")), f"{100 * delay['explained']:.1f}"]
        for joint, delay in result["delay_s"].items()
    ]  # fmt: skip
    page.add_table(
        ["joint", "dead time, s", "% explained"],
        rows,
        f"machine '{machine.name}': dead_time_s = {machine.dead_time_s:g}",
    )


def _add_data(page: Report, result: Mapping[str, Any]) -> None:
    page.add_heading("Data and fit")
    data = result["data"]
    rows = [
        [
            label,
            str(data[part]["runs"]),
            str(data[part]["recordings"]),
            f"{data[part]['minutes']:.1f}",
            "; ".join(data[part]["sources"]),
        ]
        for label, part in (
            ("to fit to", "train"),
            ("to stop by", "validation"),
            ("to judge by", "test"),
        )
    ]
    page.add_table(["", "runs", "files", "minutes", "source"], rows)
    rows = [
        [
            joint, f"{facts['commanded_s'] / 60:.1f}", f"{facts['judged_s'] / 60:.1f}", f"{100 * facts['travel']:.0f}",
            f"{facts['largest_command'][0]:.2f} to {facts['largest_command'][1]:.2f}",
        ]
        for joint, facts in data["excitation"].items()
    ]  # fmt: skip
    page.add_table(
        ["joint", "commanded to fit, min", "to judge, min", "% of travel", "commands"],
        rows,
        "How far each joint was excited",
    )
    if result["folds"]:
        folds = result["folds"]
        page.add_text(
            f"Cross-validation in {folds} folds: each run was judged once, by a model fitted to the others; then the model that is "
            "kept was fitted to all runs less those that stop the fit. Errors are those of the folds' models."
        )
    page.add_text(
        f"Fitted in {result['fit_seconds']:.1f} s on {result['device']}, seed {result['seed']}."
    )
    with page.add_details("Which runs went where"):
        for stage in data["runs"]:
            page.add_heading(stage["stage"], 3)
            for label, part in (
                ("to fit to", "train"),
                ("to stop by", "validation"),
                ("to judge by", "test"),
            ):
                page.add_text(f"{label}: {', '.join(stage[part]) or 'none'}")


def _format_percent(
    row: Mapping[str, Any] | None, among: Sequence[float], unit: str
) -> Cell | None:
    if row is None:
        return None
    note = f"{row['rmse']:.4f} {unit}" if unit else ""
    return Cell(f"{row['percent']:.3f}", note, row["percent"] <= min(among))


def _format_range(bounds: Sequence[float] | None, style: str) -> str:
    return "" if bounds is None else f"{bounds[0]:{style}} to {bounds[1]:{style}}"


def _is_surely_better(row: Mapping[str, Any]) -> bool:
    return row["ci95"] is not None and row["ci95"][1] < 0
