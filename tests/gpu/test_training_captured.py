"""Training on a real GPU: faults and rewards in CUDA graphs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import training as runs
from composed import option

from brokk_rl.contracts.task import REWARD
from brokk_rl.rl.loop import ControlLoop
from brokk_rl.rl.ppo import DevicePPO
from brokk_rl.rl.settings import Teacher

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.filterwarnings("ignore::DeprecationWarning:torch"),
    # wanted: see brokk_rl.rl.runner
    pytest.mark.filterwarnings("ignore:TensorFloat32:UserWarning"),
]

CUDA = torch.device("cuda")
NUM = 64
WARP: Any = replace(option("sim", "warp"), num_worlds=NUM, parity_worlds=0)
WILD = 5
"""The world that diverges."""


def make_loop(sim: Any = WARP, device: torch.device = CUDA, task: Any = None) -> ControlLoop:
    torch.manual_seed(0)
    task = task or option("task", "borehole_insertion")
    return runs.plant(task, sim).build(device, NUM, 256, 5)


def push(loop: ControlLoop, steps: int, seed: int = 3) -> None:
    generator = torch.Generator().manual_seed(seed)
    for _ in range(steps):
        loop.step(0.4 * torch.randn(NUM, 5, generator=generator).to(loop.device))


# --- faults ---


def test_a_captured_step_names_why_a_world_diverged(caplog: pytest.LogCaptureFixture) -> None:
    loop = make_loop()
    loop.capture()
    assert loop.graph_active
    push(loop, 3)
    assert loop.statistics()["fault_rate"] == 0.0
    loop.world._drive.reference[WILD, 2] = float("nan")  # type: ignore[attr-defined]
    push(loop, 25)  # the host comes later: the world has begun anew
    assert loop.statistics()["fault_rate"] > 0.0
    assert "the motion of q3 was not finite" in caplog.text
    assert loop.statistics()["fault_rate"] == 0.0


@pytest.mark.parametrize("level", ["flat", "several", "slanted", "goal_pose"])
def test_each_level_is_captured_with_any_noise(level: str) -> None:
    measured = option("task/noise", "measured")
    loop = make_loop(task=replace(option("task", level), noise=measured))
    loop.capture()
    assert loop.graph_active
    push(loop, 30)
    assert loop.statistics()["fault_rate"] == 0.0
    assert all(torch.isfinite(value).all() for value in loop.get_observations().values())


OUTSIDE = ("library", "clock_offset", "encoder_scale", "link_length", "base_tilt", "extrinsics")
"""Effects that the library does not draw, and the library itself."""


@pytest.mark.parametrize("actuator", ["lag", "hydraulic", "mlp"])
def test_actuators_and_all_effects_are_captured(actuator: str) -> None:
    effects = option("effect", "library").effects | {
        name: option("effect", name) for name in OUTSIDE
    }
    plant = replace(runs.plant(sim=WARP), actuator=option("actuator", actuator))
    loop = replace(plant, effect=effects).build(CUDA, NUM, 256, 5)
    loop.capture()
    assert loop.graph_active
    push(loop, 30)
    assert all(torch.isfinite(value).all() for value in loop.get_observations().values())


# --- figures of the reward ---


def test_the_terms_of_a_captured_reward_add_up_to_the_return() -> None:
    loop = make_loop()
    loop.capture(fuse=True)
    earned = torch.zeros(NUM, device=CUDA)
    returns: list[torch.Tensor] = []
    for seed in range(40):
        for _ in range(15):
            push(loop, 1, seed)
            earned += loop.reward
            returns.append(earned[loop.done].clone())
            earned[loop.done] = 0.0
    figures = loop.statistics()
    finished = torch.cat(returns)
    assert figures["episodes"] == len(finished) > NUM // 2
    terms = [value for name, value in figures.items() if name.startswith(REWARD)]
    assert len(terms) == len(option("task", "borehole_insertion").reward)
    assert sum(abs(value) > 1e-3 for value in terms) >= 3
    assert sum(terms) == pytest.approx(float(finished.mean()), abs=2e-3)
    assert figures["return"] == pytest.approx(float(finished.mean()), abs=2e-3)


@pytest.mark.parametrize(
    "teacher", [None, Teacher(weight=1.0, until=(1.0, 0.5))], ids=["alone", "led"]
)
def test_a_training_stays_captured(tmp_path: Path, teacher: Teacher | None) -> None:
    budget = NUM * runs.STEPS * 6
    training = runs.small(max_env_steps=budget, num_envs=NUM, teacher=teacher)
    training.runner["obs_groups"]["actor"] = ["guide", "joints"]
    loop = make_loop()
    loop.capture()
    folder = tmp_path / "run"
    runner = runs.make(folder, training, loop, CUDA)
    runner.run()
    assert isinstance(runner.alg, DevicePPO) and len(runner.alg._epoch or ()) == 1
    assert all(torch.isfinite(value).all() for value in runs.weights(runner).values())
    assert len(runs.progress(folder)) == 6
