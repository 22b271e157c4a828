"""Baseline: residual features of each joint and a forest of trees, trained on a development exam.

The model of the reference: the travel of a joint in a quarter of a second, piecewise linear in its
delayed commands (Hammerstein). Each probe is the residual of one effect. A feature is the slope of
the residual on a probe in the field less that in the reference, over its standard deviation from
one minute of the reference to the next. Needs scikit-learn.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from brokk_rl import record
from brokk_rl.errors import ConfigError
from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.spec import spec
from diagnosis.answer import ANSWER_FILE, Answer, Ranked, Selected, Verdict, Where
from exam import dataset
from exam.score import QUIET_KINDS

STEP_ROWS = 5
"""Samples over which a joint's way is predicted."""
LAG_ROWS = range(4, 18)
"""Delays of the commands that it depends on, samples."""
KNEES = (0.0, 0.1, 0.3, 0.6)
"""Commands where the slope of the flow curve may change, on both sides."""
BLOCK_ROWS = 1200
"""Samples of a block of the reference."""
RIDGE = 1e-3
TOOL_COLUMNS = ("ee_x_m", "ee_y_m", "ee_z_m")


def extract_features(case: Path, machine: Machine) -> np.ndarray:
    """Return the features of each joint of a case, `(J, F)`."""
    reference, field = (
        record.read_recordings(str(case / half / "*.parquet"), machine)
        for half in ("reference", "field")
    )
    rows = []
    for joint in range(machine.num_joints):
        inputs, ways = (
            np.concatenate(parts)
            for parts in zip(*(_build_inputs(one, joint) for one in reference), strict=True)
        )
        weights = np.linalg.solve(
            inputs.T @ inputs + RIDGE * len(inputs) * np.eye(inputs.shape[1]), inputs.T @ ways
        )
        there = [_measure_slopes(one, joint, weights, machine) for one in reference]
        here = np.concatenate([_measure_slopes(one, joint, weights, machine) for one in field])
        before = np.concatenate(there)
        rows.append((here.mean(0) - before.mean(0)) / (before.std(0) + 1e-6))
    own = np.clip(np.stack(rows), -50.0, 50.0)
    tool = _summarize_tool_error(field, machine) - _summarize_tool_error(reference, machine)
    others = np.stack([np.abs(np.delete(own, j, 0)).max(0) for j in range(machine.num_joints)])
    return np.concatenate(
        [own, others, np.tile(tool, (machine.num_joints, 1)), np.eye(machine.num_joints)], 1
    )


def _build_inputs(recording: Recording, joint: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the inputs `(T, P)` and the way of the next `STEP` samples, `(T,)`."""
    u, q = recording.u[:, joint].astype(float), recording.q[:, joint].astype(float)
    curve = np.stack(
        [np.maximum(side * u - knee, 0.0) for knee in KNEES for side in (1.0, -1.0)], 1
    )
    count, first = len(u) - STEP_ROWS - max(LAG_ROWS), max(LAG_ROWS)
    inputs = np.concatenate(
        [curve[first + STEP_ROWS - lag : first + STEP_ROWS - lag + count] for lag in LAG_ROWS], 1
    )
    return np.concatenate([inputs, np.ones((count, 1))], 1), q[
        first + STEP_ROWS : first + STEP_ROWS + count
    ] - q[first : first + count]


def _measure_slopes(
    recording: Recording, joint: int, weights: np.ndarray, machine: Machine
) -> np.ndarray:
    """Return slopes of the residual on the probes, and its statistics, in each block, `(B, F)`."""
    inputs, ways = _build_inputs(recording, joint)
    left, first = ways - inputs @ weights, max(LAG_ROWS)
    q, u = recording.q[first:].astype(float), recording.u.astype(float)
    late = np.stack(
        [u[first + STEP_ROWS - lag : first + STEP_ROWS - lag + len(left)] for lag in (7, 9, 11, 13)]
    )
    own, sign = late[1, :, joint], np.sign(late[1, :, joint])
    change = late[:, :, joint][0] - late[:, :, joint][3]
    others = np.abs(np.delete(late[1], joint, 1)).sum(1)
    angle = np.cumsum(q[: len(left), 1:], 1).T
    probes = [
        own, np.abs(own), sign * (np.abs(own) < 0.15), sign * (np.abs(own) > 0.75), sign * np.maximum(np.abs(own) - 0.5, 0.0),
        change, np.abs(change), sign * np.abs(change), own * others, sign * np.maximum(others + np.abs(own) - 1.0, 0.0),
        np.sign(change) * (np.abs(late[2, :, joint]) < 0.02), sign * (late[1, :, joint] * late[3, :, joint] < 0),
        own * np.arange(len(left)) / len(left), np.ones(len(left)), (np.abs(own) < 0.02) * np.cos(angle[min(joint, 3)]),
        *(np.abs(own) * np.cos(row) for row in angle), *(own * np.cos(row) for row in angle),
    ]  # fmt: skip
    design, found = np.stack(probes, 1), []
    jitter = np.diff(recording.q[first : first + len(left) + 2, joint].astype(float), 2)
    for begin in range(0, max(len(left) - BLOCK_ROWS // 2, 1), BLOCK_ROWS):
        part = slice(begin, begin + BLOCK_ROWS)
        x, r = design[part], left[part]
        slopes = (x * r[:, None]).sum(0) / ((x * x).sum(0) + 1e-3 * len(x))
        centred = r - r.mean()
        power = float((centred**2).mean()) + 1e-12
        echoes = [
            float((centred[lag:] * centred[:-lag]).mean()) / power for lag in (1, 3, 5, 7, 10, 15)
        ]
        quiet = np.abs(np.diff(recording.q[first:, joint].astype(float)[part]))
        figures = [
            np.log(power),
            np.log((jitter[part] ** 2).mean() + 1e-12),
            float((quiet < 1e-6).mean()),
            _compute_log_kurtosis(centred),
        ]
        found.append([*slopes, *echoes, *figures])
    return np.array(found)


def _compute_log_kurtosis(values: np.ndarray) -> float:
    return float(np.log((values**4).mean() / ((values**2).mean() ** 2 + 1e-18) + 1e-9))


def _summarize_tool_error(recordings: Sequence[Recording], machine: Machine) -> np.ndarray:
    """Return mean, spread and slopes of the tool error as one row; 0 without tool points."""
    offs, angles = [], []
    for one in recordings:
        if not all(name in one.extra for name in TOOL_COLUMNS):
            return np.zeros(6 + 3 * machine.num_joints)
        seen = np.stack([one.extra[name] for name in TOOL_COLUMNS], 1)
        offs.append(seen - Kinematics(machine).pose(torch.as_tensor(one.q)).tip_in_base_m.numpy())
        angles.append(one.q)
    off, q = np.concatenate(offs), np.concatenate(angles)
    slopes = np.linalg.lstsq(np.concatenate([q, np.ones((len(q), 1))], 1), off, rcond=None)[0][:-1]
    return np.concatenate([off.mean(0), off.std(0), slopes.ravel()])


NONE, UNKNOWN = "none", "unknown"


@spec
class ResidualForest:
    """Classify each joint by its residual features; the most probable class is the answer.

    Attributes:
        exam: Folder of the development exam it learns from, another than the one it sits; it cannot
            do without.
        trees: Number of trees.
        least: Probability from which an effect is named.
        seed: Of the forest.
    """

    exam: str | None
    trees: int
    least: float
    seed: int

    def answer(self, case: Path, out: Path, machine: Machine) -> None:
        """Write the answer.

        Raises:
            ConfigError: scikit-learn is missing, or the exam to learn from is not given or sealed.
        """
        if self.exam is None:
            raise ConfigError(
                "exam_candidate=trees: expected exam.candidate.exam=<folder of a development exam>, to learn from"
            )
        forest = _learn_forest(Path(self.exam), self.trees, self.seed, _MachineKey(machine))
        chances = forest.predict_proba(extract_features(case, machine))  # (J, classes)
        out.mkdir(parents=True, exist_ok=True)
        _build_answer(
            dict(zip(forest.classes_.tolist(), chances.T, strict=True)),
            machine.joint_names,
            self.least,
        ).write(out / ANSWER_FILE)


class _MachineKey:
    """A machine as a key of a cache: its name stands for it."""

    def __init__(self, machine: Machine) -> None:
        self.machine = machine

    def __hash__(self) -> int:
        return hash(self.machine.name)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _MachineKey) and other.machine.name == self.machine.name


@cache
def _learn_forest(folder: Path, trees: int, seed: int, key: _MachineKey) -> Any:
    """Return the forest, learned once a process."""
    try:
        from sklearn.ensemble import ExtraTreesClassifier  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ConfigError(
            "exam_candidate=trees needs scikit-learn: pip install 'brokk-rl[exam]'"
        ) from error
    if json.loads((folder / "exam.json").read_text())["sealed"]:
        raise ConfigError(
            f"candidate.exam={folder} is a sealed exam; a candidate learns from development seeds only"
        )
    names, rows = [], []
    for label in dataset.open_labels(folder)["cases"]:
        rows.append(extract_features(folder / dataset.CASES_FOLDER / label["case"], key.machine))
        names += [_classify_joint(label, joint) for joint in key.machine.joint_names]
    forest = ExtraTreesClassifier(
        trees, min_samples_leaf=2, class_weight="balanced_subsample", random_state=seed
    )
    return forest.fit(np.concatenate(rows), names)


def _classify_joint(label: dict[str, Any], joint: str) -> str:
    """Return the class of a joint: its largest effect, `unknown`, or `none`."""
    if label["outside"] and joint in label["outside"]["joints"]:
        return UNKNOWN
    here = [
        one
        for one in label["effects"]
        if joint in one["joints"] and label["kind"] not in QUIET_KINDS
    ]
    return max(here, key=lambda one: one["size"])["effect"] if here else NONE


def _build_answer(chances: dict[str, np.ndarray], joints: tuple[str, ...], least: float) -> Answer:
    """Return the answer to the chances of each class by joint."""
    best = {name: float(by_joint.max()) for name, by_joint in chances.items() if name != NONE}
    best[NONE] = float(chances[NONE].min()) if NONE in chances else 0.0
    named = sorted(
        (name for name in best if name not in (NONE, UNKNOWN) and best[name] >= least),
        key=lambda name: -best[name],
    )
    unknown = best.get(UNKNOWN, 0.0)
    verdict: Verdict = (
        "effects"
        if named and best[named[0]] >= unknown
        else "unknown"
        if unknown >= least
        else "none"
    )

    def having(name: str) -> tuple[str, ...]:
        by_joint = chances[name]
        return tuple(
            joint
            for joint, chance in zip(joints, by_joint, strict=True)
            if chance >= min(least, by_joint.max())
        )

    selected = [
        Selected(
            effect=name, joints=having(name), probability=best[name], parameters={}, gap_closed=None
        )
        for name in named
    ]
    ranking = [
        Ranked(name, () if name in (NONE, UNKNOWN) else having(name), chance)
        for name, chance in best.items()
    ]
    return Answer(
        verdict=verdict,
        selected=tuple(selected) if verdict == "effects" else (),
        ranking=tuple(sorted(ranking, key=lambda one: -one.probability)),
        where=Where({}, (), None),
        gap=None,
        next_experiment=None,
    )
