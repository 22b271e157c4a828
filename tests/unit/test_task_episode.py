"""Episodes of tool-pose tasks: starts, criteria at their edges, endings, figures and noise, in a world written by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from composed import MACHINE, option
from kinematic import KinematicWorld
from motion import rest
from scipy import optimize
from training import SILENT, plant

from brokk_rl.errors import ConfigError
from brokk_rl.kinematics import Kinematics, compute_tool_kinematics
from brokk_rl.sim.scene import COLUMNS, make_nominal_scenes
from tasks import starts
from tasks.term_task import ObservedTerm, RewardCurriculum, RewardTerm

CPU = torch.device("cpu")
TASKS = ("borehole_insertion", "slanted", "goal_pose")


class Stage:
    """One or more environments of a task whose arm stands where a test puts it."""

    def __init__(self, name: str = "borehole_insertion", num_envs: int = 1, **changes: Any) -> None:
        self.task = replace(option("task", name), **changes)
        self.process: Any = self.task.build(MACHINE, num_envs, CPU)
        self.world = KinematicWorld(MACHINE, num_envs)
        start = self.process.starts(num_envs, 1)
        self.history = rest(MACHINE, start["q"], num_envs)
        self.process.reset(torch.ones(num_envs, dtype=torch.bool), start)
        self.start = start
        pose = Kinematics(MACHINE).pose(start["q"])
        self.tip_m, self.pitch_rad = pose.tip_in_base_m, pose.pitch_rad

    def target_below_tip(self, x_m: float = 0.0, y_m: float = 0.0, z_m: float = 0.0) -> None:
        """Puts the target so that the tool stands at (x, y, z) from it, turned as is asked for."""
        self.process.state["start.target_pitch_rad"].copy_(self.pitch_rad)
        self.process.state["start.target_m"].copy_(self.tip_m - torch.tensor([x_m, y_m, z_m]))

    def step(self) -> Any:
        return self.process.step(self.history, self.world)

    def end(self) -> tuple[Any, str]:
        """Takes a step that ends the episode; returns it and the reason."""
        end = self.step()
        return end, self.process.reasons[int(end.reason)]

    def observe(self) -> dict[str, torch.Tensor]:
        """Returns what the policy sees, by its parts."""
        return self.process.control.encoder.decode(self.process.observe(self.history)["policy"])


def terminations(**changes: Any) -> dict[str, Any]:
    """Returns the endings of the shipped task with changes."""
    return {**option("task", "borehole_insertion").termination, **changes}


@pytest.mark.parametrize("name", TASKS)
def test_starts_lie_within_the_limits_and_in_the_open(name: str) -> None:
    task = option("task", name)
    start = task.build(MACHINE, 1, CPU).starts(256, 5)
    lower, upper = torch.tensor(MACHINE.lower), torch.tensor(MACHINE.upper)
    margin = task.arms.margin_rad - 1e-5
    assert ((start["q"] >= lower + margin) & (start["q"] <= upper - margin)).all()
    tip = Kinematics(MACHINE).pose(start["q"]).tip_in_base_m
    top = torch.zeros(256) if name == "goal_pose" else start["scene"][:, 2]
    assert (tip[:, 2] > top + task.arms.clearance_m).all() and (tip[:, 2] > task.arms.floor_m).all()


def test_starts_are_the_same_for_every_controller() -> None:
    task = option("task", "borehole_insertion")
    other = replace(task.classical, gain_1_s=0.1, margin_rad=0.3, straight=False, damping=1.0)
    both = (task, replace(task, classical=other))
    first, second = (one.build(MACHINE, 1, CPU).starts(64, 3) for one in both)
    assert all(torch.equal(first[name], second[name]) for name in first)


def _miss_pose_m(q: np.ndarray, goal_m: np.ndarray) -> float:
    """Returns how far SciPy stays from an upright tool at a place, q2 at rest, from four seeds."""
    free, draws = [0, 2, 3, 4], np.random.default_rng(0)
    lower, upper = MACHINE.lower[free] + 0.03, MACHINE.upper[free] - 0.03

    def miss(moved: np.ndarray) -> np.ndarray:
        arm = q.copy()
        arm[free] = moved
        tool = compute_tool_kinematics(MACHINE, arm)
        return np.concatenate((tool.tip_in_base_m - goal_m, tool.axis_in_base - [0.0, 0.0, -1.0]))

    ends = []
    for _ in range(4):
        seed = draws.uniform(lower, upper)
        ends.append(optimize.least_squares(miss, seed, bounds=(lower, upper)))
    return min(float(np.abs(end.fun).max()) for end in ends)


def test_another_solver_finds_no_pose_either_where_a_start_is_refused_for_it() -> None:
    task = option("task", "borehole_insertion")
    search = starts.StartSearch(task, MACHINE)
    _, part = next(search._draw_chunks(4096, 5))
    (in_range, has_pose, _), _ = search.check(part)
    ready, _ = search._bring_into_range(part["q"], part["target_m"])
    refused = (in_range & ~has_pose).nonzero()[:, 0].tolist()
    assert 5 <= len(refused) <= 0.02 * len(ready)
    for row in refused[:5]:
        q, target_m = ready[row].double().numpy(), part["target_m"][row].double().numpy()
        inside, above = ([0.0, 0.0, up_m] for up_m in (-task.depth_m, task.arms.clearance_m))
        missed_m = [_miss_pose_m(q, target_m + shift) for shift in (inside, above)]
        assert max(missed_m) > 1e-3


def test_holes_lie_in_their_ranges_and_the_scene_holds_the_target() -> None:
    task = option("task", "borehole_insertion")
    start = task.build(MACHINE, 1, CPU).starts(256, 5)
    assert torch.equal(start["scene"][:, :3], start["target_m"])
    far = start["target_m"][:, :2].norm(dim=1)
    assert ((far >= 2.3 - 1e-5) & (far <= 3.5 + 1e-5)).all()
    assert ((start["scene"][:, 4] >= 1.0) & (start["scene"][:, 4] <= 1.1)).all()
    assert (start["target_pitch_rad"] == torch.tensor(torch.pi / 2)).all()


@pytest.mark.parametrize(
    ("distance_m", "reason"),
    [
        ((9.0, 10.0), "100.0% fail by 'target in the working range' (change task.switch"),
        ((4.0, 4.1), "100.0% fail by 'pose within the joint limits' (change the ranges"),
    ],
)
def test_a_draw_of_which_nothing_can_be_done_ends_with_the_reason(
    distance_m: tuple[float, float], reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(starts, "MIN_CANDIDATES", 1024)
    task = option("task", "borehole_insertion")
    task = replace(task, hole=replace(task.hole, distance_m=distance_m))
    process = task.build(MACHINE, 1, CPU)
    with pytest.raises(ConfigError, match="BoreholeInsertion: nearly no start can be") as told:
        process.starts(1, 0)
    assert reason in str(told.value) and "0 of 1024 candidates" in str(told.value)


def test_a_draw_of_which_little_can_be_done_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tried on a chunk in which one candidate in 200 can be done, then one in 300."""
    monkeypatch.setattr(starts, "MIN_CANDIDATES", 1000)
    free = torch.ones(6000, dtype=torch.bool)
    tally = starts.DrawTally("a task", 10_000)
    done = torch.arange(6000) % 200 == 0
    tally.add(6000, [free, done, done, done])
    done = torch.arange(6000) % 10_000 == 0
    with pytest.raises(ConfigError, match=r"a task: .* 31 of 12000 candidates"):
        tally.add(6000, [free, done, done, done])


def test_a_draw_checked_in_parts_is_the_draw_checked_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    process = option("task", "borehole_insertion").build(MACHINE, 1, CPU)
    whole = process.starts(100, 2)
    monkeypatch.setattr(starts, "CHUNK", 64)
    parts = process.starts(100, 2)
    torch.testing.assert_close(parts, whole, rtol=0.0, atol=1e-4)


def test_a_draw_with_no_arm_in_the_open_is_just_empty() -> None:
    process = option("task", "goal_pose").build(MACHINE, 1, CPU)
    nothing = {name: value[:0] for name, value in process.starts(1, 0).items()}
    passed, _ = starts.StartSearch(process.task, MACHINE).check(nothing)
    assert [part.shape for part in passed] == [(0,)] * (len(starts.CONDITIONS) - 1)


@pytest.mark.parametrize("name", ["goal_pose", "slanted"])
def test_a_pitch_that_varies_must_be_told_to_the_policy(name: str) -> None:
    task = option("task", name)
    with pytest.raises(ConfigError, match="policy must observe"):
        replace(task, scaling=replace(task.scaling, pitch_rad=None))


Place = tuple[float, float, float]


def judge(
    name: str, at_m: Place, turn_rad: float = 0.0, force_n: float = 0.0
) -> tuple[bool, bool, bool]:
    """Returns whether a tool at `at_m` from a target below it is there, and strict and paper's success."""
    target_m, down = torch.tensor([[2.5, 0.5, 0.75]]), torch.tensor([torch.pi / 2])
    start = {"target_m": target_m, "target_pitch_rad": down, "scene": make_nominal_scenes(1)}
    tip_m, force = target_m + torch.tensor([at_m]), torch.tensor([force_n])
    verdict = option("task", name).judge(tip_m, down + turn_rad, force, start)
    return bool(verdict.reached), bool(verdict.success), bool(verdict.paper_success)


DEEP = (0.0, 0.0, -0.12)
"""A place in the hole, m from the target."""


@pytest.mark.parametrize(
    ("name", "at_m", "turn_rad", "force_n", "reached", "strict"),
    [
        *((name, *row) for name in ("borehole_insertion", "slanted") for row in (  # both vertical
            ((0.0, 0.0, -0.101), 0.0, 0.0, True, True),  # 0.10 m below the rim
            ((0.0, 0.0, -0.099), 0.0, 0.0, False, False),
            ((0.0, 0.0, -0.30), 0.0, 0.0, True, True),  # deeper is as good
            ((0.0125, 0.0, -0.12), 0.0, 0.0, True, True),  # 5 cm hole, 4 cm chisel and 3 mm of slack leave 13 mm
            ((0.0, -0.0135, -0.12), 0.0, 0.0, False, False),  # that deep beside the hole would be in the concrete
            ((0.0095, 0.0095, -0.12), 0.0, 0.0, False, False),  # 13.4 mm off axis
            ((0.0, 0.0, 0.2), 0.0, 0.0, False, False),
        )),
        # a tilted or forced insertion is inserted but no strict success
        ("borehole_insertion", DEEP, 0.10, 9.9e3, True, True),
        ("borehole_insertion", DEEP, -0.12, 0.0, True, False),
        ("borehole_insertion", DEEP, 0.12, 0.0, True, False),  # the paper's limit is 1 / 0.9 - 1 = 0.11
        ("borehole_insertion", DEEP, 0.0, 1.01e4, True, False),
        # a pose is reached within three centimetres and a twentieth of a radian
        *(("goal_pose", at_m, turn_rad, 0.0, is_there, is_there) for at_m, turn_rad, is_there in (
            ((0.0, 0.0, 0.0), 0.0, True),
            ((0.0, 0.0, 0.0295), 0.0, True),
            ((0.0, 0.0, -0.0305), 0.0, False),
            ((0.018, 0.018, 0.018), 0.0, False),  # 31 mm
            ((0.0, 0.0, 0.0), 0.0495, True),
            ((0.0, 0.0, 0.0), -0.0505, False),
        )),
    ],
)  # fmt: skip
def test_success_is_judged_by_place_angle_and_force(
    name: str, at_m: Place, turn_rad: float, force_n: float, reached: bool, strict: bool
) -> None:
    assert judge(name, at_m, turn_rad, force_n)[:2] == (reached, strict)


@pytest.mark.parametrize(
    ("name", "at_m", "turn_rad", "paper"),
    [
        ("borehole_insertion", (0.0, 0.0, -0.14), 0.0, True),
        ("borehole_insertion", (0.0, 0.0, -0.051), 0.0, True),  # the height limit; 8.9 cm from the target point
        ("borehole_insertion", (0.0, 0.0, -0.049), 0.0, False),
        ("borehole_insertion", (0.11, 0.0, -0.14), 0.0, True),  # 1 / 1.11 = 0.901; it need not be inside the hole
        ("borehole_insertion", (0.112, 0.0, -0.14), 0.0, False),  # 1 / 1.112 = 0.899
        ("borehole_insertion", (0.0, 0.0, -0.14), 0.110, True),
        ("borehole_insertion", (0.0, 0.0, -0.14), -0.112, False),
        ("goal_pose", (0.11, 0.0, 0.0), 0.0, True),
        ("goal_pose", (0.112, 0.0, 0.0), 0.0, False),
        ("goal_pose", (0.0, 0.0, 0.0), -0.110, True),
        ("goal_pose", (0.0, 0.0, 0.0), 0.112, False),
    ],
)  # fmt: skip
def test_the_papers_success_needs_alignment_and_of_an_insertion_height(
    name: str, at_m: Place, turn_rad: float, paper: bool
) -> None:
    assert judge(name, at_m, turn_rad)[2] is paper


def test_an_insertion_is_measured_along_the_axis_and_by_the_radius_of_its_own_hole() -> None:
    """Three holes straight ahead that lean 0.2 rad away from the machine, the last one narrower."""
    task, lean_rad = option("task", "slanted"), torch.full((3,), 0.2)
    axis = torch.tensor([-0.19867, 0.0, -0.98007])  # sin and cos of 0.2: back and down
    across = torch.tensor([0.98007, 0.0, -0.19867])
    target_m = torch.tensor([[2.5, 0.0, 0.75]]).repeat(3, 1)
    scenes = make_nominal_scenes(3)
    scenes[2, COLUMNS.index("hole_radius_m")] = 0.042
    start = {"target_m": target_m, "target_pitch_rad": torch.pi / 2 + lean_rad, "scene": scenes}
    aside_m = torch.tensor([[0.012], [0.014], [0.012]])
    tip_m = target_m + 0.11 * axis + aside_m * across
    verdict = task.judge(tip_m, start["target_pitch_rad"], torch.zeros(3), start)
    assert verdict.success.tolist() == [True, False, False]
    torch.testing.assert_close(verdict.lateral_m, aside_m[:, 0], rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", TASKS)
def test_closeness_grows_on_the_way_from_none_to_one(name: str) -> None:
    depth_m = 0.0 if name == "goal_pose" else 0.14
    height_m = torch.linspace(2.0, -depth_m, 50)
    target = torch.tensor([[2.5, 0.0, 0.7]]).repeat(50, 1)
    tip = target + torch.stack((0 * height_m, 0 * height_m, height_m), 1)
    down = torch.full((50,), torch.pi / 2)
    start = {"target_m": target, "target_pitch_rad": down, "scene": make_nominal_scenes(50)}
    closeness = option("task", name).judge(tip, down, 0 * down, start).closeness
    assert (closeness.diff() > 0).all() and closeness[0] > 0
    assert closeness[-1] == pytest.approx(1.0, abs=1e-5)


def test_a_start_in_contact_ends_at_once_with_no_reward() -> None:
    stage = Stage()
    stage.world.contact_force_n.fill_(500.0)
    end, reason = stage.end()
    assert end.terminated.item() and not end.timed_out.item() and end.reward.item() == 0.0
    assert reason == "start_in_contact"


@pytest.mark.parametrize("joint", range(5))
def test_a_joint_at_its_limit_ends_the_episode_as_a_failure(joint: int) -> None:
    stage = Stage()
    stage.step()
    stage.history.q[0, -1, joint] = float(MACHINE.upper[joint]) - 0.011
    assert not stage.step().terminated.item(), "11 mrad from the end of the travel is still inside"
    stage.history.q[0, -1, joint] = float(MACHINE.upper[joint]) - 0.009
    end, reason = stage.end()
    assert reason == "joint_limit" and end.terminated.item() and not end.timed_out.item()
    assert end.reward.item() < -5.0, "5 (1 + closeness) is lost"


def test_episodes_put_out_of_step_end_earlier_but_know_their_first_step() -> None:
    stage = Stage(episode_s=1.0)
    stage.process.state["steps"].fill_(18.0)  # what rsl-rl does through episode_length_buf
    stage.world.contact_force_n.fill_(500.0)
    assert stage.end()[1] == "start_in_contact"
    stage.world.contact_force_n.fill_(0.0)
    assert stage.step().timed_out.item()


def test_a_fault_ends_the_episode_without_reward_or_success() -> None:
    stage = Stage()
    stage.target_below_tip(z_m=-0.12)
    stage.world.faults.fill_(True)
    end, reason = stage.end()
    assert reason == "fault" and end.terminated.item() and end.reward.item() == 0.0
    assert stage.process.episode["success_strict"].item() == 0.0


def test_success_ends_the_episode_only_where_it_shall() -> None:
    for switch in ({}, {"success": None}):
        stage = Stage(termination=terminations(**switch))
        stage.step()
        stage.target_below_tip(z_m=-0.12)
        end, reason = stage.end()
        assert bool(end.terminated) is (not switch)
        assert reason == "success" if not switch else int(end.reason) == -1
        assert stage.process.episode["success_strict"].item() == 1.0


def test_a_row_is_done_hole_by_hole_and_the_tool_drawn_out_between() -> None:
    stage = Stage("several", noise=noise())
    state = stage.process.state
    for hole in range(3):
        stage.target_below_tip(z_m=-0.12)
        assert bool(stage.step().terminated) is (hole == 2)
        if hole == 2:
            break
        stage.process.observe(stage.history)
        seen_m = state["estimate_m"] - state["start.target_m"]
        assert seen_m[0].tolist() == pytest.approx([0.0, 0.0, 0.14 + 0.2], abs=1e-5)
        stage.target_below_tip(z_m=0.15)  # drawn out
        before_m = state["start.target_m"].clone()
        stage.step()
        way_m = (state["start.target_m"] - before_m)[0]
        assert way_m.norm().item() == pytest.approx(0.25, abs=1e-5)
        assert (way_m @ before_m[0]).item() == pytest.approx(0.0, abs=1e-5) and way_m[2] == 0.0
        stage.process.observe(stage.history)
        torch.testing.assert_close(state["estimate_m"], state["start.target_m"])
    assert stage.process.episode["success_strict"].item() == 1.0


def test_rows_that_leave_the_reach_are_refused() -> None:
    task: Any = option("task", "several")
    wide = replace(task, row=replace(task.row, spacing_m=20.0))
    with pytest.raises(ConfigError, match=r"change task\.row\.spacing_m"):
        wide.build(MACHINE, 2, CPU).starts(2, seed=0)


def test_a_block_that_is_struck_gives_way_once() -> None:
    loop = plant(option("task", "several")).build(CPU, 2, 8, 0)
    world: Any = loop.world
    loop.step(torch.zeros(2, 5))  # contact in the first step would void the episode
    before_m = loop.task.state["start.scene"][:, :2].clone()
    world.contact_force_n.copy_(torch.tensor([6e3, 4e3]))
    for _ in range(2):
        loop.step(torch.zeros(2, 5))
        mask, scene = world.placed
        moved_m = (scene[:, :2] - before_m).norm(dim=1)
        torch.testing.assert_close(moved_m, torch.tensor([0.01, 0.0]), rtol=0, atol=1e-6)
    assert not mask.any()


def test_the_figures_of_a_scripted_episode() -> None:
    """Five steps of 50 ms: commands 0.5, 0.5, -0.5 of q1 and still; 30 mm beside the hole, then inside at 0.2 s, then out again."""
    task = option("task", "borehole_insertion")
    action = replace(task.action, kind="direct", scale=1.0, limits=False)
    stage = Stage(termination=terminations(success=None), action=action)
    stage.process.state["lowest"].fill_(-1.0)
    stage.process.state["highest"].fill_(1.0)
    script = [  # command of q1, force, tool from the target
        (0.5, 0.0, (0.03, 0.0, 0.5)),
        (0.5, 900.0, (0.03, 0.0, 0.3)),
        (-0.5, 400.0, (0.02, 0.0, 0.1)),
        (-0.5, 0.0, (0.004, 0.003, -0.12)),
        (-0.5, 0.0, (0.3, 0.0, 0.5)),
    ]
    for command, force_n, at_m in script:
        # q2 is masked: not positioning.
        stage.history.push_u(stage.process.command(torch.tensor([[command, 0.9, 0.0, 0.0, 0.0]])))
        stage.world.contact_force_n.fill_(force_n)
        stage.target_below_tip(*at_m)
        stage.step()
    figures = {name: value.item() for name, value in stage.process.episode.items()}
    # 6 full strokes a second.
    assert figures["valve_travel"] == pytest.approx((0.5 + 0 + 1.0 + 0 + 0) / 0.05 / 5)
    assert figures["time_to_insert_s"] == pytest.approx(0.2)
    assert figures["lateral_error_m"] == pytest.approx(0.005, abs=1e-6)  # when it was inserted
    assert figures["peak_force_n"] == 900.0
    assert figures["length"] == 5 and figures["success_strict"] == 1.0


def test_an_episode_never_inserted_reports_its_last_lateral_error() -> None:
    stage = Stage()
    for lateral_m in (0.3, 0.2, 0.06):
        stage.target_below_tip(x_m=lateral_m, z_m=0.3)
        stage.step()
    assert stage.process.episode["lateral_error_m"].item() == pytest.approx(0.06, abs=1e-6)
    assert stage.process.episode["time_to_insert_s"].item() == 0.0


def estimates(stage: Stage, count: int) -> torch.Tensor:
    """Returns the errors of the first estimates of an episode, `(count, N, 3)`."""
    found = []
    for _ in range(count):
        found.append(stage.observe()["target_in_base_m"] - stage.process.state["start.target_m"])
        stage.step()
    return torch.stack(found)


def noise(**changes: Any) -> Any:
    return replace(option("task", "borehole_insertion").noise, **(SILENT | changes))


def test_the_mean_filter_gives_the_mean_of_all_samples_so_far() -> None:
    errors = {}
    for kind in ("none", "mean"):
        stage = Stage(num_envs=16, noise=noise(target_sample_m=0.01, filter=kind))
        torch.manual_seed(3)
        errors[kind] = estimates(stage, 20)
    running = errors["none"].cumsum(0) / torch.arange(1, 21)[:, None, None]
    torch.testing.assert_close(errors["mean"], running, rtol=0, atol=2e-6)
    assert errors["none"].abs().max() <= 0.01 + 1e-6
    assert errors["mean"][-1].std() < errors["none"][-1].std() / 3


def test_the_bias_is_constant_within_an_episode_and_bounded() -> None:
    torch.manual_seed(0)
    stage = Stage(num_envs=512, noise=noise(target_bias_m=0.008))
    errors = estimates(stage, 3)
    torch.testing.assert_close(errors[0], errors[2], rtol=0, atol=1e-6)
    length = errors[0].norm(dim=1)
    assert length.max() <= 0.008 + 1e-6 and length.max() > 0.0075 and length.min() < 0.0005
    assert errors[0].mean(0).abs().max() < 0.001, "all directions alike"


def test_a_camera_sees_a_target_worse_with_the_square_of_the_distance() -> None:
    law = noise(target_bias_m=0.002, target_bias_1_m=1e-3, camera_in_base_m=(0.3, 0.45, 1.9))
    ahead = torch.tensor([[0.3 + 2.0, 0.45, 1.9], [0.3, 0.45, 1.9 - 3.0]])
    found = law.measure_bias_m(ahead)
    torch.testing.assert_close(found, torch.tensor([[0.006], [0.011]]))  # 2 + 4 and 2 + 9 mm
    assert law.measure_sample_m(ahead) == 0.0


def test_the_papers_noise_is_a_share_of_each_coordinate() -> None:
    torch.manual_seed(0)
    stage = Stage(num_envs=512, noise=noise(target_relative=0.05))
    first, second = (error.abs() / stage.start["target_m"].abs() for error in estimates(stage, 2))
    assert first.max() <= 0.05 + 1e-5 and first.max() > 0.049
    assert not torch.equal(first, second), "white: drawn anew in each sample"


def test_positions_and_commands_are_scaled_by_one_factor_an_episode() -> None:
    torch.manual_seed(0)
    stage = Stage(num_envs=256, noise=noise(q_scale=0.1, u_scale=0.1))
    stage.history.q.fill_(1.0)
    stage.history.u.fill_(0.5)
    seen = stage.observe()
    q_factor, u_factor = seen["q"].flatten(1), seen["u"].flatten(1) / 0.5
    for factor in (q_factor, u_factor):
        middle = factor.median(1).values
        assert (factor - middle[:, None]).abs().max() < 1e-5, "all joints and samples alike"
        assert 0.9 - 1e-4 <= middle.min() < 0.91 and 1.09 < middle.max() <= 1.1 + 1e-4
    before = stage.process.state["q_scale"].clone()
    stage.step()
    stage.process.observe(stage.history)
    assert torch.equal(before, stage.process.state["q_scale"])


def test_a_scale_of_the_motion_leaves_the_newest_position_as_it_is() -> None:
    torch.manual_seed(0)
    stage = Stage(num_envs=64, noise=noise(q_scale=0.1, q_scale_of="motion"))
    stage.history.q.copy_(torch.linspace(0.4, 1.0, 13)[None, :, None].expand(64, 13, 5))
    q = stage.observe()["q"]
    assert torch.allclose(q[:, -1], torch.ones(64, 5), atol=1e-6)
    factor = (q[:, -1:] - q[:, :-1]) / (1.0 - stage.history.q[:, :-1])
    assert (factor - stage.process.state["q_scale"][:, None, None]).abs().max() < 1e-4
    assert factor.min() < 0.92 and factor.max() > 1.08


def test_penalties_grow_with_the_share_of_worlds_whose_last_episode_succeeded() -> None:
    """Four worlds. `duration` pays 1 in each step: a quarter of it at first, all of it once all have succeeded."""
    terms = {"time": RewardTerm(function="tasks.terms:duration", weight=1.0)}
    rule = RewardCurriculum(begin={"time": 0.25}, figure="success_reached", success=(0.0, 1.0))
    stage = Stage(num_envs=4, reward=terms, curriculum=rule)
    assert stage.step().reward.tolist() == [0.25] * 4
    process, done = stage.process, torch.tensor([True, True, False, False])
    process.episode["success_reached"].copy_(torch.tensor([1.0, 0.0, 1.0, 0.0]))
    assert stage.step().reward.tolist() == [0.25] * 4, "an episode counts once it has ended"
    process.reset(done, stage.start)
    assert stage.step().reward.tolist() == [0.25 + 0.75 / 4] * 4
    process.reset(~done, stage.start)
    assert stage.step().reward.tolist() == [0.25 + 0.75 / 2] * 4
    process.episode["success_reached"].fill_(1.0)
    process.reset(done | ~done, stage.start)
    assert stage.step().reward.tolist() == [1.0] * 4
    process.reset(done | ~done, stage.start)
    assert stage.step().reward.tolist() == [0.25] * 4, "and falls again where they fail"


def test_terms_of_ones_own_extend_what_the_critic_sees() -> None:
    term = ObservedTerm(
        function="tasks.terms:tool_pitch", samples=2, mean=1.0, std=0.5, noise=0.0, bias=0.0
    )
    stage = Stage(privileged={"pitch": term})
    plain = Stage().process.observe(stage.history)["privileged"]
    seen = stage.process.observe(stage.history)["privileged"]
    pitch_rad = Kinematics(MACHINE).pose(stage.start["q"]).pitch_rad
    assert seen.shape[1] == plain.shape[1] + 2
    torch.testing.assert_close(seen[:, -1], (pitch_rad - 1.0) / 0.5)


def test_without_noise_the_policy_sees_the_truth() -> None:
    stage = Stage("goal_pose", num_envs=4, noise=noise())
    expected = {"target_in_base_m": stage.start["target_m"], "q": stage.history.q}
    expected |= {"pitch_rad": stage.start["target_pitch_rad"], "u": stage.history.u}
    torch.testing.assert_close(stage.observe(), expected, rtol=0, atol=1e-6)
