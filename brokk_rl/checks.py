"""Is it a valid actuator, effect, task or finder? What these checkers accept is one.

Each builds the object, exercises it against the promises of its Protocol in `brokk_rl.contracts`,
and raises an `AssertionError` that says which promise was broken. Our own tests run them over every
option of each config group; an extension over its own:

    def test_my_actuator_is_an_actuator():
        check_actuator(MyActuator(gain=1.0), machine)
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from copy import deepcopy
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from brokk_rl.contracts.actuator import Actuator, ActuatorModel, Effect, FollowerModel
from brokk_rl.contracts.task import FAULT, STEPS, SUCCESS, Task, TaskProcess
from brokk_rl.contracts.vision import BoreholeFinder, FinderSpec, FrameDetections, HolePose
from brokk_rl.errors import FrameError
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.observation import restore_encoder
from brokk_rl.signals import Frame

NUM_ENVS = 4
"""Environments of a check. Chosen by hand; not searched."""
Tensors = Mapping[str, torch.Tensor]
NUM_STEPS = 20
"""Control periods of a check. Chosen by hand; not searched."""
COMMAND_SIZES = (0.0, 0.5, 100.0)
"""Standard deviations of the random actions tried: rest, usual, and far beyond the commands'
range."""
HEIGHT_PX, WIDTH_PX = 120, 160
"""Size of the picture of a check, px. Chosen by hand: small is fast."""
UNIT_TOLERANCE = 1e-5
"""Largest departure of an axis' length from 1: that of float32."""
NEGATIVE_VARIANCE = -1e-12
"""Smallest eigenvalue of a covariance that rounding may leave, m² or rad²."""


def check_actuator(
    actuator: Actuator, machine: Machine, device: torch.device | str = "cpu"
) -> None:
    """Check the model of `Actuator.build` against `ActuatorModel`."""
    place = torch.device(device)
    with isolate_randomness():
        check_actuator_model(actuator.build(machine, NUM_ENVS, place), machine, place)


def check_effect(effect: Effect, machine: Machine, device: torch.device | str = "cpu") -> None:
    """Check that an effect around the simplest actuator model is again an actuator model."""
    place = torch.device(device)
    with isolate_randomness():
        inner = ProportionalModel(machine, place)
        check_actuator_model(effect.wrap(inner, machine, NUM_ENVS, place), machine, place)


def check_actuator_model(model: ActuatorModel, machine: Machine, device: torch.device) -> None:
    """Check an actuator model for `NUM_ENVS` environments; see `ActuatorModel` for the promises."""
    check_memory(model, machine, device, lambda alter: _drive(model, machine, device, alter))
    model.reset(torch.ones(NUM_ENVS, dtype=torch.bool, device=device))
    history = build_rest_history(machine, device)
    moved = (model.step(history) - history.q[:, -1]).abs().amax(0).cpu().numpy()
    limit = machine.max_speed * machine.period_s
    text = f"reset: at rest and without a command the joints move by {moved} in one period"
    assert (moved <= limit).all(), text


class ProportionalModel:
    """The simplest actuator model: speed proportional to the command.

    Attributes:
        drive_changes: Changes by effects on drives, which do nothing to it.
    """

    def __init__(self, machine: Machine, device: torch.device) -> None:
        self.state: dict[str, torch.Tensor] = {}
        self.drive_changes: dict[str, torch.Tensor] = {}
        step = machine.max_speed * machine.period_s
        self._step = torch.as_tensor(step, dtype=torch.float32, device=device)

    def reset(self, mask: torch.Tensor) -> None:
        """Have no memory."""

    def step(self, history: History) -> torch.Tensor:
        """Return the joint positions one control period later, `(N, J)`."""
        return history.q[:, -1] + history.u[:, -1] * self._step


def _drive(
    model: ActuatorModel, machine: Machine, device: torch.device, alter_first: bool
) -> torch.Tensor:
    """Return positions under random and full commands, `(T, N, J)`.

    `alter_first` changes the commands of environment 0.
    """
    generator = torch.Generator().manual_seed(0)
    history, found = build_rest_history(machine, device), []
    for step in range(NUM_STEPS):
        u = torch.rand((NUM_ENVS, machine.num_joints), generator=generator) * 2 - 1
        u = u.sign() if step % 4 == 0 else u
        if alter_first:
            u[0] = -u[0]
        history.push_u(u.to(device))
        kept = copy_tensors(vars(history))
        q = model.step(history).clone()
        check_same(vars(history), kept, "step: changed the history")
        history.push_q(q)
        found.append(q)
    return torch.stack(found)


def check_task(task: Task, machine: Machine, device: torch.device | str = "cpu") -> None:
    """Check a task against `TaskProcess`, and the optional methods that it offers.

    The arm does not move meanwhile: no simulator is needed.

    Raises:
        AssertionError: A promise is broken; the message names it.
    """
    device = torch.device(device)
    with isolate_randomness():
        process = task.build(machine, NUM_ENVS, device)
        _check_attributes(process)
        drawn = _check_starts(process, machine)
        start = {name: value.to(device) for name, value in drawn.items()}
        history = build_rest_history(machine, device, start["q"])
        places = view_tensors(process.state), view_tensors(process.episode)

        groups = _check_observation(process, history, start)
        _check_commands(process, machine, device)
        _check_optional(process, groups, machine)
        _check_episode(process, history, device)
        check_in_place(process.state, places[0], "state")
        check_in_place(process.episode, places[1], "episode")
        before = copy_tensors(process.state)
        process.reset(torch.arange(NUM_ENVS, device=device) == 0, start)
        _check_other_rows(process.state, before)


def _check_attributes(process: TaskProcess) -> None:
    sizes = (process.num_actions, process.max_episode_steps)
    assert min(sizes) > 0, "num_actions and max_episode_steps: expected 1 or more"
    reasons = process.reasons
    assert len(set(reasons)) == len(reasons), f"reasons: expected different names, got {reasons}"
    assert FAULT in reasons, f"reasons: expected '{FAULT}', for worlds that diverged, in {reasons}"
    check_rows(process.state, "state")
    check_rows(process.episode, "episode")
    for mapping, name in (("state", STEPS), ("episode", SUCCESS)):
        value = getattr(process, mapping).get(name)
        is_good = value is not None and value.shape == (NUM_ENVS,)
        assert is_good, f"{mapping}: expected an entry '{name}' of shape (N,)"
    unknown = process.figures.keys() - process.episode.keys()
    assert not unknown, f"figures: there is no {', '.join(unknown)} in episode"


def _check_starts(process: TaskProcess, machine: Machine) -> dict[str, torch.Tensor]:
    """Check the drawn starts; return some of them."""
    start, again = process.starts(NUM_ENVS, 1), process.starts(NUM_ENVS, 1)
    other = process.starts(NUM_ENVS, 2)
    for name in ("q", "scene"):
        assert name in start, f"starts: no '{name}' among {', '.join(start)}"
    check_rows(start, "starts")
    for name, value in start.items():
        assert value.isfinite().all(), f"starts: '{name}' is not finite"
        check_same(value, again[name], f"starts: '{name}' differs for the same seed")
    assert not start["q"].equal(other["q"]), "starts: another seed gives the same arms"
    q = start["q"].cpu().numpy()
    inside = (q >= machine.lower) & (q <= machine.upper)
    assert inside.all(), "starts: an arm begins outside its joint limits"
    return start


def _check_observation(
    process: TaskProcess, history: History, start: dict[str, torch.Tensor]
) -> dict[str, torch.Tensor]:
    """Check the observation after a reset; return copies of its groups."""
    everywhere = torch.ones(NUM_ENVS, dtype=torch.bool, device=start["q"].device)
    found = []
    for _ in range(2):
        torch.manual_seed(0)
        process.reset(everywhere, start)
        found.append(copy_tensors(process.observe(history)))
    groups, again = found
    check_same(again, groups, "reset, observe: the same seed gives another observation")
    assert "policy" in groups, f"observe: no group 'policy' among {', '.join(groups)}"
    check_rows(groups, "observe")
    for name, value in groups.items():
        is_good = value.dtype == torch.float32 and bool(value.isfinite().all())
        assert is_good, f"observe: '{name}' is not finite float32"
    return groups


def _check_commands(process: TaskProcess, machine: Machine, device: torch.device) -> None:
    for size in COMMAND_SIZES:
        u = process.command(size * torch.randn(NUM_ENVS, process.num_actions, device=device))
        assert u.shape == (NUM_ENVS, machine.num_joints), f"command: got shape {tuple(u.shape)}"
        text = "command: leaves [-1, 1]; actions of the policy arrive unclipped"
        assert (u.abs() <= 1).all(), text


def _check_optional(
    process: TaskProcess, groups: dict[str, torch.Tensor], machine: Machine
) -> None:
    """Check the optional methods that need no particular target."""
    num_actions = process.num_actions
    if "classical_action" in process.offers:
        shape = tuple(process.classical_action(groups).shape)
        assert shape == (NUM_ENVS, num_actions), f"classical_action: got shape {shape}"
    if "deployable" not in process.offers:
        return
    vector, description = groups["policy"], process.describe()
    json.dumps(description)
    size = description["size"]
    known = restore_encoder(machine, description).size
    assert known == size, f"describe: a vector of {size} numbers, but its parts have {known}"
    assert vector.shape == (NUM_ENVS, size), f"observe: expected a policy vector of {size} numbers"
    resting = torch.nn.Module()  # a network whose action is zero
    resting.forward = lambda groups: groups["policy"].new_zeros(NUM_ENVS, num_actions)
    with torch.no_grad():
        u = process.deployable(resting)(vector)
    is_command = u.shape == (NUM_ENVS, machine.num_joints) and bool((u.abs() <= 1).all())
    text = "deployable: expected commands (B, J) in [-1, 1] for policy vectors (B, O)"
    assert is_command, text


def _check_episode(process: TaskProcess, history: History, device: torch.device) -> None:
    """Run to the time limit with an arm that never moves."""
    nowhere = torch.zeros(NUM_ENVS, dtype=torch.bool, device=device)
    force_n = torch.zeros(NUM_ENVS, device=device)
    world: Any = SimpleNamespace(q=history.q[:, -1], contact_force_n=force_n, faults=nowhere)
    kept, over = copy_tensors(vars(history)), nowhere.clone()
    for _ in range(process.max_episode_steps):
        step = process.step(history, world)
        for name, value in vars(step).items():
            shape = tuple(value.shape)
            assert shape == (NUM_ENVS,), f"step: '{name}' has shape {shape}"
        assert step.reward.isfinite().all(), "step: the reward is not finite"
        is_bool = step.terminated.dtype == step.timed_out.dtype == torch.bool
        assert is_bool, "step: terminated and timed_out must be bool"
        both = step.terminated & step.timed_out
        assert not both.any(), "step: an episode both terminated and timed out"
        ended = step.terminated | step.timed_out
        text = "reason must be -1 while the episode goes on, and its index where it ended"
        assert ((step.reason >= 0) == ended).all(), f"step: {text}"
        is_index = step.reason < len(process.reasons)
        assert is_index.all(), "step: reason is no index into reasons"
        process.observe(history)
        over |= ended
    text = f"step: no time-out after max_episode_steps = {process.max_episode_steps}"
    assert over.all(), text
    check_same(vars(history), kept, "step, observe: changed the history")


def check_finder(finder_spec: FinderSpec) -> None:
    """Check a finder against `BoreholeFinder` on three synthetic frames.

    One frame shows a dark hole in a flat face, one shows noise, one has no depth. A finder need not
    find the hole. It must answer the way that `mode=perceive` and the camera process expect, with
    and without a known pose of the camera.

    Raises:
        AssertionError: a promise is broken; the message says which.
    """
    finder = finder_spec.build()
    assert callable(getattr(finder, "find", None)), "build: the finder has no method find(frame)"
    generator = np.random.default_rng(0)
    hole = _draw_hole(generator)
    noise = replace(
        hole,
        color=generator.integers(0, 255, hole.color.shape, dtype=np.uint8),
        depth_m=generator.uniform(1.0, 4.0, hole.depth_m.shape).astype(np.float32),
    )
    blind = replace(noise, depth_m=np.full_like(noise.depth_m, np.nan))
    for frame in (hole, noise, blind, replace(hole, base_from_camera=None)):
        _check_frame(finder, frame)


def _draw_hole(generator: np.random.Generator) -> Frame:
    """Return a frame of a dark disc of 0.05 m in a bright face 1 m away, without depth inside."""
    camera_matrix = np.array([[140.0, 0.0, 80.0], [0.0, 140.0, 60.0], [0.0, 0.0, 1.0]])
    rows, columns = np.mgrid[:HEIGHT_PX, :WIDTH_PX]
    inside = np.hypot(columns - 80.0, rows - 60.0) < 7.0  # px: 140 px focal length, 0.05 m at 1 m
    gray = np.where(inside, 30, 180) + generator.integers(-3, 4, inside.shape)
    return Frame(
        color=np.repeat(gray[..., None], 3, 2).astype(np.uint8),
        depth_m=np.where(inside, np.nan, 1.0).astype(np.float32),
        camera_matrix=camera_matrix,
        base_from_camera=np.eye(4),
        t_s=0.0,
    )


def _check_frame(finder: BoreholeFinder, frame: Frame) -> None:
    """Call `find` twice on copies of a frame and check both answers."""
    copy = deepcopy(frame)
    found, again = _list_holes(finder, copy), _list_holes(finder, copy)
    np.testing.assert_equal(vars(copy), vars(frame), "find: changed the frame")
    text = "find: the same frame gives another answer"
    np.testing.assert_equal(list(map(vars, again)), list(map(vars, found)), text)
    for hole in found:
        _check_hole(hole)
    scores = [hole.score for hole in found]
    is_sorted = scores == sorted(scores, reverse=True)
    assert is_sorted, f"find: the surest first, got scores {scores}"


def _list_holes(finder: BoreholeFinder, frame: Frame) -> list[HolePose]:
    """Return the holes that a finder sees, none where it refuses the frame."""
    found = FrameDetections([])
    with suppress(FrameError):
        found = finder.find(frame)
    kind = type(found).__name__
    text = f"find: expected FrameDetections (brokk_rl.contracts.vision), got {kind}"
    assert isinstance(found, FrameDetections), text
    return list(found.holes)


def _check_hole(hole: HolePose) -> None:
    center, axis = np.asarray(hole.center_m), np.asarray(hole.axis)
    is_point = center.shape == (3,) and bool(np.isfinite(center).all())
    assert is_point, f"find: centre {center} is no point"
    is_unit = axis.shape == (3,) and abs(float(np.linalg.norm(axis)) - 1.0) < UNIT_TOLERANCE
    assert is_unit, f"find: axis {axis} is not a unit vector"
    assert hole.radius_m > 0, f"find: radius {hole.radius_m}"
    assert 0 <= hole.score <= 1, f"find: score {hole.score}, expected 0 to 1"
    frame = hole.frame
    assert frame in ("camera", "base"), f"find: frame '{frame}', expected camera or base"
    for name in ("cov_m2", "axis_cov_rad2"):
        covariance = np.asarray(getattr(hole, name))
        is_symmetric = covariance.shape == (3, 3) and np.allclose(covariance, covariance.T)
        assert is_symmetric, f"find: {name} is not symmetric"
        smallest = float(np.linalg.eigvalsh(covariance).min())
        assert smallest >= NEGATIVE_VARIANCE, f"find: {name} has negative variances"


def build_rest_history(
    machine: Machine, device: torch.device, q: torch.Tensor | None = None
) -> History:
    """Return a history at rest at `q`, or in the middle of the travel."""
    if q is None:
        middle = torch.as_tensor((machine.lower + machine.upper) / 2, dtype=torch.float32)
        q = middle.to(device).repeat(NUM_ENVS, 1)
    still = q[:, None, :].repeat(1, machine.num_history, 1)
    return History(q=still, u=torch.zeros_like(still))


@contextmanager
def isolate_randomness() -> Iterator[None]:
    """Leave torch's global generators as they were."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        yield


def check_rows(tensors: Tensors, what: str) -> None:
    """Check that every tensor has one row per environment."""
    for name, value in tensors.items():
        shape = tuple(value.shape)
        assert len(value) == NUM_ENVS, f"{what} '{name}': expected {NUM_ENVS} rows, got {shape}"


def check_same(found: Any, expected: Any, text: str, tolerance: float = 0.0) -> None:
    """Check that tensors hold the expected numbers; NaN equals NaN. `text` names the promise."""
    torch.testing.assert_close(found, expected, rtol=0.0, atol=tolerance, equal_nan=True, msg=text)


def check_in_place(tensors: Tensors, before: Tensors, what: str) -> None:
    """Check that all tensors lie where `view_tensors` saw them, in the same shape."""
    text = f"{what}: a tensor moved or changed its shape; write it in place"
    assert tensors.keys() == before.keys(), text
    for name, value in tensors.items():
        assert value.data_ptr() == before[name].data_ptr(), text
        assert value.shape == before[name].shape, text


def _check_other_rows(state: Tensors, before: Tensors) -> None:
    """Check that a reset of the first environment left the others as they were."""
    for name, value in state.items():
        text = f"reset: state '{name}' changed in environments outside the mask"
        check_same(value[1:], before[name][1:], text)


def view_tensors(tensors: Tensors) -> dict[str, torch.Tensor]:
    """Return views of all tensors, which keep their memory from being given to others."""
    return {name: value.view_as(value) for name, value in tensors.items()}


def copy_tensors(tensors: Tensors) -> dict[str, torch.Tensor]:
    """Return copies of all tensors."""
    return {name: value.clone() for name, value in tensors.items()}


def check_memory(
    model: ActuatorModel | FollowerModel,
    machine: Machine,
    device: torch.device,
    run: Callable[[bool], torch.Tensor],
) -> torch.Tensor:
    """Check results and memory of a model; return its results, `(T, N, J)`.

    Memory is in `state` and written in place, `reset` keeps to its mask, environments do not mix.

    Args:
        model: The model.
        machine: The machine.
        device: Where it computes.
        run: Returns its results over some control periods; told whether to treat environment 0
            otherwise.
    """
    model.reset(torch.ones(NUM_ENVS, dtype=torch.bool, device=device))
    check_rows(model.state, "state")
    place, begin = view_tensors(model.state), copy_tensors(model.state)
    first = run(False)
    shape = (NUM_ENVS, machine.num_joints)
    assert first.shape[1:] == shape, f"step: expected shape {shape}, got {tuple(first.shape[1:])}"
    is_kind = first.dtype == torch.float32 and first.device.type == device.type
    assert is_kind, f"step: expected float32 on {device}, got {first.dtype}"
    assert first.isfinite().all(), "step: not finite under full and random commands"
    check_in_place(model.state, place, "state")

    end = copy_tensors(model.state)
    model.reset(torch.arange(NUM_ENVS, device=device) == 0)
    _check_other_rows(model.state, end)
    for alter in (False, True):
        for name, value in model.state.items():
            value.copy_(begin[name])
        again = run(alter)
        if not alter:
            text = "from the same state the same commands lead elsewhere; keep all memory in state"
            check_same(again, first, f"step: {text}")
        text = "step: what happens in environment 0 changes the others"
        check_same(again[:, 1:], first[:, 1:], text)
    return first
