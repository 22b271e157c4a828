"""The gate of a refactor: the same figures before and after, made by the command line alone.

    python benchmarks/refactor/gate.py record <folder> [--tree TREE] [--parts a,b] [--workers N]
    python benchmarks/refactor/gate.py compare <before> <after>

`record` runs every part against the code in TREE and writes `<folder>/<part>.json`. `compare`
prints one line a part, writes `<after>/verdict.json`, and ends with 1 if any part is different.

Nothing of the project is imported here, so that the gate does not depend on names of modules.
What it does depend on stands in the tables below: the commands, the files that they leave, the
fields left out. Where the new code calls an option or a word otherwise on purpose, change these
tables by hand.
"""

from __future__ import annotations

import argparse
import csv
import fnmatch
import hashlib
import json
import math
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import yaml

SALT = "0123456789abcdef0123456789abcdef"
"""Salt of the exams' labels. It decides their hash, and is random where none is given."""

# --- What is run -------------------------------------------------------------
# Each command is `python -m brokk_rl <words> session.out={part}/<name>`. {part}: folder of the
# part; {parts}: folder of all parts; {share}: processes that a command may start.

ON_CPU = "session.device=cpu evaluation.video=false"
NATIVE = f"sim=native sim.num_threads=1 {ON_CPU}"  # one thread a command: see `build_environment`
COMMANDS: dict[str, dict[str, str]] = {
    # 1,024 endings on each of the two plants, as published in the README
    "evaluate_shipped": {
        "learned": f"mode=evaluate {NATIVE}",
        "hydraulic": f"mode=evaluate actuator=hydraulic {NATIVE}",
    },
    # the other physics, whose kernels run on a CPU too, and the policy behind a person
    "evaluate_others": {
        "warp": f"mode=evaluate sim=warp {ON_CPU} evaluation.episodes=32",
        "person": f"mode=evaluate {NATIVE} follower=person evaluation.episodes=256"
        " policy=tasks:policies/behind_a_person",
    },
    # the loop reads the shipped bundle and refuses one whose golden answers are not reproduced
    "golden": {
        "loop": "preset=bench page=none deploy.show=false deploy.record=false deploy.seconds=2"
        " deploy.realtime=false deploy.policy=tasks:policies/borehole_insertion"
    },
    # a quarter of an hour from three excitations; each kind of fit, with few updates
    "identification": {
        "recorded": "mode=collect excitation=[levels,ramps,repeat] collect.num_runs=5"
        " collect.run_minutes=3 collect.file_minutes=3",
        "sine": "mode=collect collect.num_runs=3 collect.run_minutes=2 collect.file_minutes=2",
        "fitted": "mode=identify identify.recordings='{part}/recorded/recordings/*'"
        " session.device=cpu fit=coupled fit.updates=100 fit.one_step_updates=200"
        " fit.horizons_s=[0.5,1.0,2.0] +fit@baselines.mlp=mlp baselines.mlp.updates=100"
        " baselines.mlp.one_step_updates=200 +fit@baselines.lag=lag +fit@baselines.valve=valve",
        "hydraulic": "mode=identify identify.recordings='{part}/sine/recordings/*'"
        " session.device=cpu fit=hydraulic fit.candidates=32 fit.starts=1 fit.iterations=3"
        " fit.windows=20 fit.validation_windows=10",
    },
    # a development exam of 12 cases: none, faint, one, several and outside
    "diagnosis": {
        "exam": f"mode=exam exam.do=make session.seed=160 exam.salt={SALT}"
        " exam.mix.num_cases=12 exam.workers={share}",
        "answers": "mode=exam exam.do=run exam.folder={part}/exam exam.workers={share}"
        " exam.candidate.limit_s=3600",  # a busy computer is no reason for a missing answer
    },
    # marks, oracle and calibration from the answers of `diagnosis`, and a small exam for baselines
    "exam_score": {
        "oracle": "mode=exam exam.do=oracle exam.folder={parts}/diagnosis/exam"
        " exam.workers={share}",
        "marks": "mode=exam exam.do=score exam.folder={parts}/diagnosis/exam"
        " +exam.answers.diagnosis={parts}/diagnosis/answers exam.oracles={part}/oracle",
        "calibration": "mode=exam exam.do=calibrate exam.trials=4"
        " +exam.answers.mild={parts}/diagnosis/answers exam.workers={share}",
        "small": f"mode=exam exam.do=make session.seed=161 exam.salt={SALT} exam_mix=sizes"
        " exam_recording=sine exam.roughness=strong exam.mix.num_cases=2 exam.workers={share}",
        "baselines": "mode=exam exam.do=baselines exam.folder={part}/small"
        " exam.baselines.trees.exam={parts}/diagnosis/exam exam.workers={share}",
    },
    # 42 frames over the seven scenes, at half the size; both finders and the network
    "holes": {
        **{
            f"{scene}_frames": f"mode=render scene={scene} rig=zed_2i_720p render.count=6"
            " session.seed=31"
            for scene in ("clean", "varied", "hidden", "haze", "decoy", "dark", "empty")
        },
        **{
            f"{scene}_holes": f"mode=perceive perceive.input={{part}}/{scene}_frames/frames"
            " perceive.pictures=false"
            for scene in ("clean", "varied", "hidden", "haze", "decoy", "dark", "empty")
        },
        "varied_paper": "mode=perceive perception=paper perceive.pictures=false"
        " perceive.input={part}/varied_frames/frames",
        "decoy_network": "mode=perceive perception/segmenter=onnx perceive.pictures=false"
        " perceive.input={part}/decoy_frames/frames",
    },
    # simulated persons, who repeat: in the world alone, and at the twin with its gateway
    "study_report": {
        "plan": "mode=study study.do=plan ground=none",
        "simulated": "mode=study study.do=simulate ground=simulated session.seed=4"
        " session.device=cpu study.design.num_participants=6 study.design.limit_s=30",
        "twin": "mode=study study.do=simulate ground=twin session.seed=5 session.device=cpu"
        " study.design.num_participants=2 study.design.limit_s=10 ground.num_processes={share}",
        "report": "mode=study study.do=report study.folder={part}/simulated session.seed=6",
    },
    # as many iterations as asked for: no bound in seconds
    "train_repeat": {
        "borehole": f"mode=train {NATIVE} session.seed=3 rl.num_envs=64 rl.num_starts=512"
        " rl.budget.max_seconds=null rl.budget.max_env_steps=36864 evaluation.episodes=64",
        "goal": f"mode=train task=goal_pose {NATIVE} session.seed=4 rl.num_envs=64"
        " rl.num_starts=512 rl.budget.max_seconds=null rl.budget.max_env_steps=15360"
        " evaluation.episodes=64",
    },
    # real processes and clocks; see `react`
    "guard_reactions": {},
}

NEEDS = {"exam_score": "diagnosis"}
"""Parts that use what another one leaves: asked for alone, they bring it."""
RECORDED = {"identification": ("recorded", "sine")}
"""Commands whose recordings get names of runs without the time of day. Runs are distributed over
sets by a hash of their names: the same recordings made a second later are fitted otherwise."""
ALONE = ("guard_reactions",)
"""Parts that measure times: run last, with nothing beside them."""

REACTIONS = "benchmarks/deploy/reactions.py"
TRIALS = 8
"""Kills and stops, two of each kind; each fault has three trials anyway. 80 s, mostly waiting."""

# --- What is read ------------------------------------------------------------
ANSWERS: dict[str, tuple[str, ...]] = {
    "evaluate_shipped": ("*/evaluation.json",),
    "evaluate_others": ("*/evaluation.json",),
    "golden": (),  # see `answer_golden`
    "identification": (
        "*/plan.json", "recorded/recordings/*.parquet", "sine/recordings/*.parquet",
        "*/identification.json", "fitted/*.safetensors", "fitted/baselines/*/*.safetensors",
        "fitted/baselines/*/*.yaml", "hydraulic/hydraulic.yaml",
    ),
    "diagnosis": (
        "exam/exam.json", "exam/labels.sealed.json", "exam/cases/*/*/*.parquet",
        "answers/*/diagnosis.json", "answers/*/effects.yaml", "answers/*/sitting.json",
    ),
    "exam_score": (
        "oracle/oracle.json", "marks/marks.json", "calibration/calibration.json",
        "calibration/prices.yaml", "calibration/certainty.yaml", "small/labels.sealed.json",
        "small/cases/*/*/*.parquet", "baselines/marks.json", "baselines/*/*/diagnosis.json",
    ),
    "holes": (
        "*_frames/frames/*.png", "*_frames/frames/*.npy", "*_frames/frames/*.truth.json",
        "*/holes.json", "*/explain.txt",
    ),
    "study_report": (
        "*/plan.json", "*/plan_errors.json", "*/trials/*.json", "*/questionnaires/*.json",
        "simulated/recordings/*.parquet", "twin/recordings/*.parquet",
        "*/report.json", "*/trials.csv", "*/means.csv", "*/effects.csv",
    ),
    "train_repeat": (
        "*/progress.csv", "*/policy.safetensors", "*/evaluation.json", "*/golden.json",
        "*/policy.json",
    ),
    "guard_reactions": ("reactions.json",),
}  # fmt: skip
"""Files of each part; all that match are read, and a pattern that matches none is an error."""

LEFT_OUT = (
    "*/seconds", "*/seconds/*", "*/fit_seconds", "*/fold_seconds*", "*/ms/*",  # times
    "*/progress.csv/rate/*",
    "*/_target_",  # where a class stands, which is what a refactor changes
    "*/use",  # an override with the path of a file
)  # fmt: skip
"""Paths that are recorded and not compared."""

RENAMED: dict[str, str] = {}
"""Words of the old code and what the new one says in their place on purpose, keys and values."""

MAY_LACK = ("*/diagnosis.json/weighed/joints/*/subsets/*",)
"""Entries that may be on one side only; where both have them they must agree. Of the weakest sets
of effects the old code itself weighs others if Python hashes names otherwise, to no effect."""

TOLERANCES: dict[str, tuple[float, str]] = {}
"""Relative tolerance of a part, and why. None is needed: the old code, run twice, left the same
bits in every part but `guard_reactions`, whose times are held against limits."""

LIMITS_MS = {
    "commander SIGKILL": 200.0, "commander SIGSTOP": 200.0, "bus SIGKILL": 100.0,
    "bus SIGSTOP": 100.0, "estop": 20.0, "deadman_released": 20.0, "remote_off": 150.0,
    "drop JointPos1": 150.0, "drop LeverState": 150.0, "drop MachineStatus": 150.0,
    "wrong_id JointPos1": 150.0, "delay JointPos2": 150.0, "corrupt JointPos2": 100.0,
    "freeze_counter JointPos1": 100.0, "masquerade MachineStatus": 100.0,
    "short LeverState": 100.0, "jump": 30.0, "out_of_range": 30.0, "invalid": 30.0,
    "second_sender": 30.0,
}  # fmt: skip
"""Longest time to zero flow, as docs/safety.md states it."""
NOISE_MS = 25.0
"""By how much a median may be later than before: two cycles of 10 ms, and waking up."""

# --- How much is kept --------------------------------------------------------
LONGEST = 64
"""Numbers of a list that are kept one by one; longer ones as hash, mean and quantiles."""
QUANTILES = (0.0, 0.05, 0.25, 0.5, 0.75, 0.95, 1.0)
HASH_LENGTH = 40
CREATED = "2026-01-01T00:00:00.000+00:00"
TAIL = 3000
"""Characters kept of what a failed command said."""
SHOWN = 12
"""Paths printed of a part that differs; the verdict's file has up to `WRITTEN`."""
WRITTEN = 200
VERDICT = "verdict.json"
INSTALLED = "installed"
PACKAGES = ("hydra-core", "torch", "numpy", "scipy", "rsl-rl-lib", "mujoco", "mujoco-warp",
            "warp-lang", "onnxruntime", "opencv-python-headless", "pyarrow")  # fmt: skip

Json = Any


def main() -> int:
    """Reads the command line, does what it says, and returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    record = commands.add_parser("record", help="run the parts against a tree, write their numbers")
    record.add_argument("folder", type=Path)
    record.add_argument("--tree", type=Path, default=Path(__file__).resolve().parents[2])
    record.add_argument("--parts", help="names with commas between; all parts without it")
    record.add_argument("--workers", type=int, default=2, help="cores to use")
    record.add_argument("--keep", type=Path, help="folder for what the commands leave; kept")
    compare = commands.add_parser("compare", help="compare two records")
    compare.add_argument("before", type=Path)
    compare.add_argument("after", type=Path)
    compare.add_argument("--parts", help="as above: a part without a record is different otherwise")
    given = parser.parse_args()
    if given.command == "compare":
        wanted = given.parts.split(",") if given.parts else list(COMMANDS)
        return compare_records(wanted, given.before, given.after)
    parts = choose_parts(given.parts)
    if given.keep is not None:
        return record_parts(parts, given.folder, given.tree.resolve(), given.workers, given.keep)
    with tempfile.TemporaryDirectory(prefix="gate") as scratch:
        return record_parts(parts, given.folder, given.tree.resolve(), given.workers, Path(scratch))


def choose_parts(names: str | None) -> list[str]:
    """Returns the parts asked for, with those that they need, in the order of the table."""
    wanted = set(names.split(",") if names else COMMANDS)
    if unknown := wanted - COMMANDS.keys():
        sys.exit(f"no part {', '.join(sorted(unknown))}; there are {', '.join(COMMANDS)}")
    wanted |= {NEEDS[name] for name in wanted if name in NEEDS}
    return [name for name in COMMANDS if name in wanted]


# --- Recording ---------------------------------------------------------------


def record_parts(parts: list[str], folder: Path, tree: Path, workers: int, scratch: Path) -> int:
    """Runs parts side by side and writes what each found; returns 1 if one failed."""
    if not (tree / "brokk_rl").is_dir():
        sys.exit(f"--tree {tree}: expected a checkout with the folder brokk_rl")
    folder.mkdir(parents=True, exist_ok=True)
    facts = collect_facts(tree)
    side_by_side = [name for name in parts if name not in ALONE]
    # the longest begins first; what it hands on follows it at once
    side_by_side.sort(key=lambda name: name not in NEEDS.values())
    failed = []
    running: dict[str, Future[bool]] = {}
    scratch = scratch.resolve()
    announce_extensions(tree, scratch / INSTALLED)
    share = max(1, workers // 2)

    def run(name: str) -> bool:
        first = running.get(NEEDS.get(name, ""))
        if first is not None and not first.result():
            return write_failure(name, folder, facts, f"it needs {NEEDS[name]}, which failed")
        return record_part(name, folder, tree, scratch, share, facts)

    with ThreadPoolExecutor(max(1, workers)) as pool:
        for name in sorted(side_by_side, key=lambda name: name in NEEDS):
            running[name] = pool.submit(run, name)
        failed += [name for name, job in running.items() if not job.result()]
    failed += [name for name in parts if name in ALONE and not run(name)]
    if failed:
        print(f"failed: {', '.join(failed)}")
    return 1 if failed else 0


def record_part(
    name: str, folder: Path, tree: Path, scratch: Path, share: int, facts: Json
) -> bool:
    """Runs the commands of one part, reads their files, writes `<name>.json`; returns success."""
    place, seconds = scratch / name, {}
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    begun = time.monotonic()
    try:
        for step, words in COMMANDS[name].items():
            start = time.monotonic()
            run_command(fill_words(words, place, scratch, share), place / step, tree, place)
            check_tree(place / step, facts["commit"])
            if step in RECORDED.get(name, ()):
                rename_runs(place / step / "recordings")
            seconds[step] = round(time.monotonic() - start, 1)
        if name in EXTRAS:
            numbers = EXTRAS[name](place, tree)
        else:
            numbers = {}
        numbers |= read_answers(place, ANSWERS[name], {str(place): "{part}", str(tree): "{tree}"})
    except (OSError, RuntimeError, ValueError) as error:
        return write_failure(name, folder, facts, str(error))
    took = time.monotonic() - begun
    seconds["all"] = round(took, 1)
    write_json(folder / f"{name}.json", {"facts": facts, "seconds": seconds, "numbers": numbers})
    print(f"{name:20} {took:6.0f} s  recorded", flush=True)
    return True


def write_failure(name: str, folder: Path, facts: Json, why: str) -> bool:
    """Writes a record that says why a part has no numbers; returns false."""
    write_json(folder / f"{name}.json", {"facts": facts, "failed": why})
    print(f"{name:20} FAILED: {why}", flush=True)
    return False


def fill_words(words: str, place: Path, scratch: Path, share: int) -> list[str]:
    """Returns the words of a command with folders and numbers of processes put in."""
    given = {"{part}": str(place), "{parts}": str(scratch), "{share}": str(share)}
    for key, value in given.items():
        words = words.replace(key, value)
    return shlex.split(words)


def run_command(words: list[str], out: Path, tree: Path, place: Path) -> None:
    """Runs `python -m brokk_rl` of the tree, with its run folder at `out`.

    Raises:
        RuntimeError: it failed; with the end of what it said.
    """
    command = [sys.executable, "-P", "-m", "brokk_rl", *words, f"session.out={out}"]
    run_process(command, tree, place)


def run_process(command: list[str], tree: Path, place: Path) -> None:
    """Runs a process in an empty folder, so that nothing is found or left in the tree."""
    done = subprocess.run(
        command,
        cwd=place,
        env=build_environment(tree, place.parent / INSTALLED),
        capture_output=True,
        text=True,
    )
    if done.returncode:
        said = (done.stdout + done.stderr)[-TAIL:].replace(str(place), "{part}")
        words = " ".join(command[1:]).replace(str(place), "{part}").replace(str(tree), "{tree}")
        raise RuntimeError(f"exit code {done.returncode} of {words}\n{said}")


def announce_extensions(tree: Path, folder: Path) -> None:
    """Writes into a folder what an installation of the tree would say of its entry points.

    Options of extensions are found by entry points of what is installed, and that may be another
    commit than the tree's; on the path before it, this takes the place of what it says.
    """
    project = tomllib.loads((tree / "pyproject.toml").read_text())["project"]
    place = folder / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    head = f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    (place / "METADATA").write_text(head)
    lines = []
    for group, entries in project.get("entry-points", {}).items():
        lines += [f"[{group}]", *(f"{name} = {target}" for name, target in entries.items())]
    (place / "entry_points.txt").write_text("\n".join(lines) + "\n")


def build_environment(tree: Path, installed: Path) -> dict[str, str]:
    """Returns the environment of a command: the tree's packages, no GPU, one thread.

    Results of torch's sums depend on the number of its threads, and OpenCV's stereo on its own;
    those of the physics do not. One thread each makes every part the same on any number of cores.
    Which weak pairs of effects the diagnosis tries hangs on the order of sets of names, which
    Python draws by chance for each process unless it is told not to.
    """
    kept = {key: value for key, value in os.environ.items() if not key.startswith("BROKK")}
    threads = ("OMP", "OPENBLAS", "MKL", "NUMEXPR")
    return {
        **kept,
        **{f"{name}_NUM_THREADS": "1" for name in threads},
        "OPENCV_FOR_THREADS_NUM": "1",
        "PYTHONHASHSEED": "0",
        "PYTHONPATH": f"{tree}{os.pathsep}{installed}",
        "PYTHONDONTWRITEBYTECODE": "1",  # the tree stays as it is
        "CUDA_VISIBLE_DEVICES": "",
        "MPLBACKEND": "Agg",
        "COLUMNS": "200",
    }


def check_tree(out: Path, commit: str | None) -> None:
    """Makes sure that the code that answered is the tree's, and no other installation's.

    Raises:
        RuntimeError: it was another one.
    """
    path = out / "session.json"
    found = json.loads(path.read_text()).get("commit") if path.is_file() else None
    if commit and found and found[:HASH_LENGTH] != commit[:HASH_LENGTH]:  # without `-dirty`
        raise RuntimeError(f"the code that answered is of commit {found}, the tree's is {commit}")


def collect_facts(tree: Path) -> Json:
    """Returns commit, versions and machine: what must be the same, or is meant to differ."""
    git = ["git", "-C", str(tree), "describe", "--always", "--abbrev=40", "--dirty", "--exclude=*"]
    commit = subprocess.run(git, capture_output=True, text=True).stdout.strip() or None
    versions = {"python": platform.python_version()}
    for package in metadata.distributions():
        if package.name in PACKAGES:
            versions[package.name] = package.version
    return {"commit": commit, "versions": versions, "machine": describe_machine()}


def describe_machine() -> Json:
    """Returns the processor and the number of cores: bits depend on the instructions it has."""
    kinds = ("model name", "cpu family", "model")
    try:
        lines = [line.split(":") for line in Path("/proc/cpuinfo").read_text().splitlines()]
        found = {key.strip(): value.strip() for key, value in (x for x in lines if len(x) == 2)}
        processor = ", ".join(f"{kind} {found[kind]}" for kind in kinds if kind in found)
    except OSError:
        processor = platform.processor()
    return {"processor": processor, "cores": os.cpu_count(), "system": platform.system()}


# --- Parts that are more than commands ---------------------------------------


def answer_golden(place: Path, tree: Path) -> Json:
    """Returns what the ONNX file of each shipped policy answers to its golden observations.

    Policies are found wherever a `golden.json` stands beside a `policy.onnx`.
    """
    found = {"loop/finished": True}  # the command would have failed otherwise
    for path in sorted(tree.rglob("golden.json")):
        hidden = any(part.startswith(".") for part in path.relative_to(tree).parts)
        if hidden or not path.with_name("policy.onnx").is_file():
            continue
        found[path.parent.name] = {
            **run_policy(path.parent),
            "files": {
                name: hash_bytes(path.with_name(name).read_bytes())
                for name in ("golden.json", "policy.onnx", "policy.safetensors")
            },
            "contract": json.loads(path.with_name("policy.json").read_text()),
        }
    return {"policies": found}


def run_policy(folder: Path) -> Json:
    """Returns the commands of a policy for its golden observations, and how far off they are."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(
        (folder / "policy.onnx").read_bytes(), options, providers=["CPUExecutionProvider"]
    )
    golden = json.loads((folder / "golden.json").read_text())
    asked, expected = (np.array(golden[key], np.float32) for key in ("observation", "command"))
    rows = [session.run(None, {"observation": row[None]})[0][0] for row in asked]  # as the loop
    off = float(np.abs(np.array(rows) - expected).max())
    return {"commands": np.array(rows).astype(float).tolist(), "largest_difference": off}


def answer_trained(place: Path, tree: Path) -> Json:
    """Returns what the exported policies of the training answer, besides the files."""
    return {"exported": {name: run_policy(place / name) for name in COMMANDS["train_repeat"]}}


def react(place: Path, tree: Path) -> Json:
    """Kills, stops and disturbs real processes; leaves `reactions.json`."""
    script = [sys.executable, str(tree / REACTIONS), str(place / "reactions.json"), str(TRIALS)]
    run_process(script, tree, place)
    return {}


EXTRAS: dict[str, Callable[[Path, Path], Json]] = {
    "golden": answer_golden,
    "train_repeat": answer_trained,
    "guard_reactions": react,
}

# --- Reading -----------------------------------------------------------------


def read_answers(place: Path, patterns: tuple[str, ...], hidden: dict[str, str]) -> Json:
    """Returns the content of all files of a part, by their paths below its folder.

    Raises:
        RuntimeError: a pattern matches no file.
    """
    found: dict[str, Json] = {}
    for pattern in patterns:
        paths = [path for path in sorted(place.glob(pattern)) if path.is_file()]
        if not paths:
            raise RuntimeError(f"no file matches {pattern}; the commands left something else")
        if pattern.endswith(".parquet"):
            found[pattern] = read_recordings(paths, place)
            continue
        for path in paths:
            found[str(path.relative_to(place))] = shorten(read_file(path), hidden)
    return found


def read_file(path: Path) -> Json:
    """Returns what one file holds, as plain data; arrays as their summary."""
    kind = path.suffix
    if kind == ".json":
        return json.loads(path.read_text())
    if kind == ".yaml":
        return yaml.safe_load(path.read_text())
    if kind == ".txt":
        return path.read_text().splitlines()
    if kind == ".csv":
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
        return {key: [read_number(row[key]) for row in rows] for key in rows[0]}
    if kind == ".npy":
        return summarise(np.load(path))
    if kind == ".png":
        import cv2

        return summarise(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
    if kind == ".safetensors":
        from safetensors.numpy import load_file

        return {key: summarise(value) for key, value in load_file(path).items()}
    raise ValueError(f"{path.name}: nobody reads such a file")


def read_recordings(paths: list[Path], place: Path) -> Json:
    """Returns a hash of each recording, and a summary of each column over all of them."""
    from pyarrow import parquet

    files, columns = {}, {}
    for path in paths:
        state = hashlib.sha256()
        table = parquet.ParquetFile(path).read()
        for name in table.column_names:
            values = table[name].to_numpy()
            state.update(name.encode() + hash_array(values).encode())
            columns.setdefault(name, []).append(values)
        files[str(path.relative_to(place))] = {"sha256": state.hexdigest()}
    together = {name: summarise(np.concatenate(parts)) for name, parts in columns.items()}
    return {"files": files, "columns": together}


def rename_runs(folder: Path) -> None:
    """Writes recordings again with the name of the file's run for a name, and a fixed time.

    Raises:
        RuntimeError: they do not say of which run they are, or when they were made.
    """
    from pyarrow import parquet

    for path in sorted(folder.glob("*.parquet")):
        table = parquet.ParquetFile(path).read()
        fixed = {b"run": path.stem.rpartition("_")[0].encode(), b"created": CREATED.encode()}
        said = {key: fixed.get(key.rpartition(b".")[2]) for key in table.schema.metadata}
        if len([one for one in said.values() if one is not None]) != len(fixed):
            raise RuntimeError(f"{path.name}: expected `run` and `created` among its metadata")
        known = {key: said[key] or value for key, value in table.schema.metadata.items()}
        parquet.write_table(table.replace_schema_metadata(known), path)


def read_number(text: str) -> Json:
    """Returns a cell as a number where it is one."""
    try:
        return float(text)
    except ValueError:
        return text


def summarise(values: np.ndarray) -> Json:
    """Returns hash, mean, spread and quantiles of an array; the hash decides, the rest tells."""
    if values.dtype.kind not in "biuf":
        return {"sha256": hash_array(values), "count": int(values.size)}
    numbers = values.astype(np.float64).ravel()
    known = numbers[np.isfinite(numbers)]
    found = {"sha256": hash_array(values), "count": int(values.size), "finite": int(known.size)}
    if known.size:
        found |= {"mean": float(known.mean()), "std": float(known.std())}
        found["quantiles"] = np.quantile(known, QUANTILES).tolist()
    return found


def hash_array(values: np.ndarray) -> str:
    """Returns the hash of type, shape and content of an array."""
    if values.dtype.kind == "O":
        return hash_bytes(repr(values.tolist()).encode())
    head = f"{values.dtype.str} {values.shape} ".encode()
    return hash_bytes(head + np.ascontiguousarray(values).tobytes())


def hash_bytes(content: bytes) -> str:
    """Returns the SHA-256 of some bytes, in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


def shorten(value: Json, hidden: dict[str, str]) -> Json:
    """Returns plain data with long lists of numbers summarised and folders of this run hidden."""
    if isinstance(value, dict):
        return {str(key): shorten(one, hidden) for key, one in value.items()}
    if isinstance(value, list):
        if value and all(
            isinstance(one, dict) and "effects" in one and "gain" in one for one in value
        ):
            # sets of effects that were weighed: no order of theirs means anything
            return {"+".join(sorted(one["effects"])): shorten(one, hidden) for one in value}
        numbers = list(list_numbers(value))
        if len(numbers) > LONGEST and None not in numbers:
            return {**summarise(np.array(numbers)), "sha256": hash_bytes(dump(value).encode())}
        return [shorten(one, hidden) for one in value]
    if isinstance(value, str):
        for folder, name in hidden.items():
            value = value.replace(folder, name)
    return value


def list_numbers(value: list[Json]) -> Iterator[float | None]:
    """Yields all numbers of a nested list, and `None` for anything else."""
    for one in value:
        if isinstance(one, list):
            yield from list_numbers(one)
        else:
            is_number = isinstance(one, (int, float)) and not isinstance(one, bool)
            yield float(one) if is_number else None


def write_json(path: Path, value: Json) -> None:
    """Writes JSON, one line for each file or fact: short, and a diff still shows where."""
    lines = []
    for key, one in value.items():
        text = dump(one)
        if isinstance(one, dict):
            text = "{\n" + ",\n".join(f"  {dump(k)}: {dump(v)}" for k, v in one.items()) + "\n }"
        lines.append(f" {dump(key)}: {text}")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("{\n" + ",\n".join(lines) + "\n}\n")


def dump(value: Json) -> str:
    """Returns compact JSON; every float keeps all its digits."""
    return json.dumps(value, separators=(",", ":"))


# --- Comparing ---------------------------------------------------------------


def compare_records(parts: list[str], before: Path, after: Path) -> int:
    """Prints a line a part, writes the verdict into `after`; returns 1 if any part is different."""
    verdicts: dict[str, Json] = {}
    for name in parts:
        first, second = (read_record(folder / f"{name}.json") for folder in (before, after))
        verdicts[name] = compare_part(name, first, second)
    for name, verdict in verdicts.items():
        print(f"{name:17} {verdict['said']}")
        for line in verdict.get("paths", [])[:SHOWN]:
            print(f"{'':17} {line}")
        if (more := verdict.get("num_paths", 0) - SHOWN) > 0:
            print(f"{'':17} and {more} more")
    for line in compare_facts(before, after):
        print(f"note: {line}")
    different = [name for name, verdict in verdicts.items() if verdict["verdict"] == "different"]
    summary = {"different": different, "parts": verdicts}
    (after / VERDICT).write_text(json.dumps(summary, indent=1) + "\n")
    print(f"DIFFERENT: {', '.join(different)}" if different else "all parts are equal")
    return 1 if different else 0


def read_record(path: Path) -> Json | None:
    """Returns the record of a part, `None` where there is none."""
    return json.loads(path.read_text()) if path.is_file() else None


def compare_part(name: str, before: Json | None, after: Json | None) -> Json:
    """Returns the verdict on one part: `equal`, `within` or `different`, and what to say."""
    for side, record in (("before", before), ("after", after)):
        if record is None or "failed" in record:
            why = "no record" if record is None else f"failed: {record['failed'].splitlines()[0]}"
            return {"verdict": "different", "said": f"DIFFERENT: {side}: {why}"}
    if name == "guard_reactions":
        return compare_reactions(before["numbers"], after["numbers"])
    old = dict(flatten(before["numbers"], "", RENAMED))
    new = dict(flatten(after["numbers"], "", {}))
    tolerance, reason = TOLERANCES.get(name, (0.0, ""))
    differing, largest, where, num_unequal, num_lacking = [], 0.0, "", 0, 0
    for path in sorted(old.keys() | new.keys()):
        if path not in old or path not in new:
            if any(fnmatch.fnmatchcase(path, pattern) for pattern in MAY_LACK):
                num_lacking += 1
                continue
            differing.append(f"{path}: only {'after' if path in new else 'before'}")
            continue
        apart = measure_difference(old[path], new[path])
        if apart == 0.0:
            continue
        num_unequal += 1
        if path.endswith("/sha256") and tolerance:
            continue  # the numbers beside it tell how far off
        if math.isfinite(apart) and apart > largest:
            largest, where = apart, path
        if apart > tolerance:
            differing.append(f"{path}: {show(old[path])} -> {show(new[path])}")
    count = f"{len(old)} values"
    if num_lacking:
        count += f", of which {num_lacking} on one side only, as they may be"
    if differing:
        said = f"DIFFERENT: {len(differing)} of {count}, numbers by up to {largest:.2g} (relative)"
        return {
            "verdict": "different", "said": said, "num_paths": len(differing),
            "paths": differing[:WRITTEN], "largest": largest, "where": where,
        }  # fmt: skip
    if num_unequal:
        said = f"equal within {tolerance:g} ({reason}): {largest:.2g} at {where}; {count}"
        return {"verdict": "within", "said": said, "largest": largest, "where": where}
    return {"verdict": "equal", "said": f"equal bit for bit, {count}", "largest": 0.0}


def flatten(value: Json, path: str, renamed: dict[str, str]) -> Iterator[tuple[str, Json]]:
    """Yields the leaves of plain data with their paths, but for those that are left out."""
    if any(fnmatch.fnmatchcase(path, pattern) for pattern in LEFT_OUT):
        return
    if isinstance(value, dict):
        for key, one in value.items():
            yield from flatten(one, f"{path}/{renamed.get(key, key)}", renamed)
    elif isinstance(value, list):
        yield f"{path}/length", len(value)
        for number, one in enumerate(value):
            yield from flatten(one, f"{path}/{number}", renamed)
    else:
        yield path, renamed.get(value, value) if isinstance(value, str) else value


def measure_difference(one: Json, other: Json) -> float:
    """Returns the relative difference of two numbers; of anything else 0, or infinity."""
    if one == other:
        return 0.0
    kinds = (int, float)
    if not isinstance(one, kinds) or not isinstance(other, kinds) or True in (
        isinstance(one, bool), isinstance(other, bool)
    ):  # fmt: skip
        return math.inf
    return abs(one - other) / max(abs(one), abs(other))


def show(value: Json) -> str:
    """Returns a value in few characters, a number with all its digits."""
    text = dump(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def compare_reactions(before: Json, after: Json) -> Json:
    """Holds times of reaction against what is stated, and medians against those before."""
    old, new = (record["reactions.json"]["reactions"] for record in (before, after))
    wrong = [f"{name}: only {'after' if name in new else 'before'}" for name in old.keys() ^ new]
    latest, where = -math.inf, ""
    for name in old.keys() & new.keys():
        worst, limit = new[name]["flow_worst_ms"], LIMITS_MS[name]
        if worst > limit:
            wrong.append(f"{name}: {worst} ms to zero flow, at most {limit:g} are stated")
        if new[name].keys() != old[name].keys() or new[name]["trials"] != old[name]["trials"]:
            wrong.append(f"{name}: other trials or fields")
        later = new[name]["flow_median_ms"] - old[name]["flow_median_ms"]
        if later > latest:
            latest, where = later, name
        if later > NOISE_MS:
            wrong.append(f"{name}: median {later:.1f} ms later than before, noise is {NOISE_MS:g}")
    said = f"{len(new)} events within their limits, medians later by {latest:.1f} ms at most"
    if wrong:
        return {"verdict": "different", "said": f"DIFFERENT: {len(wrong)} of {len(new)} events",
                "paths": sorted(wrong), "num_paths": len(wrong)}  # fmt: skip
    said += f" ({where}); {NOISE_MS:g} ms are noise"
    return {"verdict": "within", "said": said, "largest": latest, "where": where}


def compare_facts(before: Path, after: Path) -> list[str]:
    """Returns what else differs between the two records: versions and machine should not."""
    found = set()
    for name in COMMANDS:
        first, second = (read_record(folder / f"{name}.json") for folder in (before, after))
        if first is None or second is None:
            continue
        for key in ("versions", "machine"):
            old, new = first["facts"][key], second["facts"][key]
            for entry in old.keys() | new.keys():
                if old.get(entry) != new.get(entry):
                    found.add(f"{entry}: {old.get(entry)} before, {new.get(entry)} after")
    return sorted(found)


if __name__ == "__main__":
    sys.exit(main())
