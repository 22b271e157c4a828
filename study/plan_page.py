"""The plan as a page to print: the power of the design, the rules, everybody's order of trials with room for notes."""

from __future__ import annotations

from brokk_rl.report import Cell, Report
from study import crossover
from study.design import Design, Trial

SIZES = (5, 6, 8, 12, 16, 20, 24)
"""Numbers of participants in the table of a plan."""
RULES = (
    "Names are pseudonyms (P01, …). Who is who is written on paper, kept apart, and destroyed after the study; "
    "study.do=erase deletes a participant on request.",
    "The primary measure is fixed before the first trial; everything else is secondary and corrected for looking at many (Holm).",
    "A trial ends at insertion, at the time limit, or when the participant or the experimenter stops it; "
    "nothing is repeated without a note.",
    "A participant may stop at any time without a reason. What was done until then is kept unless they ask for it to be erased.",
    "The questionnaire is filled in after each period, before the other begins.",
)


def build_plan_page(
    design: Design, machine: str, seed: int, planned: list[Trial], notice: str = ""
) -> Report:
    """Return the page.

    Args:
        design: The design of the plan.
        machine: Name of the machine.
        seed: Seed of the draw.
        planned: All trials.
        notice: Said on top.
    """
    num, num_trials, inside = design.num_participants, len(design.holes), design.success
    # Everything is computed for this plan, so that the page can be judged before the study.
    smallest_size = crossover.find_smallest_size(design.alpha)
    summary, tone = _judge_design(design, smallest_size)
    found = Report(f"Plan of a study on {machine}", summary, tone)  # type: ignore[arg-type]
    found.add_text(notice, "warn")
    found.add_facts(
        {
            "participants": num,
            "trials each": f"{num_trials} with guidance, {num_trials} without, {design.practice_trials} of practice before",
            "order": design.order,
            "primary measure": design.primary,
            "time limit of a trial": f"{design.limit_s:g} s",
            "inserted": f"{inside.depth_m:g} m below the rim, within {1000 * inside.clearance_m:.0f} mm of the axis",
            "seed of the draw": seed,
        }
    )
    _add_sample_sizes(found, design, smallest_size)
    found.add_heading("Rules")
    found.add_list(RULES)
    found.add_heading("Places")
    found.add_table(
        ["hole", "x, m", "y, m", "rim z, m", "radius, m"],
        [[n, *h.center_in_base_m, h.radius_m] for n, h in design.holes.items()],
    )
    num_joints = len(next(iter(design.starts.values())))
    found.add_table(
        ["start", *(f"joint {i + 1}" for i in range(num_joints))],
        [[n, *q] for n, q in design.starts.items()],
    )
    found.add_heading("Order of trials")
    found.add_text(
        "A hole and a start a trial, in this order; tick what is done, write down what went otherwise."
    )
    _add_schedule(found, planned)
    return found


def _judge_design(design: Design, smallest_size: int) -> tuple[str, str]:
    """Return a sentence on the power of the design, and whether it is good, bad or a warning."""
    num, dz = design.num_participants, crossover.LARGE_DZ
    if design.order == "fixed":
        return (
            "With guidance first for all, order and guidance cannot be told apart, whatever the numbers say.",
            "bad",
        )
    smallest = crossover.get_smallest_p((num + 1) // 2)
    if smallest > design.alpha:
        return (
            f"{num} participants cannot reach p < {design.alpha:g}: the smallest possible p is "
            f"{smallest:.3f}. It takes {smallest_size} to be able to.",
            "bad",
        )
    power = crossover.estimate_power(num, dz, design.alpha)
    tone = "good" if power >= crossover.SUFFICIENT_POWER else "warn"
    return (
        f"{num} participants find an effect of dz {dz:g} in {100 * power:.0f} of 100 studies.",
        tone,
    )


def _add_sample_sizes(found: Report, design: Design, smallest_size: int) -> None:
    found.add_heading("How many participants")
    found.add_text(
        f"It takes {smallest_size} participants for the exact test to reach p = {design.alpha:g}. "
        f"Power is the share of up to {crossover.NUM_STUDIES} simulated studies that find the effect; dz is the mean difference in "
        "standard deviations of it."
    )
    columns = ["participants", "smallest p"]
    columns += [f"dz {dz:g}" for dz in crossover.EFFECTS_DZ]
    rows = []
    # The plan's own number stands among the usual ones.
    for num in sorted({*SIZES, design.num_participants}):
        name = Cell(str(num), note="this plan" if num == design.num_participants else "")
        least = crossover.get_smallest_p((num + 1) // 2)
        row: list[str | Cell] = [name, f"{least:.2g}"]
        for dz in crossover.EFFECTS_DZ:
            row.append(f"{crossover.estimate_power(num, dz, design.alpha):.2f}")
        rows.append(row)
    found.add_table(columns, rows, "smallest possible p, and power")


def _add_schedule(found: Report, planned: list[Trial]) -> None:
    # In the order of the plan, without repetition.
    for participant in dict.fromkeys(trial.participant for trial in planned):
        mine = []
        for trial in planned:
            if trial.participant == participant:
                mine.append(trial)
        found.add_heading(participant, 3)
        largest = max(trial.number for trial in mine)
        columns = ["", *map(str, range(1, largest + 1))]
        rows = []
        for period in sorted({trial.period for trial in mine}):
            here = [trial for trial in mine if trial.period == period]
            title = "practice" if not period else f"period {period}: {here[0].condition}"
            cells: list[str | Cell] = []
            for trial in here:
                text = f"{trial.hole} from {trial.start}"
                # In practice the condition changes from trial to trial.
                cells.append(text if period else Cell(text, trial.condition))
            # Empty cells leave room for notes by hand.
            rows.append([title, *cells, *[""] * (len(columns) - 1 - len(here))])
            rows.append(["notes", *[""] * (len(columns) - 1)])
        found.add_table(columns, rows)
