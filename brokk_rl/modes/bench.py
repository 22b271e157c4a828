"""`brokk mode=bench`: rates and seconds to success of trainings on this computer."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any, ClassVar

import torch

from brokk_rl.console_table import print_table
from brokk_rl.contracts.actuator import Actuator, Effect, Follower
from brokk_rl.contracts.task import Task
from brokk_rl.contracts.world import Simulator
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.rl.benchmark_sizes import BenchmarkSizes
from brokk_rl.rl.execution import capture_graph
from brokk_rl.rl.logger import NoTracking, TrainingLogger
from brokk_rl.rl.loop import ControlLoop, ControlLoopConfig
from brokk_rl.rl.runner import TrainingGroup, TrainingRunner
from brokk_rl.rl.settings import TrainingConfig
from brokk_rl.rl.success_sweep import LEVELS, report_sweep, run_sweep, summarise
from brokk_rl.session import Session, read_versions, write_json
from brokk_rl.spec import spec

log = logging.getLogger(__name__)

CALLS = 10
"""Of one thing before it is the turn of the next."""
RATES: tuple[str, ...] = (
    "batch_env_steps_per_s",
    "physics_env_steps_per_s",
    "env_steps_per_s",
    "train_env_steps_per_s",
)
"""In the order of what each has to do: MuJoCo's own batch (CPU only), with drive and contacts, the
control step, training."""


@spec
class Benchmark:
    """Measures rates of physics, control step and training, or the seconds until success.

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
    rl: TrainingConfig
    bench: BenchmarkSizes

    together: ClassVar[bool] = True
    """Several processes that `torchrun` starts measure at the same time and train together."""

    def run(self) -> float:
        """Measure.

        Returns:
            The training rate of the last row, that of all processes together; where the time to
            success is measured the shortest, infinite where no training passed.
        """
        alone = _read_single_process(self.bench)
        device = self.session.torch_device()
        plant = ControlLoopConfig(
            machine=self.machine,
            sim=self.sim,
            task=self.task,
            actuator=self.actuator,
            effects=self.effect,
            follower=self.follower,
        )
        if self.bench.measure == "success":
            return self._measure_success(plant, device)
        with TrainingGroup(device) as group:
            rows = []
            for row in self._rows(plant, device, group):
                rows.append(_add_comparisons(row, alone.get(row["num_envs"])))
        if group.rank.first:
            results = _describe_device(device, group) | rows[-1]
            results |= {"versions": read_versions(), "rows": rows}
            write_json(self.session.folder / "benchmark.json", results)
            _print(rows)
        return float(rows[-1]["train_env_steps_per_s"])

    def _measure_success(self, plant: ControlLoopConfig, device: torch.device) -> float:
        """Return the shortest median time to the first level, s."""

        def build(num_envs: int) -> ControlLoop:
            self.session.seed_all()
            starts = self.session.stream("starts")
            loop = plant.build(device, num_envs, self.rl.num_starts, starts)
            loop.capture(self.rl.fuse)
            return loop

        with TrainingGroup(device) as group:
            rows = run_sweep(self.bench.success, self.rl, self.session, group, build)
            if group.rank.first:
                facts = _describe_device(device, group) | {"versions": read_versions()}
                report_sweep(rows, self.session.folder, facts)
        times = [line[f"seconds_to_{LEVELS[0]:.2f}"] for line in summarise(rows)]
        return min((time_s for time_s in times if time_s is not None), default=float("inf"))

    def _rows(
        self, plant: ControlLoopConfig, device: torch.device, group: TrainingGroup
    ) -> list[dict[str, Any]]:
        rows = []
        for num_envs in self.bench.num_envs:
            self.session.seed_all()
            loop = plant.build(device, num_envs, self.rl.num_starts, self.session.stream("starts"))
            rows.append(_sum_over_ranks(group.gather(self._measure(loop, device, group))))
            log.info(
                "%d environments: %s",
                num_envs,
                ", ".join(f"{k} {v:,.0f}" for k, v in rows[-1].items() if k.endswith("_per_s")),
            )
        return rows

    def _measure(
        self, loop: ControlLoop, device: torch.device, group: TrainingGroup
    ) -> dict[str, Any]:
        num = loop.num_envs
        still = torch.zeros(num, self.machine.num_joints, device=device)
        graphs = device.type == "cuda" and loop.world.supports_graphs
        physics = (
            capture_graph(lambda: loop.world.step(still), device).replay
            if graphs
            else lambda: loop.world.step(still)
        )
        loop.capture(self.rl.fuse)
        action = torch.zeros(num, loop.num_actions, device=device)
        steps = {"physics_env_steps_per_s": physics, "env_steps_per_s": lambda: loop.step(action)}
        if bare := getattr(loop.world, "bare_step", None):
            steps["batch_env_steps_per_s"] = bare
        # processes of one computer share its cores and power: measure at the same time
        group.wait()
        seconds = self._in_turn(steps, loop, device)
        runner_steps = int(self.rl.runner["num_steps_per_env"])
        book = TrainingLogger(
            self.session.folder,
            NoTracking().open(self.session.folder, {}),
            loop.statistics,
            num * runner_steps,
            1.0,
            lambda *_: 0.0,
        )
        runner = TrainingRunner(loop, self.rl, self.session.folder, device, book, group)
        runner.learn(1)
        _wait(device)
        group.wait()
        start = time.perf_counter()
        runner.learn(self.bench.iterations)
        _wait(device)
        train_s = (time.perf_counter() - start) / (self.bench.iterations * runner_steps)
        rates = {name: num / value for name, value in seconds.items()} | {
            "train_env_steps_per_s": num / train_s
        }
        return {
            "num_envs": num,
            **{name: rates[name] for name in RATES if name in rates},
            "graph": loop.graph_active,
        }

    def _in_turn(
        self, steps: dict[str, Callable[[], object]], loop: ControlLoop, device: torch.device
    ) -> dict[str, float]:
        """Return the seconds of one call of each, the median over at least `bench.seconds`.

        A few calls of each at a time, so that other load of the computer meets all alike. Calls
        that are no control step move arms at rest at their starts; the control loop finds its
        worlds as it left them.
        """
        rest = loop.world.state_dict()
        spent: dict[str, list[float]] = {name: [] for name in steps}
        while min(map(sum, spent.values())) < self.bench.seconds:
            for name, step in steps.items():
                running = loop.world.state_dict()
                if name != "env_steps_per_s":
                    loop.world.load_state_dict(rest)
                step()  # finds what it needs in the caches
                _wait(device)
                start = time.perf_counter()
                for _ in range(CALLS):
                    step()
                _wait(device)
                spent[name].append(time.perf_counter() - start)
                if name != "env_steps_per_s":
                    loop.world.load_state_dict(running)
        return {name: median(values) / CALLS for name, values in spent.items()}


def _describe_device(device: torch.device, group: TrainingGroup) -> dict[str, Any]:
    name = f"cpu, {torch.get_num_threads()} threads"
    if device.type == "cuda":
        name = torch.cuda.get_device_name(device)
    return {"device": name, "ranks": group.rank.count}


def _sum_over_ranks(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the row of all processes: rates add up; `per_rank` holds the rates of each."""
    if len(rows) == 1:
        return rows[0]
    rates = []
    for name in rows[0]:
        if name.endswith("_per_s"):
            rates.append(name)
    per_rank = []
    for row in rows:
        per_rank.append({name: row[name] for name in rates})
    return (
        rows[0]
        | {name: sum(row[name] for row in rows) for name in rates}
        | {"ranks": len(rows), "per_rank": per_rank}
    )


def _read_single_process(sizes: BenchmarkSizes) -> dict[int, dict[str, Any]]:
    """Return the rows of the one process that is compared with, by number of environments."""
    if sizes.against is None:
        return {}
    try:
        found = json.loads(Path(sizes.against).read_text())
        rows = {row["num_envs"]: row for row in found["rows"]}
    except (OSError, ValueError, KeyError) as error:
        raise ConfigError(
            f"bench.against: {sizes.against} is no benchmark.json ({error!r})"
        ) from error
    missing = [num for num in sizes.num_envs if num not in rows]
    if found.get("ranks") != 1 or missing:
        raise ConfigError(
            f"bench.against: expected {sizes.against} to be of one process, with rows for "
            f"{list(sizes.num_envs)} environments, "
            f"got {found.get('ranks')} processes and {sorted(rows)}"
        )
    return rows


def _add_comparisons(row: dict[str, Any], alone: dict[str, Any] | None) -> dict[str, Any]:
    """Return the row with its rates relative to MuJoCo's own batch and to a single process."""
    if batch := row.get("batch_env_steps_per_s"):
        row = row | {"of_batch": {name: row[name] / batch for name in RATES[1:]}}
    if alone is None:
        return row
    ranks = row.get("ranks", 1)
    return row | {
        "weak_scaling": {
            name: row[name] / (ranks * alone[name])
            for name in RATES
            if name in row and name in alone
        }
    }


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def _print(rows: list[dict[str, Any]]) -> None:
    names = [name for name in RATES if name in rows[0]]
    heads: dict[str, str] = dict(
        zip(
            RATES,
            ("mujoco.batch alone /s", "physics /s", "control step /s", "training /s"),
            strict=True,
        )
    )
    cells = []
    for row in rows:
        texts = []
        for name in names:
            shares = []
            for kind in ("of_batch", "weak_scaling"):
                if name in row.get(kind, {}):
                    shares.append(row[kind][name])
            texts.append(" ".join([f"{row[name]:,.0f}", *(f"({share:.2f})" for share in shares)]))
        cells.append([f"{row['num_envs']:,}", *texts, "yes" if row["graph"] else "no"])
    notes = {
        "of_batch": "of mujoco.batch alone",
        "weak_scaling": "of one process times their number",
    }
    told = []
    for kind, text in notes.items():
        if kind in rows[0]:
            told.append(text)
    headings = ["environments", *(heads[name] for name in names), "CUDA graph"]
    caption = f"In brackets: rate {'; '.join(told)}." if told else None
    print_table(headings, cells, caption=caption)
