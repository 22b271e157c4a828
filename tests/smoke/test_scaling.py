"""Several processes and many jobs, as a person starts them: torchrun, local and Slurm sweeps, Optuna."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib import util
from pathlib import Path
from typing import Any

import hydra
import pytest
import torch
from conftest import Brokk
from omegaconf import OmegaConf

pytestmark = pytest.mark.slow

BIN = Path(sys.executable).parent
TORCHRUN = (str(BIN / "torchrun"), "--standalone", "--nproc-per-node=2")
SMALL = (
    "session.device=cpu", "sim=native", "sim.num_worlds=16", "sim.num_threads=1", "actuator=lag", "rl.num_starts=32",
    "rl.save_interval=2", "rl.runner.actor.obs_normalization=true", "rl.runner.critic.obs_normalization=true",
    "rl.runner.actor.hidden_dims=[16]", "rl.runner.critic.hidden_dims=[16]", "evaluation.episodes=2",
    "evaluation.num_recorded=1", "evaluation.video=false",
)  # fmt: skip
BENCH = (
    "mode=bench", "session.device=cpu", "sim=native", "sim.num_threads=1", "actuator=lag", "rl.num_starts=16",
    "bench.num_envs=[4]", "bench.seconds=0.05", "bench.iterations=1",
)  # fmt: skip


def started(
    folder: Path, *arguments: str, code: int = 0, **environment: str
) -> subprocess.CompletedProcess[str]:
    """Runs a command to its end, which is to be this exit code."""
    done = subprocess.run(
        arguments,
        cwd=folder,
        env=os.environ | {"OMP_NUM_THREADS": "1"} | environment,
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert done.returncode == code, done.stderr
    return done


def together(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Runs the command in two processes."""
    return started(folder, *TORCHRUN, str(BIN / "brokk"), *arguments)


def read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two processes: four iterations, checkpoints after the first, third and fourth."""
    folder = tmp_path_factory.mktemp("together")
    done = together(folder, "mode=train", "session.out=run", "rl.budget.max_env_steps=3072", *SMALL)
    assert done.stderr.count("evaluating trained") == 1, "the others are quiet"
    return folder / "run"


def test_two_processes_train_one_policy_and_one_writes(run: Path) -> None:
    assert [path.name for path in run.parent.iterdir()] == ["run"]
    rows = (run / "progress.csv").read_text().splitlines()[1:]
    steps_of_both = [float(row.split(",")[1]) for row in rows]
    assert steps_of_both == [768.0, 1536.0, 2304.0, 3072.0]
    assert read(run / "session.json")["outcome"] == "finished" and (run / "policy.onnx").exists()


def test_the_processes_see_different_worlds(run: Path) -> None:
    content = torch.load(run / "model_4.pt", weights_only=True)
    first, second = (one["env"]["tensors"]["history.q"] for one in (content, content["others"][0]))
    assert first.shape == second.shape and not torch.equal(first, second)


def test_two_processes_that_were_stopped_go_on_exactly(run: Path) -> None:
    arguments = ("mode=train", "session.out=parts", *SMALL)
    first, second = "rl.budget.max_env_steps=2304", "rl.budget.max_env_steps=3072"
    for words in ((first,), (second, "policy=parts")):
        together(run.parent, *arguments, *words)
    paths = [folder / "model_4.pt" for folder in (run, run.parent / "parts")]
    whole, parts = (torch.load(path, weights_only=True) for path in paths)
    for network in ("actor_state_dict", "critic_state_dict"):
        torch.testing.assert_close(dict(whole[network]), dict(parts[network]), rtol=0.0, atol=0.0)


DIFFER = """
import sys, torch
from brokk_rl.errors import DistributedError
from brokk_rl.rl.group import TrainingGroup
try:
    with TrainingGroup(torch.device("cpu")) as group:
        group.check_same({"weight": torch.ones(3)})
        group.check_same({"weight": torch.ones(3) + 1e-7 * group.rank.index})
except DistributedError as error:
    assert "rank 1" in str(error), error
    sys.exit(7)
"""


def test_processes_that_no_longer_agree_stop(tmp_path: Path) -> None:
    (tmp_path / "differ.py").write_text(DIFFER)
    done = started(tmp_path, *TORCHRUN, "differ.py", code=1)
    assert "exitcode  : 7" in done.stderr


LEARN = """
import copy, sys, torch
from test_rl_ppo import _algorithm, _learn, _roll_out
from brokk_rl import distributed
from brokk_rl.rl.group import TrainingGroup
from brokk_rl.rl.ppo import DevicePPO
from brokk_rl.rl.rollout import CapturedRollout
from rsl_rl.algorithms import PPO
name = sys.argv[1] if sys.argv[1] == "cpu" else f"cuda:{distributed.read_rank().local}"
with TrainingGroup(torch.device(name)) as group:
    device, index = str(group.device), group.rank.index
    numbers = {"global_rank": index, "local_rank": group.rank.local, "world_size": group.rank.count}
    for changes in ({}, {"schedule": "fixed"}, {"normalize_advantage_per_mini_batch": True}):
        ours, theirs = (_algorithm(kind, device, multi_gpu_cfg=numbers, **changes) for kind in (DevicePPO, PPO))
        alone, rates = _algorithm(DevicePPO, device, **changes), []
        for seed in range(4):
            last = _roll_out(ours, 10 * seed + index)  # each process has steps of its own
            theirs.load(copy.deepcopy(ours.save()), None, strict=True)
            for other in (theirs, alone):
                other.storage = copy.deepcopy(ours.storage)
            alone._rollout = CapturedRollout(alone)  # it takes no steps of its own
            for algorithm in (ours, theirs, alone):
                _learn(algorithm, seed, last)
            rates.append(ours.learning_rate)
            assert abs(ours.learning_rate / theirs.learning_rate - 1.0) < 1e-5
        assert (len(set(rates)) > 1) is (changes.get("schedule") != "fixed"), rates
        for part in ("actor", "critic"):
            mine, other, single = (getattr(algorithm, part).state_dict() for algorithm in (ours, theirs, alone))
            for name in other:
                torch.testing.assert_close(mine[name], other[name], rtol=1e-3, atol=1e-5)
            group.check_same(mine)
            assert any(not torch.allclose(mine[name], single[name], rtol=1e-2, atol=1e-4) for name in mine)
"""


def _learn_together(folder: Path, device: str) -> None:
    (folder / "learn.py").write_text(LEARN)
    tests = Path(__file__).parents[1]
    paths = os.pathsep.join(map(str, (tests.parent, tests, tests / "unit")))
    started(folder, *TORCHRUN, "learn.py", device, PYTHONPATH=paths)


def test_two_processes_learn_together_what_rsl_rls_own_learn(tmp_path: Path) -> None:
    """The parts of the update that a GPU captures, with gloo between them, against rsl-rl's own way over several processes."""
    _learn_together(tmp_path, "cpu")


@pytest.mark.gpu
@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs")
def test_two_gpus_learn_together_what_rsl_rls_own_learn(tmp_path: Path) -> None:
    _learn_together(tmp_path, "cuda")


def test_the_bench_adds_up_what_two_processes_reach(tmp_path: Path) -> None:
    together(tmp_path, *BENCH, "session.out=run")
    found = read(tmp_path / "run" / "benchmark.json")
    rates = [rank["train_env_steps_per_s"] for rank in found["per_rank"]]
    assert found["ranks"] == len(rates) == 2
    assert found["train_env_steps_per_s"] == pytest.approx(sum(rates))


def test_a_local_sweep_run_again_does_only_what_is_missing(tmp_path: Path) -> None:
    words = ("-m", *BENCH, "hydra/launcher=submitit_local", "session.seed=0,1", "session.out=sweep")

    def sweep() -> None:
        started(tmp_path, str(BIN / "brokk"), *words, BROKK_PLACES="cpu,cpu")

    sweep()
    jobs = sorted(path.parent for path in (tmp_path / "sweep").glob("[01]*/session.json"))
    before = [read(job / "session.json") for job in jobs]
    assert [record["outcome"] for record in before] == ["finished"] * 2
    assert before[0]["pid"] != before[1]["pid"]
    (jobs[1] / "session.json").write_text(json.dumps(before[1] | {"outcome": "interrupted"}))
    sweep()
    first, second = (read(job / "session.json") for job in jobs)
    assert first == before[0] and second["outcome"] == "finished"
    assert len(second["resumed"]) == 1


SBATCH = '#!/bin/sh\ncp "$1" "$KEPT"\necho "no cluster here" >&2\nexit 1\n'
ASKED = {
    "--gpus-per-node=1", "--cpus-per-task=8", "--time=240", "--partition=gpu", "--array=0-2%3", "--nodes=1",
}  # fmt: skip


def test_a_sweep_for_slurm_asks_for_a_gpu_for_each_job(tmp_path: Path) -> None:
    """A dry run: an sbatch that keeps its script and refuses it."""
    (tmp_path / "bin").mkdir()
    for name, text in (("sbatch", SBATCH), ("srun", "#!/bin/sh\n")):
        (tmp_path / "bin" / name).write_text(text)
        (tmp_path / "bin" / name).chmod(0o755)
    slurm = ("hydra/launcher=submitit_slurm", "hydra.launcher.partition=gpu")
    path = f"{tmp_path / 'bin'}:{os.environ['PATH']}"
    words = ("-m", *BENCH, *slurm, "session.seed=0,1,2", "session.out=sweep")
    started(tmp_path, str(BIN / "brokk"), *words, code=1, PATH=path, KEPT=str(tmp_path / "kept.sh"))
    script = (tmp_path / "kept.sh").read_text()
    lines = {line.removeprefix("#SBATCH ") for line in script.splitlines()}
    assert lines >= ASKED
    assert "srun" in script and "submitit.core._submit" in script


HAS_OPTUNA = util.find_spec("optuna") is not None


@pytest.mark.skipif(not HAS_OPTUNA, reason="needs the extra: pip install 'brokk-rl[optuna]'")
def test_optuna_chooses_values_and_run_again_repeats_nothing(tmp_path: Path) -> None:
    search = (
        str(BIN / "brokk"), "search=learning_rate", "hydra/launcher=basic", "hydra.sweeper.n_trials=2", "hydra.sweeper.n_jobs=1",
        "rl.budget.max_env_steps=384", "session.out=sweep", *SMALL,
    )  # fmt: skip
    for _ in range(2):
        done = started(tmp_path, *search)
        best = OmegaConf.load(tmp_path / "sweep" / "optimization_results.yaml")
        records = [read(tmp_path / "sweep" / str(job) / "session.json") for job in range(2)]
        assert best.best_value == max(record["objective"] for record in records)
        assert all("resumed" not in record for record in records)
    assert done.stderr.count("is done already") == 2


def test_a_search_without_optuna_says_what_to_install(
    brokk: Brokk, monkeypatch: pytest.MonkeyPatch
) -> None:
    if HAS_OPTUNA:
        with hydra.initialize_config_module("conf", version_base="1.3"):
            assert hydra.compose("config", overrides=["search=learning_rate"])
        return
    done = brokk("search=learning_rate", code=2)
    assert "brokk-rl[optuna]" in done.err
