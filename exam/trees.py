"""Baseline: residual features and a forest of trees, trained on the opened cases of a development exam. Needs scikit-learn."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.spec import spec
from diagnosis.answer import FILE, Answer, Ranked, Selected, Verdict, Where
from exam import features, paper, seal
from exam.marking import QUIET

NONE, UNKNOWN = "none", "unknown"


@spec
class Trees:
    """Classifies each joint of a case by its residual features; what is most probable on any joint is the answer.

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
        """Writes the answer.

        Raises:
            ConfigError: scikit-learn is missing, or the exam to learn from is not given or sealed.
        """
        if self.exam is None:
            raise ConfigError(
                "exam_candidate=trees: expected exam.candidate.exam=<folder of a development exam>, to learn from"
            )
        forest = _learned(Path(self.exam), self.trees, self.seed, _Key(machine))
        chances = forest.predict_proba(features.of_case(case, machine))  # (J, classes)
        out.mkdir(parents=True, exist_ok=True)
        _said(
            dict(zip(forest.classes_.tolist(), chances.T, strict=True)),
            machine.joint_names,
            self.least,
        ).write(out / FILE)


class _Key:
    """A machine as a key of a cache: its name stands for it."""

    def __init__(self, machine: Machine) -> None:
        self.machine = machine

    def __hash__(self) -> int:
        return hash(self.machine.name)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and other.machine.name == self.machine.name


@cache
def _learned(folder: Path, trees: int, seed: int, key: _Key) -> Any:
    """Returns the forest, learned once a process."""
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
    for label in seal.opened(folder)["cases"]:
        rows.append(features.of_case(folder / paper.CASES / label["case"], key.machine))
        names += [_class(label, joint) for joint in key.machine.joint_names]
    forest = ExtraTreesClassifier(
        trees, min_samples_leaf=2, class_weight="balanced_subsample", random_state=seed
    )
    return forest.fit(np.concatenate(rows), names)


def _class(label: dict[str, Any], joint: str) -> str:
    """Returns what a joint has: the largest effect on it, `unknown` for what lies outside the library, or `none`."""
    if label["outside"] and joint in label["outside"]["joints"]:
        return UNKNOWN
    here = [
        one for one in label["effects"] if joint in one["joints"] and label["kind"] not in QUIET
    ]
    return max(here, key=lambda one: one["size"])["effect"] if here else NONE


def _said(chances: dict[str, np.ndarray], joints: tuple[str, ...], least: float) -> Answer:
    """Returns the answer to the chances of each class by joint."""
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
