"""Every experiment and changes of the task: trained for a moment, evaluated, exported, and the answers are the same."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import yaml
from conftest import Brokk

from brokk_rl import cli, registry
from brokk_rl.extensions import load_mode
from brokk_rl.policy_folder import describe_task

SHORT = (
    "session.device=cpu", "sim=native", "evaluation.episodes=2", "evaluation.num_recorded=1", "evaluation.video=false",
    "task.episode_s=1.0",
)  # fmt: skip
SHIPPED = "tasks:policies/borehole_insertion"
TRAINED = (
    "mode=train", "rl.num_envs=8", "rl.num_starts=16", "rl.runner.num_steps_per_env=8",
    "rl.budget.max_seconds=null", "rl.budget.max_env_steps=128",
)  # fmt: skip
"""Two iterations of 8 environments."""


CHANGES_OF_BEHAVIOUR = ("follower=person", "task.action.mask=false")
"""Words that change what a policy learns with, and so the fingerprint of its task."""
QUICK = ("experiment=paper",)
"""Experiments of `make test`, beside the other task: each runs code that no other one does."""


def read_options(group: str) -> dict[str, dict[str, Any]]:
    """Returns the content of each option's file: composing all of them takes longer than a test."""
    options = [one for one in registry.list_options() if one.group == group]
    return {one.name: yaml.safe_load(one.path.read_text()) for one in options}


def list_cases() -> list[Any]:
    """Returns words of trainings, and words that an evaluation can take too; most are slow."""
    cases = [pytest.param(("task=goal_pose",), (), id="task=goal_pose")]
    for name, content in read_options("experiment").items():
        if "stages" not in content:
            cases.append(make_case(f"experiment={name}", ()))
            continue
        for stage in content["stages"].values():
            if stage["command"][0] == "mode=train":  # a story: its training, without its recordings
                words = tuple(word for word in stage["command"][1:] if "{folder}" not in word)
                marks = [pytest.mark.slow]
                cases.append(pytest.param(words, (), id=f"experiment={name}", marks=marks))
    for word in CHANGES_OF_BEHAVIOUR:
        cases.append(make_case(word, (word,)))
    return cases


def make_case(word: str, shared: tuple[str, ...]) -> Any:
    marks = [] if word in QUICK else [pytest.mark.slow]
    return pytest.param((word,), shared, id=word, marks=marks)


def describe_words(words: tuple[str, ...]) -> str:
    """Returns the fingerprint of the task that is trained with these words.

    A training that begins with a policy keeps the task of that policy.
    """
    if f"policy={SHIPPED}" in words:
        folder = Path(cli.__file__).parents[1] / SHIPPED.replace(":", "/")
        return str(read(folder / "policy.json")["task"]["fingerprint"])
    return describe_task(load_mode("mode=train", "session.out=x", *words).task).fingerprint()


def read(path: Path) -> Any:
    return json.loads(path.read_text())


@pytest.mark.parametrize(("words", "shared"), list_cases())
def test_what_was_trained_is_evaluated_and_exported_as_what_it_is(
    words: tuple[str, ...], shared: tuple[str, ...], tmp_path: Path, brokk: Brokk
) -> None:
    brokk(*words, *TRAINED, *SHORT, "session.out=run")
    made = read(tmp_path / "run" / "policy.json")
    assert made["task"]["fingerprint"] == describe_words(words)

    brokk("mode=evaluate", "policy=./run", *shared, *SHORT, "session.out=seen")
    found = read(tmp_path / "seen" / "evaluation.json")
    assert found["task"] == made["task"]
    if shared:  # on the same plant the figures are those of the training
        of_training = read(tmp_path / "run" / "evaluation.json")["policies"]
        assert found["policies"]["trained"] == of_training["trained"]

    brokk("mode=export", "policy=./run", "session.out=export")
    exported = read(tmp_path / "export" / "policy.json")
    assert exported["task"] == made["task"] and exported["parity"]["largest_difference"] < 1e-3
    golden = read(tmp_path / "run" / "golden.json")
    assert read(tmp_path / "export" / "golden.json") == golden
    weights = [tmp_path / name / "policy.safetensors" for name in ("run", "export")]
    assert weights[0].read_bytes() == weights[1].read_bytes()
    session = onnxruntime.InferenceSession(str(tmp_path / "export" / "policy.onnx"))
    answers = session.run(None, {"observation": np.array(golden["observation"], np.float32)})[0]
    assert np.abs(answers - np.array(golden["command"])).max() < 1e-3


def test_training_that_begins_with_a_policy_keeps_the_task_of_that_policy(
    tmp_path: Path, brokk: Brokk
) -> None:
    """The shipped policy corrects the classical controller of its time, not the one of today."""
    brokk(*TRAINED, *SHORT, "actuator=lag", f"policy={SHIPPED}", "session.out=run")
    shipped = Path(cli.__file__).parents[1] / SHIPPED.replace(":", "/")
    assert read(tmp_path / "run/policy.json")["task"] == read(shipped / "policy.json")["task"]
