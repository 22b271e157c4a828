"""Baseline: residual features of each joint and a forest of trees, trained on a development exam.

The model of the reference: the travel of a joint in a quarter of a second, piecewise linear in its
delayed commands (Hammerstein). Each probe is the residual of one effect. A feature is the slope of
the residual on a probe in the field less that in the reference, over its standard deviation from
one minute of the reference to the next. Needs scikit-learn.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import compress
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

# The numbers of the features are chosen by hand and not searched: the forest is a baseline.
STEP_ROWS = 5
"""Samples over which a joint's way is predicted: 0.25 s at 20 Hz."""
LAG_ROWS = range(4, 18)
"""Delays of the commands that it depends on, samples: 0.2 to 0.85 s at 20 Hz, around a dead time of
0.4 to 0.5 s (`plant_parameters.draw_plant`)."""
PROBE_LAGS = (7, 9, 11, 13)
"""Delays of the commands of the probes, samples: 0.35 to 0.65 s at 20 Hz."""
ECHO_LAGS = (1, 3, 5, 7, 10, 15)
"""Lags of the residual's autocorrelation, samples: 0.05 to 0.75 s at 20 Hz."""
KNEES = (0.0, 0.1, 0.3, 0.6)
"""Commands where the slope of the flow curve may change, on both sides."""
BLOCK_ROWS = 1200
"""Samples of a block of the reference: one minute at 20 Hz."""
RIDGE = 1e-3
"""Ridge of the reference model, of the mean square of an input of size 1."""
LARGEST_FEATURE = 50.0
"""Bound of a feature, standard deviations: a reference of almost equal blocks makes it huge."""
TOOL_COLUMNS = ("ee_x_m", "ee_y_m", "ee_z_m")


def read_half(case: Path, half: str, machine: Machine) -> list[Recording]:
    """Return the recordings of one half of a case."""
    return record.read_recordings(str(case / half / "*.parquet"), machine)


def extract_features(
    reference: Sequence[Recording], field: Sequence[Recording], machine: Machine
) -> np.ndarray:
    """Return the features of each joint of a case, `(J, F)`."""
    rows = []
    for joint in range(machine.num_joints):
        weights = _fit_reference(reference, joint)
        there = _measure_half(reference, joint, weights)
        here = _measure_half(field, joint, weights)
        # the spread of the reference between minutes is the unit: a larger change is no chance
        rows.append((here.mean(0) - there.mean(0)) / (there.std(0) + 1e-6))
    own = np.clip(np.stack(rows), -LARGEST_FEATURE, LARGEST_FEATURE)
    tool = _summarize_tool_error(field, machine) - _summarize_tool_error(reference, machine)
    # a cause that all joints share shows on the others too
    others = np.stack([np.abs(np.delete(own, j, 0)).max(0) for j in range(machine.num_joints)])
    return np.concatenate(
        [own, others, np.tile(tool, (machine.num_joints, 1)), np.eye(machine.num_joints)], 1
    )


def _fit_reference(reference: Sequence[Recording], joint: int) -> np.ndarray:
    """Return the ridge weights of the way of a joint on its inputs, `(P,)`."""
    all_inputs, all_ways = [], []
    for recording in reference:
        part_inputs, part_ways = _build_inputs(recording, joint)
        all_inputs.append(part_inputs)
        all_ways.append(part_ways)
    inputs, ways = np.concatenate(all_inputs), np.concatenate(all_ways)
    return np.linalg.solve(
        inputs.T @ inputs + RIDGE * len(inputs) * np.eye(inputs.shape[1]), inputs.T @ ways
    )


def _measure_half(recordings: Sequence[Recording], joint: int, weights: np.ndarray) -> np.ndarray:
    """Return the slopes and statistics of all blocks of one half, `(B, F)`."""
    return np.concatenate([_measure_slopes(one, joint, weights) for one in recordings])


def _build_inputs(recording: Recording, joint: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the inputs `(T, P)` and the way of the next `STEP` samples, `(T,)`."""
    u, q = recording.u[:, joint].astype(float), recording.q[:, joint].astype(float)
    # one hinge a knee and side: their sum is any curve that is straight between the knees
    hinges = []
    for knee in KNEES:
        hinges += [np.maximum(u - knee, 0.0), np.maximum(-u - knee, 0.0)]
    curve = np.stack(hinges, 1)
    count, first = len(u) - STEP_ROWS - max(LAG_ROWS), max(LAG_ROWS)
    end = first + STEP_ROWS  # the row whose position is predicted
    inputs = [curve[end - lag : end - lag + count] for lag in LAG_ROWS]
    inputs.append(np.ones((count, 1)))
    return np.concatenate(inputs, 1), q[end : end + count] - q[first : first + count]


def _build_probes(recording: Recording, joint: int, count: int) -> np.ndarray:
    """Return the response of the residual to one effect a column, `(count, K)`.

    Commands count as small below 0.02, as slow below 0.15 and as fast above 0.75 of full.
    """
    first = max(LAG_ROWS)
    q, u = recording.q[first:].astype(float), recording.u.astype(float)
    end = first + STEP_ROWS
    late = np.stack([u[end - lag : end - lag + count] for lag in PROBE_LAGS])
    own, sign = late[1, :, joint], np.sign(late[1, :, joint])
    change = late[:, :, joint][0] - late[:, :, joint][3]
    others = np.abs(np.delete(late[1], joint, 1)).sum(1)
    # angle of each link against the slewing column: its cosine is the lever arm of the weight
    angle = np.cumsum(q[:count, 1:], 1).T
    lever = np.cos(angle)
    probes = [
        own, np.abs(own), sign * (np.abs(own) < 0.15), sign * (np.abs(own) > 0.75), sign * np.maximum(np.abs(own) - 0.5, 0.0),
        change, np.abs(change), sign * np.abs(change), own * others, sign * np.maximum(others + np.abs(own) - 1.0, 0.0),
        np.sign(change) * (np.abs(late[2, :, joint]) < 0.02), sign * (late[1, :, joint] * late[3, :, joint] < 0),
        own * np.arange(count) / count, np.ones(count), (np.abs(own) < 0.02) * np.cos(angle[min(joint, 3)]),
        *(np.abs(own) * lever), *(own * lever),
    ]  # fmt: skip
    return np.stack(probes, 1)


def _measure_slopes(recording: Recording, joint: int, weights: np.ndarray) -> np.ndarray:
    """Return slopes of the residual on the probes, and its statistics, in each block, `(B, F)`."""
    inputs, ways = _build_inputs(recording, joint)
    left, first = ways - inputs @ weights, max(LAG_ROWS)
    design, found = _build_probes(recording, joint, len(left)), []
    # the second difference of a position is noise and quantisation, not motion
    jitter = np.diff(recording.q[first : first + len(left) + 2, joint].astype(float), 2)
    for begin in range(0, max(len(left) - BLOCK_ROWS // 2, 1), BLOCK_ROWS):
        part = slice(begin, begin + BLOCK_ROWS)
        x, r = design[part], left[part]
        slopes = (x * r[:, None]).sum(0) / ((x * x).sum(0) + 1e-3 * len(x))
        centred = r - r.mean()
        power = float((centred**2).mean()) + 1e-12
        echoes = []
        for lag in ECHO_LAGS:
            echoes.append(float((centred[lag:] * centred[:-lag]).mean()) / power)
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
        if not one.extra.keys() >= set(TOOL_COLUMNS):
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
        seed: Of the forest.
    """

    exam: str | None
    trees: int
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
        reference = read_half(case, "reference", machine)
        features = extract_features(reference, read_half(case, "field", machine), machine)
        chances = forest.predict_proba(features)  # (J, classes)
        names = forest.classes_.tolist()
        least = _learn_least(forest, reference, machine)
        out.mkdir(parents=True, exist_ok=True)
        _build_answer(dict(zip(names, chances.T, strict=True)), machine.joint_names, least).write(
            out / ANSWER_FILE
        )


def _learn_least(forest: Any, reference: Sequence[Recording], machine: Machine) -> float:
    """Return the largest probability of a change on repeats of the reference, where none is.

    Each of its files in turn is held against the others.
    """
    names = forest.classes_.tolist()
    changed = [k for k, name in enumerate(names) if name != NONE]
    largest = 0.0
    for number in range(len(reference)):
        rest = [*reference[:number], *reference[number + 1 :]]
        if rest:
            features = extract_features(rest, [reference[number]], machine)
            largest = max(largest, float(forest.predict_proba(features)[:, changed].max()))
    return largest


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
    if dataset.is_sealed(folder):
        raise ConfigError(
            f"candidate.exam={folder} is a sealed exam; a candidate learns from development seeds only"
        )
    names, rows = [], []
    for label in dataset.open_labels(folder)["cases"]:
        place = folder / dataset.CASES_FOLDER / label["case"]
        reference = read_half(place, "reference", key.machine)
        field = read_half(place, "field", key.machine)
        rows.append(extract_features(reference, field, key.machine))
        names += [_classify_joint(label, joint) for joint in key.machine.joint_names]
    forest = ExtraTreesClassifier(
        trees, min_samples_leaf=2, class_weight="balanced_subsample", random_state=seed
    )
    return forest.fit(np.concatenate(rows), names)


def _classify_joint(label: dict[str, Any], joint: str) -> str:
    """Return the class of a joint: its largest effect, `unknown`, or `none`."""
    if label["outside"] and joint in label["outside"]["joints"]:
        return UNKNOWN
    # an effect below the noise has nothing to learn from
    if label["kind"] in QUIET_KINDS:
        return NONE
    here = [one for one in label["effects"] if joint in one["joints"]]
    return max(here, key=lambda one: one["size"])["effect"] if here else NONE


def _build_answer(chances: dict[str, np.ndarray], joints: tuple[str, ...], least: float) -> Answer:
    """Return the answer to the chances of each class by joint."""
    best = {name: float(by_joint.max()) for name, by_joint in chances.items() if name != NONE}
    # a case has no gap only if none of its joints has one
    best[NONE] = float(chances[NONE].min()) if NONE in chances else 0.0
    unknown = best.get(UNKNOWN, 0.0)
    selected, ranking = [], []
    for name, chance in best.items():
        if name in (NONE, UNKNOWN):
            ranking.append(Ranked(name, (), chance))
            continue
        # the most probable joint has it in any case
        has = chances[name] >= min(least, chances[name].max())
        having = tuple(compress(joints, has))
        ranking.append(Ranked(name, having, chance))
        if chance > least:
            selected.append(
                Selected(
                    effect=name, joints=having, probability=chance, parameters={}, gap_closed=None
                )
            )
    selected.sort(key=lambda one: -one.probability)
    verdict: Verdict = "none"
    if selected and selected[0].probability >= unknown:
        verdict = "effects"
    elif unknown > least:
        verdict = "unknown"
    return Answer(
        verdict=verdict,
        selected=tuple(selected) if verdict == "effects" else (),
        ranking=tuple(sorted(ranking, key=lambda one: -one.probability)),
        where=Where({}, (), None),
        gap=None,
        next_experiment=None,
    )
