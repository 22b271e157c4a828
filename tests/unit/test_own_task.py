"""A policy acts by the task that it was trained in; what contradicts it is refused by name."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import training as runs
from composed import MACHINE, option, own_task
from conftest import Brokk

from brokk_rl.errors import CheckpointError, ConfigError
from brokk_rl.modes.evaluate import evaluate_policies
from brokk_rl.modes.export import Export
from brokk_rl.observation import ObservationPart
from brokk_rl.policy_choice import prepare_arguments
from brokk_rl.policy_folder import (
    TaskDescription,
    describe_policy,
    describe_task,
    list_differences,
    read_checkpoint,
    write_policy,
)
from brokk_rl.rl.export import export_onnx
from brokk_rl.rl.policy import ClassicalPolicy, TrainedPolicy
from brokk_rl.rl.settings import Evaluation
from brokk_rl.session import Session
from deploy.policy.bundle import PolicyBundle

CPU = torch.device("cpu")
SHIPPED = Path(__file__).parents[2] / "tasks" / "policies" / "borehole_insertion"
ITERATION = 16 * runs.STEPS


def insertion(**changes: Any) -> Any:
    return replace(option("task", "borehole_insertion"), **changes)


def direct(task: Any) -> Any:
    return replace(task, action=replace(task.action, kind="direct", scale=1.0))


@pytest.fixture(scope="module")
def shallow(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run folder of a short training that aims less deep."""
    folder = tmp_path_factory.mktemp("shallow")
    torch.manual_seed(0)
    training = runs.small(max_env_steps=2 * ITERATION)
    loop = runs.plant(insertion(depth_m=0.1)).build(CPU, 16, 64, 0)
    runner = runs.make(folder, training, loop)
    runner.run()
    actor, process = runner.alg.get_policy(), loop.task
    network = training.describe_network()
    plant = {"actuator": option("actuator", "lag")}
    contract = describe_policy(network, process, loop.description, MACHINE, **plant)
    write_policy(folder, contract, actor.state_dict())
    export_onnx(folder, actor, process, MACHINE, contract, runner.record_answers())  # type: ignore[arg-type]
    return folder


def test_a_policy_restores_the_behaviour_and_leaves_the_conditions(shallow: Path) -> None:
    found = own_task(insertion(episode_s=40.0), str(shallow))
    assert found == insertion(episode_s=40.0, depth_m=0.1)


def test_advice_is_restored() -> None:
    advised = own_task(insertion(), str(SHIPPED.with_name("behind_a_person")))
    assert advised.advice.delay_s == (0.1, 0.5) and advised.classical.straight is False
    assert advised.build(MACHINE, 1, CPU).control.encoder.size == 198


def test_each_field_of_the_behaviour_counts() -> None:
    task = insertion()
    changed = {
        "depth_m": insertion(depth_m=0.1),
        "action.mask": insertion(action=replace(task.action, mask=False)),
        "noise.filter": insertion(noise=replace(task.noise, filter="none")),
        "switch.rule": insertion(switch=replace(task.switch, rule="text")),
        "scaling.pitch_rad": insertion(scaling=replace(task.scaling, pitch_rad=(1.0, 1.0))),
        "classical.gain_1_s": insertion(classical=replace(task.classical, gain_1_s=1.0)),
    }
    own = describe_task(task)
    for key, other in changed.items():
        found = describe_task(other)
        differing = dict(list_differences(own.behaviour, found.behaviour))
        assert list(differing) == [key] and found.fingerprint() != own.fingerprint()
    conditions = insertion(episode_s=1.0, noise=replace(task.noise, target_bias_m=0.1))
    assert describe_task(conditions) == own


def test_a_changed_or_foreign_description_is_refused() -> None:
    data = describe_task(insertion()).to_json()
    data["behaviour"]["depth_m"] = 1.0
    with pytest.raises(CheckpointError, match="changed after it was written"):
        TaskDescription.from_json(data, "policy.json")
    with pytest.raises(CheckpointError, match="incomplete"):
        TaskDescription.from_json({"name": "x"}, "policy.json")


def test_it_is_evaluated_by_its_own_task_beside_policies_of_other_tasks(
    shallow: Path, tmp_path: Path
) -> None:
    """The figures of a policy do not depend on the words of the caller, nor on its neighbours."""
    how = Evaluation(episodes=8, seed=3, num_recorded=1, video=False)
    session = Session(out=str(tmp_path), seed=0, device="cpu")
    short = 4.0
    default = insertion(episode_s=short)
    mine = TrainedPolicy(path=str(shallow), task=replace(default, depth_m=0.1))
    shipped = TrainedPolicy(path=str(SHIPPED), task=own_task(default, str(SHIPPED)))
    classical = ClassicalPolicy(task=mine.task)
    policies: Any = {"shallow": mine, "shipped": shipped, "classical": classical}
    by_default = evaluate_policies(runs.plant(default), how, session, policies)
    own = runs.plant(insertion(episode_s=short, depth_m=0.1))
    alone = evaluate_policies(own, how, session, {"shallow": mine})
    other = evaluate_policies(runs.plant(default), how, session, {"shipped": shipped})
    assert by_default["policies"]["shallow"] == alone["policies"]["shallow"]
    assert by_default["policies"]["shipped"] == other["policies"]["shipped"]
    assert by_default["task"]["behaviour"]["depth_m"] == 0.1
    stamps = by_default["tasks"]
    assert stamps["shallow"] == stamps["classical"] != stamps["shipped"]


def test_a_checkpoint_is_exported_by_what_it_says(shallow: Path, tmp_path: Path) -> None:
    """Its file answers as the training run recorded; another network or task is noticed."""
    session = Session(out=str(tmp_path), seed=0, device="cpu")
    policy = TrainedPolicy(path=str(shallow), task=None)
    export = Export(session=session, machine=MACHINE, task=insertion(depth_m=0.1), policy=policy)
    export.run()
    made = json.loads((tmp_path / "policy.json").read_text())
    assert made["task"]["behaviour"]["depth_m"] == 0.1 and made["parity"]["observations"] == 16
    assert made["plant"] == json.loads((shallow / "policy.json").read_text())["plant"]
    golden = [json.loads((folder / "golden.json").read_text()) for folder in (tmp_path, shallow)]
    assert golden[0] == golden[1]
    with pytest.raises(CheckpointError, match=r"task\.depth_m is 0\.1 there, 0\.14 here"):
        replace(export, task=insertion()).run()

    content = read_checkpoint(shallow / "model_2.pt", CPU)
    content["answers"] = (content["answers"][0], content["answers"][1] + 0.01)
    torch.save(content, tmp_path / "model_2.pt")
    other = replace(policy, path=str(tmp_path / "model_2.pt"))
    told = r"differs from the answers .* not that of the run"
    with pytest.raises(CheckpointError, match=told):
        replace(export, policy=other).run()


def test_recorded_answers_are_those_of_the_network_in_the_loop() -> None:
    """Against the command in force after the step itself, and nothing changes by asking."""
    torch.manual_seed(0)
    loop = runs.plant(direct(insertion())).build(CPU, 8, 16, 0)

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


def test_resuming_in_another_task_is_refused_by_name(shallow: Path) -> None:
    training = runs.small(max_env_steps=4 * ITERATION)
    runner = runs.make(shallow, training)
    with pytest.raises(CheckpointError, match=r"task\.depth_m is 0\.1 there, 0\.14 here.*resolved"):
        runner.load(str(shallow / "model_2.pt"))


def test_a_pitch_is_given_exactly_where_the_policy_asks_for_one() -> None:
    bundle = PolicyBundle(str(SHIPPED), MACHINE)
    bundle.check_pitch(None)
    with pytest.raises(ConfigError, match=r"deploy\.pitch_rad=1\.2 was asked for"):
        bundle.check_pitch(1.2)
    bundle.encoder.parts["pitch_rad"] = ObservationPart("pitch_rad", (), 0.0, 1.0)
    bundle.check_pitch(1.2)
    with pytest.raises(ConfigError, match="asks for the wanted pitch"):
        bundle.check_pitch(None)


EVALUATE = ("mode=evaluate", "session.device=cpu", "session.out=run", "evaluation.episodes=1")
FEW = ("evaluation.num_recorded=1", "evaluation.video=false", "actuator=lag", "sim=native")


def test_values_of_an_experiment_yield_to_the_policy(
    brokk: Brokk, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    other = "# @package _global_\ntask: {episode_s: 1.0, switch: {rule: text}}\n"
    (tmp_path / "other.yaml").write_text(other)
    caplog.set_level("INFO")
    brokk(*EVALUATE, *FEW, "experiment=@other.yaml")
    assert " task.switch.rule=" in caplog.text
    found = json.loads((tmp_path / "run" / "evaluation.json").read_text())
    assert found["task"] == json.loads((SHIPPED / "policy.json").read_text())["task"]


@pytest.fixture
def foreign(shallow: Path, tmp_path: Path) -> Path:
    """The policy as one of a machine whose file nobody has any more."""
    folder = tmp_path / "policies" / "foreign"
    shutil.copytree(shallow, folder)
    contract = json.loads((folder / "policy.json").read_text())
    contract["plant"]["machine"] |= {"name": "foreign", "title": "of somebody else"}
    machine = replace(MACHINE, name="foreign")
    contract |= {"machine": "foreign", "fingerprint": machine.fingerprint()}
    (folder / "policy.json").write_text(json.dumps(contract))
    return folder


def test_a_policy_brings_its_machine_and_the_actuator_of_its_training(
    foreign: Path, brokk: Brokk, tmp_path: Path
) -> None:
    few = [word for word in FEW if not word.startswith("actuator")]
    brokk(*EVALUATE, *few, "task.episode_s=1.0", f"policy={foreign}")
    record = json.loads((tmp_path / "run" / "session.json").read_text())
    assert record["machine"] == "foreign"
    found = json.loads((tmp_path / "run" / "evaluation.json").read_text())
    assert found["actuator"] == "firstorderlag" or found["actuator"] == "lag"


def test_what_contradicts_a_policy_or_its_folder_is_refused(
    foreign: Path, brokk: Brokk, tmp_path: Path
) -> None:
    (foreign.parent / "session.json").write_text('{"mode": "train"}')
    before = sorted(tmp_path.rglob("*"))
    words = ("policy=policies/foreign", "machine=brokk170")
    done = brokk("mode=evaluate", *words, code=2)
    assert "=foreign, but machine=brokk170" in done.err
    done = brokk("mode=train", "policy=policies/foreign", "session.out=policies", code=2)
    assert "policies already holds a run" in done.err
    assert sorted(tmp_path.rglob("*")) == before


def test_a_training_that_goes_on_takes_up_the_words_of_its_run(tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    kept = ["mode=train", "rl.num_envs=8", "effect=[]", "session.out=elsewhere"]
    (run / "session.json").write_text(json.dumps({"overrides": kept}))
    (run / "model_1.pt").touch()
    ours = [f"policy={run}", f"session.out={run}", "rl.num_envs=16"]
    assert prepare_arguments(ours)[3:] == ["mode=train", "effect=[]"]
    begun = [f"policy={run}", "session.out=new"]
    assert prepare_arguments(begun) == begun, "it begins with the network, by words of its own"
    exact = [f"policy={run}/model_1.pt", "session.out=new"]
    assert prepare_arguments(exact)[2:] == kept[:3]
