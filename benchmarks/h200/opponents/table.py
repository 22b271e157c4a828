"""The trained policy beside its opponents on every plant, from the same starts.

    python benchmarks/h200/opponents/table.py <folder> [<plants> [<numbers before>]]

1,024 episodes each of 60 s, under the default randomisation; success within 20, 40 and 60 s is read off the time of each success.
Differences from the trained policy and from the classical controller are paired: the mean over
episodes with its 95 % interval. `<numbers before>` is a JSON table of `task.classical` numbers,
evaluated as `classical before`.
"""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any

import hydra
import torch
from hydra.utils import instantiate

from brokk_rl.build import build_node
from brokk_rl.contracts.task import Policy
from brokk_rl.policy_folder import describe_spec, find_policy
from brokk_rl.rl.loop import ControlLoop, SimulatedPlant, Starts
from brokk_rl.rl.policy import ClassicalPolicy, TrainedPolicy
from brokk_rl.statistics import compute_wilson_interval

PLANTS = "mlp,hydraulic,load_sensing,post_compensated,open_center"
EPISODES, SEED, LIMITS_S = 1024, 1024, (20.0, 40.0, 60.0)


def run_episodes(
    loop: ControlLoop, policy: Policy, starts: Starts, limit_s: float
) -> dict[str, Any]:
    """Return figures of one episode from each start, each `(N,)`, on the CPU."""
    torch.manual_seed(SEED)
    loop.begin(starts)
    running = torch.ones(loop.num_envs, dtype=torch.bool, device=loop.device)
    names = ("success_strict", "time_to_insert_s", "peak_force_n", "valve_travel")
    found = {name: torch.zeros(loop.num_envs, device=loop.device) for name in names}
    reason = torch.full((loop.num_envs,), -1.0, device=loop.device)
    groups = loop.get_observations()
    for step in range(round(limit_s / loop.machine.period_s)):
        if step % 16 == 0 and not running.any():
            break
        groups, _, done, _ = loop.step(policy.act(dict(groups.items())))  # type: ignore[arg-type]
        ended = done & running
        for name in names:
            found[name] = torch.where(ended, loop.finished[name], found[name])
        reason = torch.where(ended, loop.reason, reason)
        running &= ~done
    return {name: value.cpu() for name, value in (found | {"reason": reason}).items()}


def summarise(found: dict[str, Any], reasons: tuple[str, ...]) -> dict[str, Any]:
    """Return shares of success within each limit, and medians."""
    success = found["success_strict"] > 0
    times_s = found["time_to_insert_s"]
    row: dict[str, Any] = {}
    for limit_s in LIMITS_S:
        count = int((success & (times_s <= limit_s + 1e-3)).sum())
        low, high = compute_wilson_interval(count, len(success))
        row[f"within_{limit_s:.0f}_s"] = [count / len(success), low, high]
    row["time_to_insert_s"] = float(times_s[success].median()) if success.any() else None
    row["peak_force_n"] = float(found["peak_force_n"].mean())
    row["valve_travel"] = float(found["valve_travel"].mean())
    row["endings"] = {
        name: int((found["reason"] == index).sum()) for index, name in enumerate(reasons)
    }
    return row


def compare(one: dict[str, Any], other: dict[str, Any], limit_s: float) -> list[float]:
    """Return the mean difference of success within a limit, and its 95 % interval (paired)."""
    parts = []
    for found in (one, other):
        within = (found["success_strict"] > 0) & (found["time_to_insert_s"] <= limit_s + 1e-3)
        parts.append(within.double())
    difference = parts[0] - parts[1]
    half = 1.96 * float(difference.std()) / len(difference) ** 0.5
    mean = float(difference.mean())
    return [mean, mean - half, mean + half]


class PlantCases:
    """Policies on one plant, all from the same starts.

    Args:
        plant: Option of `actuator`.
        before: Numbers of `task.classical` for `classical before`.
    """

    def __init__(self, plant: str, before: dict[str, Any]) -> None:
        overrides = ["mode=evaluate", "sim=warp", f"actuator={plant}"]
        with hydra.initialize_config_module("conf", version_base="1.3"):
            cfg = hydra.compose("config", overrides=[*overrides, "task.episode_s=60"])
        parts = {
            name: instantiate(cfg[name], _convert_="all")
            for name in ("machine", "sim", "task", "actuator", "follower")
        }
        self._config = SimulatedPlant(
            **parts, effect=instantiate(cfg.effect, _convert_="all"), event={}
        )
        task: Any = self._config.task
        trained = TrainedPolicy(path="tasks:policies/borehole_insertion", task=None)
        numbers = dataclasses.replace(task.classical, **before)
        self._cases: dict[str, Any] = {
            "trained": (
                trained,
                build_node(find_policy(trained.path).task.apply_to(describe_spec(task)), "task"),
            ),
            "classical": (ClassicalPolicy(task=None), task),
            "classical before": (
                ClassicalPolicy(task=None),
                dataclasses.replace(task, classical=numbers),
            ),
        }
        self.results: dict[str, Any] = {}
        self._rows: dict[str, Any] = {}

    def run(self, name: str, starts: Starts | None, limit_s: float) -> Starts:
        """Run one policy for `limit_s`; return the starts."""
        begun = time.monotonic()
        torch.manual_seed(SEED)
        policy, task = self._cases[name]
        loop = dataclasses.replace(self._config, task=task).build(
            torch.device("cuda"), EPISODES, EPISODES, SEED, starts
        )
        starts = starts or {key: value.clone() for key, value in loop.starts.items()}
        fresh = loop.state_dict()
        loop.capture()
        loop.load_state_dict(fresh)
        with torch.no_grad():
            self.results[name] = run_episodes(loop, policy.build(loop, 0), starts, limit_s)
        row = summarise(self.results[name], loop.task.reasons)
        self._rows[name] = row | {"limit_s": limit_s, "seconds": time.monotonic() - begun}
        return starts

    def compare(self) -> dict[str, Any]:
        """Return figures and paired differences of all policies that have run."""
        rows = {name: dict(row) for name, row in self._rows.items()}
        for name, found in self.results.items():
            for limit_s in LIMITS_S:
                if limit_s > rows[name]["limit_s"]:
                    rows[name].pop(f"within_{limit_s:.0f}_s")
                    continue
                for other in ("trained", "classical"):
                    key = f"minus_{other}_{limit_s:.0f}_s"
                    rows[name][key] = compare(found, self.results[other], limit_s)
        return rows


def main(folder: Path, plants: list[str], before: dict[str, Any]) -> None:
    """Evaluate; write `table.json` after each policy."""
    folder.mkdir(parents=True, exist_ok=True)
    cases = {plant: PlantCases(plant, before) for plant in plants}
    starts: Starts | None = None
    table: dict[str, Any] = {}
    jobs = [
        (plant, name) for plant in plants for name in ("trained", "classical", "classical before")
    ]
    for plant, name in jobs:
        starts = cases[plant].run(name, starts, LIMITS_S[-1])
        print(plant, name, json.dumps(cases[plant]._rows[name]), flush=True)
        if "classical" in cases[plant].results:
            table[plant] = cases[plant].compare()
            (folder / "table.json").write_text(json.dumps(table, indent=1))


if __name__ == "__main__":
    main(
        Path(sys.argv[1]),
        (sys.argv[2] if len(sys.argv) > 2 else PLANTS).split(","),
        json.loads(sys.argv[3]) if len(sys.argv) > 3 else {},
    )
