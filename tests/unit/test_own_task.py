"""A policy acts by the task that it was trained in; what contradicts it is refused by name."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
import training as runs
import yaml
from composed import option
from conftest import Done

from brokk_rl.errors import CheckpointError, ConfigError
from brokk_rl.machine import Machine
from brokk_rl.modes.evaluate import choose_tasks, evaluate_policies
from brokk_rl.modes.export import Export
from brokk_rl.rl.export import export_onnx
from brokk_rl.rl.policy import ClassicalPolicy, TrainedPolicy, read_bundle, write_bundle
from brokk_rl.rl.runner import read_checkpoint
from brokk_rl.rl.settings import Evaluation
from brokk_rl.session import Session
from brokk_rl.spec import restore_spec
from brokk_rl.task_description import (
    TaskDescription,
    apply_behaviour,
    describe_task,
    read_description,
    restore_task,
)
from deploy.policy.bundle import PolicyBundle

CPU = torch.device("cpu")
SHIPPED = Path(__file__).parents[2] / "tasks" / "policies" / "borehole_insertion"
ITERATION = 16 * runs.STEPS


def insertion(**changes: Any) -> Any:
    return replace(option("task", "borehole_insertion"), **changes)


def direct(task: Any) -> Any:
    return replace(task, action=replace(task.action, kind="direct", scale=1.0))


@pytest.fixture(scope="module")
def newest(machine: Machine, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run folder of a short training with the newest sample alone."""
    folder = tmp_path_factory.mktemp("newest")
    torch.manual_seed(0)
    training = runs.small(max_env_steps=2 * ITERATION)
    loop = runs.plant(machine, insertion(memory=1)).build(CPU, 16, 64, 0)
    runner, book = runs.make(machine, folder, training, loop)
    with book:
        runner.run()
    network = training.describe_network()
    actor = runner.alg.get_policy()
    contract = write_bundle(folder, actor, network, loop.task, loop.description, machine, {})
    export_onnx(folder, actor, loop.task, machine, contract, runner.record_answers())  # type: ignore[arg-type]
    return folder


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """The policy that ships, as files of version 1 were: nothing says what its task is."""
    for path in SHIPPED.iterdir():
        shutil.copy(path, tmp_path / path.name)
    contract = json.loads((tmp_path / "policy.json").read_text())
    for key in ("task", "history", "stop", "units", "limits", "kinematics"):
        contract.pop(key)
    (tmp_path / "policy.json").write_text(json.dumps(contract | {"schema": 1}))
    model = onnx.load(tmp_path / "policy.onnx")
    kept = {one.key: one.value for one in model.metadata_props if one.key != "brokk.task"}
    onnx.helper.set_model_props(model, kept)
    onnx.save(model, tmp_path / "policy.onnx")
    from safetensors.torch import load_file, save_file

    weights = load_file(tmp_path / "policy.safetensors")
    save_file(weights, tmp_path / "policy.safetensors")
    return tmp_path


def test_a_description_restores_the_behaviour_and_leaves_the_conditions() -> None:
    trained = direct(insertion(memory=1, depth_m=0.1, episode_s=7.0))
    text = json.dumps(describe_task(trained).to_json())
    own = TaskDescription.from_json(json.loads(text), "a file")
    found = restore_task(insertion(episode_s=40.0), own)
    assert (found.memory, found.depth_m, found.action.kind) == (1, 0.1, "direct")
    assert found.episode_s == 40.0 and found.switch == trained.switch
    assert describe_task(found) == describe_task(trained)
    assert found == replace(trained, episode_s=40.0)


def test_advice_is_restored_from_and_to_null(machine: Machine) -> None:
    folder = SHIPPED.with_name("behind_a_person")
    own = read_description(folder, json.loads((folder / "policy.json").read_text()))
    assert own is not None
    advised = restore_task(insertion(), own)
    assert advised.advice.delay_s == (0.2, 0.4) and advised.classical.straight is False
    assert advised.build(machine, 1, CPU).control.encoder.size == 198
    assert restore_task(advised, describe_task(insertion())) == insertion()


def test_each_field_of_the_behaviour_counts() -> None:
    task = insertion()
    changed = {
        "memory": insertion(memory=2),
        "depth_m": insertion(depth_m=0.1),
        "action.mask": insertion(action=replace(task.action, mask=False)),
        "noise.filter": insertion(noise=replace(task.noise, filter="none")),
        "switch.rule": insertion(switch=replace(task.switch, rule="text")),
        "scaling.target_std_m": insertion(
            scaling=replace(task.scaling, target_std_m=(1.0, 1.0, 1.0))
        ),
        "classical.gain_1_s": insertion(classical=replace(task.classical, gain_1_s=1.0)),
    }
    own = describe_task(task)
    for key, other in changed.items():
        found = describe_task(other)
        assert list(own.compare(found)) == [key] and found.fingerprint() != own.fingerprint()
    conditions = insertion(episode_s=1.0, noise=replace(task.noise, target_bias_m=0.1))
    assert describe_task(conditions) == own


def test_what_was_asked_for_and_contradicts_is_refused_by_name() -> None:
    own = describe_task(direct(insertion(memory=1)))
    task = insertion()
    with pytest.raises(
        ConfigError, match=r"task\.memory=13 was asked for, the policy has 1\."
    ) as e:
        apply_behaviour(task, own, ["task.memory", "task.episode_s"], "the policy")
    assert "action" not in str(e.value)
    with pytest.raises(ConfigError, match=r"action\.kind=residual was asked for, .* has direct"):
        apply_behaviour(task, own, ["task.action"], "the policy")
    found = apply_behaviour(task, own, ["task", "task.episode_s", "task.actionable"], "the policy")
    assert describe_task(found) == own
    with pytest.raises(ConfigError, match="for task=borehole_insertion, but task=goal_pose was as"):
        apply_behaviour(option("task", "goal_pose"), own, ["task"], "the policy")


def test_a_changed_or_foreign_description_is_refused() -> None:
    data = describe_task(insertion()).to_json()
    data["behaviour"]["memory"] = 1
    with pytest.raises(CheckpointError, match="changed after it was written"):
        TaskDescription.from_json(data, "policy.json")
    with pytest.raises(CheckpointError, match="incomplete"):
        TaskDescription.from_json({"name": "x"}, "policy.json")
    own = describe_task(insertion())
    own.behaviour["wings"] = 2
    with pytest.raises(CheckpointError, match="differ in wings"):
        restore_task(insertion(), own)
    own = describe_task(insertion())
    own.behaviour["switch"] = {"rule": "planar", "reach_m": [1.7, 2.4]}
    with pytest.raises(CheckpointError, match="height_m"):
        restore_task(insertion(), own)


def test_values_of_a_file_become_specs_by_annotation_and_never_by_target() -> None:
    task = insertion()
    values = {"rule": "text", "reach_m": [1.0, 2.0], "height_m": 0.3}
    assert restore_spec(type(task.switch), values).reach_m == (1.0, 2.0)
    with pytest.raises(ConfigError, match="_target_"):
        restore_spec(type(task.switch), values | {"_target_": "os.system"})


def test_it_is_evaluated_by_its_own_task_beside_policies_of_other_tasks(
    newest: Path, machine: Machine, tmp_path: Path
) -> None:
    """The figures of a policy do not depend on the words of the caller, nor on its neighbours."""
    how = Evaluation(episodes=8, seed=3, num_recorded=1, video=False)
    session = Session(out=str(tmp_path), seed=0, device="cpu")
    mine, shipped = TrainedPolicy(folder=str(newest)), TrainedPolicy(folder=str(SHIPPED))
    short = 4.0
    by_default = evaluate_policies(
        runs.plant(machine, insertion(episode_s=short)),
        how,
        session,
        {"newest": mine, "shipped": shipped, "classical": ClassicalPolicy()},
    )
    alone = evaluate_policies(
        runs.plant(machine, insertion(episode_s=short, memory=1)), how, session, {"newest": mine}
    )
    other = evaluate_policies(
        runs.plant(machine, insertion(episode_s=short)), how, session, {"shipped": shipped}
    )
    assert by_default["policies"]["newest"] == alone["policies"]["newest"]
    assert by_default["policies"]["shipped"] == other["policies"]["shipped"]
    assert by_default["task"]["behaviour"]["memory"] == 1
    stamps = by_default["tasks"]
    assert stamps["newest"] == stamps["classical"] != stamps["shipped"]


def test_a_control_loop_of_another_task_is_refused(newest: Path, machine: Machine) -> None:
    loop = runs.plant(machine, insertion()).build(CPU, 2, 8, 0)
    with pytest.raises(CheckpointError, match=r"task\.memory is 1 there, 13 here"):
        TrainedPolicy(folder=str(newest)).build(loop, 0)


def test_a_checkpoint_is_exported_by_what_it_says(
    newest: Path, machine: Machine, tmp_path: Path
) -> None:
    """Its file answers as the training run recorded; another network or task is noticed."""
    session = Session(out=str(tmp_path), seed=0, device="cpu")
    export = Export(
        session=session, machine=machine, task=insertion(), checkpoint=str(newest), asked=()
    )
    export.run()
    made = json.loads((tmp_path / "policy.json").read_text())
    assert made["task"]["behaviour"]["memory"] == 1 and made["parity"]["observations"] == 16
    golden = [json.loads((folder / "golden.json").read_text()) for folder in (tmp_path, newest)]
    assert golden[0] == golden[1]
    with pytest.raises(ConfigError, match=r"task\.memory=13 was asked for, the policy has 1"):
        replace(export, asked=("task.memory",)).run()

    content = read_checkpoint(newest / "model_2.pt", CPU)
    content["answers"] = (content["answers"][0], content["answers"][1] + 0.01)
    torch.save(content, tmp_path / "model_2.pt")
    with pytest.raises(
        CheckpointError, match=r"differs from the answers .* not the one of the run"
    ):
        replace(export, checkpoint=str(tmp_path / "model_2.pt")).run()
    for key in ("task", "network", "answers"):
        content.pop(key)
    torch.save(content, tmp_path / "model_2.pt")
    with pytest.raises(CheckpointError, match="do not describe themselves"):
        replace(export, checkpoint=str(tmp_path / "model_2.pt")).run()


def test_recorded_answers_are_those_of_the_network_in_the_loop(machine: Machine) -> None:
    """Against the command in force after the step itself, and nothing changes by asking."""
    torch.manual_seed(0)
    loop = runs.plant(machine, direct(insertion())).build(CPU, 8, 16, 0)

    def act(groups: Any) -> torch.Tensor:
        return (groups["policy"][:, 3:8] + groups["guide"][:, :5]).tanh()

    before, random = loop.state_dict()["tensors"], torch.get_rng_state()
    observations, commands = loop.record_answers(act, 5)
    after = loop.state_dict()["tensors"]
    assert all(torch.equal(value, after[name]) for name, value in before.items())
    assert torch.equal(random, torch.get_rng_state())
    groups = loop.get_observations()
    assert torch.equal(observations, groups["policy"][:5]) and commands.abs().max() > 0.1
    loop.step(act(groups))
    assert torch.equal(commands, loop.end_u[:5])


def test_resuming_in_another_task_is_refused_by_name(newest: Path, machine: Machine) -> None:
    training = runs.small(max_env_steps=4 * ITERATION)
    runner, book = runs.make(machine, newest, training)
    with book, pytest.raises(CheckpointError, match=r"task\.memory is 1 there, 13 here.*resolved"):
        runner.load(str(newest / "model_2.pt"))


def test_weights_of_another_policy_are_noticed(
    newest: Path, machine: Machine, tmp_path: Path
) -> None:
    for name in ("policy.json", "golden.json", "policy.onnx"):
        shutil.copy(SHIPPED / name, tmp_path / name)
    shutil.copy(newest / "policy.safetensors", tmp_path / "policy.safetensors")
    with pytest.raises(CheckpointError, match=r"policy\.safetensors and policy\.json are of diff"):
        read_bundle(tmp_path, machine)
    shutil.copy(newest / "policy.onnx", tmp_path / "policy.onnx")
    with pytest.raises(CheckpointError, match=r"policy\.json and policy\.onnx do not belong"):
        PolicyBundle(str(tmp_path), machine)


def test_an_old_policy_is_read_with_what_is_assumed(
    old: Path, machine: Machine, caplog: pytest.LogCaptureFixture
) -> None:
    policy = TrainedPolicy(folder=str(old))
    assert policy.choose_task(insertion(), machine, ["task.memory"]) == insertion()
    own = TrainedPolicy(folder=str(SHIPPED)).choose_task(insertion(), machine, ())
    with caplog.at_level(logging.WARNING):
        policy.build(runs.plant(machine, own).build(CPU, 2, 8, 0), 0)
        PolicyBundle(str(old), machine)
    assert "does not say which task" in caplog.text and "task.memory=13" in caplog.text
    assert (
        "its golden answers agree" in caplog.text and "policy.onnx holds all of it" in caplog.text
    )


def test_the_classical_rival_shares_the_task_but_has_the_numbers_composed_here(
    machine: Machine,
) -> None:
    task = insertion()
    task = replace(task, classical=replace(task.classical, gain_1_s=0.7))
    config = runs.plant(machine, task)
    policies: Any = {"trained": TrainedPolicy(folder=str(SHIPPED)), "classical": ClassicalPolicy()}
    found: Any = choose_tasks(config, policies, ())
    assert found["classical"].classical.gain_1_s == 0.7
    assert found["trained"].classical.gain_1_s == 1.5  # of the policy that ships
    own = replace(found["trained"], classical=task.classical)
    assert describe_task(found["classical"]) == describe_task(own)


@pytest.mark.parametrize("change", [lambda task: replace(task, memory=1), direct])
def test_an_old_policy_whose_answers_differ_in_the_task_at_hand_is_refused(
    change: Callable[[Any], Any], old: Path, machine: Machine
) -> None:
    loop = runs.plant(machine, change(insertion())).build(CPU, 2, 8, 0)
    with pytest.raises(CheckpointError, match=r"its answers differ from golden\.json by up to"):
        TrainedPolicy(folder=str(old)).build(loop, 0)


def test_an_old_policy_without_answers_cannot_be_known(old: Path, machine: Machine) -> None:
    (old / "golden.json").unlink()
    loop = runs.plant(machine, insertion()).build(CPU, 2, 8, 0)
    with pytest.raises(CheckpointError, match=r"there is no golden\.json to find it out"):
        TrainedPolicy(folder=str(old)).build(loop, 0)


def test_an_old_run_folder_knows_its_task_by_its_configuration(old: Path, machine: Machine) -> None:
    source = Path(__file__).parents[2] / "conf" / "task" / "borehole_insertion.yaml"
    task = yaml.safe_load(source.read_text())
    task.pop("defaults")
    task |= {"memory": 1, "noise": {"_target_": "tasks.noise.ObservationNoise", "filter": "none"}}
    task["switch"]["_target_"] = "tasks.control.PhaseSwitch"  # as earlier versions had it
    resolved = {"_target_": "brokk_rl.modes.train.Train", "task": task}
    (old / "resolved.yaml").write_text(yaml.safe_dump(resolved))
    found = TrainedPolicy(folder=str(old)).choose_task(insertion(), machine, [])
    assert found.memory == 1 and found.noise.filter == "none" and found.noise.u_scale == 0.1
    assert replace(found, memory=13, noise=insertion().noise) == insertion()
    resolved["_target_"] = "brokk_rl.modes.evaluate.Evaluate"  # an evaluation trained nothing
    (old / "resolved.yaml").write_text(yaml.safe_dump(resolved))
    assert TrainedPolicy(folder=str(old)).choose_task(insertion(), machine, []) == insertion()


def test_a_pitch_is_given_exactly_where_the_policy_asks_for_one(machine: Machine) -> None:
    bundle = PolicyBundle(str(SHIPPED), machine)
    bundle.check_pitch(None)
    with pytest.raises(ConfigError, match=r"deploy\.pitch_rad=1\.2 was asked for"):
        bundle.check_pitch(1.2)
    bundle.encoder.has_pitch = True
    bundle.check_pitch(1.2)
    with pytest.raises(ConfigError, match="asks for the wanted pitch"):
        bundle.check_pitch(None)


EVALUATE = ("mode=evaluate", "session.device=cpu", "session.out=run", "evaluation.episodes=1")
FEW = ("evaluation.num_recorded=1", "evaluation.video=false", "actuator=lag", "sim=native")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("task.action.kind=direct",), "task.action.kind=direct was asked for, the policy has res"),
        (("task.action={kind: direct}",), "task.action.kind=direct was asked for"),
        (("task.memory=1",), "task.memory=1 was asked for, the policy has 13"),
        (("task=goal_pose",), "for task=borehole_insertion, but task=goal_pose was asked for"),
        (("task=@mine.yaml",), "task.memory=1 was asked for, the policy has 13"),
        (("experiment=@other.yaml",), "task.switch.rule=text was asked for, the policy has planar"),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else None,
)
def test_the_command_refuses_what_its_policy_does_not_have(
    words: tuple[str, ...], told: str, brokk: Callable[..., Done], tmp_path: Path
) -> None:
    source = Path(__file__).parents[2] / "conf" / "task"
    task = yaml.safe_load((source / "borehole_insertion.yaml").read_text())
    task |= {"noise": yaml.safe_load((source / "noise" / "assumed.yaml").read_text()), "memory": 1}
    task.pop("defaults")
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(task))
    (tmp_path / "other.yaml").write_text("# @package _global_\ntask: {switch: {rule: text}}\n")
    done = brokk(*EVALUATE, *FEW, *words)
    assert done.code == 2 and told in done.err, done.err
    assert not (tmp_path / "run").exists()


def test_the_command_finds_the_task_of_its_policy(
    newest: Path, brokk: Callable[..., Done], tmp_path: Path
) -> None:
    """A follower is of the plant: what it brings to the task is no request."""
    words = ("task.episode_s=1.0", "task.memory=1", "follower=person")
    done = brokk(*EVALUATE, *FEW, f"policy.folder={newest}", *words)
    assert done.code == 0, done.err
    found = json.loads((tmp_path / "run" / "evaluation.json").read_text())
    assert found["task"]["behaviour"]["advice"] is None and found["follower"] == "person"
    resolved = yaml.safe_load((tmp_path / "run" / "resolved.yaml").read_text())
    assert resolved["asked"] == ["task.episode_s", "task.memory"]


def test_answers_hold_many_phases(newest: Path) -> None:
    golden = json.loads((newest / "golden.json").read_text())
    assert len(golden["command"]) == 16
    assert np.ptp(np.array(golden["inputs"]["q"])[:, -1, 0]) > 0.5
