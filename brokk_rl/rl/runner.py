"""rsl-rl's on-policy runner with exact resume, atomic checkpoints and a budget."""

from __future__ import annotations

import contextlib
import io
import logging
import math
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from rsl_rl.runners import OnPolicyRunner

from brokk_rl.errors import CheckpointError, ConfigError, StorageError
from brokk_rl.rl.exploration import CappedGaussian
from brokk_rl.rl.learning_curve import find_plateau
from brokk_rl.rl.logger import TrainingLogger
from brokk_rl.rl.policy import TrainedPolicy, scale_output
from brokk_rl.rl.ppo import DevicePPO
from brokk_rl.rl.settings import TrainingConfig
from brokk_rl.rl.training_group import TrainingGroup
from brokk_rl.rl.vec_env import ControlLoop
from brokk_rl.task_description import TaskDescription

log = logging.getLogger(__name__)

ITERATIONS_PER_ROUND = 10
"""Iterations between two changes of the desired divergence, at most."""
ROUNDS_OF_ANNEAL = 10
"""Changes over the end that a plateau begins, at least: a short end is followed too."""

NUM_ANSWERS = 256
"""Observations at most, of as many environments, that a checkpoint holds with the network's own
commands. Chosen by hand: many phases of an episode, and 150 kB."""


class TrainingRunner(OnPolicyRunner):
    """Runner of a training; see `TrainingConfig`.

    rsl-rl's own checkpoint lacks the environment, the random generators and the step count. This
    one holds all of them: a resumed run on a CPU goes on bit for bit. It is read with
    `weights_only=True`, so that a checkpoint from a stranger cannot run code. Of several processes
    the first writes it, including the state of the others.

    Args:
        env: The control loop; a checkpoint of another machine than its own is refused.
        training: Configuration.
        folder: Checkpoints go here.
        device: Where the networks live.
        logger: Takes the place of rsl-rl's logger.
        group: The processes that train together, entered; `None` for a single process.
    """

    env: ControlLoop

    def __init__(
        self,
        env: ControlLoop,
        training: TrainingConfig,
        folder: Path,
        device: torch.device,
        logger: TrainingLogger,
        group: TrainingGroup | None = None,
    ) -> None:
        self.group = group or TrainingGroup(device)
        _require_groups(
            training.runner["obs_groups"], list(map(str, env.get_observations().keys()))
        )
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):  # rsl-rl prints its networks
            super().__init__(env, training.runner_config(), log_dir=None, device=str(device))
        log.debug(printed.getvalue())
        self.training, self.folder = training, folder
        self.logger = logger  # type: ignore[assignment]
        if isinstance(self.alg, DevicePPO):
            self.alg.fuse = training.fuse
        if training.symmetry and isinstance(self.alg, DevicePPO):
            env.task.require("mirror", "give rl.symmetry=false")
            self.alg.use_mirror(env.task.mirror())
        self._levelled_at: int | None = None
        """Control steps after which success no longer grew; found anew after a resume."""
        scale_output(self.alg.actor, training.output_gain)
        if training.teacher and isinstance(self.alg, DevicePPO):
            self.alg.follow(TrainedPolicy(folder=training.teacher.folder).build(env, 0).actor)

    def run(self, until: Callable[[], bool] = lambda: False) -> None:
        """Train until the budget is spent; save a checkpoint every `save_interval`.

        Args:
            until: Asked after each round; training ends early where it returns true.
        """
        steps = self.cfg["num_steps_per_env"] * self.env.num_envs * self.gpu_world_size
        first = self.current_learning_iteration == 0
        while num := self.group.broadcast_first(self._count_iterations(steps)):
            begins_round = self.current_learning_iteration % self._count_round(steps) == 0
            if self.group.broadcast_first(begins_round):
                share = self.group.broadcast_first(self._measure_share())
                self.alg.desired_kl = self.training.divergence(share)  # type: ignore[assignment]
                self._follow_schedules(share)
            with contextlib.redirect_stdout(io.StringIO()):
                self.learn(
                    num, init_at_random_ep_len=first and self.training.random_episode_lengths
                )
            first = False
            # `learn` leaves the index of the last iteration; the next one is another
            self.current_learning_iteration += 1
            enough = self.group.broadcast_first(until())
            over = enough or self.group.broadcast_first(self._count_iterations(steps)) == 0
            if over or self.current_learning_iteration % self.training.save_interval == 0:
                self.group.check_same(self._policy_state())
                self.checkpoint()
            if enough:
                break

    def _follow_schedules(self, share_spent: float) -> None:
        """Set the cap of the exploration noise and the teacher's weight, where there are any."""
        distribution, teacher = self.alg.actor.distribution, self.training.teacher
        if self.training.exploration and isinstance(distribution, CappedGaussian):
            distribution.set_cap(self.training.exploration.cap_at(share_spent))
        if teacher and isinstance(self.alg, DevicePPO):
            self.alg.set_imitation(teacher.weight_at(share_spent))

    def _count_round(self, steps: int) -> int:
        """Return the iterations between two changes of `desired_kl`: fewer in a short end.

        Args:
            steps: Control steps of one iteration.
        """
        if self.training.plateau is None or self._levelled_at is None:
            return ITERATIONS_PER_ROUND
        anneal = self._levelled_at * self.training.plateau.anneal / steps
        return min(ITERATIONS_PER_ROUND, max(1, int(anneal / ROUNDS_OF_ANNEAL)))

    def _measure_share(self) -> float:
        """Return the spent share of the training; its end begins with a plateau."""
        training, book = self.training, self._book
        share = training.budget.share_spent(book.env_steps, book.seconds)
        if training.plateau and self._levelled_at is None:
            # rows of whole rounds: how often a checkpoint is written must not change training
            whole = len(book.rows) - len(book.rows) % ITERATIONS_PER_ROUND
            row = find_plateau(book.rows[:whole], training.plateau)
            if row is not None:
                self._levelled_at = int(float(row["env_steps"]))
                log.info("success no longer grows after %d control steps", self._levelled_at)
        if training.plateau is None or self._levelled_at is None:
            return share
        done = (book.env_steps / self._levelled_at - 1.0) / training.plateau.anneal
        return max(share, 1.0 - training.settling * (1.0 - done))

    @property
    def _book(self) -> TrainingLogger:
        return self.logger  # type: ignore[return-value]

    def _count_iterations(self, steps: int) -> int:
        """Return the number of iterations until the next checkpoint or change of `desired_kl`.

        0 when the budget is spent.

        Args:
            steps: Control steps of one iteration.
        """
        book = self._book
        budget, interval = self.training.budget, self.training.save_interval
        if self._measure_share() >= 1.0:
            return 0
        num = min(
            part - self.current_learning_iteration % part
            for part in (self._count_round(steps), interval)
        )
        ends = [budget.max_env_steps] if budget.max_env_steps else []
        if self.training.plateau and self._levelled_at is not None:
            ends.append(math.ceil(self._levelled_at * (1.0 + self.training.plateau.anneal)))
        for end in ends:
            num = min(num, max(1, -(-(end - book.env_steps) // steps)))
        if budget.max_seconds:
            # the first round is short and shows how long one takes
            left = (
                (budget.max_seconds - book.seconds) * book.env_steps / book.seconds / steps
                if book.env_steps
                else 1
            )
            num = min(num, max(1, round(left)))
        return num

    def _policy_state(self) -> dict[str, torch.Tensor]:
        """Return parameters and normalisers of actor and critic by name."""
        models = {"actor": self.alg.actor, "critic": self.alg.critic}
        state = {}
        for part, model in models.items():
            for name, value in model.state_dict().items():
                state[f"{part}.{name}"] = value
        return state

    def _configure_multi_gpu(self) -> None:
        """Tell rsl-rl of the processes of `group`.

        rsl-rl's own way knows NCCL only and never ends the process group.
        """
        rank = self.group.rank
        self.gpu_world_size, self.gpu_global_rank, self.gpu_local_rank = (
            rank.count,
            rank.index,
            rank.local,
        )
        self.is_distributed = self.group.together
        numbers = {"global_rank": rank.index, "local_rank": rank.local, "world_size": rank.count}
        self.cfg["multi_gpu"] = numbers if self.is_distributed else None

    def learn(self, num_learning_iterations: int, init_at_random_ep_len: bool = False) -> None:
        """Train for some iterations; see `rsl_rl.runners.OnPolicyRunner`."""
        with allow_tensor_cores(self.training.tf32 and self.env.graph_active):
            super().learn(num_learning_iterations, init_at_random_ep_len)

    def checkpoint(self) -> None:
        """Write a checkpoint in one step; drop the oldest beyond `keep_checkpoints`.

        It holds all that is needed to go on exactly.

        Raises:
            StorageError: The disk is full or the folder cannot be written; older checkpoints are
                untouched.
        """
        own = {"env": self.env.state_dict(), "random": get_random_state(self.device)}
        parts = self.group.gather_on_first(own)
        if not self.group.rank.first:
            return
        self._book.flush()
        content = self.alg.save() | {
            "iter": self.current_learning_iteration,
            "learning_rate": self.alg.learning_rate,
            "desired_kl": self.alg.desired_kl,
            **own,
            "others": parts[1:],
            "book": self._book.state_dict(),
            "fingerprint": self.env.machine.fingerprint(),
            "task": self.env.description.to_json(),
            "network": self.training.describe_network(),
            "answers": self.record_answers(),
        }
        path = self.folder / f"model_{self.current_learning_iteration}.pt"
        part = path.with_suffix(".part")
        try:
            torch.save(content, part)
            with part.open("rb") as file:
                os.fsync(file.fileno())
            part.replace(path)
        except (
            OSError,
            RuntimeError,
        ) as error:  # torch's writer reports a full disk as a RuntimeError
            part.unlink(missing_ok=True)
            raise StorageError(
                f"cannot write the checkpoint {path}: {error}. The checkpoint before it is "
                "untouched; make room and resume."
            ) from error
        for old in list_checkpoints(self.folder)[: -self.training.keep_checkpoints]:
            old.unlink()

    def record_answers(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return observations of running episodes and the network's own commands for them.

        An export is compared with them; see `ControlLoop.record_answers`.
        """
        return self.env.record_answers(self.alg.get_policy(), NUM_ANSWERS)

    def save(self, path: str, infos: dict | None = None) -> None:
        """Do nothing: rsl-rl would save within an iteration; `checkpoint` follows every `learn`."""

    def load(
        self,
        path: str,
        load_cfg: dict | None = None,
        strict: bool = True,
        map_location: str | None = None,
    ) -> dict:
        """Restore a checkpoint so that training goes on exactly.

        Raises:
            CheckpointError: The file is missing, corrupt, holds NaN or belongs to another machine
                or configuration.
        """
        content = read_checkpoint(Path(path), self.device)
        self.env.machine.check_fingerprint(content.get("fingerprint", {}), path)
        self._check_task(content, path)
        try:
            self.alg.load(content, None, strict=True)
            own = [content, *content.get("others", [])][self.group.rank.index :][:1]
            # Empty where more processes continue than were stopped: the new ones start afresh.
            for part in own:
                self.env.load_state_dict(part["env"])
                set_random_state(part["random"], self.device)
            self.alg.learning_rate = content["learning_rate"]
            self.alg.desired_kl = content["desired_kl"]
            self.current_learning_iteration = content["iter"]
            self._book.load_state_dict(content["book"])  # last: it rewrites progress.csv
        except (KeyError, RuntimeError) as error:
            raise CheckpointError(
                f"{path} does not fit this configuration: {str(error).splitlines()[0]}. "
                "Resume with the run's own resolved.yaml."
            ) from error
        return {}

    def _check_task(self, content: dict[str, Any], path: str) -> None:
        """Refuse a checkpoint of a training for another task; the message names what differs."""
        if "task" not in content:
            log.warning("%s does not say which task it trains; assumed: the one given", path)
            return
        own, here = TaskDescription.from_json(content["task"], path), self.env.description
        differences = own.compare(here)
        if own.name != here.name:
            differences = {"": (own.name, here.name)}
        if differences:
            values = []
            for key, (there, given) in differences.items():
                name = f"task.{key}" if key else "task"
                values.append(f"{name} is {there} there, {given} here")
            raise CheckpointError(
                f"{path} belongs to a training for another task: {'; '.join(values)}. Resume with "
                "the run's own resolved.yaml: brokk --config-dir <run> --config-name resolved "
                "resume=<run> session.out=<run>"
            )


@contextlib.contextmanager
def allow_tensor_cores(allowed: bool) -> Iterator[None]:
    """Let matrix products use TF32 inside of this context.

    Only where the control step is a captured graph, whose kernels were chosen before: ten bits of
    mantissa are enough for a network, but would put the tool of a 5 m arm millimetres off.
    """
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high" if allowed else before)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def list_checkpoints(folder: Path) -> list[Path]:
    """Return the checkpoints of a run folder, oldest first."""
    return sorted(folder.glob("model_*.pt"), key=lambda path: int(path.stem.removeprefix("model_")))


def read_checkpoint(path: Path, device: torch.device | str) -> dict[str, Any]:
    """Read a checkpoint without running code from it.

    Raises:
        CheckpointError: The file is missing or corrupt, or a weight is NaN.
    """
    try:
        content = torch.load(path, weights_only=True, map_location=device)
        states = [content["actor_state_dict"], content["critic_state_dict"]]
    except FileNotFoundError as error:
        raise CheckpointError(f"there is no checkpoint {path}") from error
    except Exception as error:  # torch raises many kinds: pickle, zip, runtime, end of file
        raise CheckpointError(
            f"{path} is corrupt or not a checkpoint of ours ({type(error).__name__}); take an "
            "older one"
        ) from error
    bad: list[str] = []
    for state in states:
        for name, value in state.items():
            if not torch.isfinite(value).all():
                bad.append(name)
    if bad:
        raise CheckpointError(
            f"{path} holds NaN or infinite weights in {', '.join(bad[:3])}; take an older "
            "checkpoint"
        )
    return content


def get_random_state(device: torch.device | str) -> dict[str, torch.Tensor]:
    """Return the state of torch's generators on the CPU and on `device`."""
    state = {"cpu": torch.get_rng_state()}
    if torch.device(device).type == "cuda":
        state["cuda"] = torch.cuda.get_rng_state(device)
    return state


def set_random_state(state: dict[str, torch.Tensor], device: torch.device | str) -> None:
    """Restore generators that `get_random_state` read."""
    torch.set_rng_state(state["cpu"].cpu())
    if torch.device(device).type == "cuda" and "cuda" in state:
        torch.cuda.set_rng_state(state["cuda"].cpu(), device)


def _require_groups(asked: Mapping[str, Sequence[str]], offered: Collection[str]) -> None:
    """Raise a `ConfigError` where a network wants observations that the task does not give."""
    for network, names in asked.items():
        missing = [name for name in names if name not in offered]
        if missing:
            raise ConfigError(
                f"rl.runner.obs_groups.{network}: the task gives no group {', '.join(missing)}; "
                f"it gives {', '.join(sorted(offered))}: rl.runner.obs_groups.{network}=[policy]"
            )
