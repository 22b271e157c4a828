"""Measurements of policies: success, force and what the training needs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from measurement import Measurement, Table, load_json, read_evaluation

PLANTS = ("mlp", "hydraulic")
CIRCUITS = ("load_sensing", "post_compensated", "open_center")
LEVELS = ("flat", "gentle", "tight", "several")
DELAYS_S = ("0.1", "0.3", "0.5")
EVALUATE = "brokk mode=evaluate session.device=cpu sim=native evaluation.video=false"
TRIALS = (("filter", 40), ("filter", 20), ("none", 40))
SHORT_S = (8, 12)
STORY_STAGES = {"gpu": ("in_simulator", "in_repaired", "on_machine"), "laptop": ("on_machine",)}
BEHIND = "follower=person evaluation.episodes=256"
POLICY_CODE = (
    "tasks/*.py", "tasks/scenes", "brokk_rl/sim", "brokk_rl/kinematics.py", "actuators/models",
    "actuators/effects", "actuators/weights", "conf/task", "conf/machine", "conf/actuator", "conf/effect",
)  # fmt: skip
SHIPPED_CODE = (*POLICY_CODE, "tasks/policies/borehole_insertion")
STORY_CODE = (*POLICY_CODE, "brokk_rl/rl", "conf/rl", "conf/preset", "conf/experiment")
TRAINING_CODE = (*STORY_CODE, ":(exclude)conf/experiment/gap_loop.yaml")  # no training of its own


def evaluate_each(
    option: str, values: tuple[str, ...], *words: str, out: str = "{out}"
) -> tuple[str, ...]:
    """Return the command that evaluates, once for each value of an option."""
    fixed = " ".join((EVALUATE, *words))
    return tuple(f"{fixed} {option}={value} session.out={out}/{value}" for value in values)


def read_evaluations(folder: Path, varied: str) -> Table:
    """Return the rows of each policy in all folders, named by what varies between them."""
    rows: Table = []
    for path in sorted(folder.glob("*/evaluation.json")):
        # A sweep names its folders by place, key and value: 0_seed-1.
        value = path.parent.name.rpartition(f"{varied}-")[2]
        rows += read_evaluation(path, {varied: value})
    return rows


def read_seeds(folder: Path, **cells: Any) -> Table:
    """Return the rows of several seeds, and the controller's once: its starts are the same."""
    rows = [cells | row for row in read_evaluations(folder, "seed")]
    return [row for row in rows if row["policy"] != "classical" or row["seed"] == "1"]


def read_comparison(folder: Path) -> Table:
    """Return a row for each group of `mode=compare`: means over seeds with Student's intervals."""
    rows: Table = []
    for group in load_json(folder / "comparison/comparison.json")["groups"]:
        low, high = group["success_strict_low"], group["success_strict_high"]
        row = {
            "policy": group["policy"],
            "seeds": group["runs"],
            "strict success": round(group["success_strict"], 3),
            # The controller meets the same starts beside each seed.
            "95 %": f"{low:.3f} to {high:.3f}" if high > low else "",
            "inserted": round(group["success_reached"], 3),
            "paper's criterion": round(group["success_paper"], 3),
            "median time, s": round(group["time_to_insert_s"], 1),
            "peak force, kN": round(group["peak_force_n"] / 1000.0, 1),
            "valve travel, 1/s": round(group["valve_travel"], 1),
        }
        rows.append(row)
    return rows


def read_story(folder: Path) -> Table:
    """Return the success of each policy in each simulator and on the changed machine."""
    rows: Table = []
    for computer, stages in STORY_STAGES.items():
        found = read_evaluations(folder / computer, "stage")
        told = [row for row in found if row["stage"] in stages]
        rows += [{"trained on": computer} | row for row in told]
    return rows


MEASUREMENTS = (
    Measurement(
        name="shipped_policy",
        title="The policy that ships",
        conditions="The shipped policy and the classical controller (baseline) from the same random starts, one seed, MuJoCo C. An episode lasts 20 s. Boreholes, their errors, dead time and effects are random. The policy learned from nothing on `flat`, two H200, 5,119 million steps; a gain of 1.08 at its output was chosen on 768 other starts.",
        commands=evaluate_each("actuator", PLANTS),
        code=SHIPPED_CODE,
        read=lambda folder: read_evaluations(folder, "plant"),
        where="two cores, 3 min",
    ),
    Measurement(
        name="other_circuits",
        title="The policy that ships, on circuits to which nothing was fitted",
        conditions="Baseline: the classical controller, from the same 256 starts.",
        commands=evaluate_each("actuator", CIRCUITS, "evaluation.episodes=256"),
        code=SHIPPED_CODE,
        read=lambda folder: read_evaluations(folder, "plant"),
        where="two cores, 4 min",
    ),
    Measurement(
        name="unidentified_machine",
        title="A policy for machines that nobody identified",
        conditions="One training from nothing on four GPUs, one seed: 11,010 million steps in 576 s; the machine was lost before 610 s. The policy is the mean of the eight kept checkpoints, its only candidate. 0.95 of the last episodes succeeded; eight shorter trainings: 0.88 at most. "
        "Failures of earlier policies on these circuits suggested its effects. It moves up to three levers. Baseline: the controller without filter, same starts.",
        commands=tuple(
            command
            for follower, episode_s in TRIALS
            for command in evaluate_each(
                "actuator",
                (*PLANTS, *CIRCUITS),
                f"policy=tasks:policies/unidentified_machine evaluation.episodes=256 follower={follower} task.episode_s={episode_s}",
                *["~rivals.classical"] * (follower == "filter"),
                out=f"{{out}}/{follower}/{episode_s}",
            )
        ),
        code=(
            *POLICY_CODE,
            "tasks/policies/unidentified_machine",
            "actuators/person.py",
            "conf/follower/filter.yaml",
        ),
        read=lambda folder: [
            {"follower": follower, "episode_s": episode_s} | row
            for follower, episode_s in TRIALS
            for row in read_evaluations(folder / follower / str(episode_s), "plant")
        ],
        where="two cores, 15 min",
    ),
    Measurement(
        name="levels",
        title="Levels of the task",
        conditions="The shipped policy and the classical controller (baseline), from the same 256 starts. `flat`: the chisel ends flat, and 10 kN end an episode; the policy learned there. `gentle`: 5 kN end it. `tight`: a hole of 8.4 cm, for which nothing was trained. "
        "`several`: three holes in a row in a block that moves by a centimetre when struck with 5 kN; the shipped policy never learned to draw the chisel out. `slanted`: holes lean by up to 15 degrees, which the shipped policy does not observe.",
        commands=(
            *evaluate_each("task", LEVELS, "policy=shipped evaluation.episodes=256"),
            f"{EVALUATE} policy=classical ~rivals.classical task=slanted evaluation.episodes=256 session.out={{out}}/slanted",
        ),
        code=SHIPPED_CODE,
        read=lambda folder: read_evaluations(folder, "task"),
        where="two cores, 3 min",
    ),
    Measurement(
        name="short_training",
        title="`make train`",
        conditions="Training from nothing for 290 s: the policy commands alone; its loss also imitates, less and less, an example that knows a clear path. The baseline is the "
        "classical controller.",
        commands=(
            "brokk -m mode=train preset=laptop session.seed=1,2,3,4 evaluation.video=false session.out={out}/seeds",
        ),
        code=TRAINING_CODE,
        read=lambda folder: read_seeds(folder / "seeds"),
        where="two cores, 22 min",
    ),
    Measurement(
        name="short_training_gpu",
        title="`make train` on a GPU",
        conditions="As `make train`, with 2,048 worlds and larger steps, these values typed one by one; compiling takes half a minute before. Baseline: the classical controller.",
        commands=tuple(
            f"brokk -m mode=train preset=gpu_short rl.budget.max_seconds={seconds} session.seed=1,2,3,4,5 sim.parity_worlds=0 evaluation.video=false session.out={{out}}/{seconds}"
            for seconds in SHORT_S
        ),
        code=TRAINING_CODE,
        read=lambda folder: [
            row
            for seconds in SHORT_S
            for row in read_seeds(folder / str(seconds), **{"training, s": seconds})
        ],
        where="one H200, 11 min",
    ),
    Measurement(
        name="paper",
        title="The paper's configuration",
        conditions="`experiment=paper` is a reading of the paper under which a policy learns, five seeds of 200 million steps, 1,024 episodes each. "
        "`experiment=paper_literal`, one seed of 40 million steps, has 0.000 of each. Baseline: the controller.",
        commands=(
            "brokk -m preset=gpu experiment=paper session.seed=1,2,3,4,5 rl.budget.max_env_steps=200e6 evaluation.video=false session.out={out}/paper",
            "brokk mode=compare compare.runs={out}/paper session.out={out}/comparison",
        ),
        code=TRAINING_CODE,
        read=read_comparison,
        where="one GPU of 80 GB, 25 min",
    ),
    Measurement(
        name="paper_smooth",
        title="The paper's configuration, smooth",
        conditions="`experiment=paper_smooth`, five seeds of 170 million steps, from the same 1,024 random starts, by MuJoCo C. With the paper's vector alone five seeds of 460 to 484 million had a strict success of 0.02 to 0.57. Baseline: the controller, whose command the network sees.",
        commands=(
            "brokk -m mode=train preset=gpu experiment=paper_smooth session.seed=1,2,3,4,5 rl.budget.max_seconds=null rl.budget.max_env_steps=170e6 evaluation.video=false session.out={out}/trained",
            f"{EVALUATE} policy=<each> effect=[] task.termination.success=null task.noise.target_bias_m=0 task.noise.q_scale=0.1 task.noise.q_scale_of=motion actuator=<plant> session.out={{out}}/<each, plant>",
        ),
        code=TRAINING_CODE,
        read=lambda folder: read_evaluations(folder, "seed and plant"),
        where="one GPU of 80 GB, then its host, 15 min",
    ),
    Measurement(
        name="guided_person",
        title="A simulated person follows the advice",
        conditions="The policy that ships for a person and the classical controller (baseline), from the same 256 starts, one seed; an episode lasts 40 s. The policy commands alone, and sees what the controller computes. It assumes 0.1 to 0.5 s of delay and two to four levers at once. No real person took part.",
        commands=evaluate_each(
            "follower.delay_s", DELAYS_S, "policy=tasks:policies/behind_a_person", BEHIND
        ),
        code=(*POLICY_CODE, "tasks/policies/behind_a_person"),
        read=lambda folder: read_evaluations(folder, "delay of the person, s"),
        where="two cores, 8 min",
    ),
    Measurement(
        name="gap_loop",
        title="Diagnose, retrain, close the gap",
        conditions="Boom and stick of the simulated machine extend at half their speed. The diagnosis does not know it, and named `asymmetry` on both and nothing else. "
        "`before` learned without what was found, `trained` with it; one seed, 150 s from nothing each on one GPU, 290 s on two cores, 256 episodes.",
        commands=(
            "brokk experiment=gap_loop preset=gpu session.out={out}/gpu",
            "brokk experiment=gap_loop session.out={out}/laptop",
        ),
        code=(*STORY_CODE, "diagnosis"),
        read=read_story,
        where="one H200, 15 min, and two cores, 20 min",
    ),
)
