"""The policy bundle: what is refused, and that the ONNX file says what the network says."""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch
import training as runs
from composed import MACHINE, option
from safetensors.torch import load_file, save_file

from brokk_rl.errors import CheckpointError, ConfigError
from brokk_rl.observation import ObservationEncoder, list_pose_parts
from brokk_rl.policy_folder import TOLERANCE, describe_policy, find_policy, write_policy
from brokk_rl.rl import export
from brokk_rl.rl.loop import ControlLoop
from brokk_rl.rl.policy import NetworkPolicy, TrainedPolicy, make_actor

CPU = torch.device("cpu")
TRAINING = runs.small(max_seconds=1.0)


@dataclass
class Bundle:
    """An exported policy whose network says something else for every observation."""

    folder: Path
    loop: ControlLoop
    actor: Any
    contract: dict[str, Any]


def export_policy(folder: Path, name: str, kind: str) -> Bundle:
    folder.mkdir(exist_ok=True)
    torch.manual_seed(0)
    task = option("task", name)
    silent, action = replace(task.noise, **runs.SILENT), replace(task.action, kind=kind)
    task = replace(task, noise=silent, action=action)
    loop = runs.plant(task).build(CPU, 16, 64, 3)
    network = TRAINING.describe_network()
    actor = make_actor(network, loop.get_observations(), loop.num_actions)
    with torch.no_grad():
        for parameter in actor.mlp.parameters():
            parameter.copy_(torch.randn_like(parameter) * 0.1)
    contract = describe_policy(network, loop.task, loop.description, MACHINE, actuator=None)
    write_policy(folder, contract, actor.state_dict())
    seen = []
    for _ in range(25):
        seen.append(loop.record_answers(actor, 16))
        loop.step(torch.randn(16, 5))
    answers = torch.cat([one[0] for one in seen]), torch.cat([one[1] for one in seen])
    export.export_onnx(folder, actor, task.build(MACHINE, 1, CPU), MACHINE, contract, answers)
    return Bundle(folder, loop, actor, json.loads((folder / "policy.json").read_text()))


def open_network(bundle: Bundle) -> onnxruntime.InferenceSession:
    path = bundle.folder / "policy.onnx"
    return onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    folder = tmp_path_factory.mktemp("policy")
    return export_policy(folder, "borehole_insertion", "residual")


@pytest.fixture
def copied(bundle: Bundle, tmp_path: Path) -> Path:
    for path in bundle.folder.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    return tmp_path


def test_the_contract_says_all_that_the_machine_needs(bundle: Bundle) -> None:
    contract = bundle.contract
    assert contract["schema"] == 2 and contract["machine"] == "brokk170"
    assert contract["fingerprint"] == MACHINE.fingerprint() and contract["rate_hz"] == 20.0
    assert contract["joints"] == contract["command"]["order"] == list(MACHINE.joint_names)
    assert contract["exclusive"] == ["q2"] and contract["observation"]["size"] == 133
    assert contract["observation"]["switch"]["rule"] == "planar"
    parity = contract["parity"]
    assert parity["observations"] == 400 and parity["at_an_edge"] <= 2
    assert parity["largest_difference"] < TOLERANCE


def test_the_onnx_file_carries_the_contract(bundle: Bundle) -> None:
    session = open_network(bundle)
    told = session.get_modelmeta().custom_metadata_map
    assert told["brokk.machine"] == "brokk170" and float(told["brokk.rate_hz"]) == 20.0
    assert json.loads(told["brokk.fingerprint"]) == MACHINE.fingerprint()
    assert json.loads(told["brokk.observation"]) == bundle.contract["observation"]
    (given,), (taken,) = session.get_inputs(), session.get_outputs()
    assert (given.name, given.shape) == ("observation", ["batch", 133]) and taken.name == "command"


@pytest.mark.parametrize("kind", ["residual", "direct"])
@pytest.mark.parametrize("name", ["borehole_insertion", "goal_pose"])
def test_on_the_machine_it_commands_what_it_did_in_the_simulator(
    name: str, kind: str, tmp_path: Path
) -> None:
    """Numpy's encoder and onnxruntime on the recorded history against the control loop's own way from observation to command."""
    made = export_policy(tmp_path / "policy", name, kind)
    session = open_network(made)
    encoder = ObservationEncoder(list_pose_parts(MACHINE, option("task", name).scaling))
    loop, policy = made.loop, NetworkPolicy(made.actor, made.loop)
    loop.begin()
    off = []
    for _ in range(60):
        groups = dict(loop.get_observations().items())
        recorded = {"q": loop.history.q, "u": loop.history.u}
        recorded["target_in_base_m"] = loop.task.state["start.target_m"]
        recorded["pitch_rad"] = loop.task.state["start.target_pitch_rad"]
        vector = encoder.encode({name: value.numpy() for name, value in recorded.items()})
        on_machine = session.run(None, {"observation": vector.astype(np.float32)})[0]
        with torch.no_grad():
            _, _, done, _ = loop.step(policy.act(groups))
        in_force = loop.history.u[:, -1].numpy()[~done.numpy()]
        difference = np.abs(on_machine[~done.numpy()] - in_force).max(1)
        off += (difference > 1e-3).tolist()
    # but at the edges of masks and dead bands, as in the parity check
    assert len(off) > 900 and np.mean(off) < 0.005


def test_a_trained_policy_is_read_back_as_it_was_written(bundle: Bundle) -> None:
    groups = dict(bundle.loop.get_observations().items())
    again = TrainedPolicy(path=str(bundle.folder), task=None).build(bundle.loop, 0)
    with torch.no_grad():
        assert torch.equal(again.act(groups), NetworkPolicy(bundle.actor, bundle.loop).act(groups))


def cut_off(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def spoil(path: Path) -> None:
    weights = load_file(path)
    weights["mlp.0.weight"][0, 0] = torch.nan
    save_file(weights, path)


@pytest.mark.parametrize(
    ("file", "damage", "told"),
    [
        ("policy.safetensors", cut_off, r"or corrupt: .*mode=export"),
        ("policy.safetensors", spoil, r"NaN or infinite weights in mlp\.0\.weight"),
        ("policy.json", lambda path: path.write_bytes(b"{"), r"or corrupt: .*mode=export"),
        ("policy.safetensors", Path.unlink, r"or corrupt: No such file"),
    ],
)
def test_a_damaged_file_is_named_with_the_way_out(
    file: str, damage: Callable[[Path], Any], told: str, copied: Path
) -> None:
    damage(copied / file)
    with pytest.raises(CheckpointError, match=told):
        find_policy(str(copied)).read()


def test_a_file_of_weights_alone_is_refused(copied: Path) -> None:
    (copied / "policy.json").unlink()
    with pytest.raises(CheckpointError, match=r"got policy\.safetensors alone"):
        find_policy(str(copied / "policy.safetensors")).read()


def test_the_plant_of_a_stranger_names_no_class_but_those_of_options(copied: Path) -> None:
    path = copied / "policy.json"
    contract = json.loads(path.read_text())
    contract["plant"]["machine"]["joints"][0]["_target_"] = "os.system"
    path.write_text(json.dumps(contract))
    assert "_target_" not in find_policy(str(copied)).list_plant()["machine"]["joints"][0]
    contract["plant"]["machine"]["_target_"] = "os.system"
    path.write_text(json.dumps(contract))
    with pytest.raises(CheckpointError, match=r"machine os\.system, which no installed option has"):
        find_policy(str(copied)).list_plant()


def test_the_newest_of_weights_and_checkpoints_is_the_policy(copied: Path) -> None:
    assert find_policy(str(copied)).file.name == "policy.safetensors"
    zipfile.ZipFile(copied / "model_3.pt", "w").close()
    os.utime(copied / "policy.safetensors", (0, 0))
    assert find_policy(str(copied)).file.name == "model_3.pt"


def test_a_policy_of_another_task_is_refused(copied: Path) -> None:
    loop = runs.plant(option("task", "goal_pose")).build(CPU, 2, 4, 0)
    with pytest.raises(CheckpointError, match=r"trained for task=borehole_insertion, not for task"):
        TrainedPolicy(path=str(copied), task=None).build(loop, 0)


def test_an_observation_group_that_the_task_does_not_give_is_refused(bundle: Bundle) -> None:
    network = TRAINING.describe_network()
    network["obs_groups"] = {"actor": ["policy", "camera"]}
    with pytest.raises(ConfigError, match="gives no group camera"):
        make_actor(network, bundle.loop.get_observations(), bundle.loop.num_actions)


def test_a_file_that_says_something_else_is_not_left_behind(
    bundle: Bundle, copied: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("policy.onnx", "golden.json"):
        (copied / name).unlink()

    def answer(names: None, feed: dict[str, np.ndarray]) -> list[np.ndarray]:
        return [np.ones((len(feed["observation"]), 5), np.float32)]

    wrong = SimpleNamespace(run=answer)
    monkeypatch.setattr(export.onnxruntime, "InferenceSession", lambda *_, **__: wrong)
    task = option("task", "borehole_insertion").build(MACHINE, 1, CPU)
    answers = bundle.loop.record_answers(bundle.actor, 16)
    with pytest.raises(CheckpointError, match=r"differs from the answers .* custom layer"):
        export.export_onnx(copied, bundle.actor, task, MACHINE, bundle.contract, answers)
    assert sorted(path.name for path in copied.iterdir()) == ["policy.json", "policy.safetensors"]


def test_a_policy_that_ships_is_named_by_package_and_path(
    copied: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = copied.parent / "shipping"
    package.mkdir()
    (package / "__init__.py").touch()
    copied.rename(package / "mine")
    monkeypatch.syspath_prepend(package.parent)
    assert find_policy("shipping:mine").file == package / "mine" / "policy.safetensors"
    with pytest.raises(CheckpointError, match="no package 'missing'"):
        find_policy("missing:mine")
