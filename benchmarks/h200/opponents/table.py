"""The trained policy beside its opponents on every plant, from the same starts.

    python benchmarks/h200/opponents/table.py <folder> [<plants> [<numbers before>]]

1,024 episodes each of 60 s, under the default randomisation; success within 20, 40 and 60 s is read off
the time of each success. Differences from the trained policy (within 20 s) and from the classical
controller are paired: the mean over episodes with its 95 % interval. `<numbers before>` is a JSON table
of `task.classical` numbers, evaluated as `classical before`.
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

from brokk_rl.contracts.task import Policy
from brokk_rl.intervals import compute_wilson_interval
from brokk_rl.rl.policy import ClassicalPolicy, TrainedPolicy
from brokk_rl.rl.vec_env import ControlLoop, ControlLoopConfig

PLANTS = "mlp,hydraulic,load_sensing,post_compensated,open_center"
EPISODES, SEED, LIMITS_S = 1024, 1024, (20.0, 40.0, 60.0)


def run_episodes(loop: ControlLoop, policy: Policy, starts: dict[str, Any]) -> dict[str, Any]:
    """Return figures of one episode from each start, each `(N,)`, on the CPU."""
    torch.manual_seed(SEED)
    loop.begin(starts)
    running = torch.ones(loop.num_envs, dtype=torch.bool, device=loop.device)
    names = ("success_strict", "time_to_insert_s", "peak_force_n", "valve_travel")
    found = {name: torch.zeros(loop.num_envs, device=loop.device) for name in names}
    reason = torch.full((loop.num_envs,), -1.0, device=loop.device)
    groups = loop.get_observations()
    for step in range(loop.task.max_episode_steps):
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


def main(folder: Path, plants: list[str], before: dict[str, Any]) -> None:
    """Evaluate; write `table.json` after each plant."""
    folder.mkdir(parents=True, exist_ok=True)
    starts = None
    table: dict[str, Any] = {}
    for plant in plants:
        overrides = ["mode=evaluate", "sim=warp", f"actuator={plant}", "policy=mpc"]
        with hydra.initialize_config_module("conf", version_base="1.3"):
            cfg = hydra.compose("config", overrides=[*overrides, "task.episode_s=60"])
        parts = {
            name: instantiate(cfg[name], _convert_="all")
            for name in ("machine", "sim", "task", "actuator", "follower")
        }
        config = ControlLoopConfig(**parts, effects=instantiate(cfg.effect, _convert_="all"))
        task: Any = config.task
        trained = TrainedPolicy(folder="tasks:policies/borehole_insertion")
        numbers = dataclasses.replace(task.classical, **before)
        cases = {
            "trained": (trained, trained.choose_task(task, config.machine, ())),
            "classical": (ClassicalPolicy(), task),
            "mpc": (instantiate(cfg.policy, _convert_="all"), task),
        }
        if before:
            cases["classical before"] = (
                ClassicalPolicy(),
                dataclasses.replace(task, classical=numbers),
            )
        results: dict[str, Any] = {}
        rows: dict[str, Any] = {}
        for name, (policy, own) in cases.items():
            begun = time.monotonic()
            torch.manual_seed(SEED)
            loop = dataclasses.replace(config, task=own).build(
                torch.device("cuda"), EPISODES, EPISODES, SEED, starts
            )
            starts = starts or {key: value.clone() for key, value in loop.starts.items()}
            fresh = loop.state_dict()
            loop.capture()
            loop.load_state_dict(fresh)
            with torch.no_grad():
                results[name] = run_episodes(loop, policy.build(loop, 0), starts)
            rows[name] = summarise(results[name], loop.task.reasons)
            rows[name]["seconds"] = time.monotonic() - begun
            print(plant, name, json.dumps(rows[name]), flush=True)
            del loop
        for name, found in results.items():
            rows[name]["minus_trained_20_s"] = compare(found, results["trained"], 20.0)
            for limit_s in LIMITS_S:
                key = f"minus_classical_{limit_s:.0f}_s"
                rows[name][key] = compare(found, results["classical"], limit_s)
        table[plant] = rows
        (folder / "table.json").write_text(json.dumps(table, indent=1))


if __name__ == "__main__":
    main(
        Path(sys.argv[1]),
        (sys.argv[2] if len(sys.argv) > 2 else PLANTS).split(","),
        json.loads(sys.argv[3]) if len(sys.argv) > 3 else {},
    )
