"""The plan as a page to print: the power of the design, the rules, everybody's order of trials with room for notes."""

from __future__ import annotations

from brokk_rl.report import Cell, Report, Tone
from study import guidance_effect
from study.design import Design, Trial

SIZES = (8, 12, 16, 20, 24)
"""Numbers of participants in the table of a plan."""
EFFECTS_DZ = (0.5, guidance_effect.LARGE_DZ, 1.2)
"""A medium, a large and a very large effect, in standard deviations of a person's difference."""
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
    design: Design, machine: str, seed: int, planned: list[Trial], notice: str
) -> Report:
    """Return the page.

    Args:
        design: The design of the plan.
        machine: Name of the machine.
        seed: Seed of the draw.
        planned: All trials.
        notice: Said on top; empty for nothing.
    """
    num_trials, inside = len(design.holes), design.success
    summary, tone = _judge_size(design)
    page = Report(f"Plan of a study on {machine}", summary, tone)
    page.add_text(notice, "warn")
    page.add_facts(
        {
            "participants": design.num_participants,
            "trials each": f"{num_trials} with guidance, {num_trials} without, {design.practice_trials} of practice before",
            "primary measure": design.primary,
            "time limit of a trial": f"{design.limit_s:g} s",
            "inserted": f"{inside.depth_m:g} m below the rim, within {1000 * inside.clearance_m:.0f} mm of the axis",
            "seed of the draw": seed,
        }
    )
    _add_sizes(page, design)
    page.add_heading("Rules")
    page.add_list(RULES)
    page.add_heading("Places")
    holes = [[name, *hole.center_in_base_m, hole.radius_m] for name, hole in design.holes.items()]
    page.add_table(["hole", "x, m", "y, m", "rim z, m", "radius, m"], holes)
    starts = [[name, *q] for name, q in design.starts.items()]
    page.add_table(["start", *(f"joint {i}" for i in range(1, len(starts[0])))], starts)
    page.add_heading("Order of trials")
    page.add_text("Tick what is done, write down what went otherwise.")
    for participant in dict.fromkeys(trial.participant for trial in planned):
        page.add_heading(participant, 3)
        _add_schedule(page, [trial for trial in planned if trial.participant == participant])
    return page


def _judge_size(design: Design) -> tuple[str, Tone]:
    """Return a sentence on the power of the design, and whether it is good, bad or a warning."""
    num, dz = design.num_participants, guidance_effect.LARGE_DZ
    smallest = guidance_effect.get_smallest_p((num + 1) // 2)
    if smallest > design.alpha:
        size = guidance_effect.find_smallest_size(design.alpha)
        text = f"{num} participants cannot reach p = {design.alpha:g}: the smallest possible p is {smallest:.3f}. It takes {size}."
        return text, "bad"
    power = guidance_effect.estimate_power(num, dz, design.alpha)
    text = f"{num} participants find an effect of dz {dz:g} in {100 * power:.0f} of 100 studies."
    return text, "good" if power >= guidance_effect.SUFFICIENT_POWER else "warn"


def _add_sizes(page: Report, design: Design) -> None:
    page.add_heading("How many participants")
    rows = []
    # The plan's own number stands among the usual ones.
    for num in sorted({*SIZES, design.num_participants}):
        name = Cell(str(num), note="this plan" if num == design.num_participants else "")
        row: list[str | float | Cell | None] = [name]
        row.append(guidance_effect.get_smallest_p((num + 1) // 2))
        for dz in EFFECTS_DZ:
            row.append(f"{guidance_effect.estimate_power(num, dz, design.alpha):.2f}")
        rows.append(row)
    page.add_table(
        ["participants", "smallest p", *(f"power, dz {dz:g}" for dz in EFFECTS_DZ)],
        rows,
        f"share of {guidance_effect.NUM_STUDIES} simulated studies that find the effect at p = {design.alpha:g}; "
        "dz is the mean difference in its standard deviations",
        digits=2,
    )


def _add_schedule(page: Report, mine: list[Trial]) -> None:
    columns = ["", *map(str, range(1, max(trial.number for trial in mine) + 1))]
    rows = []
    for period in sorted({trial.period for trial in mine}):
        here = [trial for trial in mine if trial.period == period]
        title = f"period {period}: {here[0].condition}" if period else "practice"
        # In practice the condition changes from trial to trial.
        cells = [
            Cell(f"{one.hole} from {one.start}", "" if period else one.condition) for one in here
        ]
        # Empty cells leave room for notes by hand.
        rows.append([title, *cells, *[""] * (len(columns) - 1 - len(here))])
        rows.append(["notes", *[""] * (len(columns) - 1)])
    page.add_table(columns, rows)
