"""A task made of terms: its vector, its success, its endings, its masks and its contract, against numbers by hand."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from composed import MACHINE, option
from kinematic import Kinematic, KinematicWorld
from motion import rest

from brokk_rl.build import build_node, describe_spec
from brokk_rl.checks import check_task
from brokk_rl.errors import CheckpointError, ConfigError
from brokk_rl.history import History
from brokk_rl.kinematics import Kinematics
from brokk_rl.observation import restore_encoder
from brokk_rl.policy_folder import describe_task
from brokk_rl.sim.model import compile_model
from brokk_rl.sim.scene import make_nominal_scenes
from brokk_rl.sim.simulator import find_site
from brokk_rl.spec import spec
from deploy.policy.bundle import PolicyBundle
from tasks import term_task
from tasks.process import TerminationManager
from tasks.terms import StepState

CPU = torch.device("cpu")
SHIPPED = Path(__file__).parents[2] / "tasks" / "policies" / "borehole_insertion"


@spec
class Turn(term_task.TermTask):
    """Turn the first joint at a wanted speed."""


def error(state: StepState) -> torch.Tensor:
    return state.speed[:, 0] - state.start["speed"][:, 0]


def is_turning(state: StepState, tolerance: float) -> torch.Tensor:
    return error(state).abs() < tolerance


def penalty(state: StepState) -> torch.Tensor:
    return -error(state).abs()


def term(function: str, **changes: Any) -> term_task.ObservedTerm:
    values: dict[str, Any] = {"samples": 1, "mean": 0.0, "std": 1.0, "noise": 0.0, "bias": 0.0}
    return term_task.ObservedTerm(function=function, **values | changes)


def figure(function: str, title: str) -> term_task.FigureTerm:
    shown: Any = {"title": title, "unit": "share", "factor": 1.0, "digits": 2}
    return term_task.FigureTerm(function=function, reduce="last", **shown)


TIME = term_task.TerminationTerm(function="tasks.terms:time_limit", outcome="time")
SUCCESS = term_task.TerminationTerm(function="tasks.terms:success", outcome="success")


def make(**changes: Any) -> Turn:
    fields: dict[str, Any] = {
        "episode_s": 0.5,
        "scene": None,
        "start": term_task.StartsNearHome(spread=0.2, margin=0.05),
        "command": {"speed": term_task.UniformCommand(lowest=(0.1,), highest=(0.2,))},
        "observation": {
            "joints": term("tasks.terms:joint_positions", samples=3, std=0.5),
            "error": term(f"{__name__}:error", mean=1.0, std=2.0),
            "off": None,
        },
        "privileged": {"force": term("tasks.terms:contact_force", std=1000.0)},
        "action": term_task.JointAction(scale=0.5, mask=True),
        "reward": {"penalty": term_task.RewardTerm(function=f"{__name__}:penalty", weight=2.0)},
        "curriculum": None,
        "success": term_task.HeldCriterion(
            function=f"{__name__}:is_turning", params={"tolerance": 0.01}, share=0.5, after_s=0.1
        ),
        "figures": {
            "success_strict": figure("tasks.terms:success", "turned"),
            "held_share": figure("tasks.terms:held_share", "turning"),
        },
        "termination": {"time_limit": TIME},
    }
    return Turn(**fields | changes)


class Stage:
    """One environment whose first joint turns at the speeds that a test gives."""

    def __init__(self, **changes: Any) -> None:
        self.process: Any = make(**changes).build(MACHINE, 1, CPU)
        self.world = KinematicWorld(MACHINE, 1)
        self.start = self.process.starts(1, 1)
        self.history = rest(MACHINE, self.start["q"])
        self.process.reset(torch.ones(1, dtype=torch.bool), self.start)
        self.first = self.process.observe(self.history)["policy"].clone()
        self.period_s = MACHINE.period_s

    def turn(self, speed: float) -> Any:
        q = self.history.q[:, -1].clone()
        q[:, 0] += speed * self.period_s
        self.history.push_q(q)
        return self.process.step(self.history, self.world)


@pytest.fixture
def asked() -> float:
    return float(make().build(MACHINE, 1, CPU).starts(1, 1)["speed"])


def test_it_keeps_the_contract_of_tasks() -> None:
    check_task(make(), MACHINE)
    noisy = term("tasks.terms:tip_position", noise=0.01, bias=0.02, samples=2)
    check_task(make(observation={"tip": noisy}, privileged={}), MACHINE)


def test_the_vector_holds_the_terms_in_order_oldest_sample_first(asked: float) -> None:
    stage = Stage()
    lower, upper = torch.tensor(MACHINE.lower[0]), torch.tensor(MACHINE.upper[0])

    def scale(q: torch.Tensor) -> float:
        return float((2 * q - lower - upper) / (upper - lower) / 0.5)

    q0 = stage.start["q"][0, 0]
    assert stage.first.shape == (1, 3 * 5 + 1)
    assert stage.first[0, [0, 5, 10]].tolist() == pytest.approx([scale(q0)] * 3), "at rest before"
    assert float(stage.first[0, 15]) == pytest.approx((-asked - 1.0) / 2.0)
    stage.turn(0.3)
    seen = stage.process.observe(stage.history)
    expected = [scale(q0), scale(q0), scale(q0 + 0.3 * MACHINE.period_s)]
    assert seen["policy"][0, [0, 5, 10]].tolist() == pytest.approx(expected)
    assert float(seen["policy"][0, 15]) == pytest.approx((0.3 - asked - 1.0) / 2.0, abs=1e-4)
    assert seen["privileged"].shape == (1, 1)


def test_a_bias_stays_for_an_episode_and_noise_does_not() -> None:
    torch.manual_seed(0)
    tip = term("tasks.terms:tip_position", bias=0.02)
    process: Any = make(observation={"tip": tip}).build(MACHINE, 256, CPU)
    start, everywhere = process.starts(256, 1), torch.ones(256, dtype=torch.bool)
    history = rest(MACHINE, start["q"], 256)
    true_m = Kinematics(MACHINE).pose(start["q"]).tip_in_base_m
    errors = []
    for mask in (everywhere, ~everywhere, everywhere):
        process.reset(mask, start)
        errors.append(process.observe(history)["policy"] - true_m)
    assert torch.equal(errors[0], errors[1]) and not torch.equal(errors[0], errors[2])
    assert 0.019 < errors[0].abs().max() <= 0.0201 and abs(float(errors[0].mean())) < 0.002
    noisy = replace(tip, bias=0.0, noise=0.01)
    process = make(observation={"tip": noisy}).build(MACHINE, 256, CPU)
    process.reset(everywhere, start)
    first, again = (process.observe(history)["policy"] - true_m for _ in range(2))
    assert not torch.equal(first, again) and 0.009 < first.abs().max() <= 0.0101


def test_success_needs_its_share_of_the_steps_that_count(asked: float) -> None:
    """Ten steps; two are not counted, and of the other eight half must hold."""
    for num_good, expected in ((3, 0.0), (4, 1.0)):
        stage = Stage()
        ends = [stage.turn(asked if 2 <= i < 2 + num_good else 0.0) for i in range(10)]
        assert stage.process.episode["success_strict"].item() == expected
        assert stage.process.episode["held_share"].item() == pytest.approx(num_good / 8)
        assert [bool(end.timed_out) for end in ends] == [False] * 9 + [True]
    early = Stage()
    for _ in range(2):
        early.turn(asked)
    assert early.process.episode["held_share"].item() == 0.0, "before after_s"


def test_the_reward_is_the_weighted_sum(asked: float) -> None:
    stage = Stage()
    assert stage.turn(asked + 0.3).reward.item() == pytest.approx(2.0 * -0.3, abs=1e-4)
    assert stage.process.episode["reward/penalty"].item() == pytest.approx(-0.6, abs=1e-4)


def test_exclusive_joints_move_alone_where_their_command_is_the_largest() -> None:
    exclusive = torch.tensor(MACHINE.is_exclusive)
    output = torch.tensor([[0.2, 0.4, 0.0, 0.0, 0.3], [0.2, 0.4, 0.0, 0.0, -3.0]])
    found = term_task.JointAction(scale=0.5, mask=True).command(output, exclusive)
    assert found[0].tolist() == pytest.approx([0.0, 0.2, 0.0, 0.0, 0.0])
    assert found[1].tolist() == pytest.approx([0.1, 0.0, 0.0, 0.0, -1.0])
    free = term_task.JointAction(scale=0.5, mask=False).command(output, exclusive)
    assert free[1].tolist() == pytest.approx([0.1, 0.2, 0.0, 0.0, -1.0])


def test_the_contract_names_each_part_and_gives_the_vector_back(asked: float) -> None:
    stage = Stage()
    described = json.loads(json.dumps(stage.process.describe()))
    assert described["order"] == ["joints (3 x 5)", "error (1 x 1)"] and described["size"] == 16
    assert described["parts"][1]["function"] == f"{__name__}:error"
    encoder = restore_encoder(MACHINE, described)
    vector = stage.first.numpy()
    samples = encoder.decode(vector)
    assert samples["joints"].shape == (1, 3, 5) and samples["error"].shape == (1, 1, 1)
    assert samples["error"].item() == pytest.approx(-asked), "in its own unit"
    np.testing.assert_allclose(encoder.encode(samples), vector, atol=1e-6)


def test_its_description_gives_the_same_terms_back() -> None:
    task = make()
    action = term_task.JointAction(scale=1.0, mask=False)
    other = make(observation={"error": term("tasks.terms:commands")}, action=action)
    node = describe_task(task).apply_to(describe_spec(other))
    assert build_node(node, "task") == task


def test_the_machine_s_loop_refuses_parts_that_it_does_not_give(tmp_path: Path) -> None:
    contract = json.loads((SHIPPED / "policy.json").read_text())
    contract["observation"] = make().build(MACHINE, 1, CPU).describe()  # type: ignore[attr-defined]
    (tmp_path / "policy.json").write_text(json.dumps(contract))
    with pytest.raises(CheckpointError, match=r"asks for joints \(3 x 5\), error \(1 x 1\)"):
        PolicyBundle(str(tmp_path), MACHINE)


def test_a_geom_of_the_scene_gives_that_of_the_machine_its_shape() -> None:
    site = find_site(option("task", "flat").scene, option("sim", "native"))
    rounded, flat = (compile_model(MACHINE, 0.01, site=one).geom("chisel") for one in (None, site))
    assert (rounded.type.item(), flat.type.item()) == (3, 5)  # a capsule, a cylinder
    ends_m = [float(one.pos[0] + one.size[1]) for one in (rounded, flat)]
    assert ends_m == pytest.approx([MACHINE.tip_m[0] - 0.04, MACHINE.tip_m[0]])
    assert flat.contype == rounded.contype and flat.conaffinity == rounded.conaffinity


SITE = """<mujoco><worldbody><geom type="box" pos="{0} {1} {2}" size=".5 .05 .3"/>{3}</worldbody></mujoco>"""


@pytest.mark.parametrize("name", ["native", pytest.param("warp", marks=pytest.mark.slow)])
def test_the_tool_feels_a_wall_of_the_scene(name: str, tmp_path: Path) -> None:
    """q1 turns the arm to the left, and a wall stands in the way of the tool."""
    q = torch.tensor(MACHINE.home, dtype=torch.float32)[None]
    x_m, y_m, z_m = Kinematics(MACHINE).pose(q).tip_in_base_m[0].tolist()
    path = tmp_path / "site.xml"
    path.write_text(SITE.format(x_m, y_m + 0.25, z_m, ""))
    simulator = option("sim", name, **({"parity_worlds": 0} if name == "warp" else {}))
    scene = make_nominal_scenes(1)
    scene[:, 0] = -20.0
    forces, ends = [], []
    for site in (None, find_site(str(path), simulator)):
        world = simulator.build(MACHINE, "cpu", 1, site=site)
        world.reset(torch.ones(1, dtype=torch.bool), q, scene)
        increment = torch.zeros(1, 5)
        increment[0, 0] = 0.02
        force_n = 0.0
        for _ in range(15):
            world.step(increment)
            force_n = max(force_n, float(world.contact_force_n))
        assert not world.faults.any()
        forces.append(force_n)
        ends.append(float(world.q[0, 0]))
    assert forces[0] == 0.0 and forces[1] > 100.0
    assert ends[1] < ends[0] - 0.05, "the wall holds the arm"


def test_a_scene_that_cannot_be_built_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "site.xml"
    path.write_text(SITE.format(1, 1, 1, "<body><freejoint/><geom size='.1'/></body>"))
    native: Any = option("sim", "native")
    with pytest.raises(ConfigError, match="must stand still"):
        native.build(MACHINE, "cpu", 1, site=path)
    path.write_text("<mujoco><nothing/></mujoco>")
    with pytest.raises(ConfigError, match="is no MJCF"):
        native.build(MACHINE, "cpu", 1, site=path)
    with pytest.raises(ConfigError, match=r"expected an MJCF file, got nowhere\.xml"):
        find_site("nowhere.xml", native)
    with pytest.raises(ConfigError, match="sim=kinematic builds no scene"):
        find_site(str(path), cast(Any, Kinematic()))


NOWHERE = torch.zeros(3, dtype=torch.bool)


def state(q: torch.Tensor | None = None, **changes: Any) -> StepState:
    """Returns three environments in the middle of an episode in which nothing ends."""
    names = ("pitch_rad", "contact_force_n", "peak_force_n", "steps", "age", "held_share")
    fields: dict[str, Any] = {name: torch.zeros(3) for name in names}
    fields |= {name: torch.zeros(3, 2) for name in ("u", "u_before")}
    still = (torch.zeros(3, 2) if q is None else q)[:, None]
    fields |= {"history": History(q=still, u=still), "start": {}}
    fields |= {"lower": -torch.ones(2), "upper": torch.ones(2), "tip_m": torch.zeros(3, 3)}
    fields |= {"max_steps": 10, "period_s": 0.05, "success": NOWHERE, "failed": NOWHERE}
    return StepState(**fields | changes)


def ends(name: str, outcome: Any = "failure", **params: Any) -> term_task.TerminationTerm:
    return term_task.TerminationTerm(function=f"tasks.terms:{name}", params=params, outcome=outcome)


START = ends("start_in_contact", "void")


@pytest.mark.parametrize(
    ("term", "changes"),
    [
        (ends("joint_limit", margin=0.1), {"q": [[0.0, 0.0], [0.0, -0.91], [0.89, 0.0]]}),
        (ends("force_limit", largest_n=100.0), {"contact_force_n": [0.0, 101.0, 100.0]}),
        (TIME, {"steps": [0.0, 10.0, 9.0]}),
        (SUCCESS, {"success": [False, True, False]}),
        (START, {"age": [1.0, 1.0, 2.0], "contact_force_n": [0.0, 1.0, 1.0]}),
    ],
    ids=lambda value: getattr(value, "function", ""),
)
def test_a_term_holds_in_the_second_environment_only(term: Any, changes: dict[str, Any]) -> None:
    here = state(**{name: torch.tensor(value) for name, value in changes.items()})
    assert term.resolve()(here).tolist() == [False, True, False]


def test_the_first_term_counts_and_time_counts_last() -> None:
    blow, limit = ends("force_limit", largest_n=100.0), ends("joint_limit", margin=0.0)
    terms = TerminationManager({"time_limit": TIME, "blow": blow, "off": None, "limit": limit})
    assert terms.reasons == ("blow", "limit", "fault", "time_limit")
    q, force_n = torch.tensor([[2.0, 0.0], [0.0, 0.0], [2.0, 0.0]]), torch.tensor([200.0, 0.0, 0.0])
    here = state(q, steps=torch.tensor([10.0, 10.0, 1.0]), contact_force_n=force_n)
    endings = terms.judge(here, torch.tensor([False, False, True]))
    counted = [terms.reasons[int(index)] for index in endings.reason]
    assert counted == ["blow", "time_limit", "limit"]
    assert endings.terminated.tolist() == [True, False, True]
    assert endings.timed_out.tolist() == [False, True, False]
    assert here.failed.tolist() == [True, False, True]
    assert endings.is_sound.tolist() == [True, True, False]


def test_a_void_start_is_no_success_and_no_failure() -> None:
    terms = TerminationManager({"success": SUCCESS, "start": START, "time_limit": TIME})
    here = state(age=torch.ones(3), success=~NOWHERE, contact_force_n=torch.tensor([1.0, 0.0, 0.0]))
    endings = terms.judge(here, NOWHERE)
    assert here.success.tolist() == [False, True, True] and not here.failed.any()
    assert endings.reason.tolist() == [1.0, 0.0, 0.0]
    assert endings.is_sound.tolist() == [False, True, True]


@pytest.mark.parametrize(
    ("terms", "told"),
    [
        ({"success": SUCCESS}, "expected a time limit"),
        ({"time_limit": None}, "expected a time limit"),
        ({"fault": TIME}, "termination.fault: the simulator's own faults"),
    ],
)
def test_a_list_that_cannot_end_an_episode_is_refused(terms: dict[str, Any], told: str) -> None:
    task = option("task", "goal_pose")
    with pytest.raises(ConfigError, match=told):
        replace(task, termination=terms)
