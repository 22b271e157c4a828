"""`brokk mode=bench`: rates of physics, control step and training on this computer."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import torch
from torch.utils.benchmark import Timer, timer

from brokk_rl.console_table import print_table
from brokk_rl.rl.execution import capture_graph
from brokk_rl.rl.group import TrainingGroup
from brokk_rl.rl.loop import ControlLoop, SimulatedPlant
from brokk_rl.rl.runner import TrainingRunner
from brokk_rl.rl.settings import BenchmarkSizes, TrainingConfig
from brokk_rl.session import Session, read_versions, write_json
from brokk_rl.spec import spec

log = logging.getLogger(__name__)

RATES = {
    "physics_env_steps_per_s": "physics /s",
    "env_steps_per_s": "control step /s",
    "train_env_steps_per_s": "training /s",
}
"""Headings in the order of what each has to do: physics, the control step, training."""


@spec
class Benchmark(SimulatedPlant):
    """Measures rates of physics, control step and training.

    Attributes:
        session: Folder and device.
        machine: The machine.
        sim: Physics.
        task: The task.
        actuator: How commands become motion.
        effect: Effects around the actuator model, by name.
        event: Changes of the simulated machine, by name.
        follower: Who stands between policy and machine.
        rl: Training configuration.
        bench: What to measure.
    """

    session: Session
    rl: TrainingConfig
    bench: BenchmarkSizes

    together: ClassVar[bool] = True
    """Several processes that `torchrun` starts measure at the same time and train together."""

    def run(self) -> float:
        """Measure, print a table and write `benchmark.json`.

        Returns:
            The training rate of the last row, that of all processes together.
        """
        device = self.session.torch_device()
        rows = []
        with TrainingGroup(device) as group:
            for num_envs in self.bench.num_envs:
                self.session.seed_all()
                starts = self.session.stream("starts")
                loop = self.build(device, num_envs, self.rl.num_starts, starts)
                rows.append(_sum_over_ranks(group.gather(self._measure(loop, device, group))))
                rates = [f"{name} {rows[-1][name]:,.0f}" for name in RATES]
                log.info("%d environments: %s", num_envs, ", ".join(rates))
        if group.rank.first:
            facts = {"device": _name_device(device), "ranks": group.rank.count}
            facts |= rows[-1] | {"versions": read_versions(), "rows": rows}
            write_json(self.session.folder / "benchmark.json", facts)
            _print_rows(rows)
        return float(rows[-1]["train_env_steps_per_s"])

    def _measure(
        self, loop: ControlLoop, device: torch.device, group: TrainingGroup
    ) -> dict[str, Any]:
        num = loop.num_envs
        still = torch.zeros(num, self.machine.num_joints, device=device)
        graphs = device.type == "cuda" and loop.world.supports_graphs

        def physics() -> None:
            loop.world.step(still)

        if graphs:
            physics = capture_graph(physics, device).replay
        loop.capture(self.rl.fuse)
        action = torch.zeros(num, loop.num_actions, device=device)
        # processes of one computer share its cores and power: measure at the same time
        group.wait()
        rest = loop.world.state_dict()
        rates = {"physics_env_steps_per_s": num / self._time_call(physics)}
        loop.world.load_state_dict(rest)
        rates["env_steps_per_s"] = num / self._time_call(lambda: loop.step(action))
        rates["train_env_steps_per_s"] = num / self._time_training(loop, group)
        return {"num_envs": num, **rates, "graph": loop.graph_active}

    def _time_training(self, loop: ControlLoop, group: TrainingGroup) -> float:
        """Return the seconds of a control step of all environments in training."""
        num_steps = int(self.rl.runner["num_steps_per_env"])
        training = replace(self.rl, max_fault_rate=1.0)
        runner = TrainingRunner(loop, training, self.session.folder, group)
        runner.learn(1)
        group.wait()
        start_s = timer()  # it waits for the GPU
        runner.learn(self.bench.iterations)
        return (timer() - start_s) / (self.bench.iterations * num_steps)

    def _time_call(self, step: Callable[[], object]) -> float:
        """Return the seconds of one call, the median over `bench.seconds`."""
        measured = Timer("step()", globals={"step": step}, num_threads=torch.get_num_threads())
        return measured.blocked_autorange(min_run_time=self.bench.seconds).median


def _name_device(device: torch.device) -> str:
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"cpu, {torch.get_num_threads()} threads"


def _sum_over_ranks(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the row of all processes: rates add up; `per_rank` holds the rates of each."""
    if len(rows) == 1:
        return rows[0]
    per_rank = [{name: row[name] for name in RATES} for row in rows]
    total = {name: sum(rates[name] for rates in per_rank) for name in RATES}
    return rows[0] | total | {"ranks": len(rows), "per_rank": per_rank}


def _print_rows(rows: list[dict[str, Any]]) -> None:
    cells = []
    for row in rows:
        rates = [f"{row[name]:,.0f}" for name in RATES]
        cells.append([f"{row['num_envs']:,}", *rates, "yes" if row["graph"] else "no"])
    print_table(["environments", *RATES.values(), "CUDA graph"], cells)
