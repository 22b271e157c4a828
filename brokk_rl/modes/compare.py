"""`brokk mode=compare`: one table of many runs, grouped over seeds, with intervals."""

from __future__ import annotations

import csv
import io
import logging
from collections.abc import Sequence
from typing import Any

from brokk_rl.comparison import (
    MEASURES,
    PROGRESS_COLUMNS,
    RATES,
    REACHED,
    SUCCESS,
    Curve,
    EvaluatedRun,
    build_table,
    describe_differences,
    draw_comparison,
    draw_learning,
    find_differences,
    find_runs,
    format_csv,
    group_results,
    load_run,
    read_progress,
)
from brokk_rl.console_table import print_table
from brokk_rl.seed_statistics import (
    build_seed_table,
    choose_baseline,
    collect_methods,
    draw_seeds,
    format_latex,
    summarise_methods,
)
from brokk_rl.session import Session, write_json, write_text
from brokk_rl.spec import spec

log = logging.getLogger(__name__)

MOST_ROWS = 250
"""Rows of a learning curve in `learning.csv`: about the horizontal pixels of one axis at 50 dpi."""


@spec
class RunSelection:
    """Runs to compare.

    Attributes:
        runs: Run folders, folders of such (a sweep), or patterns of either.
        baseline: Values of the row to which others are compared; `None`: the first.
    """

    runs: str | tuple[str, ...]
    baseline: dict[str, Any] | None


@spec
class Compare:
    """Compare runs: success with 95 % intervals and learning curves, as tables and pictures."""

    session: Session
    compare: RunSelection

    def run(self) -> None:
        """Print tables; write `comparison.*`, of several seeds `seeds.png`, of trainings `learning.*`."""
        patterns = (self.compare.runs,) if isinstance(self.compare.runs, str) else self.compare.runs
        runs = [load_run(folder) for folder in find_runs(patterns)]
        columns = find_differences(runs)
        results = []
        for run in runs:
            results.extend(run.results(columns))
        groups = group_results(results)
        folder = self.session.folder
        methods = collect_methods(results)
        summaries = []
        if methods:
            baseline = choose_baseline(methods, self.compare.baseline)
            generator = self.session.generator("compare")
            summaries = summarise_methods(methods, baseline, generator)
        write_json(
            folder / "comparison.json",
            {
                "schema": 1,
                "columns": columns,
                "groups": groups,
                "runs": results,
                "methods": summaries,
            },
        )
        write_text(folder / "comparison.csv", format_csv(columns, results))
        draw_comparison(groups).savefig(folder / "comparison.png", dpi=150)
        self._write_learning(runs, columns)
        table = build_table(columns, groups)
        print_table(table, num_keys=len(table.columns) - len((*RATES, *MEASURES)))
        if any(summary["ci95"] for summary in summaries):
            write_text(folder / "comparison.tex", format_latex(summaries))
            draw_seeds(summaries).savefig(folder / "seeds.png", dpi=150)
            print_table(build_seed_table(summaries), num_keys=2)
        log.info("%d runs compared in %s", len(runs), folder)

    def _write_learning(self, runs: Sequence[EvaluatedRun], columns: Sequence[str]) -> None:
        trained = [(run, curve) for run in runs if (curve := read_progress(run.folder))]
        if not trained:
            return
        variations = describe_differences(
            [
                {"variation": {column: run.get_setting(column) for column in columns}}
                for run, _ in trained
            ]
        )
        curves: dict[str, list[Curve]] = {}
        lines = []
        for (run, curve), variation in zip(trained, variations, strict=True):
            seed = run.record.get("seed")
            curves.setdefault(variation, []).append(curve)
            reached = next(
                (
                    curve["seconds"][row]
                    for row, rate in enumerate(curve[SUCCESS])
                    if rate >= REACHED
                ),
                None,
            )
            when = (
                f"after {reached:.1f} s"
                if reached is not None
                else f"not in {curve['seconds'][-1]:.0f} s"
            )
            log.info("%s: strict success of %.2f while learning %s", run.folder.name, REACHED, when)
            rows = list(zip(*curve.values(), strict=True))
            lines += [(run.folder, seed, *row) for row in rows[:: -(-len(rows) // MOST_ROWS)]]
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(
            [("folder", "seed", *PROGRESS_COLUMNS), *lines]
        )
        write_text(self.session.folder / "learning.csv", text.getvalue())
        draw_learning(curves).savefig(self.session.folder / "learning.png", dpi=150)
