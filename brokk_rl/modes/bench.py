"""`brokk mode=bench`: how fast physics, control step and training are on this computer."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Any, ClassVar

import torch
from rich.console import Console
from rich.table import Table

from brokk_rl.contracts import Actuator, Effect, Follower, Simulator, Task
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.rl.distributed import Group
from brokk_rl.rl.graph import capture
from brokk_rl.rl.logbook import Logbook
from brokk_rl.rl.runner import Runner, Training
from brokk_rl.rl.tracking import Off
from brokk_rl.rl.vec_env import ControlLoop, Plant
from brokk_rl.session import Session, versions, write_json
from brokk_rl.spec import spec

log = logging.getLogger(__name__)


@spec
class Sizes:
    """What to measure.

    Attributes:
        num_envs: Numbers of environments, one row each; of each process where `torchrun` starts several.
        seconds: Least time of each measurement.
        iterations: Training iterations timed, after one to warm up.
    """

    num_envs: tuple[int, ...]
    seconds: float
    iterations: int

    def check(self) -> None:
        if not self.num_envs or min(self.num_envs) < 1:
            raise ConfigError(f"bench.num_envs: expected one or more positive numbers, got {list(self.num_envs)}")


@spec
class Bench:
    """Measures rates: physics alone, the whole control step, and training, for several numbers of environments.

    Attributes:
        session: Folder and device.
        machine: The machine.
        sim: Physics.
        task: Task.
        actuator: Actuator model.
        effect: Effects, by name.
        follower: Who stands between policy and machine.
        rl: Training configuration.
        bench: What to measure.
    """

    session: Session
    machine: Machine
    sim: Simulator
    task: Task
    actuator: Actuator
    effect: dict[str, Effect]
    follower: Follower
    rl: Training
    bench: Sizes

    together: ClassVar[bool] = True
    """Several processes that `torchrun` starts measure at the same time and train together."""

    def run(self) -> float:
        """Measures; returns the training rate of the last row, that of all processes together."""
        device = self.session.torch_device()
        plant = Plant(
            machine=self.machine, sim=self.sim, task=self.task, actuator=self.actuator, effects=self.effect, follower=self.follower
        )
        with Group(device) as group:
            rows = self._rows(plant, device, group)
        if group.rank.first:
            name = torch.cuda.get_device_name(device) if device.type == "cuda" else f"cpu, {torch.get_num_threads()} threads"
            results = {"device": name, "ranks": group.rank.count, **rows[-1], "versions": versions(), "rows": rows}
            write_json(self.session.folder / "benchmark.json", results)
            _print(rows)
        return float(rows[-1]["train_env_steps_per_s"])

    def _rows(self, plant: Plant, device: torch.device, group: Group) -> list[dict[str, Any]]:
        rows = []
        for num_envs in self.bench.num_envs:
            self.session.seed_all()
            loop = plant.build(device, num_envs, self.rl.num_starts, self.session.stream("starts"))
            rows.append(_over_ranks(group.all(self._measure(loop, device, group))))
            log.info(
                "%d environments: %s", num_envs, ", ".join(f"{k} {v:,.0f}" for k, v in rows[-1].items() if k.endswith("_per_s"))
            )
        return rows

    def _measure(self, loop: ControlLoop, device: torch.device, group: Group) -> dict[str, Any]:
        num = loop.num_envs
        still = torch.zeros(num, self.machine.num_joints, device=device)
        graphs = device.type == "cuda" and loop.world.supports_graphs
        physics = capture(lambda: loop.world.step(still), device).replay if graphs else lambda: loop.world.step(still)
        group.wait()  # those of one computer share its processors and its power: measure them at the same time
        physics_s = self._time(physics, device)
        loop.capture(self.rl.fuse)
        action = torch.zeros(num, loop.num_actions, device=device)
        group.wait()
        step_s = self._time(lambda: loop.step(action), device)
        runner_steps = int(self.rl.runner["num_steps_per_env"])
        book = Logbook(
            self.session.folder, Off().open(self.session.folder, {}), loop.statistics, num * runner_steps, 1.0, lambda *_: 0.0
        )
        runner = Runner(loop, self.rl, self.session.folder, device, book, group)
        runner.learn(1)
        _wait(device)
        group.wait()
        start = time.perf_counter()
        runner.learn(self.bench.iterations)
        _wait(device)
        train_s = (time.perf_counter() - start) / (self.bench.iterations * runner_steps)
        return {
            "num_envs": num,
            "physics_env_steps_per_s": num / physics_s,
            "env_steps_per_s": num / step_s,
            "train_env_steps_per_s": num / train_s,
            "graph": loop.graph_active,
        }

    def _time(self, step: Callable[[], object], device: torch.device) -> float:
        """Returns the seconds that one call takes, the mean over at least `bench.seconds`."""
        for _ in range(3):
            step()
        _wait(device)
        calls, spent = 0, 0.0
        while spent < self.bench.seconds:
            start = time.perf_counter()
            for _ in range(10):
                step()
            _wait(device)
            calls, spent = calls + 10, spent + time.perf_counter() - start
        return spent / calls


def _over_ranks(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Returns the row of all processes: rates add up; what each of them reached stands in `per_rank`."""
    if len(rows) == 1:
        return rows[0]
    rates = [name for name in rows[0] if name.endswith("_per_s")]
    per_rank = [{name: row[name] for name in rates} for row in rows]
    return rows[0] | {name: sum(row[name] for row in rows) for name in rates} | {"ranks": len(rows), "per_rank": per_rank}


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def _print(rows: list[dict[str, Any]]) -> None:
    table = Table("environments", "physics /s", "control step /s", "training /s", "CUDA graph")
    for row in rows:
        rates = [f"{row[name]:,.0f}" for name in ("physics_env_steps_per_s", "env_steps_per_s", "train_env_steps_per_s")]
        table.add_row(f"{row['num_envs']:,}", *rates, "yes" if row["graph"] else "no")
    Console().print(table)
