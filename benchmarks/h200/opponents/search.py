"""Search for the numbers of the classical controller on starts of its own.

    python benchmarks/h200/opponents/search.py <folder> [<seconds>]

Cross-entropy method (Rubinstein 1999): all candidates of a generation run side by side on a GPU, half of
the episodes through the learned actuator and half through the hydraulic plant, under the default
randomisation, 20 s each. The score is the share of successes less half a per cent per mean second
until success. The starts come from `SEED` and are disjoint from those of evaluation (seed 1024). The last
round chooses between today's numbers and those found, from starts that the search has not used.
"""

from __future__ import annotations

import copy
import json
import sys
import time
from dataclasses import asdict, fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import hydra
import torch
from hydra.utils import instantiate

from brokk_rl.rl.loop import ControlLoop, SimulatedPlant
from tasks.control import ClassicalController
from tasks.settings import ControllerGuidance
from tasks.tool_pose import ToolPoseProcess

SEED = 20261123
NUM_CANDIDATES, NUM_STARTS, NUM_ELITES = 32, 64, 6
SMOOTHING, NARROWEST = 0.6, 0.04
NAMES = (
    "in_flight_samples",
    "dead_band",
    "gain_1_s",
    "top_speed_m_s",
    "top_rate_rad_s",
    "damping",
    "rest",
    "creep",
    "hover_m",
    "funnel_outer_m",
    "funnel_inner_m",
    "brake_s",
)
WIDTH = dict.fromkeys(NAMES, 0.4) | {"in_flight_samples": 0.1, "hover_m": 0.15, "dead_band": 0.25}
"""Standard deviation of the first generation, of the logarithm of each number."""


def compose(actuator: str) -> Any:
    """Return the composed configuration of an evaluation."""
    with hydra.initialize_config_module("conf", version_base="1.3"):
        return hydra.compose(
            "config",
            overrides=["mode=evaluate", "sim=warp", f"actuator={actuator}", "policy=classical"],
        )


def list_numbers(config: Any) -> list[float]:
    """Return the numbers of `task.classical` in the order of `NAMES`."""
    values = asdict(config)
    values["funnel_outer_m"], values["funnel_inner_m"] = values.pop("funnel_m")
    return [float(values[name]) for name in NAMES]


class CandidateController:
    """The classical controller with other numbers in each block of environments.

    Args:
        base: The controller.
        numbers: `(K, P)`, in the order of `NAMES`; write in place.
        straight: `ClassicalConfig.straight` of all candidates.
    """

    def __init__(self, base: ClassicalController, numbers: torch.Tensor, straight: bool) -> None:
        self._base, self._numbers, self._straight = base, numbers, straight

    def __getattr__(self, name: str) -> Any:
        return getattr(self._base, name)

    def guide(
        self,
        q: torch.Tensor,
        u: torch.Tensor,
        target_m: torch.Tensor,
        pitch_rad: torch.Tensor,
        reach_m: tuple[float, float],
        coming: None = None,
    ) -> ControllerGuidance:
        """Return commands and errors; see `ClassicalController.guide`."""
        names = [field.name for field in fields(ControllerGuidance)]
        period_s = self._base._period_s
        age = torch.arange(q.shape[1] - 1, -1, -1, dtype=torch.float32, device=q.device)
        identity = torch.eye(4, device=q.device)

        def guide_one(numbers: torch.Tensor, *inputs: torch.Tensor) -> tuple[torch.Tensor, ...]:
            given = dict(zip(NAMES, numbers.unbind(0), strict=True))
            one = copy.copy(self._base)
            funnel_m = (given["funnel_outer_m"], given["funnel_inner_m"])
            one.config = SimpleNamespace(straight=self._straight, funnel_m=funnel_m, **given)  # type: ignore[assignment]
            in_flight = (given["in_flight_samples"] - age).clamp(0.0, 1.0)
            one._in_flight = in_flight[:, None] * period_s
            one._damping = given["damping"] ** 2 * identity
            q, u, target_m, pitch_rad = inputs
            found = one.guide(q, u, target_m, pitch_rad, reach_m)
            return tuple(getattr(found, name) for name in names)

        count = len(self._numbers)
        blocks = [value.unflatten(0, (count, -1)) for value in (q, u, target_m, pitch_rad)]
        parts = torch.vmap(guide_one)(self._numbers, *blocks)
        return ControllerGuidance(
            **{name: part.flatten(0, 1) for name, part in zip(names, parts, strict=True)}
        )


class Trial:
    """Candidates side by side in one captured control loop."""

    def __init__(
        self, actuator: str, straight: bool, starts: dict[str, torch.Tensor] | None
    ) -> None:
        cfg = compose(actuator)
        device = torch.device("cuda")
        parts = {name: instantiate(cfg[name], _convert_="all") for name in ("machine", "sim")}
        parts |= {name: instantiate(cfg[name], _convert_="all") for name in ("task", "actuator")}
        config = SimulatedPlant(
            **parts,
            effect=instantiate(cfg.effect, _convert_="all"),
            event={},
            follower=instantiate(cfg.follower, _convert_="all"),
        )
        self.config = parts["task"].classical
        torch.manual_seed(SEED)
        self.loop: ControlLoop = config.build(
            device, NUM_CANDIDATES * NUM_STARTS, 8192, SEED, starts
        )
        first = torch.tensor(list_numbers(self.config), device=device)
        self.numbers = first.repeat(NUM_CANDIDATES, 1)
        task = self.loop.task
        assert isinstance(task, ToolPoseProcess)
        control = task.control
        candidates: Any = CandidateController(control.controller, self.numbers, straight)
        control.controller = candidates
        self.loop.capture()

    def run(self, numbers: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        """Return success and time (s), `(2, K, S)`, of candidates `(K, P)` from starts `(S,)`."""
        loop, num = self.loop, len(rows)
        self.numbers.copy_(numbers)
        start = {
            key: value[rows].repeat(len(numbers), *[1] * (value.dim() - 1))
            for key, value in loop.starts.items()
        }
        loop.begin(start)
        action = torch.zeros(loop.num_envs, loop.num_actions, device=loop.device)
        running = torch.ones(loop.num_envs, dtype=torch.bool, device=loop.device)
        success, steps = torch.zeros_like(action[:, 0]), torch.zeros_like(action[:, 0])
        for _ in range(loop.task.max_episode_steps):
            _, _, done, _ = loop.step(action)
            steps += running
            ended = done & running
            success = torch.where(ended, loop.finished["success_strict"], success)
            running &= ~done
        time_s = torch.where(success > 0, steps * loop.machine.period_s, 20.0)
        return torch.stack((success, time_s)).reshape(2, len(numbers), num)


def score(result: torch.Tensor) -> torch.Tensor:
    """Return the score of each candidate, `(K,)`, for results `(2, K, S)`."""
    return result[0].mean(1) - 0.005 * result[1].mean(1)


def main(folder: Path, seconds: float) -> None:
    """Search; write `search.json` and `search.csv` into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    begun = time.monotonic()
    generator = torch.Generator("cuda").manual_seed(SEED)
    trials: dict[tuple[str, bool], Trial] = {}
    starts = None
    for straight in (True, False):
        for actuator in ("mlp", "hydraulic"):
            trials[actuator, straight] = Trial(actuator, straight, starts)
            starts = starts or trials[actuator, straight].loop.starts
    print(f"captured after {time.monotonic() - begun:.0f} s", flush=True)
    default = torch.tensor(list_numbers(next(iter(trials.values())).config), device="cuda")
    found: dict[str, Any] = {
        "names": NAMES,
        "default": default.tolist(),
        "seed": SEED,
        "history": [],
    }
    means: dict[bool, torch.Tensor] = {}
    share = {True: 0.5, False: 0.4}
    for straight in (True, False):
        mean = default.log() if straight else means[True].log()
        width = torch.tensor([WIDTH[name] for name in NAMES], device="cuda")
        until = time.monotonic() + share[straight] * (seconds - (time.monotonic() - begun))
        generation = 0
        while time.monotonic() < until:
            drawn = torch.randn(NUM_CANDIDATES, len(NAMES), device="cuda", generator=generator)
            numbers = (mean + width * drawn).exp()
            numbers[0] = mean.exp()
            rows = torch.randint(4096, (NUM_STARTS,), device="cuda", generator=generator)
            result = torch.cat(
                [
                    trials[actuator, straight].run(numbers, rows)
                    for actuator in ("mlp", "hydraulic")
                ],
                2,
            )
            points = score(result)
            elite = numbers[points.topk(NUM_ELITES).indices].log()
            mean = (1 - SMOOTHING) * mean + SMOOTHING * elite.mean(0)
            width = (1 - SMOOTHING) * width + SMOOTHING * elite.std(0)
            width = width.clamp(min=NARROWEST)
            row = {
                "straight": straight,
                "generation": generation,
                "success_of_mean": float(result[0, 0].mean()),
                "success": float(result[0].mean()),
                "best": float(points.max()),
                "numbers": mean.exp().tolist(),
            }
            found["history"].append(row)
            print(json.dumps(row), flush=True)
            (folder / "search.json").write_text(json.dumps(found))
            generation += 1
        means[straight] = mean.exp()
    found["final"] = []
    for straight in (True, False):
        choice = torch.stack([default, means[True], means[False]]).repeat(11, 1)[:NUM_CANDIDATES]
        results = []
        for k in range(4):  # starts that the search has not used
            rows = 4096 + NUM_STARTS * k + torch.arange(NUM_STARTS, device="cuda")
            results += [trials[a, straight].run(choice, rows) for a in ("mlp", "hydraulic")]
        for index, name in enumerate(("default", "found straight", "found free")):
            picked = torch.cat([result[:, index::3].flatten(1) for result in results], 1)
            by = [float(result[0, index::3].mean()) for result in results]
            row = {
                "numbers": name,
                "straight": straight,
                "success": float(picked[0].mean()),
                "time_s": float(picked[1].mean()),
                "mlp": sum(by[::2]) / 4,
                "hydraulic": sum(by[1::2]) / 4,
            }
            found["final"].append(row)
            print(json.dumps(row), flush=True)
            (folder / "search.json").write_text(json.dumps(found))


if __name__ == "__main__":
    main(Path(sys.argv[1]), float(sys.argv[2]) if len(sys.argv) > 2 else 300.0)
